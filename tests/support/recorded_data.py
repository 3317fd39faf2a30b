"""Real recordings, which are never in the project: tests of them skip without."""

from pathlib import Path

import pytest

_NAME = Path("shared") / "data" / "recorded"
_FOUND = next((p / _NAME for p in Path(__file__).resolve().parents if (p / _NAME).is_dir()), None)


def recorded(name: str) -> Path:
    """The folder of a recording beside the project; skips the test where there is none."""
    if _FOUND is None or not (_FOUND / name).exists():
        pytest.skip(f"needs the recording {name}")
    return _FOUND / name
