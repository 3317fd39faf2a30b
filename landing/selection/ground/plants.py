"""Low plants: grass and crops that stand wide and that pulses pass to the ground.

Over a meadow some pulses return from the grass and some from the ground beneath it: the returns of
a cell spread, and the highest ones look like objects. The ground is that of the map.
A vehicle stands on the ground all the same. Low plants are taken for what they are where they form
a stand: the spread fills an area of a metre, the highest returns are low, and in every cell some
returns come from the ground. A post, a kerb, a rope or a tuft by itself is narrower, a rock or a
log lets no pulse through, so that the lowest returns over it make a step; both stay what they were.
"""

import dataclasses

import cv2
import numpy as np

from touchdown.landing.api import GroundParams
from touchdown.landing.selection.ground.elevation_raster import ElevationRaster
from touchdown.sim.typing import Mask

_NOISE_M = np.float32(0.05)
"""error of the highest of many returns of bare ground"""


def standing_plants(
    raster: ElevationRaster, limits: GroundParams, *, fill_gaps: bool = False
) -> Mask:
    """Returns the mask of cells (rows, cols) in clumps and stands of low plants.

    ``fill_gaps``: a clump may have cells of bare ground in it. Seen from near, where clumps have
    several cells, that adds their thin parts; from far it would join what stands apart."""
    found = np.zeros(raster.shape, np.bool_)
    around = np.ones((3, 3), np.uint8)
    with np.errstate(invalid="ignore"):
        lowest = cv2.erode(np.where(raster.known, raster.low, np.float32(1e6)), around)
        level = raster.low - lowest <= limits.plants_level_m
        spread = raster.high - raster.low
        for side_m, max_m, mean_m in (limits.plants_clump, limits.plants_stand):
            low = (spread <= max_m) & (raster.height - raster.low <= mean_m)
            some = (low & (spread > limits.plants_spread_m)).astype(np.uint8)
            filled = some
            if fill_gaps:
                closed = cv2.morphologyEx(some, cv2.MORPH_CLOSE, around) > 0
                filled = some | (closed & low & level)
            cells = max(round(side_m / raster.cell_m), 3) | 1  # an even kernel moves what it opens
            core = cv2.morphologyEx(filled, cv2.MORPH_OPEN, np.ones((cells, cells), np.uint8))
            edge = cv2.dilate(core, np.ones((2 * limits.plants_edge_cells + 1,) * 2, np.uint8))
            found |= (core > 0) | ((edge > 0) & (some > 0))
    return found & raster.known


def without_plants(raster: ElevationRaster, plants: Mask, limits: GroundParams) -> ElevationRaster:
    """Returns the raster with the ground under ``plants`` (rows, cols) in their place: spread and
    highest returns become those of bare ground. Where no pulse showed the ground well enough, they
    stay. Without plants the raster itself is returned."""
    if not plants.any():
        return raster
    ground = raster.ground(plants)
    with np.errstate(invalid="ignore"):
        sure = plants & (ground.std_m <= limits.plants_ground_std_m)
    return dataclasses.replace(
        raster,
        height=np.where(sure, ground.height_m, raster.height),
        high=np.where(sure, ground.height_m + _NOISE_M, raster.high),
        std=np.where(sure, np.minimum(raster.std, 0.5 * _NOISE_M), raster.std),
    )
