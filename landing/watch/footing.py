"""The ground under the legs, and the nearest ground that is safe to stand on."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from touchdown.estimator.api import GridMap
from touchdown.landing.watch.surface import CELL_M, Layers
from touchdown.sim.typing import Array, Float32, Mask

_RADIUS_M = 0.8
"""of what the vehicle stands on, with what it drifts by"""
_KNOWN_SHARE = 0.5
_CLEAR_M = 1.0
"""radius that has to be free of everything around another place to land"""
_ASIDE_SLOPE_DEG = 8.0
_REACH_M = 4.0
"""farthest of such places"""
_WATER_M, _WATER_PULSES = 1.0, 5.0


class Footing(NamedTuple):
    """What the legs would stand on; NaN where too little of it is seen."""

    slope_deg: float
    step_m: float
    """largest distance of lowest returns to their plane"""


def footing(layers: Layers, corner: Array, site: Array) -> Footing:
    """Returns what the ground within ``_RADIUS_M`` of the site (2,) is like."""
    x, y = _offsets(len(layers.low), corner, site)
    near = np.hypot(x, y) < _RADIUS_M
    at = near & np.isfinite(layers.low)
    if at.sum() < max(_KNOWN_SHARE * near.sum(), 10):
        return Footing(math.nan, math.nan)
    rows, cols = np.nonzero(at)
    design = np.column_stack([np.ones(rows.size), x[0, cols], y[rows, 0]])
    z = layers.low[at].astype(np.float64)
    plane, *_ = np.linalg.lstsq(design, z, rcond=None)
    slope = math.degrees(math.atan(math.hypot(plane[1], plane[2])))
    return Footing(slope, float(np.quantile(np.abs(z - design @ plane), 0.95)))


def water_fraction(grid: GridMap, site: Array) -> float:
    """Returns the fraction of the pulses within a metre of the site (2,) that the map has no return
    of; 0 where it has few pulses."""
    col, row = np.floor((site - grid.origin_xy_m) / grid.cell_m).astype(int)
    reach = int(_WATER_M / grid.cell_m)
    box = np.s_[max(row - reach, 0) : max(row + reach + 1, 0),
                max(col - reach, 0) : max(col + reach + 1, 0)]  # fmt: skip
    lost, hits = float(grid.missing[box].sum()), float(grid.count[box].sum())
    return lost / (lost + hits) if lost + hits >= _WATER_PULSES else 0.0


def nearest_safe(
    layers: Layers, corner: Array, free: Mask, site: Array, away: Sequence[tuple[Array, float]]
) -> Array | None:
    """Returns the nearest place (2,) to the site (2,) that is level and has been free; None where
    there is none. ``away``: places (2,) with the distance to keep from each."""
    radius = int(_CLEAR_M / CELL_M)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    safe = cv2.erode(_closed(free), disc, borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0
    safe &= _slope_deg(layers.ground, radius) < _ASIDE_SLOPE_DEG
    x, y = _offsets(len(free), corner, site)
    for place, distance in away:
        safe &= np.hypot(x + site[0] - place[0], y + site[1] - place[1]) > distance
    gap = np.where(safe, np.hypot(x, y), np.inf)
    best = int(np.argmin(gap))
    if gap.flat[best] > _REACH_M:
        return None
    row, col = divmod(best, len(gap))
    return corner + CELL_M * (np.array([col, row]) + 0.5)


def _closed(free: Mask) -> Float32:
    """``free`` without gaps of one cell, which few returns leave."""
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    return cv2.morphologyEx(free.astype(np.uint8), cv2.MORPH_CLOSE, cross)  # type: ignore[return-value]


def _slope_deg(ground: Float32, reach: int) -> Float32:
    """Slope over ``reach`` cells to each side; inf where it is not known."""
    slope = np.full_like(ground, np.inf)
    inner = np.s_[reach:-reach, reach:-reach]
    run = 2.0 * reach * CELL_M
    across = ground[reach:-reach, 2 * reach :] - ground[reach:-reach, : -2 * reach]
    along = ground[2 * reach :, reach:-reach] - ground[: -2 * reach, reach:-reach]
    slope[inner] = np.degrees(np.arctan(np.hypot(across, along) / run))
    return np.nan_to_num(slope, nan=np.inf)


def _offsets(cells: int, corner: Array, site: Array) -> tuple[Array, Array]:
    """x (1, cells) and y (cells, 1) of a grid from a place (2,)."""
    at = (np.arange(cells) + 0.5) * CELL_M
    return (corner[0] + at - site[0])[None, :], (corner[1] + at - site[1])[:, None]
