"""Probability to tip or to slide after a touchdown, over terrain and conditions; what slope and
step a vehicle stands on; and whether the rule of the ground truth agrees.

Each contact draws friction, horizontal speed and wind evenly from their ranges, and the seed of all
else. Intervals are Wilson's, over contacts, which are independent.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any
from zlib import crc32

import numpy as np

from touchdown.experiments.benchmarks.contact.terrain import Terrain, bare_vehicle
from touchdown.experiments.benchmarks.contact.trial import (
    Conditions,
    Touch,
    Trial,
    fly_trial,
    pad_margin_m,
)
from touchdown.experiments.benchmarks.processes import mapped
from touchdown.experiments.config.loading import load_config
from touchdown.experiments.config.schema import Config
from touchdown.experiments.config.slots import PX4
from touchdown.experiments.errors import UsageError
from touchdown.experiments.reporting.statistics import Estimate, fraction_interval
from touchdown.sim.airframe.vehicle import vehicle_model

SLOPES_DEG = (0.0, 2.5, 5.0, 7.5, 10.0, 12.5, 15.0, 17.5, 20.0, 22.5, 25.0)
HEIGHTS_M = (0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4)
GROUNDS = (("slope", 0), ("step", 1), ("step", 2), ("rock", 1), ("rock", 2))
"""kind of terrain, and legs on it"""
FAILURES = ("tips", "strikes", "slides")
BINS = 3
"""of each condition in a map"""
_FIXED = {
    "scene": "flat", "estimator": "oracle", "landing.classifier": "off", "sim.threads": 1,
    "camera.width": 64, "camera.height": 36,
}  # fmt: skip
"""nothing looks: the camera is small because it takes time to make"""
_DRAWN = ("seed", "wind.mean_kmh", "wind.wakes", "mapper.enabled")


@dataclass(frozen=True, kw_only=True, slots=True)
class Ranges:
    """Ranges that the conditions of a contact are drawn from, evenly."""

    friction: tuple[float, float] = (0.3, 0.9)
    """coefficient of sliding friction of the feet on the ground"""
    speed_mps: tuple[float, float] = (0.0, 0.5)
    """over the ground at the contact, in any direction"""
    wind_kmh: tuple[float, float] = (0.0, 40.0)
    """mean at 20 ft; at the vehicle by the profile of ``wind.roughness_length_m``"""

    def __post_init__(self) -> None:
        for one in fields(self):
            low, high = getattr(self, one.name)
            if not 0.0 <= low <= high:
                raise ValueError(f"{one.name} from {low:g} to {high:g}: give 0 <= LOW <= HIGH")


def contact_config(overrides: Sequence[str] = (), profile: str = "field") -> Config:
    """The configuration of all contacts. Raises UsageError."""
    for text in overrides:
        key = text.partition("=")[0].strip()
        if key in _FIXED or key in _DRAWN:
            raise UsageError(f"--set {text}: the bench sets '{key}' itself")
    fixed = [f"{key}={str(value).lower()}" for key, value in _FIXED.items()]
    config = load_config(overrides=[*fixed, *overrides], profile=profile)
    if config.control.controller == PX4:
        raise UsageError("control.controller 'px4' has no final descent of its own to be tried")
    return config.model_copy(update={"mapper": replace(config.mapper, enabled=False)})


def trials(config: Config, ranges: Ranges, contacts: int, seed: int) -> Iterator[Trial]:
    """``contacts`` of each level of each ground. A trial does not depend on how many there are."""
    for kind, legs in GROUNDS:
        for level in SLOPES_DEG if kind == "slope" else HEIGHTS_M[1:]:
            terrain = Terrain(kind, legs, level)
            for number in range(contacts):
                name = crc32(f"{terrain.name} {level:g}".encode())
                rng = np.random.default_rng([seed, name, number])
                drawn = Conditions(*(float(rng.uniform(*getattr(ranges, one.name)))
                                     for one in fields(ranges)))  # fmt: skip
                own = config.model_copy(update={"seed": int(rng.integers(2**31))})
                yield Trial(own, terrain, drawn)


def measure(
    *,
    contacts: int = 100,
    seed: int = 0,
    jobs: int = 1,
    bound: float = 0.05,
    ranges: Ranges | None = None,
    overrides: Sequence[str] = (),
    profile: str = "field",
    report: Callable[[int, int], None] = lambda _done, _all: None,
) -> dict[str, Any]:
    """Flies all contacts and returns the figures of `figures_of`. Raises UsageError."""
    ranges = ranges or Ranges()
    config = contact_config(overrides, profile)
    planned = list(trials(config, ranges, contacts, seed))
    touches = []
    for touch in mapped(fly_trial, planned, jobs):
        touches.append(touch)
        report(len(touches), len(planned))
    asked: dict[str, Any] = {"seed": seed, "profile": profile, "set": list(overrides)}
    asked["slide_m"] = pad_margin_m(vehicle_model(bare_vehicle(), prefix=""))
    return asked | figures_of(touches, ranges, bound, config)


def figures_of(
    touches: Sequence[Touch], ranges: Ranges, bound: float, config: Config
) -> dict[str, Any]:
    """``levels``: probabilities by ground and size; ``maps``: by size and condition; ``limits``:
    the largest slope and height up to which the upper end of the probability to fail stays below
    ``bound``; ``rule``: failures where the true rule calls the ground safe, and where not."""
    levels, maps = [], []
    stands: dict[str, float | None] = {}
    for name, own in _grouped(touches, lambda t: t.terrain.name):
        by_size = _grouped(own, lambda t: t.terrain.size)
        rows = [_level(name, size, some) for size, some in by_size]
        levels += rows
        stands[name] = _limit(rows, bound)
        maps += [_map(name, dial, by_size, ranges) for dial in (f.name for f in fields(ranges))]
    heights = [value for name, value in stands.items() if name != "slope"]
    known = [value for value in heights if value is not None]
    judged = _grouped(touches, lambda t: t.safe_geometry)
    return {
        "contacts": len(touches),
        "ranges": {one.name: list(getattr(ranges, one.name)) for one in fields(ranges)},
        "bound": bound,
        "levels": levels,
        "maps": maps,
        "limits": {
            "by_ground": stands,
            "max_slope_deg": stands.get("slope"),
            "max_step_m": min(known, default=None) if len(known) == len(heights) else None,
        },
        "present": {
            "max_slope_deg": config.landing.max_slope_deg, "max_step_m": config.landing.max_step_m
        },
        "rule": {"safe" if safe else "unsafe": _fails(own) for safe, own in judged},
    }  # fmt: skip


def _grouped(
    touches: Sequence[Touch], key: Callable[[Touch], Any]
) -> list[tuple[Any, list[Touch]]]:
    """Touches by ``key``, in the order in which the keys come."""
    found: dict[Any, list[Touch]] = {}
    for touch in touches:
        found.setdefault(key(touch), []).append(touch)
    return list(found.items())


def _fails(touches: Sequence[Touch]) -> dict[str, Any]:
    failed = sum(touch.fails != "" for touch in touches)
    found: Estimate = fraction_interval(failed, len(touches))
    return {"contacts": len(touches), "fails": failed, "probability": found.value,
            "low": found.low, "high": found.high}  # fmt: skip


def _level(ground: str, size: float, touches: Sequence[Touch]) -> dict[str, Any]:
    counted = {name: sum(touch.fails == name for touch in touches) for name in FAILURES}
    return {"ground": ground, "size": size, **_fails(touches), **counted}


def _limit(rows: Sequence[dict[str, Any]], bound: float) -> float | None:
    """The largest size such that it and all smaller ones are below the bound."""
    largest = None
    for row in rows:
        if row["high"] > bound:
            break
        largest = row["size"]
    return largest


def _map(
    ground: str, dial: str, by_size: Sequence[tuple[float, list[Touch]]], ranges: Ranges
) -> dict[str, Any]:
    """Failures by size (rows) and by the dial in even bins (columns); None without a contact."""
    low, high = getattr(ranges, dial)
    edges = np.linspace(low, high, BINS + 1)
    cells = []
    for _, touches in by_size:
        values = np.array([getattr(touch.conditions, dial) for touch in touches])
        bins = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, BINS - 1)
        inside = [[t for t, b in zip(touches, bins, strict=True) if b == n] for n in range(BINS)]
        cells.append([_fails(some) if some else None for some in inside])
    sizes = [size for size, _ in by_size]
    return {"ground": ground, "dial": dial, "edges": edges.tolist(), "sizes": sizes, "cells": cells}


def table(figures: dict[str, Any]) -> str:
    """The figures as text."""
    lines = [f"{'ground':18}{'size':>7}  contacts  tips strikes slides  fails (95 % interval)"]
    for row in figures["levels"]:
        unit = "°" if row["ground"] == "slope" else " m"
        lines.append(
            f"{row['ground']:18}{row['size']:5g}{unit:2}{row['contacts']:10}"
            f"{row['tips']:6}{row['strikes']:8}{row['slides']:7}  {_percent(row)}"
        )
    limits, present = figures["limits"], figures["present"]
    lines.append(f"fails at most {100 * figures['bound']:g} %, upper end of the interval:")
    for key, unit in (("max_slope_deg", "°"), ("max_step_m", " m")):
        found = "none of the levels" if limits[key] is None else f"{limits[key]:g}{unit}"
        lines.append(f"  {key:14}{found}  (landing.{key} is {present[key]:g}{unit})")
    for verdict, row in figures["rule"].items():
        lines.append(f"the true rule says {verdict}: {row['fails']} of {row['contacts']} fail, "
                     f"{_percent(row)}")  # fmt: skip
    return "\n".join(lines)


def _percent(row: dict[str, Any]) -> str:
    return f"{100 * row['probability']:.0f} % ({100 * row['low']:.1f} to {100 * row['high']:.1f})"
