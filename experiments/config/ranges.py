"""Ranges and choices of configuration keys: from their types, and on a side that these leave open
from the unit of the key."""

import dataclasses
import functools
import operator
import typing
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NamedTuple

from annotated_types import BaseMetadata, GroupedMetadata

from touchdown.experiments.config.schema import Config

BOUNDS = ("gt", "ge", "lt", "le")

LARGEST_OF_KEY: Mapping[str, float] = {
    "seed": 2**63 - 1,
    "scene_seed": 2**63 - 1,
    # Rate of the physics, and what follows from it.
    "sim.tick_hz": 10_000,
    # Images and their copies: an ultra-high definition image takes 25 MB.
    "camera.width": 3840,
    "camera.height": 2160,
    "camera.samples": 32,
    # Electrons and lumens of the largest pixels and lamps, by orders of magnitude.
    "camera.full_well_e": 1e7,
    "camera.electrons_per_lux_s": 1e7,
    "lamp.flux_lm": 1e7,
    "livo.scan_points": 100_000,
    "sim.battery_capacity_j": 1e9,
    "mapper.count_cap": 1e6,
    # Northings of projected maps: a site given in the file's coordinates is named with its remedy.
    "landing.site_xy_m": 1e7,
}
"""Largest values of keys with a reason of their own."""


class Unit(NamedTuple):
    """The unit that a key's name ends with, and the largest magnitude of such keys."""

    symbol: str
    largest: float


UNITS: Mapping[str, Unit] = {
    "_kmh": Unit("km/h", 450.0),  # the strongest gust measured on Earth had 408 km/h
    "_mmph": Unit("mm/h", 2000.0),
    "_radps": Unit("rad/s", 1e4),
    "_mps2": Unit("m/s²", 1000.0),
    "_mps": Unit("m/s", 125.0),
    "_hz": Unit("Hz", 1000.0),
    "_deg": Unit("°", 360.0),
    "_ut": Unit("µT", 1000.0),  # fields on the ground have 25 to 65
    "_k": Unit("K", 200.0),
    "_pa": Unit("Pa", 110e3),  # of the whole atmosphere
    "_px": Unit("px", 4000.0),
    "_pixels": Unit("px", 16384.0),  # side of a texture
    "_ppm": Unit("ppm", 1e6),
    "_ticks": Unit("ticks", 100_000),
    "_ohm": Unit("Ω", 10.0),
    "_m": Unit("m", 10e3),  # 32 bits of a point resolve 1 mm up to here
    "_s": Unit("s", 86_400.0),
    "_j": Unit("J", 1e9),
}
"""By the end of a key's name; the first that fits counts."""


def unit_of(key: str) -> Unit | None:
    """The unit that the name of a key ends with; None if there is none."""
    name = f"_{key.rpartition('.')[2]}"
    return next((unit for end, unit in UNITS.items() if name.endswith(end)), None)


MAX, LARGEST = 10_000, 1000.0
"""of other counts, such as features and keyframes, and of numbers without a unit"""
SMALLEST = 1e-6
"""positive number that is no count: smaller ones overflow where they divide"""


@functools.cache
def types_of_keys() -> dict[str, Any]:
    """The type of every key of the schema, by dotted key, with its metadata."""
    return dict(_types_in(Config, Config.model_fields))


def _types_in(group: Any, names: Iterable[str], prefix: str = "") -> Iterator[tuple[str, Any]]:
    hints = typing.get_type_hints(group, include_extras=True)
    for name in names:
        if dataclasses.is_dataclass(hints[name]):
            inner = [field.name for field in dataclasses.fields(hints[name])]
            yield from _types_in(hints[name], inner, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", hints[name]


@functools.cache
def constants() -> frozenset[str]:
    """The dotted names of the constants beside the keys, which were keys in earlier versions."""
    return frozenset(_constants_in(Config))


def _constants_in(group: Any, prefix: str = "") -> Iterator[str]:
    for name, kind in typing.get_type_hints(group).items():
        if typing.get_origin(kind) is typing.ClassVar:
            yield f"{prefix}{name}"
        elif dataclasses.is_dataclass(kind):
            yield from _constants_in(kind, f"{prefix}{name}.")


def bounds_of(kind: Any) -> dict[str, float]:
    """Bounds ``gt``, ``ge``, ``lt``, ``le`` of the numbers in a type; those of elements of a tuple
    are those of the first element."""
    if typing.get_origin(kind) is typing.Annotated:
        found = _flat(kind.__metadata__)
        pairs = ((name, getattr(item, name, None)) for item in found for name in BOUNDS)
        return {name: bound for name, bound in pairs if bound is not None}
    for inner in typing.get_args(kind):
        if bounds := bounds_of(inner):
            return bounds
    return {}


def choices_of(kind: Any) -> tuple[str, ...]:
    """The names that a key of a closed set, or of a list from one, may take; none for other
    types."""
    if typing.get_origin(kind) is tuple:
        return choices_of(typing.get_args(kind)[0])
    return typing.get_args(kind) if typing.get_origin(kind) is typing.Literal else ()


@functools.cache
def limits_of(key: str) -> Mapping[str, float]:
    """Bounds of the numbers of ``key``, a lower and an upper one; empty for a key without."""
    kind = types_of_keys().get(key)
    found = _number_kinds(kind)
    if not found:
        return {}
    bounds = bounds_of(kind)
    count = found == {int}
    if not bounds.keys() & {"lt", "le"}:
        unit = unit_of(key)
        largest = unit.largest if unit else MAX if count else LARGEST
        bounds["le"] = LARGEST_OF_KEY.get(key, largest)
    if bounds.get("gt") == 0 and "lt" not in bounds:
        del bounds["gt"]
        bounds["ge"] = 1 if count else SMALLEST
    if not bounds.keys() & {"gt", "ge"}:
        bounds["ge"] = -bounds.get("le", LARGEST)
    return bounds


def _number_kinds(kind: Any) -> set[type]:
    """Which of int and float a type, or the elements of its values, may be."""
    if typing.get_origin(kind) is typing.Annotated:
        return _number_kinds(kind.__origin__)
    if typing.get_origin(kind) is typing.Literal:
        return set()
    inner = typing.get_args(kind)
    return set().union(*map(_number_kinds, inner)) if inner else {kind} & {int, float}


def out_of_range(key: str, value: Any) -> bool:
    """True if ``value``, or a number in it, is outside the limits of ``key``."""
    limits = limits_of(key)
    numbers = value if isinstance(value, list | tuple) else (value,)
    return any(
        isinstance(number, int | float)
        and not isinstance(number, bool)
        and not all(_HOLDS[name](number, bound) for name, bound in limits.items())
        for number in numbers
    )


_HOLDS = {"gt": operator.gt, "ge": operator.ge, "lt": operator.lt, "le": operator.le}


def _flat(metadata: Any) -> Iterator[BaseMetadata]:
    for item in metadata:
        if isinstance(item, GroupedMetadata):
            yield from _flat(item)
        elif isinstance(item, BaseMetadata):
            yield item


def range_text(bounds: Mapping[str, float]) -> str:
    """``within 0 to 1``, ``above 0 and below 90`` and the like; "" without bounds."""
    if bounds.get("le") == 2**63 - 1:
        return "within 0 to 2^63 - 1"
    low, high = bounds.get("ge"), bounds.get("le")
    if low is not None and high is not None:
        return f"within {low:g} to {high:g}"
    names = {"gt": "above", "ge": "at least", "lt": "below", "le": "at most"}
    return " and ".join(f"{names[name]} {bounds[name]:g}" for name in BOUNDS if name in bounds)


def rule_of(key: str) -> str:
    """The rule that a value of ``key`` must satisfy: ``must be within 0 to 1``; "" if there is
    none."""
    text = range_text(limits_of(key))
    return f"must be {text}" if text else ""
