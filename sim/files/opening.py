"""Checks of files of users before a library opens them."""

import contextlib
import os
import stat
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

MIB = 1 << 20


_KINDS: tuple[tuple[str, Callable[[int], bool]], ...] = (
    ("is a directory", stat.S_ISDIR),
    ("is a named pipe", stat.S_ISFIFO),
    ("is a socket", stat.S_ISSOCK),
    ("is a device", lambda mode: not stat.S_ISREG(mode)),
)


def no_file(path: Path) -> str:
    """The reason why ``path`` is no regular file, such as ``does not exist`` or ``is a directory``;
    "" if it is one. Files that the kernel makes up while they are read, which may wait for ever or
    hold the memory of a process, are none."""
    try:
        found = path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return "does not exist"
    except OSError as error:
        return f"cannot be read ({os.strerror(error.errno or 0)})"
    except ValueError:
        return "is no name of a file: it has a zero byte"
    for kind, holds in _KINDS:
        if holds(found.st_mode):
            return kind
    made_up = (where for where in ("/proc", "/sys") if os.path.ismount(where))
    if any(os.stat(where).st_dev == found.st_dev for where in made_up):
        return "is a file of the kernel's state"
    return ""


def check_file(path: Path, what: str, max_bytes: int | None = None) -> None:
    """Raises FileNotFoundError for a missing file, ValueError for what is no regular file (see
    `no_file`) and for a file above ``max_bytes``. ``what`` names the kind of file in the message.
    """
    reason = no_file(path)
    if reason == "does not exist":
        raise FileNotFoundError(f"{what} '{path}' does not exist")
    if reason:
        raise ValueError(f"{what} '{path}' {reason}; give a file")
    size = path.stat().st_size
    if max_bytes is not None and size > max_bytes:
        raise ValueError(
            f"{path} has {size / MIB:.0f} MiB, and {what} may have {max_bytes / MIB:.0f} MiB at "
            "most; make it smaller"
        )


def printable(text: str) -> str:
    """Returns text from a file for a message: characters that would steer a terminal are escaped,
    and long text is cut."""
    cut = text if len(text) <= 80 else f"{text[:77]}..."
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in cut)


@contextlib.contextmanager
def quiet_libraries() -> Iterator[None]:
    """Drops what C libraries print on stderr, such as a page of advice of Qhull, and their
    warnings: an error is one line, of the exception that they raise as well."""
    with contextlib.ExitStack() as held:
        held.enter_context(warnings.catch_warnings())
        warnings.simplefilter("ignore")
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
