"""Surfaces with traffic, by observed motion and LIDAR intensity: sites on them rank lower.

A surface on which motion was observed is extended over connected cells of the same intensity, since
vehicles may drive anywhere on it. The class of the ground is left to ground classification.
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
_SAME_INTENSITY = 0.35
"""relative difference of the mean intensity up to which two cells count as one surface: intensity
falls with the cosine of the incidence angle, to 0.75 at the edge of the field of view"""
_NEAR_M = 2.0


def traffic_surface(raster: ElevationRaster, landable: LandableMap) -> Mask:
    """Returns the mask of cells with the intensity of cells with motion that are connected to
    them."""
    return surface_of(raster, (landable.defect == Defect.MOVING) & raster.known)


def surface_of(raster: ElevationRaster, cells: Mask) -> Mask:
    """Returns the mask of cells with the intensity of ``cells`` (rows, cols) that are connected to
    them."""
    if not cells.any():
        return np.zeros(raster.shape, np.bool_)
    intensity = _smooth_intensity(raster)
    typical = np.median(intensity[cells])
    alike = raster.known & (np.abs(intensity - typical) <= _SAME_INTENSITY * typical)
    _, labels = cv2.connectedComponents(alike.astype(np.uint8), connectivity=4)
    connected = np.unique(labels[cells & alike])
    surface: Mask = np.isin(labels, connected[connected > 0])
    return surface


def surfaces_of_sites(raster: ElevationRaster, sites_odom: Sequence[Array]) -> Mask:
    """Returns the mask of the surfaces that ``sites_odom`` (3,) lie on, by intensity."""
    found = np.zeros(raster.shape, np.bool_)
    for site in sites_odom:
        row, col = raster.cell_of(site)
        if raster.contains(row, col) and raster.known[row, col]:
            cells = np.zeros(raster.shape, np.bool_)
            cells[row, col] = True
            found |= surface_of(raster, cells)
    return found


def _smooth_intensity(raster: ElevationRaster) -> Float32:
    """Returns the mean intensity over about a metre of observed cells."""
    size = (2 * round(0.5 * _SMOOTHING_M / raster.cell_m) + 1,) * 2
    seen = np.isfinite(raster.intensity) & raster.known
    intensity = np.where(seen, raster.intensity, np.float32(0.0))
    total = cv2.boxFilter(intensity, -1, size, borderType=cv2.BORDER_CONSTANT)
    share = cv2.boxFilter(seen.astype(np.float32), -1, size, borderType=cv2.BORDER_CONSTANT)
    return (total / np.maximum(share, np.float32(1e-3))).astype(np.float32)


def traffic_zone(raster: ElevationRaster, landable: LandableMap) -> Mask:
    """Returns the mask of cells within 2 m of a surface with traffic."""
    return dilated(traffic_surface(raster, landable), _NEAR_M / raster.cell_m)


def traffic_penalty(close: Mask, params: LandingParams) -> Float32:
    """Returns the penalty (rows, cols) on the value of sites: ``traffic_penalty`` in cells that are
    ``close`` to traffic or to ground that classification refused, else 0."""
    return np.where(close, np.float32(params.traffic_penalty), np.float32(0.0))
