"""Dotted keys of nested tables."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from touchdown.experiments.config.external_table import PREFIX
from touchdown.experiments.errors import nearest

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
    "landing.level_weight": "landing.risk.weight_level",
    "landing.clearance_weight": "landing.risk.weight_room",
    "landing.traffic_penalty": "landing.risk.weight_traffic",
    "landing.plants_penalty": "landing.risk.weight_plants",
}
"""Keys of earlier versions and their names now."""

REMOVED_GROUPS = ("survey_fit",)
"""Groups of keys of earlier versions that are constants now."""

RENAMED_GROUPS: Mapping[str, str] = {"paper": "zou2024"}
"""Groups of keys of earlier versions and their names now."""

RENAMED_VALUES: Mapping[tuple[str, str], str] = {
    ("estimator", "paper"): "zou2024",
    ("gps.preset", "paper"): "zou2024",
}
"""Values of earlier versions, by key, and their names now."""


def present_name(key: str) -> str:
    """The name now of a key of an earlier version; ``key`` itself where it was not renamed."""
    group, dot, rest = key.partition(".")
    return RENAMED.get(key) or f"{RENAMED_GROUPS.get(group, group)}{dot}{rest}"


def present_value(key: str, value: Any) -> Any:
    """The name now of a value of an earlier version; ``value`` itself where it was not renamed."""
    return RENAMED_VALUES.get((key, value), value) if isinstance(value, str) else value


def hint_for(key: str, known: Iterable[str]) -> str:
    """The hint with the present name of a renamed key, else with the nearest known one."""
    now, known = present_name(key), tuple(known)
    return f" (it is '{now}' now)" if now != key and now in known else nearest(now, known)


def hint_for_value(key: str, value: str, known: Iterable[str]) -> str:
    """The hint with the present name of a renamed value, else with the nearest known one."""
    now = present_value(key, value)
    return f" (it is '{now}' now)" if now != value else nearest(value, known)


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
