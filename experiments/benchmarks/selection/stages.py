"""The steps of the paper's Table 7, timed one by one: those of ``landing.selection.selector``
before the check of single sites."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.api import GridMap
from touchdown.landing.api import LandingParams
from touchdown.landing.selection.clustering import bandwidths, quick_shift
from touchdown.landing.selection.ground.elevation_raster import observed_raster
from touchdown.landing.selection.ground.landable import ground_planes
from touchdown.landing.selection.score import c_sum
from touchdown.landing.selection.terms.distance import distance
from touchdown.landing.selection.terms.flatness import flatness_of
from touchdown.landing.selection.terms.smoothness import smoothness_of

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]

STAGES = ("down_sampling", "flatness", "smoothness", "distance", "clustering")


@dataclass(frozen=True, kw_only=True, slots=True)
class Staged:
    """Costs and clusters of the observed part of a map, with the time of each step."""

    origin_xy_m: Array
    cell_m: float
    total: Float32
    """C_sum (Eq. 13), (rows, cols), NaN unknown"""
    modes: NDArray[np.int32]
    """(K, 2) row, col"""
    seconds: dict[str, float]
    """by step of ``STAGES``"""


class StageTimer:
    """Measures the seconds from one ``lap`` to the next."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        """Stores the time since the last call as that of the step ``name``."""
        now = time.perf_counter()
        self.seconds[name] = now - self._last
        self._last = now


def staged_selection(
    grid: GridMap, position_odom: Array, params: LandingParams, footprint_radius_m: float
) -> Staged:
    """Computes costs and modes for a vehicle at ``position_odom`` (3,). Raises ValueError for an
    empty map."""
    timer = StageTimer()
    raster = observed_raster(grid)
    if raster is None:
        raise ValueError("the map is empty: there is nothing to select from")
    timer.lap("down_sampling")
    planes = ground_planes(raster, params)
    flat = flatness_of(raster, planes, params)
    timer.lap("flatness")
    smooth = smoothness_of(raster, params)
    timer.lap("smoothness")
    near = distance(raster, position_odom, np.inf)
    timer.lap("distance")
    total = c_sum(smooth, flat, near, params)
    bandwidth, radius = bandwidths(footprint_radius_m / raster.cell_m, params)
    clusters = quick_shift(total, bandwidth_cells=bandwidth, radius_cells=radius)
    timer.lap("clustering")
    return Staged(
        origin_xy_m=raster.origin_xy_m,
        cell_m=raster.cell_m,
        total=total,
        modes=clusters.modes,
        seconds=timer.seconds,
    )
