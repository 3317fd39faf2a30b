"""The slots of a flight: the parts that may be replaced, the keys that name what fills them, and
the table ``external`` of parameters of external parts, of any keys. Those of a selector are
``external.selector.*``, and so on; keys of no kind are an estimator's."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from operator import attrgetter
from typing import TYPE_CHECKING, Any

from touchdown.experiments.errors import UsageError, nearest

if TYPE_CHECKING:
    from touchdown.experiments.config.schema import Config


@dataclass(frozen=True, slots=True)
class Slot:
    """A part of a flight that a shipped one or MODULE:FUNCTION fills."""

    kind: str
    """also the name of its option and of its axis in a campaign"""
    key: str
    """of the configuration"""
    default: str
    shipped: tuple[str, ...] = ()
    """names; those of estimators are in `experiments.flight.wiring`"""
    takes_file: bool = False
    """the path of a file may stand there too"""


MODE_KEY = "landing.survey_only"
PREFIX = "external."
_DEEPEST = 8
PX4 = "px4"
"""the controller that is a program of its own"""

SLOTS: Mapping[str, Slot] = {
    slot.kind: slot
    for slot in (
        Slot("estimator", "estimator", "livo"),
        Slot("selector", "landing.selector", "risk", ("risk", "zou2024")),
        Slot("lander", "landing.lander", "site", ("site",)),
        Slot("controller", "control.controller", "cascade", ("cascade", PX4)),
        Slot("mapper", "mapper.mapper", "grid", ("grid",)),
        Slot("watch", "landing.watch", "standard", ("standard", "off")),
        Slot("classifier", "landing.classifier", "auto", ("auto", "off"), takes_file=True),
    )
}
"""By kind."""


def names_code(slot: Slot, name: Any) -> bool:
    """True where ``name`` is MODULE:FUNCTION: what it names would be imported and run. Every text
    with a colon counts, but for the path of a file where the slot takes one."""
    if not isinstance(name, str) or ":" not in name:
        return False
    return not (slot.takes_file and ("/" in name or name.endswith((".onnx", ".json"))))


def part_of(config: Config, kind: str) -> str:
    """The name that fills a slot."""
    return str(attrgetter(SLOTS[kind].key)(config))


def external_parts(config: Config) -> Iterator[tuple[str, str]]:
    """(kind, MODULE:FUNCTION) of each slot that code from outside fills."""
    for kind, slot in SLOTS.items():
        name = part_of(config, kind)
        if names_code(slot, name):
            yield kind, name


def other_parts(config: Config) -> dict[str, str]:
    """Names by kind of the parts beside the estimator that fly and are not those by default. A
    survey alone has neither selector, classifier nor watch."""
    idle = {
        "estimator",
        *(("selector", "classifier", "watch") if config.landing.survey_only else ()),
    }
    names = {kind: part_of(config, kind) for kind in SLOTS if kind not in idle}
    return {kind: name for kind, name in names.items() if name != SLOTS[kind].default}


def check_part_names(config: Config, sources: Mapping[str, str]) -> None:
    """Raises UsageError, naming the nearest one, for a part that is neither shipped nor
    MODULE:FUNCTION; names of estimators are checked by `experiments.flight.wiring`."""
    for kind, slot in SLOTS.items():
        name = part_of(config, kind)
        known = name in slot.shipped or names_code(slot, name) or slot.takes_file
        if slot.shipped and not known:
            where = sources.get(slot.key, "the configuration")
            raise UsageError(
                f'{slot.key} = "{name[:60]}" in {where} is unknown{nearest(name, slot.shipped)}; '
                f"known: {', '.join(slot.shipped)}, or MODULE:FUNCTION of your own"
            )


def params_of(config: Config, kind: str) -> dict[str, Any]:
    """Parameters of an external part: ``external.KIND.*``, and for an estimator the keys of
    ``external`` that are of no kind."""
    table = config.external
    bare = {key: value for key, value in table.items() if key not in SLOTS}
    return {**(bare if kind == "estimator" else {}), **table.get(kind, {})}


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
