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
from touchdown.landing.selection.elevation_raster import ElevationRaster, dilated
from touchdown.landing.selection.landable import Defect, LandableMap

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]
Mask = NDArray[np.bool_]

_SMOOTHING_M = 1.0
_SAME_ECHO = 0.35
"""relative difference of the mean echo strength up to which two cells count as one surface: the
echo falls with the cosine of the incidence, to 0.75 at the edge of the field of view"""
_NEAR_M = 2.0


def traffic_surface(raster: ElevationRaster, landable: LandableMap) -> Mask:
    """Cells that give the same echo as those where something moved, and are connected to them."""
    return surface_of(raster, (landable.defect == Defect.MOVING) & raster.known)


def surface_of(raster: ElevationRaster, cells: Mask) -> Mask:
    """Cells that give the same echo as ``cells`` (rows, cols), and are connected to them."""
    if not cells.any():
        return np.zeros(raster.shape, np.bool_)
    echo = _smooth_echo(raster)
    typical = np.median(echo[cells])
    alike = raster.known & (np.abs(echo - typical) <= _SAME_ECHO * typical)
    _, labels = cv2.connectedComponents(alike.astype(np.uint8), connectivity=4)
    connected = np.unique(labels[cells & alike])
    surface: Mask = np.isin(labels, connected[connected > 0])
    return surface


def surfaces_of_sites(raster: ElevationRaster, sites_odom: Sequence[Array]) -> Mask:
    """Cells of the surface that each of ``sites_odom`` (3,) lies on, by the same echo."""
    found = np.zeros(raster.shape, np.bool_)
    for site in sites_odom:
        row, col = raster.cell_of(site)
        if raster.contains(row, col) and raster.known[row, col]:
            cells = np.zeros(raster.shape, np.bool_)
            cells[row, col] = True
            found |= surface_of(raster, cells)
    return found


def _smooth_echo(raster: ElevationRaster) -> Float32:
    """Mean intensity over about a metre of seen cells."""
    size = (2 * round(0.5 * _SMOOTHING_M / raster.cell_m) + 1,) * 2
    seen = np.isfinite(raster.intensity) & raster.known
    echo = np.where(seen, raster.intensity, np.float32(0.0))
    total = cv2.boxFilter(echo, -1, size, borderType=cv2.BORDER_CONSTANT)
    share = cv2.boxFilter(seen.astype(np.float32), -1, size, borderType=cv2.BORDER_CONSTANT)
    return (total / np.maximum(share, np.float32(1e-3))).astype(np.float32)


def traffic_zone(raster: ElevationRaster, landable: LandableMap) -> Mask:
    """Cells within 2 m of a surface that traffic uses."""
    return dilated(traffic_surface(raster, landable), _NEAR_M / raster.cell_m)


def traffic_penalty(close: Mask, params: LandingParams) -> Float32:
    """What is taken off C_sum when sites are ranked, (rows, cols): ``traffic_penalty`` in cells
    that are ``close`` to traffic or to what ground classification refused, else 0."""
    return np.where(close, np.float32(params.traffic_penalty), np.float32(0.0))
