"""Shape of rugged ground: a hillside with waves, steps, gullies, ridges, grooves and snow."""

import cv2
import numpy as np
from numba import njit
from scipy import ndimage

from touchdown.scenes.api import Array
from touchdown.scenes.authoring.micro_relief import parallel, wander
from touchdown.scenes.authoring.noise import fractal_noise, tileable_noise
from touchdown.scenes.authoring.plane import draw_heading, unit
from touchdown.scenes.authoring.relief import HALF_M, smoothstep
from touchdown.scenes.places.rugged.presets import Dials, Preset

NODES = 801
CELL_M = 2.0 * HALF_M / (NODES - 1)
_TILE = 1024
"""Nodes of the periodic noise that the ground is cut out of"""
_LOW_CUTS = (1.0, 1.5, 2.3, 3.5, 5.3, 8.0, 12.0)
"""Waves over the tile, of the longest ones"""
_PLANES = (0.2, 0.35, 0.5, 0.62, 0.72, 0.8, 0.87, 0.93, 0.97)
"""Parts of the slope that a plane has"""
_COARSE = 5
"""Nodes between those at which slopes are measured"""
_SLOPE_BASE_M = 4.8
"""a multiple of the distance of coarse nodes and of nodes"""
_FACE = 0.28
"""Part of a step's level distance that its face takes"""
_TREAD = 0.22
"""Part of a step's height that its tread rises by"""
_FULL_FROM_M = 0.5
"""Standard deviation of heights from which steps and ridges have their size"""
RUT_M, CREVICE_M = (0.45, 0.22), (0.30, 0.45)
"""width and depth"""
_TRACK_M = 1.9
"""between the ruts of a vehicle"""


def shape_ground(rng: np.random.Generator, dials: Dials) -> Array:
    """Returns the heights (NODES, NODES) in metres of the ground without rocks, grooves and snow,
    with the mean slope of ``dials`` and, as nearly as that allows, their relief."""
    seed, look = int(rng.integers(2**31)), dials.preset
    uphill = hillside(draw_heading(rng))
    details = _Details(rng, look)

    def base(low_cut: float, plane: float) -> Array:
        noise = np.random.default_rng(seed)
        waves = tileable_noise(noise, _TILE, 0.5 * look.spectrum, low_cut)[:NODES, :NODES]
        tilt = np.tan(np.deg2rad(plane * dials.slope_deg)) * uphill
        few = np.s_[::_COARSE, ::_COARSE]
        coarse = waves[few].astype(np.float64)
        high = _height_for(coarse, tilt[few], details, dials.slope_deg)
        return np.asarray(waves * high + tilt, np.float64)

    ground, wanted = base(_LOW_CUTS[0], look.plane), dials.relief_m
    if wanted is not None:
        lower = (base(low_cut, 0.0) for low_cut in _LOW_CUTS)
        higher = (base(_LOW_CUTS[0], plane) for plane in _PLANES)
        tried = (ground, *lower, *higher)
        ground = min(tried, key=lambda h: abs(relief_m(details.on(h)) - wanted))
    return _carved_to(details.on(ground), details, dials.slope_deg)


def hillside(heading: float) -> Array:
    """(NODES, NODES) metres from the middle of the scene along a heading in radians."""
    axis = np.linspace(-HALF_M, HALF_M, NODES)
    return np.asarray(np.cos(heading) * axis + np.sin(heading) * axis[:, None], np.float64)


def relief_m(heights: Array) -> float:
    """Height between the lowest and the highest fiftieth."""
    low, high = np.percentile(heights, [2.0, 98.0])
    return float(high - low)


def mean_slope_deg(heights: Array, cell_m: float) -> float:
    """Mean slope over 5 m."""
    reach = max(1, round(0.5 * _SLOPE_BASE_M / cell_m))
    north = (heights[2 * reach :] - heights[: -2 * reach])[:, reach:-reach]
    east = (heights[:, 2 * reach :] - heights[:, : -2 * reach])[reach:-reach]
    return float(np.rad2deg(np.arctan(np.hypot(north, east) / (2 * reach * cell_m))).mean())


class _Details:
    """What a preset adds to waves: steps, ridges and gullies."""

    def __init__(self, rng: np.random.Generator, look: Preset) -> None:
        self._look = look
        shape = (NODES, NODES)
        where = fractal_noise(rng, shape, 34.0 / CELL_M, 2, 0.4).astype(np.float64)
        self._stepped = smoothstep(-0.15, 0.15, where - np.quantile(where, 1.0 - look.terrace_part))
        self._offset = 0.35 * fractal_noise(rng, shape, 22.0 / CELL_M, 3, 0.5).astype(np.float64)
        ridges = np.abs(fractal_noise(rng, shape, 17.0 / CELL_M, 3, 0.45))
        mounds = fractal_noise(rng, shape, 5.5 / CELL_M, 2, 0.4)
        self._ridges = np.exp(-((ridges / 0.16) ** 2)) + 0.35 * np.clip(mounds, 0.0, None)
        self._starts = rng.uniform(0.0, 1.0, (9000, 2))

    def on(self, heights: Array) -> Array:
        """(n, n) heights of the whole square at any number of nodes, with the details."""
        look, size = self._look, len(heights)
        every = slice(None, None, (NODES - 1) // (size - 1))
        # Level ground has none.
        full = min(1.0, float(heights.std()) / _FULL_FROM_M)
        if look.terrace_m > 0.0:
            level = heights + self._offset[every, every]
            stepped = _steps(level, look.terrace_m) - self._offset[every, every]
            heights = heights + full * self._stepped[every, every] * (stepped - heights)
        if look.ridge_m > 0.0:
            heights = heights + full * look.ridge_m * self._ridges[every, every]
        return heights

    def carved(self, heights: Array) -> Array:
        """With gullies where water would run."""
        if self._look.gully_m <= 0.0:
            return heights
        coarse = np.ascontiguousarray(heights[::2, ::2])
        smooth = np.asarray(cv2.GaussianBlur(coarse, (0, 0), 3.0), np.float64)
        flow = np.zeros(coarse.shape)
        _trickle(smooth, self._starts * (len(coarse) - 3) + 1.0, flow)
        course = np.log1p(cv2.GaussianBlur(flow, (0, 0), 0.8))
        depth = np.minimum(course / np.quantile(course, 0.995), 1.2) ** 1.3
        valley = cv2.GaussianBlur(depth, (0, 0), 4.5)
        cut = 0.45 * cv2.GaussianBlur(depth, (0, 0), 1.2) + 1.7 * valley
        fine = cv2.resize(cut, heights.shape[::-1], interpolation=cv2.INTER_CUBIC)
        return np.asarray(heights - self._look.gully_m * fine, np.float64)


def _steps(level: Array, step_m: float) -> Array:
    """Heights (...) of treads and faces in place of even slopes."""
    number = np.floor(level / step_m)
    along = level / step_m - number
    face = smoothstep(1.0 - _FACE, 1.0, along)
    return step_m * (number + _TREAD * np.minimum(along / (1.0 - _FACE), 1.0) + face * (1 - _TREAD))


@njit(cache=True, error_model="numpy")
def _trickle(heights: Array, starts: Array, flow: Array) -> None:
    """Counts in ``flow`` the drops that start at (N, 2) nodes and run down to a hollow."""
    last = heights.shape[0] - 2
    for k in range(starts.shape[0]):
        row, col = int(starts[k, 0]), int(starts[k, 1])
        for _ in range(3 * heights.shape[0]):
            flow[row, col] += 1.0
            best, down, right = 0.0, 0, 0
            for i in range(-1, 2):
                for j in range(-1, 2):
                    fall = heights[row, col] - heights[row + i, col + j]
                    fall *= 0.7071 if i * j != 0 else 1.0
                    if fall > best:
                        best, down, right = fall, i, j
            row, col = row + down, col + right
            if best <= 0.0 or min(row, col) < 1 or max(row, col) > last:
                break


def _height_for(few: Array, tilt: Array, details: _Details, slope_deg: float) -> float:
    """The factor of waves at every fifth node that gives them, on a tilted plane and with their
    details, the slope."""
    low, high = 0.0, 40.0
    for _ in range(24):
        middle = 0.5 * (low + high)
        steep = mean_slope_deg(details.on(middle * few + tilt), _COARSE * CELL_M) > slope_deg
        low, high = (low, middle) if steep else (middle, high)
    return low


def _carved_to(heights: Array, details: _Details, slope_deg: float) -> Array:
    """With gullies, which are steep themselves: all becomes lower until the slope is met."""
    carved = details.carved(heights)
    for _ in range(3 if carved is not heights else 0):
        steep = np.tan(np.deg2rad(mean_slope_deg(carved, CELL_M)))
        carved = carved * (np.tan(np.deg2rad(slope_deg)) / max(steep, 1e-6))
    return carved


def roughness(rng: np.random.Generator, dials: Dials) -> Array:
    """(NODES, NODES) metres of what is finer than a metre; scree is coarser by 3 cm."""
    fine = fractal_noise(rng, (NODES, NODES), 0.9 / CELL_M, 3, 0.7).astype(np.float64)
    patches = fractal_noise(rng, (NODES, NODES), 9.0 / CELL_M, 3, 0.5).astype(np.float64)
    scree = 0.03 * smoothstep(-0.4, 0.6, patches) * (dials.cover == "scree")
    return (dials.preset.rough_m + scree) * fine


def grooves(rng: np.random.Generator, dials: Dials) -> Array:
    """(NODES, NODES) metres that ruts or crevices are deep."""
    ruts = dials.preset.ruts
    width, depth = RUT_M if ruts else CREVICE_M
    mask = np.zeros((NODES, NODES), np.uint8)
    for _ in range(1500):
        if (mask > 127).mean() >= dials.groove_fraction:
            break
        middle, way = rng.uniform(-HALF_M, HALF_M, 2), unit(draw_heading(rng))
        length = rng.uniform(25.0, 70.0) if ruts else rng.uniform(5.0, 20.0)
        line = wander(rng, middle + 0.5 * length * np.array([-way, way]), 3.0 if ruts else 0.35)
        sides = (-0.5 * _TRACK_M, 0.5 * _TRACK_M) if ruts else (0.0,)
        points = [np.round(16.0 * (parallel(line, s) + HALF_M) / CELL_M) for s in sides]
        thick = max(1, round(width * rng.uniform(0.6, 1.2) / CELL_M))
        cv2.polylines(mask, [p.astype(np.int32) for p in points], False, 255, thick, cv2.LINE_AA, 4)
    uneven = 1.0 + 0.3 * fractal_noise(rng, (NODES, NODES), 2.0 / CELL_M, 2)
    return np.asarray(depth * np.clip(uneven, 0.3, 1.6) * mask / 255.0, np.float64)


_SNOW_FRACTION = 0.28


def snow_depth(rng: np.random.Generator, heights: Array) -> Array:
    """(NODES, NODES) metres of old snow in hollows and below edges."""
    wide = ndimage.gaussian_filter(heights, 3.5 / CELL_M)
    hollow = wide - heights + 0.12 * fractal_noise(rng, heights.shape, 11.0 / CELL_M, 3, 0.5)
    depth = np.clip(1.4 * (hollow - np.quantile(hollow, 1.0 - _SNOW_FRACTION)), 0.0, 1.2)
    return np.asarray(ndimage.gaussian_filter(depth, 0.35 / CELL_M), np.float64)
