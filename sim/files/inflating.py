"""Bounded reading of compressed data: a size that a header claims is a limit, never a fact."""

from __future__ import annotations

import gzip
import struct
import zlib
from pathlib import Path
from typing import BinaryIO

import zstandard

MAX_TEXT_BYTES = 1 << 19
"""of all texts and profiles of a PNG that may be compressed; a byte inflates to 1032 at most"""
_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_STEP = 1 << 20
_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
"""of a pixel, by the colour type of a PNG"""


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
    have their checksums, it has at most ``most_pixels``, and its data inflate to no more bytes than
    these pixels need: decoders inflate all, and print about damage what they like."""
    if file.read(len(_SIGNATURE)) != _SIGNATURE:
        raise ValueError("is no PNG file")
    kind, room, text = b"", 0, 0
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
                room = _needed(piece, most_pixels)
            elif kind == b"IDAT":
                room -= _inflated_size(inflater, piece, room)
        if struct.unpack(">I", _exactly(file, 4)) != (checksum,):
            raise ValueError("does not have its checksum")


def _exactly(file: BinaryIO, size: int) -> bytes:
    data = file.read(size)
    if len(data) < size:
        raise ValueError("ends too early")
    return data


def _needed(header: bytes, most_pixels: int) -> int:
    """Bytes of an image with a filter byte for each row; interlaced rows are at most twice as many
    and 7 more, and each may end within a byte."""
    width, height, bits, colour = struct.unpack(">IIBB", header[:10].ljust(10, b"\0"))
    if width * height > most_pixels:
        raise ValueError(f"has {width} x {height} pixels, more than {most_pixels}")
    return height * -(-width * bits * _CHANNELS.get(colour, 4) // 8) + 2 * (2 * height + 7)


def _inflated_size(inflater: zlib._Decompress, piece: bytes, room: int) -> int:
    """Bytes to which a piece inflates. Raises ValueError above ``room`` and for damaged data."""
    size = 0
    try:
        while piece and not inflater.eof:
            size += len(inflater.decompress(piece, _STEP))
            piece = inflater.unconsumed_tail
            if size > room:
                raise ValueError("inflates to more than its size in pixels needs")
    except zlib.error:
        raise ValueError("cannot be inflated") from None
    return size
