"""Split of images into training, validation and test by fixed rules on the origin of an image: it
is the same in every run and for every copy of the data."""

from __future__ import annotations

import re
from zlib import crc32

SPLITS = ("train", "val", "test")
HELD_OUT_SCENES = ("footbridge", "pools")
"""scenes of which all patches are for the test"""
_SEED_CYCLE = 5
_UC_TEST = range(64, 80)
"""test file numbers of each class of UC Merced"""
_UC_CYCLE = 8
_TEST_SHARE, _VAL_SHARE = 0.2, 0.1


def split_of_layout(scene: str, seed: int) -> str:
    """Returns the split of all patches of one seed of a scene: three seeds of five are for
    training."""
    if scene in HELD_OUT_SCENES or seed % _SEED_CYCLE == _SEED_CYCLE - 1:
        return "test"
    return "val" if seed % _SEED_CYCLE == _SEED_CYCLE - 2 else "train"


def split_of_ucmerced(file: str) -> str:
    """Returns the split by the number in a file's name: 64 to 79 are for the test, every eighth of
    the rest for validation. Raises ValueError for a name without a number."""
    number = re.search(r"(\d+)\.\w+$", file)
    if number is None:
        raise ValueError(f"'{file}' has no number, as the files of UC Merced have")
    if int(number[1]) in _UC_TEST:
        return "test"
    return "val" if int(number[1]) % _UC_CYCLE == _UC_CYCLE - 1 else "train"


def split_of_file(relative: str) -> str:
    """Returns the split by a hash of ``relative``, class folder and file name: a fifth for the
    test, a tenth for validation."""
    share = crc32(relative.encode()) / 2**32
    if share < _TEST_SHARE:
        return "test"
    return "val" if share < _TEST_SHARE + _VAL_SHARE else "train"
