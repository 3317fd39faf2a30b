"""Water in the ground texture: bottom seen through the shallows, ripples, sky and sun on them.

The bottom's colour is dimmed on its way up by absorption, exp(-k d) per channel (Beer and Lambert),
and gives way to the colour of the water's body; the sheet adds the sky by the slope of its ripples
and, where a facet happens to be tilted towards the sun, a glint. The light is the one seen from
straight above: it does not move with the camera.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numba import njit

from touchdown.scenes.api import LAND_CLASSES, NO_DETAIL_ID, Array, Bytes, Float32, GroundRaster
from touchdown.scenes.authoring.light import sun_shines
from touchdown.scenes.authoring.noise import fractal_noise
from touchdown.scenes.authoring.plane import draw_heading
from touchdown.scenes.authoring.variation import present_variation

WATER_REFLECTIVITY = 0.03
_TILE = 1024
_WET_M = 0.07
"""The bank is darkened up to this height over the water."""
_OPAQUE = 5.5
"""Depths of 1/e from which on nothing of the bottom is seen."""


@dataclass(frozen=True, kw_only=True, slots=True)
class WaterLook:
    """Colours RGB 0..255; lengths in metres."""

    body: tuple[float, float, float]
    """of deep water"""
    clarity_m: tuple[float, float, float]
    """depth at which a channel of the bottom is dimmed to 1/e"""
    sky: tuple[float, float, float] = (150.0, 176.0, 204.0)
    wave_m: float = 1.1
    """of the strongest ripples"""
    ripple: float = 0.5
    """strength of the ripples' relief, 0..1"""
    wind_angle: float = 0.0
    """radians; the ripples run this way"""


def draw_look(rng: np.random.Generator) -> WaterLook:
    """Returns the look of blue, green or grey water with waves of some metres."""
    colours = np.array([[18.0, 66.0, 96.0], [22.0, 80.0, 84.0], [46.0, 76.0, 88.0]])
    red, green, blue = rng.dirichlet(np.ones(3)) @ colours
    return WaterLook(
        body=(red, green, blue),
        clarity_m=(0.7, 1.5, 1.4),
        wave_m=float(rng.uniform(2.5, 5.0)),
        ripple=float(rng.uniform(0.45, 0.75)),
        wind_angle=draw_heading(rng),
    )


def varied(look: WaterLook) -> WaterLook:
    """As a scene draws it, or with the water of `scenes.authoring.ground.varied_materials`."""
    other = present_variation()
    if other is None:
        return look
    return replace(look, body=other.body, clarity_m=other.clarity_m, ripple=other.ripple)


def upsample(nodes: Array, size: int) -> Float32:
    """A raster (size, size) float32, row 0 at y_min, of a node grid over the same square (N, N),
    linearly as the terrain is."""
    scale = (len(nodes) - 1) / size
    matrix = np.array([[scale, 0.0, 0.5 * scale], [0.0, scale, 0.5 * scale]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    image = cv2.warpAffine(
        nodes.astype(np.float32), matrix, (size, size), flags=flags, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(image, np.float32)


def ripple_tiles(
    rng: np.random.Generator, look: WaterLook, texel_m: float
) -> tuple[Float32, Float32]:
    """Slopes of a periodic sheet of ripples along and across the wind, (1024, 1024), unit
    variance of the whole. The spectrum peaks at ``wave_m`` and is spread about the wind by a
    squared cosine."""
    rows = np.fft.fftfreq(_TILE, texel_m)[:, None]
    cols = np.fft.rfftfreq(_TILE, texel_m)[None, :]
    wave_number = np.maximum(np.hypot(rows, cols), 1e-9) * look.wave_m
    along = np.arctan2(rows, cols) - look.wind_angle
    peak = np.exp(-1.25 * wave_number**-2.0) * wave_number**-2.3
    amplitude = peak * (0.25 + 0.75 * np.cos(along) ** 2)
    amplitude[0, 0] = 0.0
    sheet = np.fft.rfft2(rng.standard_normal((_TILE, _TILE))) * amplitude
    shape = (_TILE, _TILE)
    x_slope = np.fft.irfft2(1j * cols * sheet, s=shape)
    y_slope = np.fft.irfft2(1j * rows * sheet, s=shape)
    scale = np.sqrt(x_slope.var() + y_slope.var())
    return (x_slope / scale).astype(np.float32), (y_slope / scale).astype(np.float32)


_NO_GLINT = 10.0
"""height of a sun that no ripple mirrors"""


def lay_water(
    rng: np.random.Generator,
    image: Bytes,
    depth_m: Float32,
    half_m: float,
    look: WaterLook,
    sun_direction: Array,
) -> None:
    """Paints water over the bottom in ``image`` (rows, cols, 3), top row = y_max, in place.

    depth_m: (n, n), row 0 at y_min, over the same square; negative above the water. sun_direction:
    (3,) unit, the way the light travels.
    """
    texel = 2.0 * half_m / len(image)
    along, across = ripple_tiles(rng, look, texel)
    gusts = fractal_noise(rng, (512, 512), 70.0, 3, 0.55)
    shades = fractal_noise(rng, (512, 512), 44.0, 4, 0.6)
    to_sun = -sun_direction[:2] / np.linalg.norm(sun_direction[:2])
    _lay(image, depth_m, along, across, gusts, shades, np.array(look.body), np.array(look.sky),
         1.0 / np.array(look.clarity_m), look.ripple, to_sun,
         float(-sun_direction[2]) if sun_shines() else _NO_GLINT)  # fmt: skip


@njit(cache=True, error_model="numpy")
def _sample(field_: Float32, row: float, col: float) -> float:
    i = min(max(int(row), 0), field_.shape[0] - 2)
    j = min(max(int(col), 0), field_.shape[1] - 2)
    v, u = row - i, col - j
    top = field_[i, j] * (1.0 - u) + field_[i, j + 1] * u
    low = field_[i + 1, j] * (1.0 - u) + field_[i + 1, j + 1] * u
    return top * (1.0 - v) + low * v


@njit(cache=True, error_model="numpy")
def _lay(
    image: Bytes,
    depth: Float32,
    along: Float32,
    across: Float32,
    gusts: Float32,
    shades: Float32,
    body: Array,
    sky: Array,
    dimming: Array,
    ripple: float,
    to_sun: Array,
    sun_height: float,
) -> None:
    rows, cols = image.shape[:2]
    to_depth = len(depth) / rows
    to_gust = (len(gusts) - 1.001) / rows
    mask = along.shape[0] - 1
    for row in range(rows):
        out = rows - 1 - row
        depth_row = (row + 0.5) * to_depth - 0.5
        for col in range(cols):
            below = _sample(depth, depth_row, (col + 0.5) * to_depth - 0.5)
            if below <= -_WET_M:
                continue
            if below <= 0.0:
                wet = 1.0 - 0.36 * (1.0 + below / _WET_M)
                for c in range(3):
                    image[out, col, c] = int(image[out, col, c] * wet)
                continue
            gust = _sample(gusts, row * to_gust, col * to_gust)
            shade = _sample(shades, row * to_gust, col * to_gust)
            i, j = int(0.77 * row + 0.64 * col) & mask, int(0.77 * col - 0.64 * row) & mask
            sx = along[row & mask, col & mask] + 0.55 * along[i, j]
            sy = across[row & mask, col & mask] + 0.55 * across[i, j]
            # Ripples grow from the sheltered edge to the open water, and with the gusts.
            rough = ripple * min(0.25 + 0.3 * below, 1.0) * min(max(0.75 + 0.35 * gust, 0.2), 1.5)
            tilt = rough * (sx * to_sun[0] + sy * to_sun[1])
            # Slopes focus the sunlight on a shallow bottom into a net of bright lines.
            net = abs(sx - 0.6 * sy)
            focus = 0.35 * max(0.0, 1.0 - 5.0 * net) * min(below / 0.25, 1.0)
            facing = 1.0 + 0.12 * tilt + 0.05 * shade
            mirror = 0.055 + 0.05 * max(tilt, 0.0) + 0.02 * max(gust, 0.0)
            glint = 0.0
            if tilt > 1.15 * (0.6 + 0.5 * sun_height) and below > 0.1:
                glint = min(2.4 * (tilt - 1.15 * (0.6 + 0.5 * sun_height)), 0.75)
            for c in range(3):
                value = body[c] * facing
                if dimming[c] * below < _OPAQUE:
                    seen = np.exp(-dimming[c] * below)
                    bottom = image[out, col, c] * 0.80 * (1.0 + focus)
                    value += seen * (bottom - value)
                value += mirror * (sky[c] - 0.5 * value)
                value += glint * (250.0 - value)
                if below < 0.008:
                    value += 14.0
                image[out, col, c] = int(min(max(value, 0.0), 255.0))


def flood_raster(raster: GroundRaster, depth_m: Float32) -> GroundRaster:
    """``raster`` with class and reflectivity of water where it is under water. depth_m: (n, n)
    over the same square, n a multiple of the raster's rows."""
    rows, cols = raster.class_id.shape
    blocks = depth_m.reshape(rows, len(depth_m) // rows, cols, len(depth_m) // cols)
    flooded = blocks.mean(axis=(1, 3)) > 0.0
    detail = raster.detail_id
    return replace(
        raster,
        class_id=np.where(flooded, np.uint8(LAND_CLASSES.index("water")), raster.class_id),
        reflectivity=np.where(flooded, np.float32(WATER_REFLECTIVITY), raster.reflectivity),
        detail_id=None if detail is None else np.where(flooded, np.uint8(NO_DETAIL_ID), detail),
    )
