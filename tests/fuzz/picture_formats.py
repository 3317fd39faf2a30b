"""PNG, JPEG and GeoTIFF files with changes in their structure: sizes, types, tags, checksums."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fuzz.mutations import Rng, chance, flipped, pick

Image = NDArray[np.uint8]


def ground(rng: Rng, rows: int, cols: int) -> Image:
    """(rows, cols, 3) noise about green."""
    image = rng.integers(60, 120, (rows, cols, 3)).astype(np.uint8)
    image[..., 1] += 80
    return image


# ---------------------------------------------------------------------------------------------- PNG


def png(rng: Rng, size: tuple[int, int] | None = None, changes: bool = True) -> bytes:
    """A PNG file of ground, mostly with a change in one of its chunks; ``size``: rows, columns."""
    rows, cols = size or pick(rng, ((32, 32), (1, 1), (40, 20), (64, 48), (5, 200)))
    image = ground(rng, rows, cols)
    if not changes or chance(rng, 0.3):
        return _png(_header(rows, cols, 8, 2), _scanlines(image))
    kind = int(rng.integers(9))
    header, body = _header(rows, cols, 8, 2), _scanlines(image)
    if kind == 0:  # another size than there are pixels for
        sides = [rows, cols]
        sides[int(rng.integers(2))] = int(pick(rng, (0, 1, 2 * rows, 30_000, 100_000, 2**31 - 1)))
        header = _header(sides[0], sides[1], 8, 2)
    elif kind == 1:  # other types, mostly with fitting pixels
        depth, colour = pick(
            rng, ((8, 0), (16, 2), (8, 6), (16, 0), (1, 0), (8, 4), (8, 3), (3, 7))
        )
        channels = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}.get(colour, 1)
        row = 1 + (cols * channels * depth + 7) // 8
        header, body = _header(rows, cols, depth, colour), bytes(row * rows)
    elif kind == 2:  # a bomb: many pixels in few bytes
        side = int(pick(rng, (5000, 12_000, 30_000)))
        return _png(_header(side, side, 1, 0), _zeros((1 + (side + 7) // 8) * side), packed=True)
    elif kind == 3:
        body = body[: int(rng.integers(len(body)))]
    elif kind == 4:  # words that a viewer may print
        return _png(header, body, more=(b"tEXt", b"Title\0\x1b[31m[/x]<script>"))
    elif kind == 5:
        return _png(
            header, body, more=(pick(rng, (b"PLTE", b"acTL", b"eXIf", b"QQQQ")), b"\x01" * 9)
        )
    elif kind == 6:  # a bad filter in each row
        body = bytes(9 if n % (1 + 3 * cols) == 0 else b for n, b in enumerate(body[:4000]))
    elif kind == 7:  # a wrong checksum
        return flipped(rng, _png(header, body))
    else:  # interlaced, which the pixels are not
        header = header[:-1] + b"\x01"
    return _png(header, body)


def _header(rows: int, cols: int, depth: int, colour: int) -> bytes:
    return struct.pack(">2I5B", cols & 0xFFFFFFFF, rows & 0xFFFFFFFF, depth, colour, 0, 0, 0)


def _scanlines(image: Image) -> bytes:
    rows = image.reshape(len(image), -1)
    return np.column_stack([np.zeros(len(rows), np.uint8), rows]).tobytes()


def _zeros(count: int) -> bytes:
    press = zlib.compressobj(9)
    block = bytes(1 << 20)
    parts = [press.compress(block) for _ in range(count >> 20)]
    return b"".join([*parts, press.compress(bytes(count & ((1 << 20) - 1))), press.flush()])


def _png(
    header: bytes, body: bytes, *, packed: bool = False, more: tuple[bytes, bytes] | None = None
) -> bytes:
    chunks = [(b"IHDR", header), *([more] if more else [])]
    chunks += [(b"IDAT", body if packed else zlib.compress(body, 1)), (b"IEND", b"")]
    made = [
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(made)


# --------------------------------------------------------------------------------------------- JPEG


def jpeg(rng: Rng, size: tuple[int, int] | None = None, changes: bool = True) -> bytes:
    """A JPEG file of ground, mostly cut, flipped or with another size in its header."""
    import cv2

    rows, cols = size or pick(rng, ((32, 32), (1, 1), (40, 24), (64, 48), (8, 200)))
    image = ground(rng, rows, cols)
    if chance(rng, 0.1):
        image = image[..., 0]
    data = bytes(cv2.imencode(".jpg", image)[1])
    if not changes or chance(rng, 0.3):
        return data
    kind = int(rng.integers(5))
    if kind == 0:
        return data[: int(rng.integers(2, len(data)))]
    if kind == 1:
        at = data.index(b"\xff\xc0") + 5
        rows, cols = (int(pick(rng, (0, 1, 33, 20_000, 65_535))) for _ in range(2))
        return data[:at] + struct.pack(">2H", rows, cols) + data[at + 4 :]
    if kind == 2:  # an Exif header that turns the image, or is cut
        exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0"
        exif += struct.pack("<I", int(pick(rng, (1, 3, 6, 8, 99)))) + bytes(4)
        exif = exif[: int(rng.integers(6, len(exif) + 1))]
        return data[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + data[2:]
    if kind == 3:
        return data + data
    return flipped(rng, data)


# ------------------------------------------------------------------------------------------ GeoTIFF

_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 12: 8}
_CODES = {1: "B", 2: "s", 3: "H", 4: "I", 12: "d"}
_HERE = 0xFFFFFFF0
"""stands for the offset of the pixels"""
Tags = dict[int, tuple[int, Any]]


def geotiff(rng: Rng) -> bytes:
    """An elevation model of 120 x 120 cells of 1 m, mostly with one to three other tags."""
    side = 120
    rows, cols = np.mgrid[:side, :side]
    heights = (400.0 + 0.002 * (rows - 60) ** 2 + 0.05 * cols).astype("<f4")
    if chance(rng, 0.3):
        _change_heights(rng, heights)
    tags: Tags = {
        256: (4, [side]),
        257: (4, [side]),
        258: (3, [32]),
        259: (3, [1]),
        262: (3, [1]),
        273: (4, [0]),
        277: (3, [1]),
        278: (4, [side]),
        279: (4, [heights.nbytes]),
        339: (3, [3]),
        33550: (12, [1.0, 1.0, 0.0]),
        33922: (12, [0.0, 0.0, 0.0, 448_000.0, 4_421_000.0, 0.0]),
        34735: (3, [1, 1, 0, 3, 1024, 0, 1, 1, 1025, 0, 1, 1, 3072, 0, 1, 32650]),
        42113: (2, "-9999"),
    }
    for _ in range(int(pick(rng, (0, 0, 1, 1, 2, 3)))):
        _change_tag(rng, tags)
    return _tiff(tags, heights.tobytes(), big=chance(rng, 0.05))


def _change_heights(rng: Rng, heights: NDArray[np.float32]) -> None:
    odd = np.float32(pick(rng, (np.nan, np.inf, -np.inf, -9999.0, 3e38, 1e5, -32768.0, 0.0)))
    share = float(pick(rng, (0.01, 0.3, 0.6, 1.0)))
    heights[rng.random(heights.shape) < share] = odd


_SIDES = (0, 1, 2, 119, 121, 25_000, 100_000, 2**31 - 1)
_REALS = (0.0, -1.0, 1e-9, 1e9, 1e300, float("nan"), float("inf"), 30.0, 0.3048)
_PACKINGS = (0, 1, 5, 7, 8, 32773, 32946, 34887, 34925, 50000, 50001, 65535)
"""none, LZW, JPEG, deflate, PackBits, LERC, LZMA, ZSTD, WebP"""
_NEW: dict[int, Callable[[Rng], tuple[int, Any]]] = {
    256: lambda rng: (4, [int(pick(rng, _SIDES))]),
    257: lambda rng: (4, [int(pick(rng, _SIDES))]),
    258: lambda rng: (3, [int(pick(rng, (1, 8, 16, 24, 64, 128, 0)))]),
    259: lambda rng: (3, [int(pick(rng, _PACKINGS))]),
    262: lambda rng: (3, [int(pick(rng, (0, 2, 3, 5, 6, 99)))]),
    273: lambda rng: (4, [int(pick(rng, (0, 1, 2**32 - 1)))]),
    277: lambda rng: (3, [int(pick(rng, (0, 2, 3, 4, 65535)))]),
    278: lambda rng: (4, [int(pick(rng, (0, 1, 7, 2**32 - 1)))]),
    279: lambda rng: (4, [int(pick(rng, (0, 1, 2**32 - 1)))]),
    322: lambda rng: (4, [int(pick(rng, (0, 16, 100_000)))]),
    317: lambda rng: (3, [int(pick(rng, (2, 3, 9)))]),
    339: lambda rng: (3, [int(pick(rng, (1, 2, 4, 5, 6, 0)))]),
    33550: lambda rng: (12, [float(pick(rng, (1.0, *_REALS))) for _ in range(3)]),
    33922: lambda rng: (12, [float(pick(rng, (0.0, 4.4e5, *_REALS))) for _ in range(6)]),
    34264: lambda rng: (12, [float(pick(rng, (0.0, 1.0, -1.0, *_REALS))) for _ in range(16)]),
    34735: lambda rng: (3, [int(x) for x in pick(rng, _GEO_KEYS)]),
    42113: lambda rng: (2, pick(rng, ("nan", "", "x", "1e999", "400", "\x1b[31m", "-32768"))),
    42112: lambda rng: (2, pick(rng, _METADATA)),
}
_GEO_KEYS = (
    [1, 1, 0, 2, 1024, 0, 1, 2, 2048, 0, 1, 4326],
    [1, 1, 0, 2, 1024, 0, 1, 1, 3072, 0, 1, 2263],
    [1, 1, 0, 1, 3072, 0, 1, 65535],
    [1, 1, 0, 9999, 1024],
    [1, 1, 0, 2, 1024, 34737, 9, 0, 1025, 0, 1, 1],
    [],
)
_METADATA = (
    "<GDALMetadata><Item name='OFFSET' sample='0' role='offset'>1e308</Item></GDALMetadata>",
    "<GDALMetadata><Item name='SCALE' sample='0' role='scale'>nan</Item></GDALMetadata>",
    "<GDALMetadata><Item name='UNITTYPE' sample='0' role='unittype'>[/x]</Item></GDALMetadata>",
    "<GDALMetadata><Item",
    "<VRTDataset><SourceFilename>/dev/zero</SourceFilename></VRTDataset>",
)


def _change_tag(rng: Rng, tags: Tags) -> None:
    tag = int(pick(rng, _NEW))
    if chance(rng, 0.2):
        tags.pop(tag, None)
    else:
        tags[tag] = _NEW[tag](rng)


def _tiff(tags: Tags, pixels: bytes, *, big: bool = False) -> bytes:
    """Little-endian, one strip; a strip's offset of 0 becomes the true one."""
    word, entry_size, head = ("Q", 20, 16) if big else ("I", 12, 8)
    inline = 8 if big else 4
    start = head + (8 if big else 2) + entry_size * len(tags) + (8 if big else 4)
    extra, entries = b"", b""
    for tag, (kind, values) in sorted(tags.items()):
        if tag == 273 and values == [0]:
            values = [_HERE]
        data = values.encode() + b"\0" if kind == 2 else struct.pack(
            f"<{len(values)}{_CODES[kind]}", *values)  # fmt: skip
        count = len(data) // _SIZES[kind]
        if len(data) > inline:
            entries += struct.pack(f"<2H{word}{word}", tag, kind, count, start + len(extra))
            extra += data
        else:
            entries += struct.pack(f"<2H{word}", tag, kind, count) + data.ljust(inline, b"\0")
    at = start + len(extra)
    entries = entries.replace(struct.pack("<I", _HERE), struct.pack("<I", at), 1)
    if big:
        first = b"II+\0" + struct.pack("<2HQ", 8, 0, 16) + struct.pack("<Q", len(tags))
        return first + entries + bytes(8) + extra + pixels
    return b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + bytes(4) + extra + pixels
