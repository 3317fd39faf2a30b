"""Reads ``result.json``."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from touchdown.experiments.errors import UsageError

Row = Mapping[str, Any]


def lookup(row: Row, path: str) -> Any:
    """The value at a dotted path, None where any key is missing."""
    value: Any = row
    for key in path.split("."):
        if not isinstance(value, Mapping):
            return None
        value = value.get(key)
    return value


def load_run(path: Path) -> dict[str, Any]:
    """One ``result.json``. Raises UsageError when it is none."""
    try:
        row: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise UsageError(f"'{path}' cannot be read: {error}") from error
    if not isinstance(row, dict):
        raise UsageError(f"'{path}' is no run's result: it holds no object of keys and values")
    missing = {"scene", "estimator", "seed", "outcome"} - row.keys()
    if missing:
        raise UsageError(f"'{path}' is no run's result: {', '.join(sorted(missing))} missing")
    for key in ("scene", "estimator", "outcome"):
        if not isinstance(row[key], str):
            raise UsageError(f"'{path}' is no run's result: {key} = {row[key]!r} must be text")
    seed = row["seed"]
    if isinstance(seed, bool) or not isinstance(seed, int) or abs(seed) >= 2**63:
        raise UsageError(
            f"'{path}' is no run's result: seed = {row['seed']!r} must be a whole number"
        )
    return row
