"""What the terms of a score are made of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from touchdown.landing.api import LandingParams, SelectorParams
from touchdown.landing.selection.ground.elevation_raster import ElevationRaster
from touchdown.landing.selection.ground.landable import LandableMap

Float32 = NDArray[np.float32]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True, slots=True)
class Inputs:
    """One map and what is known of it, (rows, cols); NaN unknown."""

    params: LandingParams
    selector: SelectorParams
    raster: ElevationRaster
    landable: LandableMap
    vehicle_odom: NDArray[np.float64]
    """(3,)"""
    smoothness: Float32
    """Eq. 14, 0 to 1"""
    flatness: Float32
    """Eqs. 15 to 17, 0 to 1"""
    distance: Float32
    """Eq. 18, 1 near to 0 far"""
    probability: Float32
    """probability of a touchdown that is safe by geometry"""
    traffic: Mask
    """near a surface with traffic, or on one whose class was refused"""
    plants: Mask
    """stands of low plants"""
    ground: Float32
    """probability of ground of an allowed class, by the semantic map"""
    clearance_m: Float32
    """distance to the nearest cell that does not pass the gates"""
