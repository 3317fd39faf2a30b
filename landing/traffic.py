"""Where vehicles may drive, as far as colour and motion tell: a preference, not a rule.

What a place is, a classifier must say. Until it does, ground without colour (asphalt, concrete) is
preferred less than what grows, and a colourless surface on which something was seen to move is
taken for a road as far as it goes.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from landing.api import LandingParams
from landing.landable import Defect, LandableMap
from landing.terrain import Terrain, distance_to

Float32 = NDArray[np.float32]
Mask = NDArray[np.bool_]

_PAVED_SATURATION = 0.18
"""(max - min) / max of colour: asphalt and concrete are below 0.15, soil and plants above 0.3"""
_BLUR_M = 0.6
_NEAR_M = 2.0


def paved_cells(terrain: Terrain) -> Mask:
    """Coloured cells whose colour, averaged over about a metre, is nearly grey."""
    coloured = np.isfinite(terrain.rgb[..., 0])
    rgb = np.where(coloured[..., None], terrain.rgb, np.float32(0.0))
    size = 2 * round(_BLUR_M / terrain.cell_m) + 1
    sums = cv2.boxFilter(rgb, -1, (size, size), borderType=cv2.BORDER_CONSTANT)
    top = sums.max(axis=2)
    return coloured & (top - sums.min(axis=2) < np.float32(_PAVED_SATURATION) * top)


def traffic_penalty(terrain: Terrain, landable: LandableMap, params: LandingParams) -> Float32:
    """What is taken off C_sum when sites are ranked, (rows, cols): ``traffic_penalty`` within 2 m
    of a paved surface that is connected to where something moved, ``paved_penalty`` near any other
    paved one, else 0."""
    paved = paved_cells(terrain)
    number, labels = cv2.connectedComponents(paved.astype(np.uint8), connectivity=4)
    moved = landable.defect == Defect.MOVING
    driven = np.zeros(number, bool)
    driven[np.unique(labels[moved & paved])] = True
    driven[0] = False
    road = driven[labels]
    penalty = np.zeros(terrain.shape, np.float32)
    penalty[distance_to(paved, terrain.cell_m) <= _NEAR_M] = params.paved_penalty
    penalty[distance_to(road, terrain.cell_m) <= _NEAR_M] = params.traffic_penalty
    return penalty
