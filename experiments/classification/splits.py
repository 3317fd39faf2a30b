"""Which images train, which stop the training, and which are kept for the test. Fixed rules: what
an image is decides, so that no run and no second copy of the data can move it."""

from __future__ import annotations

import re
from zlib import crc32

SPLITS = ("train", "val", "test")
HELD_OUT_SCENES = ("footbridge", "pools")
"""of which nothing is ever trained on"""
_SEED_CYCLE = 5
_UC_TEST = range(64, 80)
"""file numbers of each class of UC Merced"""
_UC_CYCLE = 8
_TEST_SHARE, _VAL_SHARE = 0.2, 0.1


def split_of_place(scene: str, seed: int) -> str:
    """Of all patches of a rendered place: three seeds of five train."""
    if scene in HELD_OUT_SCENES or seed % _SEED_CYCLE == _SEED_CYCLE - 1:
        return "test"
    return "val" if seed % _SEED_CYCLE == _SEED_CYCLE - 2 else "train"


def split_of_ucmerced(file: str) -> str:
    """By the number in a file's name: 64 to 79 are for the test, of the rest every eighth to stop
    the training. A name without a number raises ValueError."""
    number = re.search(r"(\d+)\.\w+$", file)
    if number is None:
        raise ValueError(f"'{file}' has no number, as the files of UC Merced have")
    if int(number[1]) in _UC_TEST:
        return "test"
    return "val" if int(number[1]) % _UC_CYCLE == _UC_CYCLE - 1 else "train"


def split_of_file(relative: str) -> str:
    """By a hash of ``relative``, class folder and file name: a fifth for the test, a tenth to stop
    the training."""
    share = crc32(relative.encode()) / 2**32
    if share < _TEST_SHARE:
        return "test"
    return "val" if share < _TEST_SHARE + _VAL_SHARE else "train"
