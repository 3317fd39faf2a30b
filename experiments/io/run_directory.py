"""Atomic creation of run directories and files. What a killed process left is removed by the next
that makes the same."""

from __future__ import annotations

import ctypes
import datetime
import os
import re
import shutil
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from touchdown.experiments.errors import UsageError, system_message
from touchdown.experiments.io.foreign import as_plain_name, read_object

_AT_FDCWD, _RENAME_EXCHANGE = -100, 2
_PARTIAL = re.compile(r"\.(?P<name>.+?)\.(?:partial-(?:(?P<host>.+)\.)?)?(?P<process>\d+)")
"""Names of unfinished files and folders: of what they become, and the machine and the process that
write them."""
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

    Raises UsageError where the machine does not let it: a full or read-only disk, no permission.
    """
    try:
        if out_dir.is_symlink():
            out_dir = out_dir.resolve()
        with _staging(out_dir) as partial:
            partial.mkdir()
            yield partial
            put_in_place(partial, out_dir)
    except OSError as error:
        # Of the machine, such as a full disk; whoever reads it knows ``out_dir`` alone.
        if system_message(error) is None:
            raise
        error.filename, error.filename2 = str(out_dir), None
        raise UsageError(f"--out: {system_message(error)}") from error


@contextmanager
def whole_folder(out: Path) -> Iterator[Path]:
    """Yields the path of a folder to make, which becomes ``out``, in place of an earlier one, if
    all goes well. Its last part is the name of ``out``."""
    with _staging(out) as partial:
        partial.mkdir()
        yield partial / out.name
        put_in_place(partial / out.name, out)


@contextmanager
def whole_file(out: Path) -> Iterator[Path]:
    """A file to write; it becomes ``out``, in place of an earlier one, if all goes well."""
    with _staging(out) as partial:
        yield partial
        os.replace(partial, out)


@contextmanager
def _staging(out: Path) -> Iterator[Path]:
    """The path beside ``out`` where it is made, which names the owner: this process. What lies
    there at the end is removed, and first what a process left that no longer lives."""
    out.parent.mkdir(parents=True, exist_ok=True)
    clear_partials(out.parent, out.name)
    partial = out.with_name(f".{out.name}.partial-{socket.gethostname()}.{os.getpid()}")
    _remove(partial)  # it may be a link that leads elsewhere
    try:
        yield partial
    finally:
        _remove(partial)


def clear_partials(folder: Path, name: str | None = None, *, alone: bool = False) -> None:
    """Removes the unfinished files and folders that dead processes left in ``folder``: those of
    ``name``, or all. ``alone``: nobody else writes there, and all are of dead processes."""
    for path in list(folder.iterdir()) if folder.is_dir() else []:
        found = _PARTIAL.fullmatch(path.name)
        if found is None or (name is not None and found["name"] != name):
            continue
        if alone or _is_abandoned(path, found["host"], found["process"]):
            _remove(path)


def _is_abandoned(partial: Path, host: str | None, process: str) -> bool:
    """True if the process that made ``partial`` has ended. False where it runs on another machine,
    of which nothing is known; one without the name of a machine is of this one."""
    import psutil

    if host not in (None, socket.gethostname()):
        return False
    try:
        # A process that began after the last change is another one of that number.
        return bool(psutil.Process(int(process)).create_time() > partial.stat().st_ctime + 1.0)
    except psutil.NoSuchProcess:
        return True
    except (psutil.Error, OSError, OverflowError):
        return False


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def put_in_place(made: Path, out: Path) -> None:
    """Moves the directory ``made`` to ``out``. An earlier one there is exchanged for it in one step
    where the file system can do that: no moment is without one of them."""
    if out.exists() and not _exchange(made, out):
        shutil.rmtree(out)
    if made.exists() and not out.exists():
        os.replace(made, out)


def _exchange(one: Path, other: Path) -> bool:
    """True if the two paths have been exchanged."""
    renameat2 = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if renameat2 is None:
        return False
    paths = (os.fsencode(one.absolute()), os.fsencode(other.absolute()))
    return bool(renameat2(_AT_FDCWD, paths[0], _AT_FDCWD, paths[1], _RENAME_EXCHANGE) == 0)


def utc_now() -> str:
    """The current time in UTC, ISO 8601, to the second."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


def write_text(path: Path, text: str) -> None:
    """Writes a text file atomically."""
    with whole_file(path) as partial:
        partial.write_text(text, encoding="utf-8")
