"""The table ``external`` of a configuration: parameters of an external estimator, of any keys."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

PREFIX = "external."
_DEEPEST = 8


def wrong_external_key(values: Mapping[str, Any], estimator: Any) -> tuple[str, str] | None:
    """The first dotted key of the table in ``values`` that is wrong, and the reason; None
    if all are right."""
    ours = {key: value for key, value in values.items() if key.startswith(PREFIX)}
    for key, value in ours.items():
        if isinstance(estimator, str) and ":" not in estimator:
            return key, (
                "is for an external estimator, MODULE:FUNCTION, which "
                f"'{estimator}' is not; leave it out (in a campaign: set it in an [[override]])"
            )
        if isinstance(value, dict):
            return key, f"is a table; set its keys one by one, such as {key}.gain"
        if key.count(".") > _DEEPEST:
            return key[:80], "is nested too deeply"
        parent = next((other for other in ours if key.startswith(f"{other}.")), None)
        if parent is not None:
            return key, f"cannot be set beside a value of {parent}"
        reason = _wrong_value(value)
        if reason:
            return key, reason
    return None


def _wrong_value(value: Any, depth: int = 0) -> str:
    if isinstance(value, float) and not math.isfinite(value):
        return "must hold finite numbers"
    if isinstance(value, list | dict):
        if depth == _DEEPEST:
            return "is nested too deeply"
        items = value.values() if isinstance(value, dict) else value
        return next((reason for item in items if (reason := _wrong_value(item, depth + 1))), "")
    if not isinstance(value, str | int | float):
        return f"is a {type(value).__name__}; text, numbers, booleans and lists of them can be set"
    return ""
