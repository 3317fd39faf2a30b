"""Surfaces with traffic, by observed motion and LIDAR intensity.

A surface on which motion was observed is extended over connected cells of the same intensity, since
vehicles may drive anywhere on it. The class of the ground is left to ground classification.
"""

from collections.abc import Sequence

import cv2
import numpy as np

from touchdown.landing.api import LandingParams
from touchdown.landing.selection.ground.elevation_raster import ElevationRaster, dilated
from touchdown.landing.selection.ground.landable import Defect, LandableMap
from touchdown.sim.typing import Array, Float32, Mask


def surface_of(raster: ElevationRaster, cells: Mask, params: LandingParams) -> Mask:
    """Returns the mask of cells with the intensity of ``cells`` (rows, cols) that are connected to
    them."""
    if not cells.any():
        return np.zeros(raster.shape, np.bool_)
    intensity = _smooth_intensity(raster, params.traffic_smoothing_m)
    typical = np.median(intensity[cells])
    alike = raster.known & (np.abs(intensity - typical) <= params.traffic_same_intensity * typical)
    _, labels = cv2.connectedComponents(alike.astype(np.uint8), connectivity=4)
    connected = np.unique(labels[cells & alike])
    return np.isin(labels, connected[connected > 0])


def surfaces_of_sites(
    raster: ElevationRaster, sites_odom: Sequence[Array], params: LandingParams
) -> Mask:
    """Returns the mask of the surfaces that ``sites_odom`` (3,) lie on, by intensity."""
    found = np.zeros(raster.shape, np.bool_)
    for site in sites_odom:
        row, col = raster.cell_of(site)
        if raster.contains(row, col) and raster.known[row, col]:
            cells = np.zeros(raster.shape, np.bool_)
            cells[row, col] = True
            found |= surface_of(raster, cells, params)
    return found


def _smooth_intensity(raster: ElevationRaster, window_m: float) -> Float32:
    """Returns the mean intensity of observed cells over a window."""
    size = (2 * round(0.5 * window_m / raster.cell_m) + 1,) * 2
    seen = np.isfinite(raster.intensity) & raster.known
    intensity = np.where(seen, raster.intensity, np.float32(0.0))
    total = cv2.boxFilter(intensity, -1, size, borderType=cv2.BORDER_CONSTANT)
    fraction = cv2.boxFilter(seen.astype(np.float32), -1, size, borderType=cv2.BORDER_CONSTANT)
    return (total / np.maximum(fraction, np.float32(1e-3))).astype(np.float32)


def traffic_zone(raster: ElevationRaster, landable: LandableMap, params: LandingParams) -> Mask:
    """Returns the mask of cells within ``traffic_near_m`` of a surface with traffic: of cells with
    the intensity of cells with motion that are connected to them."""
    moving = (landable.defect == Defect.MOVING) & raster.known
    return dilated(surface_of(raster, moving, params), params.traffic_near_m / raster.cell_m)
