"""Estimates of recordings; real recordings are never in the project: tests of them skip without."""

from pathlib import Path

import numpy as np
import pytest

from touchdown.experiments.io.tum import read_tum

_NAME = Path("shared") / "data" / "recorded"
_FOUND = next((p / _NAME for p in Path(__file__).resolve().parents if (p / _NAME).is_dir()), None)


def assert_estimates_equal(whole: Path, part: Path) -> None:
    """The run ``part`` has estimates, equal to the bit, at more than a hundred times of ``whole``,
    and at no others."""
    log, own = (read_tum(run / "estimate.tum") for run in (whole, part))
    rows = np.isin(log[0], own[0])
    assert rows.sum() == len(own[0]) > 100
    for column in (1, 2):
        np.testing.assert_array_equal(log[column][rows], own[column])


def recorded(name: str) -> Path:
    """The folder of a recording beside the project; skips the test where there is none."""
    if _FOUND is None or not (_FOUND / name).exists():
        pytest.skip(f"needs the recording {name}")
    return _FOUND / name
