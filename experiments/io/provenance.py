"""Versions and git revision that a result states."""

from __future__ import annotations

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


def versions() -> dict[str, str]:
    names = ("touchdown", "mujoco", "numpy", "numba", "open3d-cpu", "open3d", "rerun-sdk")
    found: dict[str, str] = {}
    for name in (*names, "opencv-contrib-python-headless"):
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def git_revision() -> str | None:
    """The revision of the source tree, None for an installed package."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return None
    try:
        call = subprocess.run(
            ["git", "rev-parse", "HEAD"], cwd=root, capture_output=True, text=True, check=False
        )
    except OSError:
        return None
    return call.stdout.strip() or None
