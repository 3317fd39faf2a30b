"""Picture of rugged ground: materials, the light on rocks and lumps, and their shadows."""

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import ndimage

from touchdown.scenes.api import Array, Bytes, Float32
from touchdown.scenes.authoring import micro_relief
from touchdown.scenes.authoring.ground import TEXELS, Canvas, Ground
from touchdown.scenes.authoring.light import light_in_shadow
from touchdown.scenes.authoring.noise import fractal_noise
from touchdown.scenes.authoring.relief import HALF_M, HeightField
from touchdown.scenes.authoring.water import upsample
from touchdown.scenes.places.rugged.presets import Dials
from touchdown.scenes.places.rugged.relief import CELL_M
from touchdown.scenes.places.rugged.rocks import Rocks, heap

_SMALL = 1280
_FINE = TEXELS // 2
_STEEP_DEG, _BARE_DEG = 35.0, 43.0
"""Slopes from which on ground is bare, and holds no snow"""
_SNOW_M = 0.06
_SOFT_M = 0.10
"""Depth below the edge of a shadow at which it is full"""


def paint_ground(
    rng: np.random.Generator, canvas: Canvas, dials: Dials, heights: Array, snow: Array, cut: Array,
    seen: Rocks, tussocks: Rocks,
) -> None:  # fmt: skip
    """Fills the canvas with the preset's materials: patches, bare faces, snow, trodden grooves,
    tussocks and rocks. heights, snow, cut: (NODES, NODES) metres."""
    look, shape = dials.preset, (_SMALL, _SMALL)
    cell = 2.0 * HALF_M / _SMALL

    def noise(wave_m: float, octaves: int) -> Float32:
        return _wide(fractal_noise(rng, shape, wave_m / cell, octaves, 0.6), _FINE)

    ragged = noise(1.4, 3)
    rise = np.hypot(*np.gradient(ndimage.gaussian_filter(heights, 0.35 / CELL_M), CELL_M))
    steep = np.rad2deg(np.arctan(upsample(rise, _FINE))) + 3.0 * ragged
    edge = 0.15 * ragged - 0.03 * (steep - 15.0)
    layer = np.full((_FINE, _FINE), int(look.ground), np.uint8)
    layer[noise(12.0, 5) + edge > 0.75] = int(look.patches[0])
    layer[noise(7.0, 4) + edge > 1.15] = int(look.patches[1])
    if dials.cover == "scree":
        strewn = Ground.GRAVEL if look.ground is Ground.LIMESTONE else Ground.SCREE
        layer[noise(9.0, 3) + 0.2 * ragged > 0.35] = int(strewn)
    layer[steep > _STEEP_DEG] = int(look.steep)
    if look.ruts:
        layer[upsample(cut, _FINE) > 0.08] = int(Ground.SOIL)
    for things, material in ((tussocks, Ground.DRY_GRASS), (seen, look.rock)):
        layer[heap(things, _FINE) > 0.0] = int(material)
    canvas.material[:] = cv2.resize(layer, (TEXELS, TEXELS), interpolation=cv2.INTER_NEAREST)
    white = (upsample(snow, _FINE) + 0.015 * ragged - _SNOW_M) * (steep < _BARE_DEG)
    white[heap(seen, _FINE) > 0.0] = -1.0
    if snow.any():
        canvas.material[_wide(white, TEXELS) > 0.0] = int(Ground.SNOW)
    _stain(rng, canvas, dials, heights, cut, steep)


def _wide(raster: Float32, size: int) -> Float32:
    """(size, size), linearly."""
    wide = cv2.resize(raster, (size, size), interpolation=cv2.INTER_LINEAR)
    return np.asarray(wide, np.float32)


def _stain(
    rng: np.random.Generator, canvas: Canvas, dials: Dials, heights: Array, cut: Array,
    steep: Float32,
) -> None:  # fmt: skip
    """Layers on the faces, and the dark of grooves."""
    dark = 235.0 * np.clip(upsample(cut, _FINE) / 0.3, 0.0, 1.0) * (not dials.preset.ruts)
    if dials.preset.strata_m > 0.0:
        bend = 0.25 * fractal_noise(rng, (_FINE, _FINE), 500.0, 3, 0.5)
        level = upsample(heights, _FINE) / dials.preset.strata_m + bend
        bands = np.sin(2.0 * np.pi * level) + 0.6 * np.sin(2.0 * np.pi * 2.7 * level + 1.0)
        face = np.clip((steep - 14.0) / 16.0, 0.12, 1.0)
        dark = np.maximum(dark, 62.0 * face * np.clip(bands + 0.3, 0.0, 1.6))
    np.maximum(
        canvas.stain, _wide(dark.astype(np.float32), TEXELS).astype(np.uint8), out=canvas.stain
    )


def light_slopes(
    rng: np.random.Generator, ground: Array, terrain: HeightField, sun: Array,
    things: tuple[Rocks, ...],
) -> Bytes:  # fmt: skip
    """Tones of the ground, as of `MicroRelief.shading`: the light on slopes, on rocks that are
    finer than the nodes, and in the shadows that all of them throw. ground: (NODES, NODES) metres
    without rocks. sun: (3,) the direction in which light travels."""
    fine = micro_relief.MicroRelief()
    raised = np.zeros((_FINE, _FINE), np.float32)
    for one in things:
        np.maximum(raised, heap(one, _FINE).astype(np.float32), out=raised)
    grain = fractal_noise(rng, (_FINE, _FINE), 5.0, 3, 0.7)
    fine.drifts_m[:] = cv2.GaussianBlur(raised, (0, 0), 0.7) + np.float32(0.0035) * grain
    fine.stand_on(HeightField(heights_m=ground))
    tone = fine.shading(rng, sun)
    # Nodes hold half of what a small rock rises.
    surface = upsample(terrain.heights_m, _FINE) + np.float32(0.4) * raised
    depth = shadow_depth(surface, sun, 2.0 * HALF_M / _FINE)
    full = 1.0 - light_in_shadow()
    left = 1.0 - full * np.clip((depth - 0.02) / _SOFT_M, 0.0, 1.0)
    wide = cv2.resize(left.astype(np.float32), (TEXELS, TEXELS), interpolation=cv2.INTER_LINEAR)
    np.multiply(tone, wide, out=tone, casting="unsafe")
    return tone


def shadow_depth(heights: Float32, sun: Array, cell_m: float) -> NDArray[np.float32]:
    """(n, n) metres below the edge of the shadow that the surface throws on itself, row 0 at
    y_min; 0 in the light."""
    across = abs(sun[0]) > abs(sun[1])
    x, y = (sun[1], sun[0]) if across else (sun[0], sun[1])
    seen = heights.T if across else heights
    seen = np.ascontiguousarray(seen[::-1] if y < 0.0 else seen)
    lid = np.empty_like(seen)
    drop = -sun[2] / max(abs(y), 1e-9) * cell_m
    _sweep(seen, lid, float(x / max(abs(y), 1e-9)), float(drop))
    lid -= seen
    lid = lid[::-1] if y < 0.0 else lid
    return np.ascontiguousarray(lid.T if across else lid)


@njit(cache=True, error_model="numpy")
def _sweep(heights: Float32, lid: Float32, slant: float, drop: float) -> None:
    """Height of the shadow's edge over each cell: light comes from row - 1, col - slant."""
    rows, cols = heights.shape
    lid[0] = heights[0]
    for row in range(1, rows):
        for col in range(cols):
            at = min(max(col - slant, 0.0), cols - 1.001)
            left = int(at)
            part = at - left
            edge = lid[row - 1, left] * (1.0 - part) + lid[row - 1, left + 1] * part - drop
            lid[row, col] = max(heights[row, col], edge)
