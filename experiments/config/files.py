"""Configuration files: reading of TOML and JSON within limits, and which of them may name code."""

import json
import re
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from touchdown.experiments.config.slots import SLOTS, names_code
from touchdown.experiments.errors import UsageError, input_message, is_text
from touchdown.scenes.api import names_function
from touchdown.sim.files.opening import no_file

MAX_BYTES = 1 << 20
"""of a configuration file"""
DEEPEST = 32
"""levels of tables and lists within each other"""
LARGEST = 2**63 - 1
"""whole number in a configuration: what tables of results have room for"""
RESULT_FILES = ("result.json", "campaign.json", "part.json")
"""Files whose directory holds results."""


def read_tree(file: Path) -> dict[str, Any]:
    """The tables of a TOML or JSON file, in UTF-8 with or without a byte order mark.

    Raises ``UsageError`` for a file that is not valid, too large or too deep, and for whole numbers
    and text that no key can hold.
    """
    kind = "JSON" if file.suffix == ".json" else "TOML"
    text = _text(file)
    if kind == "TOML" and _MANY_PARTS.search(text):  # takes time that grows with their square
        raise UsageError(f"'{file}' {_TOO_DEEP}")
    try:
        data = json.loads(text) if kind == "JSON" else tomllib.loads(text)
    except (tomllib.TOMLDecodeError, json.JSONDecodeError) as error:
        raise UsageError(f"'{file}' is not valid {kind}: {_one_line(error)}") from None
    except RecursionError:
        raise UsageError(f"'{file}' {_TOO_DEEP}") from None
    except ValueError:  # of Python, about a number of thousands of digits
        raise UsageError(f"'{file}' holds a whole number that {_TOO_LARGE}") from None
    if not isinstance(data, dict):
        raise UsageError(f"'{file}' must hold one object of keys and values")
    if reason := wrong_value(data):
        raise UsageError(f"'{file}' holds a value that {reason}")
    return data


def _text(file: Path) -> str:
    if reason := no_file(file):
        raise UsageError(f"configuration file '{file}' {reason}")
    try:
        with file.open("rb") as opened:
            content = opened.read(MAX_BYTES + 1)
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise UsageError(f"'{file}' cannot be read as text: {_one_line(error)}") from None
    except OSError as error:
        raise UsageError(input_message(error)) from None
    if len(content) > MAX_BYTES:
        raise UsageError(
            f"'{file}' has more than {MAX_BYTES >> 20} MB, which no configuration needs; name the "
            "file of a configuration"
        )
    return text


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())


_TOO_DEEP = f"is nested too deeply: a configuration has at most {DEEPEST} levels"
_PART = r"""(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+"""
_MANY_PARTS = re.compile(rf"(?<![\w.-]){_PART}(?:\.[ \t]*+{_PART}){{{DEEPEST}}}")
"""A key of more parts with dots between them than there may be levels."""
_TOO_LARGE = f"is too large: whole numbers go to {LARGEST}; write a larger one as 1e20"


def wrong_value(value: Any) -> str:
    """The reason why no key can hold ``value`` or something in it: too deep, too large, no text; ""
    if a key can."""
    left = [(value, 0)]
    while left:
        item, depth = left.pop()
        if depth > DEEPEST:
            return _TOO_DEEP
        if isinstance(item, dict):
            left += [(inner, depth + 1) for pair in item.items() for inner in pair]
        elif isinstance(item, list):
            left += [(inner, depth + 1) for inner in item]
        elif isinstance(item, int) and abs(item) > LARGEST:
            return _TOO_LARGE
        elif isinstance(item, str) and not is_text(item):
            return f"is no text: {ascii(item)[:60]} has half a character or a zero byte; correct it"
    return ""


def came_with_results(file: Path) -> bool:
    """True if a program wrote the configuration beside results: a JSON file, or a file in the
    directory of a run or a campaign. Other files were written by their user."""
    return file.suffix == ".json" or any((file.parent / n).is_file() for n in RESULT_FILES)


def check_named_code(file: Path, named: Iterable[tuple[str, Any]]) -> None:
    """Raises ``UsageError`` where a file that came with results names external code for a slot or
    a scene: the module would be imported, and may lie beside them. ``named``: keys, or their axes,
    and values."""
    if not came_with_results(file):
        return
    kinds = {name: kind for kind, slot in SLOTS.items() for name in (kind, slot.key)}
    for key, name in named:
        kind = "scene" if key == "scene" else kinds.get(key, "")
        option = "scene-from" if kind == "scene" else kind
        if key == "px4.path" and name is not None:
            raise UsageError(
                f"'{file}' came with results and names a program, px4.path = '{name}', which would "
                "be run; if you trust it, give --allow-code, or name yours with --px4"
            )
        of_scene = kind == "scene" and names_function(name)
        if of_scene or (kind in SLOTS and names_code(SLOTS[kind], name)):
            raise UsageError(
                f"'{file}' came with results and names code, {kind} '{name}': the module "
                f"'{name.partition(':')[0]}' would be imported and run, from the current directory "
                f"too; if you trust it, give --allow-code, or name the {kind} with --{option}"
            )
