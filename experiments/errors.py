"""Errors of the user and of the machine, and their one-line messages."""

import difflib
import errno
import os
import re
from collections.abc import Callable, Iterable
from importlib.util import find_spec
from typing import Any


def nearest(name: str, known: Iterable[str]) -> str:
    """The hint `` (did you mean 'x'?)`` with the nearest known name; "" if none is near."""
    matches = difflib.get_close_matches(name, list(known), n=1, cutoff=0.5)
    return f" (did you mean '{matches[0]}'?)" if matches else ""


def visible(text: object, keep: str = "") -> str:
    r"""Text of outside as it may be printed: control characters, line ends, marks of direction and
    of no width, and lone surrogates are written as escapes, such as ``\x1b`` and ``\u202e``.
    Characters of ``keep`` stay."""
    words = str(text)
    if words.isprintable():
        return words
    return "".join(c if c.isprintable() or c in keep else ascii(c)[1:-1] for c in words)


def is_text(text: str) -> bool:
    """True unless text holds half a character (a lone surrogate) or a zero byte: no file, table or
    terminal takes it."""
    if text.isascii():
        return "\0" not in text
    return "\0" not in text and not any("\ud800" <= letter <= "\udfff" for letter in text)


def broken_text(tree: Any) -> str | None:
    """The first key or value in nested tables and lists that is no text, as an escape; None where
    all are."""
    left = [tree]
    while left:
        item = left.pop()
        if isinstance(item, dict):
            left += [inner for pair in item.items() for inner in pair]
        elif isinstance(item, list):
            left += item
        elif isinstance(item, str) and not is_text(item):
            return ascii(item)[:60]
    return None


def plain_fault(message: str) -> str:
    """A message of pydantic without the names of classes, beginning in lower case."""
    words = re.sub(
        r" or instance of \w+|, unable to parse raw data as a unicode string", "", message
    )
    words = words.replace("a valid dictionary", "a table").replace("an object", "a table")
    return f"{words[:1].lower()}{words[1:]}"


_REMEDIES = {
    errno.ENOSPC: "make room there and give the command again",
    errno.EDQUOT: "make room there and give the command again",
    errno.EROFS: "name a path that can be written to",
    errno.EACCES: "name one that you may use, or change its permissions",
    errno.EPERM: "name one that you may use, or change its permissions",
    errno.ENAMETOOLONG: "give a shorter name",
    errno.ELOOP: "its links lead in a circle; name the target itself",
    errno.ENOTDIR: "a part of that path is a file; name another",
    errno.EEXIST: "a part of that path is a file; name another",
    errno.ENOTEMPTY: "something has come there in the meantime; name another",
    errno.EISDIR: "that is a directory; name a file",
    errno.EMFILE: "raise the limit on open files (ulimit -n)",
    errno.ENFILE: "raise the limit on open files (ulimit -n)",
    errno.EIO: "the disk may be full or failing",
    errno.EFBIG: "raise the limit on the size of files (ulimit -f)",
}


def system_message(error: OSError) -> str | None:
    """The message for an error of the machine (disk full, permissions); None for other errors."""
    remedy = _REMEDIES.get(error.errno or 0)
    if remedy is None:
        return None
    names = [f"'{name}'" for name in (error.filename2 or error.filename,) if name]
    return f"{': '.join([*names, os.strerror(error.errno or 0)])}; {remedy}"


def input_message(error: ValueError | OSError) -> str:
    """The message for an error that bad input or the machine has caused."""
    if isinstance(error, OSError) and error.strerror:
        where = f"'{error.filename}': " if error.filename else ""
        return system_message(error) or f"{where}{error.strerror}"
    return str(error)


def reason_of(error: Exception) -> str:
    """The words of an error, without the number that the system gives it; of a document that does
    not fit its model the first fault and its place."""
    from pydantic import ValidationError

    if isinstance(error, ValidationError):
        first = error.errors(include_url=False)[0]
        return f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
    return error.strerror if isinstance(error, OSError) and error.strerror else str(error)


def require_dm_control(what: str) -> None:
    """Raises UsageError, naming ``what`` needs it, where dm_control cannot be imported."""
    if find_spec("dm_control") is None:
        raise UsageError(
            f"{what} needs dm_control, which is not installed: pip install dm-control, on Python "
            "3.11 or 3.12 (labmaze, which it needs, has no wheels for newer ones)"
        )


def usage_errors(action: Callable[[], Any]) -> Any:
    """Runs ``action`` and returns its result. Raises UsageError for its ValueError or OSError."""

    try:
        return action()
    except (ValueError, OSError) as error:
        raise UsageError(input_message(error)) from error


class UsageError(ValueError):
    """A mistake of the user, with a message of one line. The command line exits with code 2."""


class ExternalPartError(UsageError):
    """Error of an external part, in one line."""
