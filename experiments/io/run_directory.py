"""Atomic creation of run directories and files. What a killed process left is removed by the next
that makes the same."""

import datetime
import errno
import os
import re
import shutil
import socket
import stat
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from touchdown.experiments.errors import UsageError, system_message
from touchdown.experiments.io.untrusted import as_plain_name
from touchdown.scenes.api import short_name

_PARTIAL = re.compile(r"\.(?P<name>.+?)\.partial-(?:(?P<host>.+)\.)?(?P<process>\d+)")
"""Names of unfinished files and folders: of what they become, and the machine and the process that
write them."""
SENSORS_FILE = "sensors.mcap"
RUN_FILES = frozenset({
    "classes.png", "config.json", "costmap.png", "estimate.tum", "flight.rrd", "map.ply",
    "odometry.tum", "px4.log", "px4.ulg", "reference.tum", "result.json", SENSORS_FILE,
    "truth.tum",
})  # fmt: skip
"""Names of all files that a flight or a replay writes into its run directory."""


def default_out_dir(scene: str, estimator: str, seed: int, ending: str = "") -> Path:
    """``runs/SCENE-ESTIMATOR-SEED`` and ``ending``, whatever a configuration file calls the two."""
    name = f"{short_name(scene)}-{estimator.replace(':', '.')}-{seed}{ending}"
    return Path("runs") / as_plain_name(name)


def check_out_dir(out_dir: Path) -> None:
    """Raises UsageError unless ``out_dir`` is new, empty, or an earlier run to be replaced, in a
    folder that can be written to."""
    _check_writable(out_dir)
    if not out_dir.exists():
        return
    if not out_dir.is_dir():
        raise UsageError(f"--out {out_dir}: is a file; name a new directory")
    if Path.cwd().is_relative_to(out_dir.resolve()):
        raise UsageError(
            f"--out {out_dir}: is the working directory or above it, and would be replaced; name "
            "another directory"
        )
    if os.path.ismount(out_dir):
        raise UsageError(f"--out {out_dir}: is a mount point; name a directory in it")
    with suppress(FileNotFoundError):  # it went in the meantime
        if unknown := unknown_entries(out_dir, RUN_FILES):
            raise UsageError(
                f"--out {out_dir}: holds '{unknown[0]}', which no run writes, and would be "
                "replaced as a whole; name another directory"
            )
        if any(out_dir.iterdir()):
            from touchdown.experiments.io.results import load_result

            try:
                load_result(out_dir / "result.json")
            except UsageError as error:
                raise UsageError(
                    f"--out {out_dir}: holds something that is no run ({error}); name another "
                    "directory"
                ) from error


def _check_writable(out_dir: Path) -> None:
    folder = out_dir.absolute().parent
    while not folder.exists():
        folder = folder.parent
    probe = folder / f".touchdown-{socket.gethostname()}.{os.getpid()}"
    try:
        probe.mkdir(exist_ok=True)
        probe.rmdir()
    except OSError as error:
        raise UsageError(
            f"--out {out_dir}: '{folder}' cannot be written to ({error.strerror}); name another "
            "directory"
        ) from error


def unknown_entries(folder: Path, own: Collection[str]) -> list[str]:
    """Names in ``folder``, sorted, of all but regular files whose name is in ``own``."""
    return sorted(path.name for path in folder.iterdir() if _is_own(path, own) is False)


def _is_own(path: Path, own: Collection[str]) -> bool | None:
    """None where another process has removed it."""
    try:
        return path.name in own and stat.S_ISREG(path.lstat().st_mode)
    except FileNotFoundError:
        return None


def remove_own(folder: Path, own: Collection[str]) -> None:
    """Removes the regular files of ``folder`` whose names are in ``own``, and the folder if nothing
    else is in it."""
    for path in list(folder.iterdir()):
        if _is_own(path, own):
            path.unlink(missing_ok=True)
    with suppress(OSError):
        folder.rmdir()


@contextmanager
def run_directory(out_dir: Path, own: Collection[str] = RUN_FILES) -> Iterator[Path]:
    """A directory to fill; it becomes ``out_dir`` if all goes well, in place of an earlier one that
    holds nothing but files of the names ``own`` (see `put_in_place`).

    Raises UsageError where the machine does not let it: a full or read-only disk, no permission.
    """
    out = out_dir.resolve() if out_dir.is_symlink() else out_dir
    with _named_in_errors(out_dir), _staging(out) as partial:
        partial.mkdir()
        yield partial
        put_in_place(partial, out, own)


@contextmanager
def filled_folder(folder: Path) -> Iterator[Path]:
    """A directory to fill with files; they are moved into ``folder`` if all goes well, each in
    place of an earlier one of its name. What else lies there stays. Raises UsageError as
    `run_directory` does."""
    with _named_in_errors(folder), _staging(folder) as partial:
        partial.mkdir()
        yield partial
        folder.mkdir(exist_ok=True)
        for path in list(partial.iterdir()):
            os.replace(path, folder / path.name)
        partial.rmdir()


@contextmanager
def _named_in_errors(out: Path) -> Iterator[None]:
    """Raises UsageError for errors of the machine, such as a full disk. It names ``out``: whoever
    reads it knows no other path."""
    try:
        yield
    except OSError as error:
        if system_message(error) is None:
            raise
        error.filename, error.filename2 = str(out), None
        raise UsageError(f"--out: {system_message(error)}") from error


@contextmanager
def whole_folder(out: Path, own: Collection[str]) -> Iterator[Path]:
    """Yields the path of a folder to make, which becomes ``out`` if all goes well, in place of an
    earlier one that holds nothing but files of the names ``own``. Its last part is the name of
    ``out``."""
    with _staging(out) as partial:
        partial.mkdir()
        yield partial / out.name
        put_in_place(partial / out.name, out.resolve(), own)
        with suppress(OSError):  # what an earlier one holds by now stays
            partial.rmdir()


@contextmanager
def whole_file(out: Path) -> Iterator[Path]:
    """A file to write; it becomes ``out``, in place of an earlier one, if all goes well."""
    with _staging(out) as partial:
        yield partial
        os.replace(partial, out)


@contextmanager
def _staging(out: Path) -> Iterator[Path]:
    """The path beside ``out`` where it is made, which names the owner: this process. First what a
    process left that no longer lives is removed, and on an error what is unfinished."""
    out.parent.mkdir(parents=True, exist_ok=True)
    clear_partials(out.parent, out.name)
    partial = out.with_name(f".{out.name}.partial-{socket.gethostname()}.{os.getpid()}")
    _remove(partial)  # it may be a link that leads elsewhere
    try:
        yield partial
    except BaseException:
        _remove(partial)
        raise


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


def put_in_place(made: Path, out: Path, own: Collection[str]) -> None:
    """Moves the directory ``made`` to ``out``. An earlier one there is moved away right before, and
    removed if it holds nothing but files whose names are in ``own``.

    Raises UsageError if it has got another file since the work began: it stays as it is, and
    ``made`` is moved beside it.
    """
    while not _moved(made, out):
        with suppress(FileNotFoundError):  # another process replaces it at the same time
            if unknown := unknown_entries(out, own):
                beside = move_beside(made, out)
                raise UsageError(
                    f"--out {out}: holds '{unknown[0]}' by now, which would be lost; what was made "
                    f"is in '{beside}'"
                )
            earlier = made.with_name(f"{made.name}.earlier")
            os.rename(out, earlier)
            replaced = _moved(made, out)
            remove_own(earlier, own)
            if replaced:
                return


def _moved(made: Path, out: Path) -> bool:
    """True if ``made`` is now ``out``, False if there is a directory that is not empty."""
    try:
        os.replace(made, out)
    except OSError as error:
        if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
            raise
        return False
    return True


def move_beside(made: Path, out: Path) -> Path:
    """Moves the directory ``made`` to the first free of ``OUT-2``, ``OUT-3`` and so on, and returns
    that path."""
    number = 2
    while (beside := out.with_name(f"{out.name}-{number}")).exists() or not _moved(made, beside):
        number += 1
    return beside


def utc_now() -> str:
    """The current time in UTC, ISO 8601, to the second."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


def write_text(path: Path, text: str) -> None:
    """Writes a text file atomically."""
    with whole_file(path) as partial:
        partial.write_text(text, encoding="utf-8")
