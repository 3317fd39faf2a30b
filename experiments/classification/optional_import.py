"""Imports of modules that need an optional library."""

from __future__ import annotations

import importlib
from typing import Any

from touchdown.experiments.errors import UsageError


def recognition(module: str) -> Any:
    """A module of the package `landing.classification`, such as ``labels``. Raises UsageError where
    it needs a library that is not installed."""
    try:
        return importlib.import_module(f"touchdown.landing.classification.{module}")
    except ImportError as error:
        missing = (error.name or "").partition(".")[0]
        if missing not in ("torch", "onnx", "onnxruntime"):
            raise
        raise UsageError(
            f"this needs {missing}: install it with pip install 'touchdown[train]'"
        ) from error
