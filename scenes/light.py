"""The sun of a scene, and the ground's picture under it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenes.bake import bake_light
from scenes.builder import Builder, fill_texture
from scenes.ground import Canvas, Ground, shade_ground

Array = NDArray[np.float64]


def draw_sun(rng: np.random.Generator, spec: Any) -> Array:
    """Turns and tints the light `sun`. Returns the way it travels, (3,) unit."""
    elevation, azimuth = np.deg2rad(rng.uniform(38.0, 62.0)), rng.uniform(0.0, 2.0 * np.pi)
    flat = np.cos(elevation)
    direction = -np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])
    warmth = rng.uniform(0.0, 1.0)
    strength = rng.uniform(0.62, 0.74) / np.sin(elevation) * 0.92
    light = spec.light("sun")
    light.dir = direction
    light.diffuse = strength * np.array([1.0, 0.985 - 0.04 * warmth, 0.95 - 0.12 * warmth])
    return direction


def ground_picture(
    builder: Builder,
    canvas: Canvas,
    sun: Array,
    pattern_angles: dict[Ground, float],
    hilly: bool = False,
) -> NDArray[np.uint8]:
    """The ground under the light and shadows of everything placed so far, (rows, cols, 3), top
    row = y_max. pattern_angles: as in `scenes.ground.shade_ground`; hilly: as in
    `scenes.bake.bake_light`."""
    pixels = len(canvas.material) // 2
    light = bake_light(builder.casters, builder.terrain, sun, pixels, 0.50, hilly)
    return shade_ground(builder.rng, canvas, light, pattern_angles)


def finish_picture(
    builder: Builder,
    canvas: Canvas,
    sun: Array,
    pattern_angles: dict[Ground, float],
    hilly: bool = False,
) -> None:
    """Gives the terrain its `ground_picture`, the texture `ground`."""
    picture = ground_picture(builder, canvas, sun, pattern_angles, hilly)
    fill_texture(builder.spec.texture("ground"), picture)
