"""The scenes that have a name."""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Callable

from scenes.draft import SceneDraft

_GENERATORS = {
    "footbridge": "scenes.footbridge.generate",
    "rooftop_parking": "scenes.rooftop_parking.generate",
    "cottage": "scenes.cottage.generate",
    "crossroad": "scenes.crossroad.generate",
    "forest": "scenes.forest.generate",
    "turf": "scenes.turf.generate",
    "flat": "scenes.flat.generate",
    "houses": "scenes.houses.generate",
    "lake": "scenes.lake.generate",
    "pools": "scenes.pools.generate",
    "open_water": "scenes.open_water.generate",
}


def scene_names() -> list[str]:
    """Names that `scenes.compose.load_scene` knows, sorted."""
    return sorted(_GENERATORS)


def scene_generator(name: str) -> Callable[[int], SceneDraft]:
    """The function seed -> draft of a named scene.

    Raises ValueError for an unknown name, with the nearest match and all names.
    """
    if name not in _GENERATORS:
        near = difflib.get_close_matches(name, _GENERATORS, n=1, cutoff=0.5)
        hint = f" did you mean '{near[0]}'?" if near else ""
        known = ", ".join(scene_names())
        raise ValueError(
            f"unknown scene '{name}':{hint} known scenes: {known}; or give the path of an MJCF file"
        )
    generate: Callable[[int], SceneDraft] = importlib.import_module(_GENERATORS[name]).generate
    return generate
