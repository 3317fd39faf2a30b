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


def hint_for(key: str, known: Iterable[str]) -> str:
    """The hint with the present name of a renamed key, else with the nearest known one."""
    return f" (it is '{RENAMED[key]}' now)" if key in RENAMED else nearest(key, known)


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
