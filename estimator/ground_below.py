"""Height of the ground below a rangefinder that points down along the body axis."""

import math
from collections import deque
from collections.abc import Sequence

import numpy as np

from touchdown.estimator.filtering.imu_propagation import NavState
from touchdown.sim.api import RangefinderSample, SensorRig
from touchdown.sim.typing import Array

_REMEMBERED = 32
"""echoes that ``spot`` looks among: more than half a second"""


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
        self._nearest_s = 1.5 * rig.nav.rangefinder.period_ticks / rig.tick_hz
        self._echoes: deque[tuple[float, float]] = deque(maxlen=_REMEMBERED)

    def spot(self, time_s: float) -> Array | None:
        """(3,) point of the ground that the beam met at ``time_s``, in the IMU frame then; None
        without an echo within 1.5 periods of the rangefinder."""
        near = min(self._echoes, key=lambda echo: abs(echo[0] - time_s), default=None)
        if near is None or abs(near[0] - time_s) > self._nearest_s:
            return None
        return self._mount + near[1] * self._down

    def take(self, samples: Sequence[RangefinderSample], state: NavState) -> None:
        """Updates by the ``samples`` since the last call, up to the filter's state."""
        now_s = state.tick / self._tick_hz
        for sample in samples:
            if not sample.range_m > 0.0 or not math.isfinite(sample.range_m):
                continue
            self._echoes.append((sample.time_s, sample.range_m))
            age_s = now_s - sample.time_s
            start = state.position - age_s * state.velocity + state.rotation @ self._mount
            hit = start + sample.range_m * (state.rotation @ self._down)
            step_s = sample.time_s - self._time_s
            fraction = -math.expm1(-step_s / self._memory_s) if self._memory_s > 0.0 else 1.0
            self.height_m += fraction * (float(hit[2]) - self.height_m)
            self._time_s = sample.time_s
