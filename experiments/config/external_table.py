"""The table ``external`` of a configuration: parameters of external parts, of any keys. Those of a
selector are ``external.selector.*``, and so on; keys of no kind are an estimator's."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from touchdown.experiments.config.slots import SLOTS, names_code

PREFIX = "external."
_DEEPEST = 8


def wrong_external_key(values: Mapping[str, Any]) -> tuple[str, str] | None:
    """The first dotted key of the table in ``values`` that is wrong, and the reason; None
    if all are right."""
    ours = {key: value for key, value in values.items() if key.startswith(PREFIX)}
    for key, value in ours.items():
        kind = _kind_of(key)
        slot = SLOTS[kind]
        part = values.get(slot.key, slot.default)
        if isinstance(part, str) and not names_code(slot, part):
            return key, (
                f"is for an external {kind}, MODULE:FUNCTION, which "
                f"'{part}' is not; leave it out (in a campaign: set it in an [[override]])"
                f"{_of_another_part(key, values)}"
            )
        if key == f"{PREFIX}{kind}":
            return key, f"is the table of the {kind}; set its keys, such as {key}.gain"
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


def _kind_of(key: str) -> str:
    """Kind of the part that a key of the table is for."""
    name = key.removeprefix(PREFIX).partition(".")[0]
    return name if name in SLOTS else "estimator"


def _of_another_part(key: str, values: Mapping[str, Any]) -> str:
    """Hint for a key that lacks the kind of its part."""
    kinds = [k for k, slot in SLOTS.items() if names_code(slot, values.get(slot.key))]
    if _kind_of(key) != "estimator" or not kinds:
        return ""
    return f"; that of the {kinds[0]} is {PREFIX}{kinds[0]}.{key.removeprefix(PREFIX)}"


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
