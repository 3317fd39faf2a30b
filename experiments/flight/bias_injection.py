"""An estimator with a deliberate error; it proves that the flight follows the estimate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from touchdown.estimator.api import Estimate, Estimator, spare_sensors
from touchdown.experiments.api import BiasParams
from touchdown.sim.api import Observation
from touchdown.sim.frames import Pose

_TAKEN_OFF_M = 1.0


class BiasedEstimator:
    """Adds a horizontal offset to another estimator's pose, ramped in linearly after take-off."""

    def __init__(self, inner: Estimator, params: BiasParams) -> None:
        if params.ramp_s <= 0.0:
            raise ValueError(f"bias.ramp_s is {params.ramp_s}; it must be positive")
        self.needs, self.spare_sensors = inner.needs, spare_sensors(inner)
        self._inner = inner
        self._bias = np.array([*params.xy_m, 0.0])
        self._ramp_s = params.ramp_s
        self._start_height: float | None = None
        self._since_s: float | None = None

    def update(self, obs: Observation) -> Estimate:
        estimate = self._inner.update(obs)
        height = float(estimate.odom_from_body.translation[2])
        if self._start_height is None:
            self._start_height = height
        if self._since_s is None:
            if height < self._start_height + _TAKEN_OFF_M:
                return estimate
            self._since_s = estimate.time_s
        elapsed = (estimate.time_s - self._since_s) / self._ramp_s
        return self._shifted(estimate, min(elapsed, 1.0), ramping=elapsed < 1.0)

    def _shifted(self, estimate: Estimate, share: float, *, ramping: bool) -> Estimate:
        pose = estimate.odom_from_body
        offset = share * self._bias
        track = estimate.scan_track
        if track is not None:
            track = replace(track, positions_odom=track.positions_odom + offset)
        rate = self._bias / self._ramp_s if ramping else np.zeros(3)
        return replace(
            estimate,
            odom_from_body=Pose(pose.rotation, pose.translation + offset),
            velocity_odom=estimate.velocity_odom + rate,
            scan_track=track,
        )
