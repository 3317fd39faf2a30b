"""The term distance (Zou, Sun, Kong 2024, Eq. 18): the energy to reach a site."""

from __future__ import annotations

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
    away = np.hypot(x[None, :], y[:, None]).astype(np.float32)
    weight, near = np.float32(site.selector.weight_distance), site.distance
    value = weight * near if site.selector.distance_zero == "farthest" else -(weight * (1.0 - near))
    return TermLayer(name="distance", value=value, quantity=away, unit="m")


def distance(raster: ElevationRaster, position_odom: Array, reach_m: float) -> Float32:
    """Eq. 18: straight-line distance from the vehicle as a proxy for energy, 1 at the nearest cell
    and 0 at the farthest; NaN beyond ``reach_m``, the range of the remaining energy."""
    x, y = (axis.astype(np.float32) for axis in raster.offsets_from(position_odom[:2]))
    z = raster.height - np.float32(position_odom[2])
    horizontal = (x**2)[None, :] + (y**2)[:, None]
    metres = np.sqrt(horizontal + z**2)
    allowed = np.isfinite(metres) & (horizontal <= np.float32(min(reach_m, 1e9)) ** 2)
    if not allowed.any():
        return np.full(raster.shape, np.nan, np.float32)
    near, far = float(metres[allowed].min()), float(metres[allowed].max())
    cost = 1.0 - (metres - near) / max(far - near, 1e-6)
    return np.where(allowed, cost, np.nan).astype(np.float32)
