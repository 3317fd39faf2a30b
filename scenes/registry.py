"""Registry of the named scenes."""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from touchdown.scenes.authoring.draft import SceneDraft

_GENERATORS = {
    "footbridge": "touchdown.scenes.places.footbridge.generate",
    "rooftop_parking": "touchdown.scenes.places.rooftop_parking.generate",
    "cottage": "touchdown.scenes.places.cottage.generate",
    "crossroad": "touchdown.scenes.places.crossroad.generate",
    "forest": "touchdown.scenes.places.forest.generate",
    "turf": "touchdown.scenes.places.turf.generate",
    "flat": "touchdown.scenes.places.flat.generate",
    "houses": "touchdown.scenes.places.houses.generate",
    "lake": "touchdown.scenes.places.lake.generate",
    "pools": "touchdown.scenes.places.pools.generate",
    "open_water": "touchdown.scenes.places.open_water.generate",
    "dunes": "touchdown.scenes.places.dunes.generate",
    "snow": "touchdown.scenes.places.snow.generate",
}


def scene_names() -> list[str]:
    """Returns the names that `scenes.compose.load_scene` accepts, sorted."""
    return sorted(_GENERATORS)


def scene_generator(name: str) -> Callable[[int], SceneDraft]:
    """Returns the generator (seed -> draft) of a named scene.

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
