"""The eight features of the risk of a touchdown, each 0 for perfect ground and about 1 at the limit
of the geometric check.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from touchdown.landing.api import LandingParams
from touchdown.landing.selection.ground.elevation_raster import (
    ElevationRaster,
    dilated,
    disc_maximum,
    distance_to,
)
from touchdown.landing.selection.ground.landable import Defect, LandableMap

Float32 = NDArray[np.float32]
Mask = NDArray[np.bool_]

NAMES = ("slope", "step", "object", "spread", "neighbour", "confinement", "sparsity", "age")

_SLOPE_DISC_M = 0.5
_SPREAD_LIMIT_M = 0.05
_NEIGHBOUR_LIMIT_M = 0.25
_CLEARANCE_M = 2.0
"""clearance beyond the footprint from which confinement is 0"""
_MAX = 2.0
"""features are clipped at twice the limit"""
_AGE_S = 60.0
_IS_HARD = np.isin(np.arange(len(Defect)), (Defect.UNKNOWN, Defect.MOVING, Defect.WATER))
"""defects that exclude a cell whatever the coefficients"""


@dataclass(frozen=True, kw_only=True, slots=True)
class RiskFeatures:
    """Features of every cell.

    ``values``: (rows, cols, 8) float32, last axis as ``NAMES``, finite everywhere; ``open``: (rows,
    cols), cells whose footprint lies within the map and contains no unknown ground, motion or
    water."""

    values: Float32
    open: Mask


def risk_features(
    raster: ElevationRaster,
    landable: LandableMap,
    params: LandingParams,
    *,
    now_s: float,
    drift_m: float = 0.0,
) -> RiskFeatures:
    """Returns the features of every cell as a touchdown point.

    ``now_s``: current time, for the age of cells; ``drift_m``: drift of the vehicle in gusts,
    subtracted from the clearance around the footprint.
    """
    cell = raster.cell_m
    footprint = params.ground.footprint_m
    pad = footprint / cell
    hard = _IS_HARD[landable.defect]
    border = int(np.ceil(pad))
    inside = np.zeros(raster.shape, np.bool_)
    inside[border:-border, border:-border] = True
    flawed = hard | (landable.defect >= Defect.ROUGH)
    clearance = distance_to(flawed, cell)
    side = 2 * border + 1
    few = np.reciprocal(1.0 + raster.count).astype(np.float32)
    thin = np.asarray(cv2.blur(few, (side, side), borderType=cv2.BORDER_REPLICATE), np.float32)
    values = np.empty((*raster.shape, len(NAMES)), np.float32)
    _scaled(disc_maximum(landable.slope_deg, _SLOPE_DISC_M / cell), 0.0,
            1.0 / params.max_slope_deg, values[..., 0])  # fmt: skip
    for index, layer in ((1, landable.step_m), (2, landable.peak_m)):
        _scaled(disc_maximum(layer, pad), 0.0, 1.0 / params.max_step_m, values[..., index])
    _scaled(disc_maximum(raster.std, pad), 0.0, 1.0 / _SPREAD_LIMIT_M, values[..., 3])
    _scaled(landable.tall_m, 0.0, 1.0 / _NEIGHBOUR_LIMIT_M, values[..., 4])
    _scaled(clearance, _CLEARANCE_M + footprint + drift_m, -1.0 / _CLEARANCE_M, values[..., 5])
    _scaled(thin, 0.0, 1.0, values[..., 6])
    _scaled(raster.last_seen, now_s, -1.0 / _AGE_S, values[..., 7])
    return RiskFeatures(values=values, open=inside & ~dilated(hard, pad))


@numba.njit(cache=True)
def _scaled(layer: Float32, zero: float, gain: float, out: Float32) -> None:
    """Writes (layer - zero) * gain clipped to [0, 2] into ``out``; 2 where the layer is NaN."""
    rows, cols = layer.shape
    for row in range(rows):
        for col in range(cols):
            value = (layer[row, col] - zero) * gain
            out[row, col] = min(max(value, 0.0), _MAX) if value == value else _MAX
