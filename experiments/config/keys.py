"""Dotted keys of nested tables, and those that tell the runs of one directory apart."""

import json
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from touchdown.experiments.config.files import read_tree
from touchdown.experiments.errors import UsageError
from touchdown.scenes.api import DEFAULT_VEHICLE

RENAMED: Mapping[str, str] = {
    "livo.mount_turn_sigma_deg": "livo.mount_rotation_sigma_deg",
    "livo.mount_shift_sigma_m": "livo.mount_translation_sigma_m",
    "livo.camera_turn_sigma_deg": "livo.camera_rotation_sigma_deg",
    "livo.camera_shift_sigma_m": "livo.camera_translation_sigma_m",
    "landing.scorer": "landing.selector",
    "landing.weight_flatness": "landing.zou2024.weight_flatness",
    "landing.weight_smoothness": "landing.zou2024.weight_smoothness",
    "landing.weight_distance": "landing.zou2024.weight_distance",
    "landing.energy_weight": "landing.risk.weight_distance",
    "landing.level_weight": "landing.risk.weight_slope",
    "landing.clearance_weight": "landing.risk.weight_clearance",
    "landing.traffic_penalty": "landing.risk.weight_traffic",
    "landing.plants_penalty": "landing.risk.weight_plants",
    "landing.second_look": "landing.site_recheck",
    **{
        f"landing.{selector}.{old}": f"landing.{selector}.{new}"
        for selector in ("risk", "zou2024")
        for old, new in (("weight_room", "weight_clearance"), ("weight_level", "weight_slope"))
    },
    **{
        f"{key}_share": f"{key}_fraction"
        for key in (
            "vehicle_error.mass",
            "vehicle_error.thrust",
            "vehicle_error.torque",
            "vehicle_error.rotor",
            "faults.motor_loss",
            "faults.dirt",
            "livo.assumed_depth",
            "landing.wind_thrust",
            "landing.wind_gust",
            "calibration_error.readout",
        )
    },
}
"""Keys of earlier versions and their names now."""

REMOVED_GROUPS = ("survey_fit",)
"""Groups of keys of earlier versions that are constants now."""

RENAMED_GROUPS: Mapping[str, str] = {"paper": "zou2024"}
"""Groups of keys of earlier versions and their names now."""

RENAMED_VALUES: Mapping[tuple[str, str], str] = {
    ("estimator", "paper"): "zou2024",
    ("gps.preset", "paper"): "zou2024",
    **{
        (f"landing.{selector}.terms", old): new
        for selector in ("risk", "zou2024")
        for old, new in (("room", "clearance"), ("level", "slope"))
    },
}
"""Values of earlier versions, by key, and their names now."""


def renewed(values: Mapping[str, Any], source: str) -> dict[str, Any]:
    """``values`` by the keys, and with the names, of this version. Those of earlier versions are
    told in one warning that names ``source``."""
    found: dict[str, Any] = {}
    told = []
    for key, value in values.items():
        now, value_now = _present_key(key), _present_value(key, value)
        found[now] = value_now
        if now != key:
            told.append(f"'{key}' is '{now}'")
        elif value_now is not value and value_now != value:
            told.append(f"{key} = {value!r} is {value_now!r}")
    if told:
        warnings.warn(f"{source}: earlier names: {'; '.join(told)} now", stacklevel=3)
    return found


def _present_key(key: str) -> str:
    group, dot, rest = key.partition(".")
    return RENAMED.get(key) or f"{RENAMED_GROUPS.get(group, group)}{dot}{rest}"


def _present_value(key: str, value: Any) -> Any:
    if isinstance(value, list):
        return [_present_value(key, item) for item in value]
    return RENAMED_VALUES.get((key, value), value) if isinstance(value, str) else value


def flatten(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """(dotted key, value) of every leaf of nested tables."""
    for name, value in tree.items():
        if isinstance(value, dict):
            yield from flatten(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


BASES: Mapping[str, str] = {
    "profile": "field", "preset": "whole", "vehicle": DEFAULT_VEHICLE, "rig": ""
}  # fmt: skip
"""Keys whose values set many others, and their values where nothing names one. An empty rig is the
vehicle's own sensors."""


def base_in(values: Mapping[str, Any], key: str) -> str:
    """What ``values`` by dotted key name for a key of `BASES`."""
    name = values.get(key)
    return name if isinstance(name, str) else BASES[key]


WITHOUT_EFFECT = ("record", "log.", "sim.threads")
"""Keys, or their beginnings, that change nothing of a flight."""
UNTOLD = ("scene", "seed", "estimator", *WITHOUT_EFFECT)
"""Keys, or their beginnings, that every result has, too, or that change nothing of a flight."""


def settings_apart(runs: Sequence[Path]) -> list[dict[str, Any]]:
    """The keys of ``config.json`` in which some of the run directories differ, and their values in
    each; None for a key that a run's file lacks. A run without a readable file has no settings.
    """
    values = [_values(run / "config.json") for run in runs]
    known = [one for one in values if one]
    keys = {key: None for one in known for key in one if not key.startswith(UNTOLD)}
    apart = [key for key in keys if len({json.dumps(one.get(key)) for one in known}) > 1]
    return [{key: one.get(key) for key in apart} if one else {} for one in values]


def _values(file: Path) -> dict[str, Any]:
    try:
        return dict(flatten(read_tree(file)))
    except UsageError:
        return {}
