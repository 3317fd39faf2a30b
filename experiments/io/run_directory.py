"""Atomic creation of run directories and files."""

from __future__ import annotations

import contextlib
import datetime
import fcntl
import os
import re
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from touchdown.experiments.errors import UsageError, system_message
from touchdown.experiments.io.foreign import as_plain_name, read_object

_PARTIAL = re.compile(r"\..+\.(?:partial-)?(\d+)")
"""names of unfinished files and folders; the number is that of the process that writes it"""
_GRACE_S = 60.0
"""between the making of a folder and its being held"""
_KEYS_OF_RESULT = ("outcome", "scene", "seed", "estimator")


def default_out_dir(scene: str, estimator: str, seed: int, ending: str = "") -> Path:
    """``runs/SCENE-ESTIMATOR-SEED`` and ``ending``, whatever a configuration file calls the two."""
    name = f"{Path(scene).stem}-{estimator.replace(':', '.')}-{seed}{ending}"
    return Path("runs") / as_plain_name(name)


def check_out_dir(out_dir: Path) -> None:
    """Raises UsageError unless ``out_dir`` is new, empty, or an earlier run to be replaced."""
    if not out_dir.exists():
        return
    if not out_dir.is_dir():
        raise UsageError(f"--out {out_dir}: is a file; name a new directory")
    if Path.cwd().is_relative_to(out_dir.resolve()):
        raise UsageError(
            f"--out {out_dir}: is the working directory or above it, and would be replaced; name "
            "another directory"
        )
    if any(out_dir.iterdir()) and not _holds_result(out_dir):
        raise UsageError(f"--out {out_dir}: holds something that is no run; name another directory")


def _holds_result(directory: Path) -> bool:
    try:
        tree = read_object(directory / "result.json")
    except (OSError, ValueError):
        return False
    return all(key in tree for key in _KEYS_OF_RESULT)


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
    What a process that is dead left of the same directory is removed.

    Raises UsageError where the machine does not let it: a full or read-only disk, no permission.
    """
    target = out_dir.resolve()  # a link stays, and what it points to is replaced
    partial = target.with_name(f".{target.name}.partial-{os.getpid()}")
    try:
        clear_partials(target.parent, target.name)
        partial.mkdir(parents=True)
        with _held(partial):
            yield partial
            if target.exists():
                shutil.rmtree(target)
            os.replace(partial, target)
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
    clear_partials(out.parent, out.name)
    partial = out.with_name(f".{out.name}.partial-{os.getpid()}")
    try:
        yield partial
        os.replace(partial, out)
    finally:
        partial.unlink(missing_ok=True)


def clear_partials(folder: Path, name: str | None = None, *, alone: bool = False) -> None:
    """Removes the unfinished files and folders that dead processes left in ``folder``: those of
    ``name``, or all. ``alone``: nobody else writes there, and all are of dead processes."""
    for path in list(folder.iterdir()) if folder.is_dir() else []:
        found = _PARTIAL.fullmatch(path.name)
        if found is None or not (name is None or path.name.startswith(f".{name}.")):
            continue
        if not alone and _is_filled(path, int(found[1])):
            continue
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def _is_filled(path: Path, process: int) -> bool:
    """True if somebody may still write to an unfinished file or folder."""
    if _is_held(path):
        return True
    # The process may have its number from one that is dead; folders are held from the beginning.
    if process == os.getpid() or not Path("/proc", str(process)).exists():
        return False
    try:
        return not path.is_dir() or time.time() - path.stat().st_mtime < _GRACE_S
    except FileNotFoundError:
        return False


@contextmanager
def _held(folder: Path) -> Iterator[None]:
    """Marks a folder as being filled, for machines and containers that do not see this process."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        with contextlib.suppress(OSError):  # some network file systems lock no folder
            fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
        yield
    finally:
        os.close(descriptor)


def _is_held(path: Path) -> bool:
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    finally:
        os.close(descriptor)
    return False


def utc_now() -> str:
    """The current time in UTC, ISO 8601, to the second."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


def write_text(path: Path, text: str) -> None:
    """Writes a text file atomically."""
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        partial.unlink(missing_ok=True)  # it may be a link that leads elsewhere
        with partial.open("x", encoding="utf-8") as file:
            file.write(text)
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
