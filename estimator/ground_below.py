"""Height of the ground below a rangefinder that points down along the body axis."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.filtering.imu_propagation import NavState
from touchdown.sim.api import RangefinderSample, SensorRig

Array = NDArray[np.float64]


class GroundBelow:
    """Height of the ground in the odometry frame, smoothed over ``memory_s``; without echoes, as
    over dark water, the last height is kept."""

    def __init__(self, rig: SensorRig, memory_s: float) -> None:
        self._tick_hz = rig.tick_hz
        self._memory_s = memory_s
        imu_from_body = rig.body_from_imu.inverse()
        self._mount = imu_from_body.apply(np.array(rig.nav.rangefinder.position_body_m))
        self._down = -imu_from_body.rotation[:, 2]
        start = rig.world_from_body_start.translation
        self.height_m = float(start[2]) - rig.vehicle.leg_height_m
        self._time_s = -math.inf

    def take(self, samples: Sequence[RangefinderSample], state: NavState) -> None:
        """Updates by the ``samples`` since the last call, up to the filter's state."""
        now_s = state.tick / self._tick_hz
        for sample in samples:
            if not sample.range_m > 0.0 or not math.isfinite(sample.range_m):
                continue
            age_s = now_s - sample.time_s
            start = state.position - age_s * state.velocity + state.rotation @ self._mount
            hit = start + sample.range_m * (state.rotation @ self._down)
            step_s = sample.time_s - self._time_s
            share = -math.expm1(-step_s / self._memory_s) if self._memory_s > 0.0 else 1.0
            self.height_m += share * (float(hit[2]) - self.height_m)
            self._time_s = sample.time_s
