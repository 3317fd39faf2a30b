"""Atomic creation of run directories and files."""

from __future__ import annotations

import datetime
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from touchdown.experiments.errors import UsageError, system_message


def check_out_dir(out_dir: Path) -> None:
    """Raises UsageError unless ``out_dir`` is new, empty, or an earlier run to be replaced."""
    if not out_dir.exists():
        return
    if not out_dir.is_dir():
        raise UsageError(f"--out {out_dir}: is a file; name a new directory")
    if any(out_dir.iterdir()) and not (out_dir / "result.json").exists():
        raise UsageError(f"--out {out_dir}: holds something that is no run; name another directory")


def check_log_kept(out_dir: Path, *, logs: bool, force: bool) -> None:
    """Raises UsageError where a run with a sensor log would be replaced by one without: the log may
    be what other commands count on. ``logs``: the new run writes one."""
    if force or logs:
        return
    from touchdown.experiments.io.sensor_log import FILE_NAME

    if (out_dir / FILE_NAME).is_file():
        raise UsageError(
            f"'{out_dir}' holds {FILE_NAME}, and this run would replace it without one; name "
            "another directory with --out, or give --force"
        )


@contextmanager
def run_directory(out_dir: Path) -> Iterator[Path]:
    """A directory to fill; it becomes ``out_dir``, in place of an earlier run, if all goes well.

    Raises UsageError where the machine does not let it: a full or read-only disk, no permission.
    """
    partial = out_dir.with_name(f".{out_dir.name}.partial-{os.getpid()}")
    try:
        partial.mkdir(parents=True)
        yield partial
        if out_dir.exists():
            shutil.rmtree(out_dir)
        os.replace(partial, out_dir)
    except OSError as error:
        # Of the machine, such as a full disk; whoever reads it knows ``out_dir`` alone.
        if system_message(error) is None:
            raise
        error.filename, error.filename2 = str(out_dir), None
        raise UsageError(f"--out: {system_message(error)}") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)


@contextmanager
def whole_file(out: Path) -> Iterator[Path]:
    """A file to write; it becomes ``out``, in place of an earlier one, if all goes well."""
    out.parent.mkdir(parents=True, exist_ok=True)
    partial = out.with_name(f".{out.name}.partial-{os.getpid()}")
    try:
        yield partial
        os.replace(partial, out)
    finally:
        partial.unlink(missing_ok=True)


def utc_now() -> str:
    """The current time in UTC, ISO 8601, to the second."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


def write_text(path: Path, text: str) -> None:
    """Writes a text file atomically."""
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        partial.write_text(text, encoding="utf-8")
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
