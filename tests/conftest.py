"""Settings of the whole test suite, before anything is imported."""

from __future__ import annotations

import os
from typing import Any

import pytest

os.environ.setdefault("MUJOCO_GL", "egl")
# Tests share the machine with each other's processes; libraries stay on one thread.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(_name, "1")


@pytest.fixture
def torch() -> Any:
    """The module, on one thread; a test that needs it is skipped without it."""
    module: Any = pytest.importorskip("torch")
    module.set_num_threads(1)
    return module
