"""Names of the runs of a campaign: how they are made, and whether a name that is read back from a
file is one of them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from touchdown.experiments.config.loading import OPTION_KEYS
from touchdown.experiments.config.slots import SLOTS
from touchdown.experiments.io.untrusted import is_plain_name
from touchdown.scenes.api import short_name

AXES: Mapping[str, str] = {
    "scene": "scene",
    "estimator": "estimator",
    "seed": "seed",
    "wind_kmh": OPTION_KEYS["wind_kmh"],
    **{kind: slot.key for kind, slot in SLOTS.items() if kind != "estimator"},
}
"""Short names of axes and the keys that they set; any other key is an axis by its own name."""

_FIRST = ("scene", "estimator", "seed")
_LABELS = {
    "wind_kmh": "w", "faults.events": "", "profile": "", "harsh_effects": "", "preset": "",
    **{name: "" for slot in SLOTS.values() for name in (slot.kind, slot.key)},
}  # fmt: skip
"""Prefixes of the values of an axis in run names, where it is not the last part of its key."""


def run_name(place: Mapping[str, Any], axes: Mapping[str, list[Any]]) -> str:
    """``crossroad-gps-s3``, then every further axis that has several values."""
    parts = [_start(place)]
    for axis, value in place.items():
        if axis not in _FIRST and len(axes[axis]) > 1:
            parts.append(_part(axis, value))
    return "-".join(parts)


def is_run_name(name: object, values: Mapping[str, Any]) -> bool:
    """True if a campaign could have called a run of these ``values`` (dotted keys) ``name``: its
    scene, estimator and seed, then some of its values in any order, since a run keeps the name that
    it had when fewer axes had several values."""
    if not isinstance(name, str) or not is_plain_name(name) or any(k not in values for k in _FIRST):
        return False
    start = _start(values)
    if not name.startswith(start):
        return False
    axes = {key: axis for axis, key in AXES.items()}
    parts = {
        f"-{_part(axis, value)}"
        for key, value in values.items()
        if key not in _FIRST
        for axis in (key, axes.get(key, key))
    }
    reached = {len(start)}
    for place in range(len(start), len(name)):
        if place in reached:
            reached |= {place + len(part) for part in parts if name.startswith(part, place)}
    return len(name) in reached


def _start(values: Mapping[str, Any]) -> str:
    scene, estimator, seed = (values[key] for key in _FIRST)
    return "-".join(map(_plain, (short_name(str(scene)), str(estimator), f"s{seed}")))


def _part(axis: str, value: Any) -> str:
    label = _LABELS.get(axis, axis.rpartition(".")[2])
    return _plain(f"{label}{_slug(value) or 'none'}")


def _plain(text: str) -> str:
    return re.sub(r"[^\w.+-]+", ".", text)


def _slug(value: Any) -> str:
    if isinstance(value, list):
        return "_".join(_slug(item) for item in value)
    return f"{value:g}" if isinstance(value, float) else str(value).replace("*", "x")
