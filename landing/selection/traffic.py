"""Where vehicles may drive, as far as motion and the laser tell: a preference, not a rule.

What a place is, a classifier must say. But a surface on which something was seen to move goes on
for as far as it gives the same echo: cars that were here a moment ago will be there in the next.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.landing.api import LandingParams
from touchdown.landing.selection.landable import Defect, LandableMap
from touchdown.landing.selection.terrain import Terrain, near

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]
Mask = NDArray[np.bool_]

_SMOOTHING_M = 1.0
_SAME_ECHO = 0.35
"""relative difference of the mean echo strength up to which two cells count as one surface: the
echo falls with the cosine of the incidence, to 0.75 at the edge of the field of view"""
_NEAR_M = 2.0


def driven_surface(terrain: Terrain, landable: LandableMap) -> Mask:
    """Cells that give the same echo as those where something moved, and are connected to them."""
    return surface_of(terrain, (landable.defect == Defect.MOVING) & terrain.known)


def surface_of(terrain: Terrain, cells: Mask) -> Mask:
    """Cells that give the same echo as ``cells`` (rows, cols), and are connected to them."""
    if not cells.any():
        return np.zeros(terrain.shape, np.bool_)
    echo = _smooth_echo(terrain)
    typical = np.median(echo[cells])
    alike = terrain.known & (np.abs(echo - typical) <= _SAME_ECHO * typical)
    _, labels = cv2.connectedComponents(alike.astype(np.uint8), connectivity=4)
    connected = np.unique(labels[cells & alike])
    surface: Mask = np.isin(labels, connected[connected > 0])
    return surface


def surfaces_of_sites(terrain: Terrain, sites_odom: Sequence[Array]) -> Mask:
    """Cells of the surface that each of ``sites_odom`` (3,) lies on, by the same echo."""
    found = np.zeros(terrain.shape, np.bool_)
    for site in sites_odom:
        row, col = terrain.cell_of(site)
        if terrain.contains(row, col) and terrain.known[row, col]:
            cells = np.zeros(terrain.shape, np.bool_)
            cells[row, col] = True
            found |= surface_of(terrain, cells)
    return found


def _smooth_echo(terrain: Terrain) -> Float32:
    """Mean intensity over about a metre of seen cells."""
    size = (2 * round(0.5 * _SMOOTHING_M / terrain.cell_m) + 1,) * 2
    seen = np.isfinite(terrain.intensity) & terrain.known
    echo = np.where(seen, terrain.intensity, np.float32(0.0))
    total = cv2.boxFilter(echo, -1, size, borderType=cv2.BORDER_CONSTANT)
    share = cv2.boxFilter(seen.astype(np.float32), -1, size, borderType=cv2.BORDER_CONSTANT)
    return (total / np.maximum(share, np.float32(1e-3))).astype(np.float32)


def near_traffic(terrain: Terrain, landable: LandableMap) -> Mask:
    """Cells within 2 m of a surface that traffic uses."""
    return near(driven_surface(terrain, landable), _NEAR_M / terrain.cell_m)


def traffic_penalty(close: Mask, params: LandingParams) -> Float32:
    """What is taken off C_sum when sites are ranked, (rows, cols): ``traffic_penalty`` in cells
    that are ``close`` to traffic or to what ground classification refused, else 0."""
    return np.where(close, np.float32(params.traffic_penalty), np.float32(0.0))
