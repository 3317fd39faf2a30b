"""Dotted keys of nested tables."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from touchdown.experiments.config.external_table import PREFIX


def is_external_key(key: str) -> bool:
    """True for a key of the table ``external``, where any key is allowed."""
    return key.startswith(PREFIX)


def flatten(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """(dotted key, value) of every leaf of nested tables."""
    for name, value in tree.items():
        if isinstance(value, dict):
            yield from flatten(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value
