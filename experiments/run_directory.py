"""A run directory appears at once, complete, or not at all."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from experiments.config import UsageError


def check_out_dir(out_dir: Path) -> None:
    """Raises UsageError unless ``out_dir`` is new, empty, or an earlier run to be replaced."""
    if not out_dir.exists():
        return
    if not out_dir.is_dir():
        raise UsageError(f"--out {out_dir}: is a file; name a new directory")
    if any(out_dir.iterdir()) and not (out_dir / "result.json").exists():
        raise UsageError(f"--out {out_dir}: holds something that is no run; name another directory")


@contextmanager
def run_directory(out_dir: Path) -> Iterator[Path]:
    """A directory to fill; it becomes ``out_dir``, in place of an earlier run, if all goes well."""
    partial = out_dir.with_name(f".{out_dir.name}.partial-{os.getpid()}")
    partial.mkdir(parents=True)
    try:
        yield partial
        if out_dir.exists():
            shutil.rmtree(out_dir)
        os.replace(partial, out_dir)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
