"""What the risk of a touchdown is estimated from: eight rasters, each 0 where nothing speaks
against landing and about 1 at the limit of the geometric rule.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from landing.api import LandingParams
from landing.landable import FOOTPRINT_M, Defect, LandableMap
from landing.terrain import Terrain, disc_maximum, distance_to, near

Float32 = NDArray[np.float32]
Mask = NDArray[np.bool_]

NAMES = ("slope", "step", "object", "spread", "neighbour", "confinement", "sparsity", "age")

_SLOPE_DISC_M = 0.5
_SPREAD_LIMIT_M = 0.05
_NEIGHBOUR_LIMIT_M = 0.25
_ROOM_M = 2.0
"""beyond the footprint; more room than this makes no landing safer"""
_MOST = 2.0
"""twice a limit is as bad as any more"""
_AGE_S = 60.0
_HARD = (Defect.UNKNOWN, Defect.MOVING, Defect.WATER)
"""no coefficient outweighs these"""


@dataclass(frozen=True, kw_only=True, slots=True)
class RiskFeatures:
    """``values``: (rows, cols, 8) float32, last axis as ``NAMES``, finite everywhere; ``open``:
    (rows, cols), the cells whose footprint lies in seen, dry, quiet ground within the map."""

    values: Float32
    open: Mask


def risk_features(
    terrain: Terrain,
    landable: LandableMap,
    params: LandingParams,
    *,
    now_s: float,
    drift_m: float = 0.0,
) -> RiskFeatures:
    """Of every cell as a touchdown point.

    ``now_s``: the time that ages are counted to; ``drift_m``: how far gusts may carry the vehicle,
    taken off the room around the footprint.
    """
    cell = terrain.cell_m
    pad = FOOTPRINT_M / cell
    hard = np.isin(landable.defect, _HARD)
    border = int(np.ceil(pad))
    inside = np.zeros(terrain.shape, np.bool_)
    inside[border:-border, border:-border] = True
    flawed = hard | (landable.defect >= Defect.ROUGH)
    room = distance_to(flawed, cell) - np.float32(FOOTPRINT_M + drift_m)
    slope = disc_maximum(landable.slope_deg, _SLOPE_DISC_M / cell)
    side = 2 * border + 1
    thin = cv2.blur(1.0 / (1.0 + terrain.count), (side, side), borderType=cv2.BORDER_REPLICATE)
    seen = np.where(np.isfinite(terrain.last_seen), terrain.last_seen, np.float32(now_s))
    rasters = (
        slope / np.float32(params.max_slope_deg),
        disc_maximum(landable.step_m, pad) / np.float32(params.max_step_m),
        disc_maximum(landable.peak_m, pad) / np.float32(params.max_step_m),
        disc_maximum(terrain.std, pad) / np.float32(_SPREAD_LIMIT_M),
        landable.tall_m / np.float32(_NEIGHBOUR_LIMIT_M),
        1.0 - room / np.float32(_ROOM_M),
        thin,
        (np.float32(now_s) - seen) / np.float32(_AGE_S),
    )
    values = np.stack(rasters, axis=-1)
    np.nan_to_num(values, copy=False, nan=_MOST, posinf=_MOST, neginf=0.0)
    np.clip(values, 0.0, _MOST, out=values)
    return RiskFeatures(values=values, open=inside & ~near(hard, pad))
