"""PNG, JPEG and GeoTIFF files with changes in their structure: sizes, types, tags, checksums."""

import struct
import warnings
import zlib
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from fuzz.mutations import MARKED, Rng, chance, damaged, pick

_SIDES = (0, 1, 2, 33, 20_000, 30_000, 65_535, 100_000, 2**31 - 1, 2**32 - 1)
_ODD: dict[str, tuple[Any, ...]] = {
    "B": (0, 1, 2, 3, 4, 6, 7, 8, 16, 255),
    "H": (0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 16, 24, 64, 119, 1024, 2263, 3072, 4326, 32_773, 32_946,
          34_887, 34_925, 50_000, 50_001, 65_535),
    "I": _SIDES,
    "d": (0.0, 1.0, -1.0, 30.0, 0.3048, 4.4e5, 1e-9, 1e9, 1e300, float("nan"), float("inf")),
}  # fmt: skip
"""By their code of `struct`: sizes, kinds of pixels, packings (LZW, JPEG, deflate, PackBits, LERC,
LZMA, ZSTD, WebP), keys of map projections and their values."""


def _poke(rng: Rng, data: bytearray, at: int, code: str) -> None:
    if at + struct.calcsize(code) <= len(data):
        struct.pack_into(code, data, at, pick(rng, _ODD[code[-1]]))


def _ground(rng: Rng, sizes: tuple[tuple[int, int], ...]) -> NDArray[np.uint8]:
    """(rows, cols, 3) noise about green."""
    image = rng.integers(60, 120, (*pick(rng, sizes), 3)).astype(np.uint8)
    image[..., 1] += 80
    return image


def png(rng: Rng, size: tuple[int, int] | None = None, changes: bool = True) -> bytes:
    """A PNG file of ground, mostly with a change in one of its chunks; ``size``: rows, columns."""
    image = _ground(rng, (size,) if size else ((32, 32), (1, 1), (40, 20), (64, 48), (5, 200)))
    if changes and chance(rng, 0.2):
        deep, alpha = image.astype(np.uint16) * 256, np.dstack([image, image[..., 0]])
        image = pick(rng, (image[..., 0], deep, deep[..., 0], alpha))
    data = bytes(cv2.imencode(".png", image)[1])
    if not changes or chance(rng, 0.3):
        return data
    chunks = _chunks(data)
    kind = int(rng.integers(5))
    if kind == 0:  # another size, type or interlacing than the pixels have, and a right checksum
        header = bytearray(chunks[0][1])
        at = int(rng.integers(7))
        _poke(rng, header, *((4 * at, ">I") if at < 2 else (6 + at, "B")))
        chunks[0] = (b"IHDR", bytes(header))
    elif kind == 1:  # a bomb: many pixels in few bytes, or more than the header says
        side = int(pick(rng, (5000, 12_000, 30_000)))
        header = struct.pack(">2I5B", side, pick(rng, (side, side, 8)), 1, 0, 0, 0, 0)
        chunks[:-1] = [(b"IHDR", header), (b"IDAT", zlib.compress(bytes(side * side >> 3), 9))]
    elif kind == 2:  # missing pixels, bad filters
        body = zlib.decompress(b"".join(body for name, body in chunks if name == b"IDAT"))
        chunks[1:-1] = [(b"IDAT", zlib.compress(damaged(rng, body)))]
    elif kind == 3:  # words that a viewer may print, and chunks that are none
        name = pick(rng, (b"tEXt", b"PLTE", b"acTL", b"eXIf", b"QQQQ"))
        chunks.insert(1, (name, pick(rng, (b"Title\0\x1b[31m[/x]<script>", b"\x01" * 9))))
    else:
        return damaged(rng, data)
    parts = (struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))
             for name, body in chunks)  # fmt: skip
    return data[:8] + b"".join(parts)


def _chunks(data: bytes) -> list[tuple[bytes, bytes]]:
    found, at = [], 8
    while at < len(data):
        size, name = struct.unpack_from(">I4s", data, at)
        found.append((name, data[at + 8 : at + 8 + size]))
        at += 12 + size
    return found


def jpeg(rng: Rng) -> bytes:
    """A JPEG file of ground, mostly damaged, with an EXIF record, or another size in its header."""
    image = _ground(rng, ((32, 32), (1, 1), (40, 24), (64, 48), (8, 200)))
    flags = [cv2.IMWRITE_JPEG_PROGRESSIVE, int(chance(rng, 0.3))]
    data = bytes(cv2.imencode(".jpg", image[..., 0] if chance(rng, 0.1) else image, flags)[1])
    exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0" + bytes(
        [pick(rng, (1, 3, 6, 8, 99)), 0, 0, 0] + [0] * 4
    )  # turns the image
    exif = exif[: int(rng.integers(6, len(exif) + 1))]
    other = bytearray(data)
    for at in (5, 7):
        start = max(data.find(b"\xff\xc0"), data.find(b"\xff\xc2"))
        struct.pack_into(">H", other, start + at, min(65_535, pick(rng, _SIDES)))
    turned = data[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + data[2:]
    return bytes(pick(rng, (data, data, damaged(rng, data), other, data + data, turned)))


_TIFF_CODES = {3: "H", 4: "I", 12: "d"}
_PROFILES: tuple[dict[str, Any], ...] = (
    {"compress": "lzw"}, {"compress": "zstd"}, {"compress": "deflate", "predictor": 3},
    {"tiled": True, "blockxsize": 16, "blockysize": 16}, {"count": 2}, {"dtype": "uint8"},
    {"dtype": "complex64"}, {"crs": "EPSG:4326"}, {"crs": "EPSG:2263"}, {"BIGTIFF": "YES"},
    {"nodata": 400.0}, {"transform": None}, {"photometric": "RGB", "count": 3, "dtype": "uint8"},
)  # fmt: skip


def geotiff(rng: Rng) -> bytes:
    """An elevation model of 120 x 120 cells of 1 m, mostly with one to three other tags."""
    from affine import Affine
    from rasterio.io import MemoryFile

    rows, cols = np.mgrid[:120, :120]
    heights = (400.0 + 0.002 * (rows - 60) ** 2 + 0.05 * cols).astype(np.float32)
    if chance(rng, 0.3):
        odd = (np.nan, np.inf, -np.inf, -9999.0, 3e38, 1e5, -32768.0, 0.0)
        heights[rng.random(heights.shape) < pick(rng, (0.01, 0.3, 0.6, 1.0))] = pick(rng, odd)
    profile = {
        "driver": "GTiff", "width": 120, "height": 120, "count": 1, "dtype": "float32",
        "transform": Affine(1, 0, 448_000, 0, -1, 4_421_000), "crs": "EPSG:32650", "nodata": -9999,
        **(pick(rng, _PROFILES) if chance(rng, 0.3) else {}),
    }  # fmt: skip
    if profile["dtype"] != "float32":
        profile["nodata"] = None
    with warnings.catch_warnings(), np.errstate(all="ignore"), MemoryFile() as memory:
        warnings.simplefilter("ignore")
        with memory.open(**profile) as dataset:
            dataset.write(np.stack([heights.astype(profile["dtype"])] * int(profile["count"])))
            if chance(rng, 0.1):
                words = [text for text in MARKED if text.isprintable()]
                dataset.update_tags(1, OFFSET=pick(rng, ("1e308", "nan")), UNITS=pick(rng, words))
        data = bytearray(memory.read())
    for _ in range(int(pick(rng, (0, 0, 1, 1, 2, 3)))):
        _change_tag(rng, data)
    return bytes(data)


def _change_tag(rng: Rng, data: bytearray) -> None:
    """Changes a value of a tag, seldom the tag itself, its type or the number of its values."""
    start = struct.unpack_from("<I", data, 4)[0]
    if data[:4] != b"II*\0" or start + 2 > len(data):
        return  # in large files they are elsewhere
    entry = start + 2 + 12 * int(rng.integers(max(1, *struct.unpack_from("<H", data, start))))
    if entry + 12 > len(data):
        return
    kind, count, value = struct.unpack_from("<HII", data, entry + 2)
    code = _TIFF_CODES.get(kind, "B")
    first = entry + 8 if count * struct.calcsize(code) <= 4 else value
    at = first + struct.calcsize(code) * int(rng.integers(max(1, min(count, 100))))
    places = ((at, f"<{code}"), (entry, "<H"), (entry + 2, "<H"), (entry + 4, "<I"))
    _poke(rng, data, *pick(rng, places[:1] * 5 + places[1:]))
