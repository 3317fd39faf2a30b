"""GPS, IMU, magnetometer and barometer: the usual navigation of multicopters.

The inertial filter is aided by the receiver's velocity, the magnetometer's heading and the
barometer's height. The position in the world comes from fixes alone. Their error wanders with a
correlation time longer than the flight, so that averaging does not reduce it: the position follows
the fixes.
"""

from __future__ import annotations

import math

import numpy as np

from touchdown.estimator.api import Estimate, GpsEstimatorParams
from touchdown.estimator.baselines.aiding import update_velocity
from touchdown.estimator.baselines.navigator import Navigator
from touchdown.estimator.baselines.world_anchor import FollowingAnchor, WanderingAnchor
from touchdown.sim.api import GpsFix, Observation, SensorNeeds, SensorRig
from touchdown.sim.frames import Pose

_PATIENCE_S = 2.0
"""time without a fix after which the estimate is unhealthy"""


class SatelliteAiding:
    """Processing of fixes: velocity update of the filter, and position of its frame in the
    world."""

    def __init__(self, nav: Navigator, anchor: FollowingAnchor | WanderingAnchor) -> None:
        self._nav, self._anchor = nav, anchor
        rig = nav.rig
        self._lever = rig.body_from_imu.inverse().apply(np.array(rig.nav.gps.antenna_body_m))
        self._last_s = -math.inf
        self.innovation = 0.0
        """normalised innovation of the newest velocity, standard deviations"""

    def take(self, fix: GpsFix) -> None:
        """Processes a fix at the filter's time; one that is not finite is skipped."""
        if not np.isfinite(fix.position_world + fix.velocity_world).all():
            self._nav.skipped += 1
            return
        eskf = self._nav.eskf
        if not self._nav.stationary:
            self.innovation = update_velocity(eskf, fix, self._lever, self._nav.rate_imu)
        antenna = eskf.state.position + eskf.state.rotation @ self._lever
        self._anchor.take(fix.position_world - antenna, fix.sigma_position_m, fix.time_s)
        self._last_s = fix.time_s

    def healthy(self, time_s: float) -> bool:
        """True if a recent fix exists."""
        return time_s - self._last_s < _PATIENCE_S

    def estimate(self, obs: Observation, diagnostics: dict[str, float]) -> Estimate:
        """Returns the present estimate, in the world frame given by the fixes."""
        self._anchor.step(self._nav.rig.imu_ticks / self._nav.rig.tick_hz)
        return self._nav.estimate(
            obs,
            healthy=self.healthy(obs.time_s),
            diagnostics=diagnostics | {"velocity_innovation": self.innovation},
            world_from_odom=Pose(np.eye(3), self._anchor.offset),
            covariance=self._anchor.covariance,
        )


class GpsEstimator:
    """The GPS estimator. Deterministic; nothing is drawn at random."""

    needs = SensorNeeds(gps=True, magnetometer=True, barometer=True)

    def __init__(self, rig: SensorRig, params: GpsEstimatorParams | None = None) -> None:
        params = params or GpsEstimatorParams()
        self._nav = Navigator(
            rig, self.needs, known_start=False, correction_time_s=params.correction_time_s,
            heading_sigma_deg=params.heading_sigma_deg, baro_sigma_m=params.baro_sigma_m,
        )  # fmt: skip
        self._satellites = SatelliteAiding(self._nav, FollowingAnchor(params.follow_period_s))

    def update(self, obs: Observation) -> Estimate:
        """Processes the arrived messages and returns the estimate at ``obs.tick``."""
        for epoch in self._nav.epochs(obs):
            if epoch.fix is not None:
                self._satellites.take(epoch.fix)
        return self._satellites.estimate(obs, {})
