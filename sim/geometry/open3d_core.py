"""Open3D without its viewers until somebody asks for one: they bring 600 modules of web servers and
notebooks, 26 MB and half of the time of the import."""

from __future__ import annotations

import importlib
import os
import sys
from types import ModuleType
from typing import Any

_VIEWERS = "open3d.visualization"


def load_open3d() -> Any:
    """The package ``open3d``; its ``visualization`` is imported at its first use. RuntimeError or
    ImportError as of the import."""
    if "open3d" in sys.modules:
        return importlib.import_module("open3d")  # whole, also if another thread imports it now
    # It would otherwise probe for a display when it is first imported.
    os.environ.setdefault("OPEN3D_CPU_RENDERING", "true")
    sys.modules[_VIEWERS] = ModuleType(_VIEWERS)  # found by the import, so not looked for
    try:
        package: Any = importlib.import_module("open3d")
    finally:
        del sys.modules[_VIEWERS]
    package.__getattr__ = _viewers
    return package


def _viewers(name: str) -> ModuleType:
    if name != "visualization":
        raise AttributeError(f"module 'open3d' has no attribute '{name}'")
    return importlib.import_module(_VIEWERS)
