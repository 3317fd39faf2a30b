"""Registry of the named scenes."""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING

from touchdown.scenes.api import DeckParams, Dials, RuggedParams

if TYPE_CHECKING:
    from touchdown.scenes.authoring.draft import SceneDraft

_NAMES = (
    "cottage", "crossroad", "deck", "dunes", "flat", "footbridge", "forest", "houses", "lake",
    "open_water", "pools", "rooftop_parking", "rugged", "snow", "turf",
)  # fmt: skip
RUGGED, DECK = "rugged", "deck"
"""The scenes that `RuggedParams` and `DeckParams` describe."""
_DIALS: Mapping[str, type[Dials]] = {RUGGED: RuggedParams, DECK: DeckParams}


def dials_of(name: str, given: Dials | None) -> Dials | None:
    """Those that the scene is made with: of a scene without dials None."""
    kind = _DIALS.get(name)
    return None if kind is None else given or kind()


def scene_names() -> list[str]:
    """Returns the names that `scenes.compose.load_scene` accepts, sorted."""
    return list(_NAMES)


def scene_generator(name: str, dials: Dials | None = None) -> Callable[[int], SceneDraft]:
    """Returns the generator (seed -> draft) of a named scene. dials: of a scene that has any.

    Raises ValueError for an unknown name, with the nearest match and all names.
    """
    if name not in _NAMES:
        near = difflib.get_close_matches(name, _NAMES, n=1, cutoff=0.5)
        hint = f" did you mean '{near[0]}'?" if near else ""
        known = ", ".join(scene_names())
        raise ValueError(
            f"unknown scene '{name}':{hint} known scenes: {known}; or give the path of an MJCF file"
        )
    place = importlib.import_module(f"touchdown.scenes.places.{name}")
    generate: Callable[..., SceneDraft] = place.generate
    found = dials_of(name, dials)
    return generate if found is None else partial(generate, params=found)
