"""The nearest known name, for error messages."""

from __future__ import annotations

import difflib
import errno
import os
from collections.abc import Callable, Iterable
from typing import Any


def nearest(name: str, known: Iterable[str]) -> str:
    """`` (did you mean 'x'?)`` or an empty string."""
    matches = difflib.get_close_matches(name, list(known), n=1, cutoff=0.5)
    return f" (did you mean '{matches[0]}'?)" if matches else ""


_REMEDIES = {
    errno.ENOSPC: "make room there and give the command again",
    errno.EDQUOT: "make room there and give the command again",
    errno.EROFS: "name a place that can be written to",
    errno.EACCES: "name one that you may use, or change its permissions",
    errno.EPERM: "name one that you may use, or change its permissions",
    errno.ENAMETOOLONG: "give a shorter name",
    errno.ELOOP: "its links lead in a circle; name the place itself",
    errno.ENOTDIR: "a part of that path is a file; name another",
    errno.EISDIR: "that is a directory; name a file",
    errno.EMFILE: "raise the limit on open files (ulimit -n)",
    errno.ENFILE: "raise the limit on open files (ulimit -n)",
    errno.EIO: "the disk may be full or failing",
    errno.EFBIG: "raise the limit on the size of files (ulimit -f)",
}


def system_message(error: OSError) -> str | None:
    """What to tell of an error that the machine has and not the program; None for others."""
    remedy = _REMEDIES.get(error.errno or 0)
    if remedy is None:
        return None
    names = [f"'{name}'" for name in (error.filename2 or error.filename,) if name]
    return f"{': '.join([*names, os.strerror(error.errno or 0)])}; {remedy}"


def input_message(error: ValueError | OSError) -> str:
    """What to tell of an error that bad input or the machine has caused."""
    known = system_message(error) if isinstance(error, OSError) else None
    return known or str(error)


def usage_errors(action: Callable[[], Any]) -> Any:
    """Runs ``action``; what it finds wrong with its input becomes a UsageError."""

    try:
        return action()
    except (ValueError, OSError) as error:
        raise UsageError(input_message(error)) from error


class UsageError(ValueError):
    """A mistake of the user, told in one line; the command line turns it into exit code 2."""
