"""Compressed data that claim one size and have another: no more is inflated than is needed."""

import gzip
import io
import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import zstandard
from PIL import Image

from touchdown.sim.files.inflating import MAX_TEXT_BYTES, check_png, gunzipped, inflated_chunk

from support.hostile_files import png

BOMB, LITTLE = 1 << 25, 1 << 23


@pytest.fixture
def _little_memory() -> Iterator[None]:
    tracemalloc.start()
    yield
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < LITTLE


LAST_ROW = bytes(2 * 4 + 7 + 2 * 7 + 2 * 13 + 4 * 13 + 3 * 25)
"""rows of the passes of 8 x 8 interlaced pixels up to the last"""
BOMBS = {
    "pixels": (png(8, 8, inflated=BOMB), "inflates to more than its size in pixels needs"),
    "grey": (png(8, 8, 1, 0, inflated=17), "inflates to more"),
    "text": (png(8, 8, inflated=200, text=bytes(MAX_TEXT_BYTES)), "512 KiB of texts and profiles"),
    "size": (png(1000, 2000), "has 1000 x 2000 pixels, more than 1000000"),
    "checksum": (png(8, 8, inflated=200).replace(b"IEND\xae", b"IEND\xad"), "have its checksum"),
    "short": (png(8, 8, inflated=200)[:-20], "ends too early"),
    "filter": (png(8, 8, data=bytes(175) + b"\5"), "has a row with an unknown filter"),
    "kind": (png(8, 8, methods=(0, 1, 0)), "is of a kind that PNG does not have"),
    "bits": (png(8, 8, 4), "is of a kind that PNG does not have"),
    "pass": (png(8, 8, methods=(0, 0, 1), data=LAST_ROW + b"\5"), "a row with an unknown filter"),
    "rows": (png(8, 8, inflated=199), "does not hold all of its rows"),
    "narrow": (png(1, 10**6, data=bytes(10**6) + b"\5"), "has a row with an unknown filter"),
    "none": (b"GIF", "is no PNG file"),
}


CHUNKS = [
    zstandard.ZstdCompressor(write_content_size=stated).compress(bytes(BOMB))
    for stated in (False, True)
]
GZIP = gzip.compress(bytes(BOMB))


@pytest.mark.usefixtures("_little_memory")
@pytest.mark.parametrize("kind", BOMBS)
def test_png_files_that_are_refused(kind: str) -> None:
    data, message = BOMBS[kind]
    with pytest.raises(ValueError, match=message):
        check_png(io.BytesIO(data), 1_000_000)


def test_png_files_of_every_kind_pass() -> None:
    rng = np.random.default_rng(0)
    for shape in ((3, 5, 3), (33, 17, 4), (40, 60), (1, 1, 3)):
        for kind in (np.uint8, np.uint16):
            image = rng.integers(0, np.iinfo(kind).max, shape).astype(kind)
            check_png(io.BytesIO(cv2.imencode(".png", image)[1].tobytes()), 10_000)
    check_png(io.BytesIO(png(8, 8, methods=(0, 0, 1), data=LAST_ROW + bytes(25))), 10_000)
    for colours in (2, 16, 256):
        file = io.BytesIO()
        grey = Image.fromarray(rng.integers(0, 255, (31, 19), np.uint8))
        grey.quantize(colours).save(file, "png")
        check_png(io.BytesIO(file.getvalue()), 10_000)


@pytest.mark.usefixtures("_little_memory")
def test_no_more_of_a_chunk_is_inflated_than_it_states() -> None:
    for packed in CHUNKS:
        with pytest.raises(ValueError, match="does not inflate to the size that it states"):
            inflated_chunk(packed, "zstd", 10)
    with pytest.raises(ValueError, match="compressed by 'lz4', not by zstd"):
        inflated_chunk(b"", "lz4", 10)


def test_a_sound_chunk_is_inflated() -> None:
    data = np.random.default_rng(0).bytes(3_000_000)
    assert inflated_chunk(zstandard.compress(data), "zstd", len(data)) == data
    assert inflated_chunk(data, "", len(data)) == data


@pytest.mark.usefixtures("_little_memory")
def test_of_a_gzip_file_one_byte_more_than_allowed_is_read(tmp_path: Path) -> None:
    (tmp_path / "a.gz").write_bytes(GZIP)
    assert gunzipped(tmp_path / "a.gz", 1000) == bytes(1001)
