"""The slots of a flight: the parts that may be replaced, and the keys that name what fills them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
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
    value: Any = config
    for name in SLOTS[kind].key.split("."):
        value = getattr(value, name)
    return str(value)


def external_parts(config: Config) -> Iterator[tuple[str, str]]:
    """(kind, MODULE:FUNCTION) of each slot that code from outside fills."""
    for kind, slot in SLOTS.items():
        name = part_of(config, kind)
        if names_code(slot, name):
            yield kind, name


def other_parts(config: Config) -> dict[str, str]:
    """Names by kind of the parts beside the estimator that fly and are not those by default. A
    survey alone has neither selector nor classifier."""
    idle = {"estimator", *(("selector", "classifier") if config.landing.survey_only else ())}
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
