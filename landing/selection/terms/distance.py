"""The term distance (Zou, Sun, Kong 2024, Eq. 18): the energy to reach a site."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from touchdown.landing.api import TermLayer
from touchdown.landing.selection.ground.elevation_raster import ElevationRaster
from touchdown.landing.selection.terms.inputs import Inputs

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]


def term(site: Inputs) -> TermLayer:
    """Returns the reward of near sites, or the penalty of far ones, by ``distance_zero``."""
    x, y = site.raster.offsets_from(site.vehicle_odom)
    weight, near = np.float32(site.selector.weight_distance), site.distance
    value = weight * near if site.selector.distance_zero == "farthest" else -(weight * (1.0 - near))
    away = np.sqrt((x**2)[None, :] + (y**2)[:, None]).astype(np.float32)
    return TermLayer(name="distance", value=value, quantity=away, unit="m")


def distance(raster: ElevationRaster, position_odom: Array, reach_m: float) -> Float32:
    """Eq. 18: straight-line distance from the vehicle as a proxy for energy, 1 at the nearest cell
    and 0 at the farthest; NaN beyond ``reach_m``, the range of the remaining energy."""
    x, y = (axis.astype(np.float32) for axis in raster.offsets_from(position_odom[:2]))
    reach = np.float32(min(reach_m, 1e9))
    metres = np.full(raster.shape, np.nan, np.float32)
    up = raster.height - np.float32(position_odom[2])
    _closeness(x**2, y**2, up, reach * reach, metres)
    return metres


@numba.njit(cache=True)
def _closeness(xx: Float32, yy: Float32, up: Float32, limit: Any, metres: Float32) -> None:
    """Eq. 18 into ``metres`` of cells within the square root of ``limit``, from squares of
    offsets and heights over the vehicle."""
    near: Any = np.float32(np.inf)
    far: Any = -near
    for row in range(yy.size):
        for col in range(xx.size):
            horizontal, high = xx[col] + yy[row], up[row, col]
            if horizontal <= limit and high == high:
                away = np.sqrt(horizontal + high * high)
                metres[row, col] = away
                near, far = min(near, away), max(far, away)
    extent = np.float32(max(far - near, 1e-6))
    for row in range(yy.size):
        for col in range(xx.size):
            metres[row, col] = np.float32(1.0) - (metres[row, col] - near) / extent
