"""Checks of files of users before a library opens them."""

from __future__ import annotations

import contextlib
import os
import stat
import sys
from collections.abc import Iterator
from pathlib import Path

MIB = 1 << 20


def check_file(path: Path, what: str, max_bytes: int | None = None) -> int:
    """Returns the size of a regular file, bytes.

    Raises FileNotFoundError for a missing file, ValueError for a folder, a named pipe, a socket, a
    device (which never end, or never begin) and for a file above ``max_bytes``. ``what`` names the
    kind of file in the message.
    """
    try:
        found = path.stat()
    except (FileNotFoundError, NotADirectoryError):
        raise FileNotFoundError(f"{what} not found: {path}") from None
    except ValueError as error:  # a null byte in the name
        raise ValueError(f"{what}: '{path}' is no name of a file: {error}") from error
    if not stat.S_ISREG(found.st_mode):
        raise ValueError(f"{what}: '{path}' is {_kind(found.st_mode)}; give a file")
    if max_bytes is not None and found.st_size > max_bytes:
        raise ValueError(
            f"{path} has {found.st_size / MIB:.0f} MiB, and {what} may have {max_bytes / MIB:.0f} "
            "MiB at most; make it smaller"
        )
    return found.st_size


def _kind(mode: int) -> str:
    for name, holds in (
        ("a folder", stat.S_ISDIR),
        ("a named pipe", stat.S_ISFIFO),
        ("a socket", stat.S_ISSOCK),
    ):
        if holds(mode):
            return name
    return "a device"


def printable(text: str) -> str:
    """Returns text from a file for a message: characters that would steer a terminal are escaped,
    and long text is cut."""
    cut = text if len(text) <= 80 else f"{text[:77]}..."
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in cut)


@contextlib.contextmanager
def quiet_libraries() -> Iterator[None]:
    """Drops what C libraries print on stderr, such as a page of advice of Qhull: an error is one
    line, of the exception that they raise as well."""
    with contextlib.ExitStack() as held:
        with contextlib.suppress(OSError, ValueError):  # there is no stderr
            if sys.stderr is not None:
                sys.stderr.flush()
            kept = os.dup(2)
            held.callback(os.close, kept)
            held.callback(os.dup2, kept, 2)
            nowhere = os.open(os.devnull, os.O_WRONLY)
            held.callback(os.close, nowhere)
            os.dup2(nowhere, 2)
        yield
