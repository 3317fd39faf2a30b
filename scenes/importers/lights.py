"""The light of a file's scene: whether its ground is lit, and the sun of one that is not."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from touchdown.scenes.api import Array
from touchdown.scenes.importers.top_view import Place

DARK = 0.15
"""Light on level ground, 1 for a white one: below it pictures are mostly noise."""


def add_sun(spec: Any) -> None:
    """Adds a sun to ``spec``, and the light of the sky."""
    taken = any(light.name == "sun" for light in spec.lights)
    spec.worldbody.add_light(
        name="" if taken else "sun", type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        dir=[-0.4, 0.3, -0.86],
        diffuse=[0.62, 0.60, 0.55], ambient=[0.20, 0.20, 0.22], castshadow=False,
    )  # fmt: skip


def ground_light(place: Place) -> float:
    """Returns the light on most of the ground that is seen, were it level, without shadows: the
    median of the sums over lamps and the camera's light (OpenGL 2.1 specification, section
    2.14.1, which MuJoCo draws by)."""
    model, data, points = place.model, place.data, place.points()
    mujoco.mj_comPos(model, data)
    mujoco.mj_camlight(model, data)
    head = model.vis.headlight
    light = np.full(len(points), head.active * (np.mean(head.ambient) + np.mean(head.diffuse)))
    for lamp in range(model.nlight):
        if model.light_active[lamp]:
            falls = _falling(model, data, lamp, points)
            light += falls * model.light_diffuse[lamp].mean() + model.light_ambient[lamp].mean()
    return float(np.median(light)) if len(light) else 0.0


def _falling(model: Any, data: Any, lamp: int, points: Array) -> Array:
    """(N,) share of a lamp's light that falls on level ground at (N, 3) points."""
    kind, axis = int(model.light_type[lamp]), data.light_xdir[lamp]
    if kind == int(mujoco.mjtLightType.mjLIGHT_DIRECTIONAL):
        return np.full(len(points), max(-axis[2], 0.0))
    way = points - data.light_xpos[lamp]
    far = np.maximum(np.linalg.norm(way, axis=1), 1e-6)
    fall = np.maximum(-way[:, 2] / far, 0.0)
    weaker = np.stack([far**0, far, far**2], axis=1) @ model.light_attenuation[lamp]
    fall /= np.maximum(weaker, 1e-6)
    if kind == int(mujoco.mjtLightType.mjLIGHT_SPOT):
        along = np.maximum(way @ axis / far, 0.0)
        inside = along >= np.cos(np.deg2rad(model.light_cutoff[lamp]))
        fall *= inside * along ** model.light_exponent[lamp]
    return np.asarray(fall)
