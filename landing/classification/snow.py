"""Snow by its brightness to the LIDAR: ground that no image of the training shows.

At 905 nm snow reflects 0.6 (coarse, old) to 0.9 (fresh) of the light (Warren, "Optical properties
of snow", Rev. Geophys. 20, 1982); grass, soil, sand, asphalt, tiles and concrete reflect less than
0.5, ice and water less than 0.1. What else is white is small or bounded by steps: markings, fleece,
and roofs, whose snow is that of a building. So snow is bright ground that is connected, without a
step, over a wide area. In an image it is white like a pale roof.
"""

import cv2
import numpy as np

from touchdown.estimator.api import MapView
from touchdown.landing.selection.ground.elevation_raster import ElevationRaster, observed_raster
from touchdown.scenes.api import LAND_CLASSES
from touchdown.sim.typing import Array, Mask

_LEVELS = 150.0
"""intensity of a matt target that reflects everything, straight below (Livox)"""
_BRIGHT = 0.5
"""least reflectivity times cosine of a cell; the cosine is 0.75 at the edge of the field of view"""
_BRIGHT_MEDIAN = 0.6
"""of the cells around a site"""
_BRIGHT_FRACTION = 0.9
"""of the cells around a site that must be part of the surface"""
_STEP_M = 0.25
"""between neighbouring cells of one surface"""
_WIDE_M2 = 500.0
"""area of the surface; the roof of a hall may be as large, but ends in steps"""
_WATER, _FIELD = LAND_CLASSES.index("water"), LAND_CLASSES.index("field")


def is_snow(map_view: MapView, site_odom: Array, half_m: float) -> bool:
    """True if the square of ``half_m`` around ``site_odom`` (3,) lies on a wide surface without
    steps that is as bright to the LIDAR as snow alone is."""
    raster = observed_raster(map_view.coarse)
    if raster is None:
        return False
    row, col = raster.cell_of(site_odom)
    reach = round(half_m / raster.cell_m)
    if not raster.contains(row, col):
        return False
    around = np.s_[max(row - reach, 0) : row + reach + 1, max(col - reach, 0) : col + reach + 1]
    seen = raster.known[around]
    if not seen.any() or np.median(raster.intensity[around][seen]) < _BRIGHT_MEDIAN * _LEVELS:
        return False
    surface = _surface_at(raster, row, col)
    wide = surface.sum() * raster.cell_m**2 >= _WIDE_M2
    return bool(wide and surface[around][seen].mean() >= _BRIGHT_FRACTION)


def as_snow(probabilities: Array) -> Array:
    """Returns the probabilities (7,) of an image of snow: all but that of water is the field's,
    since under it may be ice."""
    water = float(probabilities[_WATER])
    found = np.zeros_like(probabilities)
    found[_WATER], found[_FIELD] = water, float(probabilities.sum()) - water
    return found


def _surface_at(raster: ElevationRaster, row: int, col: int) -> Mask:
    """Returns the bright cells (rows, cols) that are connected with the cell (row, col) without a
    step; none where it is dark itself."""
    known = raster.known
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    top = cv2.dilate(np.where(known, raster.height, np.float32(-1e6)), cross)
    bottom = cv2.erode(np.where(known, raster.height, np.float32(1e6)), cross)
    with np.errstate(invalid="ignore"):
        bright = known & (raster.intensity >= _BRIGHT * _LEVELS) & (top - bottom <= _STEP_M)
    _, labels = cv2.connectedComponents(bright.astype(np.uint8), connectivity=4)
    return np.asarray((labels == labels[row, col]) & bright)
