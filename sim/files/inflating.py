"""Bounded reading of compressed data: a size that a header claims is a limit, never a fact."""

from __future__ import annotations

import gzip
import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO, NamedTuple

import zstandard

MAX_TEXT_BYTES = 1 << 19
"""of all texts and profiles of a PNG that may be compressed; a byte inflates to 1032 at most"""
_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_STEP = 1 << 20
_KINDS: Mapping[int, tuple[int, tuple[int, ...]]] = {
    0: (1, (1, 2, 4, 8, 16)), 2: (3, (8, 16)), 3: (1, (1, 2, 4, 8)), 4: (2, (8, 16)),
    6: (4, (8, 16)),
}  # fmt: skip
"""channels of a pixel and their possible bits, by the colour type of a PNG"""
_LAST_FILTER = 4
_ADAM7 = (
    (0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2),
    (0, 1, 1, 2),
)  # fmt: skip
"""first column and row and the steps of each pass of an interlaced PNG"""


def gunzipped(path: Path, most: int) -> bytes:
    """Returns what a gzip file holds, at most ``most`` bytes of it and one more. Raises OSError,
    EOFError or zlib.error for a damaged file."""
    with gzip.open(path) as file:
        return file.read(most + 1)


def inflated_chunk(data: bytes, compression: str, size: int) -> bytes:
    """Returns the ``size`` bytes that a chunk of an MCAP file states. Raises ValueError where it
    inflates to more or fewer, and for another compression than that of a flight."""
    if compression == "zstd":
        data = zstandard.ZstdDecompressor().stream_reader(data).read(size + 1)
    elif compression:
        raise ValueError(f"a chunk is compressed by {compression[:40]!a}, not by zstd")
    if len(data) != size:
        raise ValueError("a chunk does not inflate to the size that it states")
    return data


def check_png(file: BinaryIO, most_pixels: int) -> None:
    """Reads a PNG file to its end. Raises ValueError, a predicate of "an image", unless its chunks
    have their checksums, it has at most ``most_pixels``, its data inflate to as many bytes as these
    pixels need, and each row has a known filter: decoders inflate all, and print about damage what
    they like."""
    if file.read(len(_SIGNATURE)) != _SIGNATURE:
        raise ValueError("is no PNG file")
    kind, text, done = b"", 0, 0
    passes: list[_Rows] = []
    inflater = zlib.decompressobj()
    while kind != b"IEND":
        size, kind = struct.unpack(">I4s", _exactly(file, 8))
        checksum = zlib.crc32(kind)
        text += size if kind in (b"zTXt", b"iTXt", b"iCCP") else 0
        if text > MAX_TEXT_BYTES:
            raise ValueError(f"has more than {MAX_TEXT_BYTES >> 10} KiB of texts and profiles")
        for start in range(0, size, _STEP):
            piece = _exactly(file, min(_STEP, size - start))
            checksum = zlib.crc32(piece, checksum)
            if kind == b"IHDR":
                passes = _passes(piece, most_pixels)
            elif kind == b"IDAT" and passes:
                done = _inflate_rows(inflater, piece, passes, done)
        if struct.unpack(">I", _exactly(file, 4)) != (checksum,):
            raise ValueError("does not have its checksum")
    if not passes or done < passes[-1].end:
        raise ValueError("does not hold all of its rows")


def _exactly(file: BinaryIO, size: int) -> bytes:
    data = file.read(size)
    if len(data) < size:
        raise ValueError("ends too early")
    return data


class _Rows(NamedTuple):
    """Rows of a pass of an image in the inflated data: from ``start`` to ``end``, each of ``step``
    bytes with its filter first."""

    start: int
    step: int
    end: int


def _passes(header: bytes, most_pixels: int) -> list[_Rows]:
    """The passes of an image, in order."""
    if len(header) != 13:
        raise ValueError("has a header of another size")
    width, height, bits, colour, packing, filtering, interlace = struct.unpack(">IIBBBBB", header)
    if width * height > most_pixels:
        raise ValueError(f"has {width} x {height} pixels, more than {most_pixels}")
    channels, depths = _KINDS.get(colour, (0, ()))
    if not width * height or bits not in depths or packing or filtering or interlace > 1:
        raise ValueError("is of a kind that PNG does not have")
    found, start = [], 0
    for x, y, step_x, step_y in _ADAM7 if interlace else ((0, 0, 1, 1),):
        columns, rows = -(-(width - x) // step_x), -(-(height - y) // step_y)
        if columns > 0 and rows > 0:
            step = 1 + -(-columns * bits * channels // 8)
            found.append(_Rows(start, step, start := start + rows * step))
    return found


def _inflate_rows(inflater: zlib._Decompress, piece: bytes, passes: list[_Rows], done: int) -> int:
    """Inflates a piece of the data of an image, of which ``done`` bytes came before, and returns
    the bytes so far. Raises ValueError above their size, for an unknown filter and for damage."""
    try:
        while piece and not inflater.eof:
            data = inflater.decompress(piece, _STEP)
            piece = inflater.unconsumed_tail
            if done + len(data) > passes[-1].end:
                raise ValueError("inflates to more than its size in pixels needs")
            for start, step, end in passes:
                first = start + max(-(-(done - start) // step), 0) * step
                filters = data[max(first - done, 0) : max(end - done, 0) : step]
                if first < end and filters and max(filters) > _LAST_FILTER:
                    raise ValueError("has a row with an unknown filter")
            done += len(data)
    except zlib.error:
        raise ValueError("cannot be inflated") from None
    return done
