"""Names, JSON documents and links in files of other people, before they are used. Every string of a
file that becomes a path goes through this module."""

import json
from collections.abc import Iterable
from pathlib import Path, PurePosixPath
from typing import Any

from touchdown.experiments.errors import UsageError, broken_text
from touchdown.sim.files.opening import no_file

LONGEST_NAME = 200
"""bytes of a name; file systems take 255, of which endings such as that of a partial file are left
over"""


def is_plain_name(name: object) -> bool:
    """True if ``name`` can be nothing but one entry of a directory: printable text without a
    separator that is not ``.`` or ``..``."""
    if not isinstance(name, str) or name in ("", ".", "..") or "/" in name:
        return False
    return name.isprintable() and len(name.encode()) <= LONGEST_NAME


def as_plain_name(text: str) -> str:
    """``text`` as one entry of a directory: separators and unprintable characters are dots."""
    return "".join(c if c.isprintable() and c != "/" else "." for c in text)


def inside(folder: Path, name: object) -> Path:
    """The path of ``name``, one or several plain names with slashes between them, in ``folder``.
    Raises ValueError for a name that leads elsewhere."""
    parts = name.split("/") if isinstance(name, str) else []
    if not parts or not all(map(is_plain_name, parts)):
        raise ValueError(f"{shown(name)} is no name of a file in '{folder}'")
    return folder / PurePosixPath(*parts)


def shown(value: object) -> str:
    """``value`` as a short quoted text of printable ASCII."""
    text = ascii(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


def read_object(path: Path) -> dict[str, Any]:
    """The JSON object in ``path``. Raises OSError, or ValueError with the reason in one line."""
    if (reason := no_file(path)).startswith("is "):
        raise ValueError(f"it {reason}")
    try:
        tree = json.loads(path.read_text(encoding="utf-8"))
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    except UnicodeDecodeError:
        raise ValueError("it is not UTF-8 text") from None
    except json.JSONDecodeError as error:
        raise ValueError(f"it is no JSON: {error}") from None
    except ValueError:  # of int()
        raise ValueError("it holds a number of thousands of digits") from None
    if (text := broken_text(tree)) is not None:
        raise ValueError(f"{text} has half a character or a zero byte")
    if not isinstance(tree, dict):
        raise ValueError("it holds no object of keys and values")
    return tree


def refuse_links(paths: Iterable[Path], what: str) -> None:
    """Raises UsageError, one line, if one of ``paths`` is a link: ``what`` is written and removed
    there, and a link may lead anywhere."""
    for path in paths:
        if path.is_symlink():
            raise UsageError(
                f"'{path}' is a link; {what} uses none, since it replaces and removes what lies "
                "there: move the target of the link to its place, or name another --out"
            )
