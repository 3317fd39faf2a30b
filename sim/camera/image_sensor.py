"""What the sensor's rows collect: shutter, motion blur, light, electrons, noise, grey levels.

One pass over the image: for every row and every instant of its exposure the drawn places that it
shows, the mean of their linear light, electrons with shot and read noise, grey levels. Where an
exposure is one instant in even and sufficient light, tables of the grey level do the rest.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.camera.gl import InverseDepth
from touchdown.sim.camera.lamp import LampField, lamp_row
from touchdown.sim.camera.optics import GAMMA, LIGHT, NOISE_MARGIN, Lens
from touchdown.sim.camera.shutter import sample_row, trace_row
from touchdown.sim.typing import Array, Bytes, Float32

_NOISE_UNIT = 1.0 / 32.0
"""a step of the noise tile, in standard deviations"""
_ROOTS = 4096

_DISPLAY: Bytes = np.rint(255.0 * (np.arange(_ROOTS) / (_ROOTS - 1.0)) ** (2.0 / GAMMA)).astype(
    np.uint8
)
"""grey level of the root of linear light: roots resolve the dark as grey levels do"""


class NoisePlace(NamedTuple):
    """Where an image begins in a noise tile, and the sign of the noise."""

    row: int
    col: int
    sign: int


class Tone(NamedTuple):
    """Grey levels that drawn levels become, ``scale`` times as large, and their noise: its standard
    deviation is ``floor`` and the sum of ``slopes`` times the lesser of level and ``bends``."""

    scale: np.float32
    floor: np.float32
    bends: tuple[np.float32, ...]
    slopes: tuple[np.float32, ...]


_BENDS = (0.7, 1.0, 1.08, 1.3, 1.7, 2.4, 4.0, 10.0)
"""Places at which the noise's deviation is exact, over the level whose electrons equal their noise;
between them it is off by a fifteenth at most"""
_EVEN = Tone(np.float32(1.0), np.float32(1.0), *2 * ((np.float32(0.0),) * (len(_BENDS) + 1),))
"""levels as drawn, with the noise as it is"""
_QUIET_GAIN = 2.0
"""Up to this gain noise is small against the light, so that its effect on grey levels is linear"""
_LEVELS: Float32 = np.arange(256, dtype=np.float32)
_BRIGHTER: Float32 = ((1.0 + np.arange(257) / 256.0) ** (1.0 / GAMMA)).astype(np.float32)
"""grey levels under the ambient light and up to as much again, over those under it alone"""
_NO_LAMP = LampField(np.zeros((1, 1), np.float32), 1.0, 1.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True, slots=True)
class Exposed:
    """An exposure: electrons of a white surface under the ambient light, saturation, read noise
    (electrons), and amplification. ``lamp`` adds ``electrons_per_lux`` for each of its lux."""

    electrons: float
    full_well: float
    read_noise: float
    gain: float
    lamp: LampField | None = None
    electrons_per_lux: float = 0.0


def sensor_noise(height: int, width: int, key: list[int]) -> NDArray[np.int8]:
    """Standard normal noise in steps of 1/32, a margin larger than the image, (rows, 3 columns):
    each colour has its own."""
    shape = (height + NOISE_MARGIN, 3 * (width + NOISE_MARGIN))
    drawn = np.random.default_rng(key).standard_normal(shape, dtype=np.float32)
    return np.clip(np.rint(drawn / _NOISE_UNIT), -127, 127).astype(np.int8)


class ImageSensor:
    """Develops rasters of ``lens``, drawn bottom row first."""

    def __init__(self, lens: Lens) -> None:
        height, width = lens.image.height, lens.image.width
        self._bent = lens.map_x is not None
        self._x = np.arange(width, dtype=np.float32)[None] + np.float32(lens.margin)
        self._y = np.zeros((1, width), dtype=np.float32) + np.float32(lens.margin)
        if lens.map_x is not None and lens.map_y is not None:
            self._x, self._y = lens.map_x, lens.map_y
        self._shape = (height, width, 3)
        self.raster: CameraIntrinsics = lens.raster

    def shown(
        self,
        drawn: Bytes,
        depth: InverseDepth,
        shifts: Array,
        noise: NDArray[np.int8],
        place: NoisePlace,
    ) -> Bytes:
        """(H, W, 3) image of rows with the (H, 1, 12) coefficients ``shifts``, with grey noise of
        `optics.noise_tile`."""
        image = np.empty(self._shape, dtype=np.uint8)
        _show(
            drawn, *buffers_of(depth), shifts, self._x, self._y, self._bent,
            noise, place.row, 3 * place.col, float(place.sign), _EVEN, image,
        )  # fmt: skip
        return image

    def exposed(
        self,
        drawn: Bytes,
        depth: InverseDepth,
        shifts: Array,
        noise: NDArray[np.int8],
        place: NoisePlace,
        light: Exposed,
    ) -> Bytes:
        """(H, W, 3) image of rows whose exposures are the mean of K instants with the (H, K, 12)
        coefficients ``shifts``; noise of `sensor_noise`."""
        image = np.empty(self._shape, dtype=np.uint8)
        fraction = light.electrons_per_lux / light.electrons
        quiet = shifts.shape[1] == 1 and light.gain <= _QUIET_GAIN
        if quiet and (light.lamp is None or fraction * max_lux(depth, light.lamp) < 1.0):
            shown: Bytes | Float32 = drawn
            if light.lamp is not None:
                shown = np.empty(drawn.shape, dtype=np.float32)
                _lamp_up(drawn, _LEVELS, *buffers_of(depth), light.lamp, fraction, False, shown)
            _show(
                shown, *buffers_of(depth), shifts, self._x, self._y, self._bent,
                noise, place.row, 3 * place.col, place.sign * _NOISE_UNIT, quiet_tone(light), image,
            )  # fmt: skip
            return image
        lit = np.empty(drawn.shape, dtype=np.float32)
        if light.lamp is None:
            _light_up(drawn, LIGHT, lit)
        else:
            _lamp_up(drawn, LIGHT, *buffers_of(depth), light.lamp, fraction, True, lit)
        _expose(
            lit, *buffers_of(depth), shifts, self._x, self._y, self._bent,
            noise, place.row, 3 * place.col, place.sign * _NOISE_UNIT,
            _DISPLAY, light.electrons, light.full_well, light.read_noise**2, light.gain, image,
        )  # fmt: skip
        return image


def buffers_of(depth: InverseDepth) -> tuple[Float32, float, float]:
    """As the kernels take it."""
    return depth.levels, depth.far, depth.per_level


def max_lux(depth: InverseDepth, lamp: LampField) -> float:
    """No surface gets more from the lamp."""
    inverse = depth.far + depth.per_level * float(depth.levels.max())
    return float(lamp.beam.max()) * inverse**2


def mean_light(drawn: Bytes, depth: InverseDepth, lamp: LampField | None, ambient: float) -> float:
    """Mean of linear light times illuminance over every eighth pixel, in lux of white."""
    field = lamp or _NO_LAMP
    return float(_meter(drawn, *buffers_of(depth), LIGHT, ambient, lamp is not None, field))


def quiet_tone(light: Exposed) -> Tone:
    """The tone of an exposure, its noise to first order."""
    scale = (light.electrons * light.gain / light.full_well) ** (1.0 / GAMMA)
    even = 0.5 + math.sqrt(0.25 + light.read_noise**2)  # electrons that equal their noise
    level = 255.0 * (even / light.electrons) ** (1.0 / GAMMA)
    bends = np.array([*np.minimum(level * np.array(_BENDS), 254.0), 255.0])
    lit = np.array([0.0, *bends]) / 255.0
    collected = light.electrons * lit**GAMMA
    noise = np.sqrt(collected + light.read_noise**2)
    maximum, minimum = collected + noise, np.maximum(collected - noise, 0.0)
    root = (light.gain / light.full_well) ** (1.0 / GAMMA)
    spread = 127.5 * root * (maximum ** (1.0 / GAMMA) - minimum ** (1.0 / GAMMA))
    steps = np.diff(np.array([0.0, *bends]))
    rise = np.where(steps > 0.0, np.diff(spread) / np.maximum(steps, 1e-9), 0.0)
    slopes = rise - np.append(rise[1:], 0.0)
    return Tone(
        np.float32(scale), np.float32(spread[0]),
        tuple(bends.astype(np.float32)), tuple(slopes.astype(np.float32)),
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def _light_up(drawn: Bytes, light: Float32, lit: Float32) -> None:
    source, target = drawn.reshape(drawn.size), lit.reshape(lit.size)
    for j in range(len(source)):
        target[j] = light[source[j]]


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _lamp_up(
    drawn: Bytes, light: Float32, depth: Float32, far: float, per_level: float,
    field: LampField, fraction: float, linear: bool, lit: Float32,
) -> None:  # fmt: skip
    """``lit``: ``light`` of grey levels with the lamp, whose lux are worth ``fraction`` of the
    ambient light each; in linear light or in grey levels."""
    rows, cols = depth.shape
    lux = np.empty(cols, np.float32)
    one, half, steps = np.float32(1.0), np.float32(0.5), np.float32(len(_BRIGHTER) - 1)
    for i in range(rows):
        lamp_row(depth, far, per_level, field, rows - 1 - i, lux)
        for j in range(cols):
            more = np.float32(fraction) * lux[j]
            factor = one + more if linear else _BRIGHTER[np.intp(min(more, one) * steps + half)]
            for c in range(3):
                lit[i, j, c] = factor * light[drawn[i, j, c]]


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _show(
    drawn: NDArray[Any], depth: Float32, far: float, per_level: float, shifts: Array,
    x: Float32, y: Float32, bent: bool,
    noise: NDArray[np.int8], first_row: int, first: int, unit: float, tone: Tone, out: Bytes,
) -> None:  # fmt: skip
    height, width = out.shape[0], out.shape[1]
    lines = out.reshape(height, 3 * width)
    sx, sy = np.empty(width, np.float32), np.empty(width, np.float32)
    levels = np.empty(3 * width, np.float32)
    ys = y[0].copy()
    step, scale, floor = np.float32(unit), tone.scale, tone.floor
    a, b = tone.slopes, tone.bends
    zero, top, half = np.float32(0.0), np.float32(255.0), np.float32(0.5)
    for i in range(height):
        if not bent:
            ys[:] = y[0, 0] + np.float32(i)
        trace_row(
            shifts[i, 0], x[i if bent else 0], y[i] if bent else ys, depth, far, per_level, sx, sy
        )
        sample_row(drawn, sx, sy, levels)
        deviates, target = noise[first_row + i, first : first + 3 * width], lines[i]
        for j in range(3 * width):
            at = levels[j]
            # written out, so that the loop becomes vector instructions
            spread = floor + a[0] * min(at, b[0]) + a[1] * min(at, b[1]) + a[2] * min(at, b[2])
            spread += a[3] * min(at, b[3]) + a[4] * min(at, b[4]) + a[5] * min(at, b[5])
            spread += a[6] * min(at, b[6]) + a[7] * min(at, b[7]) + a[8] * min(at, b[8])
            value = scale * at + spread * (step * np.float32(deviates[j]))
            target[j] = np.uint8(np.int32(min(max(value + half, zero), top)))


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _expose(
    lit: Float32, depth: Float32, far: float, per_level: float, shifts: Array,
    x: Float32, y: Float32, bent: bool,
    noise: NDArray[np.int8], first_row: int, first: int, unit: float,
    display: Bytes, electrons: float, full_well: float, read_variance: float,
    gain: float, out: Bytes,
) -> None:  # fmt: skip
    height, width = out.shape[0], out.shape[1]
    instants = shifts.shape[1]
    lines = out.reshape(height, 3 * width)
    sx, sy = np.empty(width, np.float32), np.empty(width, np.float32)
    light = np.empty(3 * width, np.float32)
    total = np.empty(3 * width, np.float32)
    ys = y[0].copy()
    well, variance = np.float32(full_well), np.float32(read_variance)
    scale, step = np.float32(gain / full_well), np.float32(unit)
    top = np.float32(len(display) - 1)
    zero, one, half = np.float32(0.0), np.float32(1.0), np.float32(0.5)
    per_instant = np.float32(electrons / instants)
    for i in range(height):
        if not bent:
            ys[:] = y[0, 0] + np.float32(i)
        total[:] = 0.0
        for k in range(instants):
            trace_row(
                shifts[i, k], x[i if bent else 0], y[i] if bent else ys, depth, far, per_level,
                sx, sy,
            )  # fmt: skip
            sample_row(lit, sx, sy, light)
            for j in range(3 * width):
                total[j] += per_instant * light[j]
        deviates, target = noise[first_row + i, first : first + 3 * width], lines[i]
        for j in range(3 * width):
            collected = min(total[j], well)
            noisy = collected + np.sqrt(collected + variance) * (step * np.float32(deviates[j]))
            value = min(max(noisy * scale, zero), one)
            target[j] = display[np.uintp(np.sqrt(value) * top + half)]


@njit(cache=True, nogil=True, error_model="numpy")
def _meter(
    drawn: Bytes, depth: Float32, far: float, per_level: float, light: Float32, ambient: float,
    lit: bool, field: LampField,
) -> float:  # fmt: skip
    rows, cols = depth.shape
    total, count = 0.0, 0
    lux = np.zeros(cols, np.float32)
    for row in range(4, rows, 8):
        if lit:
            lamp_row(depth, far, per_level, field, row, lux)
        for col in range(4, cols, 8):
            pixel = drawn[rows - 1 - row, col]
            mean = light[pixel[0]] + light[pixel[1]] + light[pixel[2]]
            total += mean / 3.0 * (ambient + lux[col])
            count += 1
    return total / max(count, 1)
