"""Registry of the named scenes."""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

from touchdown.scenes.api import RuggedParams

if TYPE_CHECKING:
    from touchdown.scenes.authoring.draft import SceneDraft

_NAMES = (
    "cottage", "crossroad", "dunes", "flat", "footbridge", "forest", "houses", "lake",
    "open_water", "pools", "rooftop_parking", "rugged", "snow", "turf",
)  # fmt: skip
RUGGED = "rugged"
"""The scene that `RuggedParams` describe."""


def scene_names() -> list[str]:
    """Returns the names that `scenes.compose.load_scene` accepts, sorted."""
    return list(_NAMES)


def scene_generator(name: str, rugged: RuggedParams | None = None) -> Callable[[int], SceneDraft]:
    """Returns the generator (seed -> draft) of a named scene. rugged: dials of `RUGGED`, which the
    other scenes do not look at.

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
    return generate if name != RUGGED else partial(generate, params=rugged or RuggedParams())
