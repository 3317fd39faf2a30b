"""Bakes sunlight into the ground texture: shadows along the sun, and ambient occlusion below
objects.

Real-time shadow maps would triple the render time on a software renderer.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from touchdown.scenes.api import Array, Float32
from touchdown.scenes.authoring.builder import Caster
from touchdown.scenes.authoring.height_field import HeightField
from touchdown.scenes.authoring.sky import light_in_shadow

_SUBPIXEL_BITS = 4
_SLOPE_STEPS = 3
"""Steps towards the point where a sun ray meets the slope; each shrinks the error by the slope
over the sun's own."""


def bake_light(
    casters: list[Caster],
    terrain: HeightField,
    sun_direction: Array,
    pixels: int,
    ambient: float,
    hilly: bool = False,
) -> Float32:
    """Returns the share of full light on the ground, (pixels, pixels) float32 in (0, 1], row 0 at
    y_min.

    sun_direction: (3,) unit, the direction in which the light travels. ambient: light left in full
    shadow by day; under other lights `scenes.authoring.sky` gives it. Casters are projected on the
    level ground at their own foot, or, in ``hilly`` scenes, on the slope that the shadow falls on;
    overlaps multiply."""
    ambient = light_in_shadow(ambient)
    cell = 2.0 * terrain.half_m / pixels
    sun = np.ones((pixels, pixels), np.float32)
    sky = np.ones((pixels // 4, pixels // 4), np.float32)
    for caster in casters:
        points = caster.points
        middle = points[:, :2].mean(axis=0)
        ground = terrain.point(*middle)
        height = np.maximum(points[:, 2] - ground, 0.0)
        lift = float(height.min())
        if ambient < 1.0:
            shadow = points[:, :2] - height[:, None] * sun_direction[:2] / sun_direction[2]
            for _ in range(_SLOPE_STEPS if hilly else 0):
                height = np.maximum(points[:, 2] - terrain.at(shadow), 0.0)
                shadow = points[:, :2] - height[:, None] * sun_direction[:2] / sun_direction[2]
            _darken(sun, shadow, terrain.half_m, cell, 1.0 - caster.opacity)
        # Low objects dim the ground around their foot, high crowns hardly do.
        _darken(sky, points[:, :2], terrain.half_m, 4.0 * cell, 1.0 - 0.55 * np.exp(-lift / 1.5))
    soft = cv2.GaussianBlur(sun, (0, 0), 0.8)
    open_sky = cv2.GaussianBlur(sky, (0, 0), 0.35 / (4.0 * cell))
    open_sky = cv2.resize(open_sky, (pixels, pixels), interpolation=cv2.INTER_LINEAR)
    light = np.asarray(soft, np.float32)
    light *= 1.0 - ambient  # in place: each new raster would cost more than the sum
    light += ambient
    sky = np.asarray(open_sky, np.float32)
    sky *= 0.55
    sky += 0.45
    light *= sky
    return light


def _darken(layer: Float32, outline: Array, half_m: float, cell: float, factor: float) -> None:
    """Multiplies the convex hull of ``outline`` (N, 2) metres into ``layer``."""
    hull = cv2.convexHull(((outline + half_m) / cell - 0.5).astype(np.float32))[:, 0]
    (left, right), (low, high) = (_span(axis, len(layer)) for axis in hull.T.tolist())
    if high <= low or right <= left:
        return
    mask = np.zeros((high - low, right - left), np.uint8)
    corners = np.round((hull - (left, low)) * 2**_SUBPIXEL_BITS).astype(np.int32)
    cv2.fillConvexPoly(mask, corners, 255, cv2.LINE_AA, _SUBPIXEL_BITS)
    window = layer[low:high, left:right]
    window *= 1.0 - (1.0 - factor) * (mask.astype(np.float32) / 255.0)


def _span(places: list[float], pixels: int) -> tuple[int, int]:
    """First and past-the-last pixel around ``places``."""
    low, high = math.floor(min(places)) - 1, math.ceil(max(places)) + 2
    return min(max(low, 0), pixels), min(max(high, 0), pixels)
