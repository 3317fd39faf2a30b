"""Ranges and choices of configuration keys, from their types."""

from __future__ import annotations

import functools
import typing
from collections.abc import Iterator
from typing import Any

from annotated_types import BaseMetadata, GroupedMetadata

from touchdown.experiments.config.schema import Config

BOUNDS = ("gt", "ge", "lt", "le")


@functools.cache
def types_of_keys() -> dict[str, Any]:
    """The type of every key of the schema, by dotted key, with its metadata."""
    types: dict[str, Any] = {}
    for name, kind in typing.get_type_hints(Config, include_extras=True).items():
        if hasattr(kind, "__dataclass_fields__"):
            hints = typing.get_type_hints(kind, include_extras=True)
            types |= {f"{name}.{field}": hints[field] for field in kind.__dataclass_fields__}
        elif name in Config.model_fields:
            types[name] = kind
    return types


def bounds_of(kind: Any) -> dict[str, float]:
    """Bounds ``gt``, ``ge``, ``lt``, ``le`` of the numbers in a type; those of elements of a tuple
    are those of the first element."""
    if typing.get_origin(kind) is typing.Annotated:
        found = _flat(kind.__metadata__)
        return {name: getattr(item, name) for item in found for name in BOUNDS if _has(item, name)}
    for inner in typing.get_args(kind):
        if bounds := bounds_of(inner):
            return bounds
    return {}


def choices_of(kind: Any) -> tuple[str, ...]:
    """The names that a key of a closed set may take; none for other types."""
    return typing.get_args(kind) if typing.get_origin(kind) is typing.Literal else ()


def _flat(metadata: Any) -> Iterator[BaseMetadata]:
    for item in metadata:
        if isinstance(item, GroupedMetadata):
            yield from _flat(item)
        elif isinstance(item, BaseMetadata):
            yield item


def _has(item: Any, name: str) -> bool:
    return getattr(item, name, None) is not None


def range_text(bounds: dict[str, float]) -> str:
    """``positive``, ``within 0 to 1`` and the like; "" without bounds."""
    low, high = bounds.get("ge"), bounds.get("le")
    if low is not None and high is not None:
        return f"within {low:g} to {high:g}"
    if bounds == {"gt": 0}:
        return "positive"
    if bounds == {"ge": 0}:
        return "not negative"
    names = {"gt": "above", "ge": "at least", "lt": "below", "le": "at most"}
    return " and ".join(f"{names[name]} {bounds[name]:g}" for name in BOUNDS if name in bounds)


def rule_of(key: str) -> str:
    """The rule that a value of ``key`` must satisfy: ``must be positive``; "" if there is none."""
    text = range_text(bounds_of(types_of_keys().get(key)))
    if text.startswith("not "):
        return f"must not be {text.removeprefix('not ')}"
    return f"must be {text}" if text else ""
