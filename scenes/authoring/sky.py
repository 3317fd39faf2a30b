"""The light under which scenes are made: day, overcast, dusk or night.

It is a property of the context, not of a scene's plan: generators draw the same numbers under every
light. Only what is drawn of them changes: lamps of the model, shadows in the ground's texture, the
sky. All lights show a level white surface about equally bright; how bright that is in lux is
`scenes.api.LIGHT_LUX`, and a camera's exposure deals with it.

- overcast: no sun. A light from the zenith and an even one give walls 0.4 of the light of level
  ground, as under the CIE's overcast sky;
- dusk: the sun stands 2 degrees high. A quarter of the light on level ground comes from it, with
  long, soft shadows, three quarters from the sky. What faces the sun is no brighter than 1.2 times
  a white level surface, which the eight bits of a drawing ask for;
- night: no sun and no lamps, an even light, which leaves the occlusion below objects.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from contextvars import ContextVar
from typing import Any, NamedTuple

import mujoco

from touchdown.scenes.api import Light, LowSun

DUSK_SUN_DEG = 2.0
DUSK_SUN_SHARE = 0.25
"""of the light on level ground at dusk"""


class Sky(NamedTuple):
    """Light, and the sun of ``day`` where it is not the scene's own."""

    light: Light = "day"
    sun: LowSun | None = None


_DAY = Sky()
_sky: ContextVar[Sky] = ContextVar("sky", default=_DAY)

_SKIES: dict[str, tuple[list[float], list[float]]] = {
    "overcast": ([0.70, 0.72, 0.75], [0.84, 0.85, 0.86]),
    "dusk": ([0.30, 0.36, 0.55], [0.96, 0.66, 0.42]),
    "night": ([0.03, 0.04, 0.07], [0.08, 0.09, 0.13]),
}
"""Colours of a gradient sky, zenith and horizon"""


@contextlib.contextmanager
def lit_by(light: Light, sun: LowSun | None = None) -> Iterator[None]:
    """Gives this light to all scenes made inside the context; ``sun`` None leaves each its own."""
    token = _sky.set(Sky(light, sun))
    try:
        yield
    finally:
        _sky.reset(token)


def present_sky() -> Sky:
    """The light of the context."""
    return _sky.get()


def sun_shines() -> bool:
    """True by day: shadows are sharp and water glints."""
    return _sky.get().light == "day"


def light_in_shadow(by_day: float) -> float:
    """Share of the light that a full shadow leaves, which is ``by_day`` under the sun."""
    light = _sky.get().light
    if light == "day":
        return by_day
    return 1.0 - DUSK_SUN_SHARE if light == "dusk" else 1.0


def set_sky(spec: Any) -> None:
    """Colours the gradient sky of a model."""
    colours = _SKIES.get(_sky.get().light)
    if colours is None:
        return
    for texture in spec.textures:
        gradient = texture.builtin == mujoco.mjtBuiltin.mjBUILTIN_GRADIENT
        if texture.type == mujoco.mjtTexture.mjTEXTURE_SKYBOX and gradient:
            texture.rgb1, texture.rgb2 = colours
