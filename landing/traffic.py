"""Where vehicles may drive, as far as motion and the laser tell: a preference, not a rule.

What a place is, a classifier must say. But a surface on which something was seen to move goes on
for as far as it gives the same echo: cars that were here a moment ago will be there in the next.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from landing.api import LandingParams
from landing.landable import Defect, LandableMap
from landing.terrain import Terrain, near

Float32 = NDArray[np.float32]
Mask = NDArray[np.bool_]

_SMOOTHING_M = 1.0
_SAME_ECHO = 0.35
"""relative difference of the mean echo strength up to which two cells count as one surface: the
echo falls with the cosine of the incidence, to 0.75 at the edge of the field of view"""
_NEAR_M = 2.0


def driven_surface(terrain: Terrain, landable: LandableMap) -> Mask:
    """Cells that give the same echo as those where something moved, and are connected to them."""
    moved = (landable.defect == Defect.MOVING) & terrain.known
    if not moved.any():
        return np.zeros(terrain.shape, np.bool_)
    echo = _smooth_echo(terrain)
    typical = np.median(echo[moved])
    alike = terrain.known & (np.abs(echo - typical) <= _SAME_ECHO * typical)
    _, labels = cv2.connectedComponents(alike.astype(np.uint8), connectivity=4)
    connected = np.unique(labels[moved & alike])
    driven: Mask = np.isin(labels, connected[connected > 0])
    return driven


def _smooth_echo(terrain: Terrain) -> Float32:
    """Mean intensity over about a metre of seen cells."""
    size = (2 * round(0.5 * _SMOOTHING_M / terrain.cell_m) + 1,) * 2
    seen = np.isfinite(terrain.intensity) & terrain.known
    echo = np.where(seen, terrain.intensity, np.float32(0.0))
    total = cv2.boxFilter(echo, -1, size, borderType=cv2.BORDER_CONSTANT)
    share = cv2.boxFilter(seen.astype(np.float32), -1, size, borderType=cv2.BORDER_CONSTANT)
    return (total / np.maximum(share, np.float32(1e-3))).astype(np.float32)


def traffic_penalty(terrain: Terrain, landable: LandableMap, params: LandingParams) -> Float32:
    """What is taken off C_sum when sites are ranked, (rows, cols): ``traffic_penalty`` within 2 m
    of a surface that traffic uses, else 0."""
    close = near(driven_surface(terrain, landable), _NEAR_M / terrain.cell_m)
    return np.where(close, np.float32(params.traffic_penalty), np.float32(0.0))
