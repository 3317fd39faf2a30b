"""Versions and git revision that a result states."""

import importlib.metadata
import math
import subprocess
from pathlib import Path
from typing import Any

import numpy as np


def plain_json(value: Any) -> Any:
    """Plain JSON: numpy scalars to Python's, NaN and infinities to null."""
    if isinstance(value, dict):
        return {key: plain_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain_json(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


DISTRIBUTION = "touchdown-sim"
"""Name by which the package is installed; it is imported as ``touchdown``."""


def versions() -> dict[str, str]:
    """Installed versions of the packages that decide a flight. OpenCV says its own: it comes in
    several packages."""
    import cv2  # a flight has loaded it

    names = ("mujoco", "numpy", "numba", "open3d-cpu", "open3d", "rerun-sdk")
    found: dict[str, str] = {"opencv": cv2.__version__}
    for name in (DISTRIBUTION, *names):
        try:
            found[name.removesuffix("-sim")] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


UNRECORDED_REMEDY = (
    "Touchdown was installed from a source without git history; fly from a git checkout, or "
    "install a wheel that was built in one"
)
"""Reason and remedy of a result without revision."""
REVISION_FILE = "git_revision.txt"
"""Beside this module in a wheel, written by ``setup.py``."""


def _built_revision() -> str | None:
    file = Path(__file__).with_name(REVISION_FILE)
    return file.read_text(encoding="utf-8").strip() or None if file.is_file() else None


DIRTY = "-dirty"
"""End of the revision of a source tree with changes that are not committed."""


def git_revision() -> str | None:
    """`revision_of` the source tree, or the revision from which the installed package was built;
    None where neither is recorded."""
    root = Path(__file__).resolve().parents[2]
    return revision_of(root) if (root / ".git").exists() else _built_revision()


def revision_of(root: Path) -> str | None:
    """The revision that is checked out in ``root``, with `DIRTY` at its end where a tracked file
    differs from it; None where git does not know it."""
    try:
        call = subprocess.run(
            ["git", "describe", "--always", f"--dirty={DIRTY}", "--abbrev=40", "--exclude=*"],
            cwd=root,
            capture_output=True,
            text=True,
            check=False,
        )
    except OSError:
        return None
    return call.stdout.strip() or None
