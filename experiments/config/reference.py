"""The reference of configuration keys, made from the schema: `touchdown config`, a page of the
site."""

import ast
import functools
import inspect
import json
import typing
from collections.abc import Iterator
from operator import attrgetter
from types import NoneType, UnionType
from typing import Any

from touchdown.experiments.config.profiles import DEFAULT, KEY
from touchdown.experiments.config.ranges import limits_of, range_text, types_of_keys, unit_of
from touchdown.experiments.config.schema import Config

_KINDS = {bool: "true or false", str: "text", int: "whole number", float: "number"}

INTRODUCTION = """# Configuration keys

Every key of a flight with its unit, default and meaning, made from the schema. The defaults are
those of profile `ideal`; the profile that is flown, `field`, sets others
([Flying](flying.md#profiles)), and so does the preset `short`
([Flying](flying.md#short-flights)). A key is set in a TOML file (`--config`), by
`--set KEY=VALUE`, or in Python by `overrides={"KEY": VALUE}`; see [Flying](flying.md) for files
and their order. An unknown key, a value outside its range and a wrong type are refused in one
line. `ticks` are periods of `sim.tick_hz`.
"""


@functools.cache
def meanings(kind: Any) -> dict[str, str]:
    """The docstring below each field of a class, on one line."""
    (body,) = ast.parse(inspect.getsource(kind)).body
    assert isinstance(body, ast.ClassDef)
    base: Any = kind.__base__
    found: dict[str, str] = dict(meanings(base)) if hasattr(base, "__dataclass_fields__") else {}
    for field, text in zip(body.body, body.body[1:], strict=False):
        if not (isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)):
            continue
        if isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant):
            found[field.target.id] = " ".join(str(text.value.value).split())
    return found


def meaning_of(key: str) -> str:
    """The docstring of a key; "" if there is none."""
    group, _, name = key.rpartition(".")
    kind: Any = type(attrgetter(group)(Config())) if group else Config
    return meanings(kind).get(name, "")


def values_of(key: str) -> str:
    """The values that a key takes: kind and range."""
    kind = types_of_keys()[key]
    text = " or ".join(_kind_texts(kind))
    bounds = range_text(limits_of(key))
    return f"{text}, {bounds}" if bounds else text


def _kind_texts(kind: Any) -> Iterator[str]:
    if kind is NoneType:
        yield "none"
    elif typing.get_origin(kind) is typing.Annotated:
        yield from _kind_texts(kind.__origin__)
    elif typing.get_origin(kind) in (typing.Union, UnionType):
        for inner in typing.get_args(kind):
            yield from _kind_texts(inner)
    elif typing.get_origin(kind) is typing.Literal:
        yield ", ".join(f"`{value}`" if value else "empty" for value in typing.get_args(kind))
    elif typing.get_origin(kind) is tuple:
        inner = typing.get_args(kind)
        (first, *_) = _kind_texts(inner[0])
        many = f"names from {first}" if first.startswith("`") else f"{first}s"
        yield f"list of {many}" if inner[-1] is Ellipsis else f"{len(inner)} {many}"
    else:
        yield _KINDS.get(kind, "any")


def default_of(key: str) -> str:
    """The default as TOML, or ``none``."""
    if key == KEY:
        return f"`{json.dumps(DEFAULT)}`"
    value = attrgetter(key)(Config())
    if value is None:
        return "none"
    return f"`{json.dumps(value, default=str)}`"


def groups() -> Iterator[tuple[str, str, list[str]]]:
    """(group, its description, its keys); the keys without a group come first, as ``""``."""
    found: dict[str, list[str]] = {"": []}
    for key in types_of_keys():
        found.setdefault(key.rpartition(".")[0], []).append(key)
    for group, keys in found.items():
        if group:
            kind = type(attrgetter(group)(Config()))
            text = inspect.cleandoc(kind.__doc__ or "")
            yield group, "" if text.startswith(f"{kind.__name__}(") else text, keys
        else:
            yield "", "", keys


def reference_page() -> str:
    """Markdown: a table of keys for each group."""
    parts = [INTRODUCTION]
    for name, text, keys in groups():
        parts.append(f"## {f'`{name}`' if name else 'Without a group'}\n")
        if text:
            parts.append(f"{_markdown(text)}\n")
        parts.append("| key | default | unit | values | meaning |\n|---|---|---|---|---|")
        for key in keys:
            unit = unit_of(key)
            symbol = unit.symbol if unit else ""
            cells = (default_of(key), symbol, values_of(key), _markdown(meaning_of(key)))
            parts.append(f"| `{key}` | {' | '.join(cell.replace('|', '¦') for cell in cells)} |")
        parts.append("")
    return "\n".join(parts)


def _markdown(text: str) -> str:
    """Docstring text as Markdown."""
    return " ".join(text.split()).replace("``", "`").replace("<", "&lt;")
