"""GPS, IMU, magnetometer and barometer: the usual navigation of multicopters.

The inertial filter is aided by the receiver's velocity, the magnetometer's heading and the
barometer's height. The position in the world comes from fixes alone. Their error wanders with a
correlation time longer than the flight, so that averaging does not reduce it: the position follows
the fixes.
"""

import math

import numpy as np

from touchdown.estimator.api import CalibrationPriors, Estimate, GpsEstimatorParams
from touchdown.estimator.baselines.aiding import update_velocity
from touchdown.estimator.baselines.navigator import Navigator
from touchdown.sim.api import GpsFix, Observation, SensorNeeds, SensorRig
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array

_UNKNOWN_M2 = 1e6
_FIX_TIMEOUT_S = 2.0
"""time without a fix after which the estimate is unhealthy"""


class FollowingAnchor:
    """Anchor that follows the fixes: the frame is at the newest fix, smoothed over ``follow_s``."""

    def __init__(self, follow_s: float) -> None:
        self._follow_s = follow_s
        self._target: Array | None = None
        self._variance = np.full(3, _UNKNOWN_M2)
        self.offset: Array = np.zeros(3)
        """(3,) m, world_from_odom"""

    @property
    def covariance(self) -> Array:
        """(3, 3) m^2 as reported by the receiver. Its error wanders as slowly as the flight is
        long, so that fixes do not average it out."""
        return np.diag(self._variance)

    def take(self, offset: Array, sigma: Array, time_s: float) -> None:
        """Processes a fix. ``offset`` (3,): fix minus odometry at the fix's time; ``sigma`` (3,) as
        reported."""
        if self._target is None:
            self.offset = offset
        self._target = offset
        self._variance = sigma * sigma

    def step(self, seconds: float) -> None:
        """Moves the frame towards its target."""
        if self._target is not None:
            fraction = -math.expm1(-seconds / self._follow_s)
            self.offset = self.offset + fraction * (self._target - self.offset)


class WanderingAnchor:
    """Anchor that separates the position of the frame from the wandering error of the receiver.

    Kalman filter with two states an axis: the offset, a random walk by the drift of the odometry,
    and the receiver's error, a Gauss-Markov process of the reported size and of the correlation
    time ``tau_s``. The first fix measures the sum only; later ones separate both as far as the
    error wanders while the odometry does not.
    """

    def __init__(
        self, tau_s: float, drift_m_sqrt_s: float, white_m: float, correction_time_s: float
    ) -> None:
        self._tau_s, self._drift, self._white = tau_s, drift_m_sqrt_s, white_m
        self._correction_time_s = correction_time_s
        self._mean = np.zeros((3, 2))
        self._covariance = np.tile(np.diag([_UNKNOWN_M2, 0.0]), (3, 1, 1))
        self._time_s = math.nan
        self.offset: Array = np.zeros(3)

    @property
    def covariance(self) -> Array:
        """(3, 3) m^2 of the offset."""
        return np.diag(self._covariance[:, 0, 0])

    def take(self, offset: Array, sigma: Array, time_s: float) -> None:
        """As ``FollowingAnchor.take``."""
        first = math.isnan(self._time_s)
        if first:
            self._covariance[:, 1, 1] = sigma * sigma
        else:
            self._predict(max(time_s - self._time_s, 0.0), sigma)
        self._time_s = time_s
        observed = self._covariance.sum(axis=2)
        innovation = observed.sum(axis=1) + self._white**2
        gain = observed / innovation[:, None]
        residual = offset - self._mean.sum(axis=1)
        self._mean = self._mean + gain * residual[:, None]
        self._covariance = self._covariance - gain[:, :, None] * observed[:, None, :]
        if first:
            self.offset = self._mean[:, 0].copy()

    def _predict(self, seconds: float, sigma: Array) -> None:
        keep = np.array([1.0, math.exp(-seconds / self._tau_s)])
        self._mean = self._mean * keep
        self._covariance = self._covariance * np.outer(keep, keep)
        self._covariance[:, 0, 0] += self._drift**2 * seconds
        self._covariance[:, 1, 1] += sigma * sigma * -math.expm1(-2.0 * seconds / self._tau_s)

    def step(self, seconds: float) -> None:
        """Moves the frame towards its target."""
        if not math.isnan(self._time_s):
            fraction = -math.expm1(-seconds / self._correction_time_s)
            self.offset = self.offset + fraction * (self._mean[:, 0] - self.offset)


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
        return time_s - self._last_s < _FIX_TIMEOUT_S

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

    def __init__(
        self,
        rig: SensorRig,
        params: GpsEstimatorParams | None = None,
        priors: CalibrationPriors | None = None,
    ) -> None:
        params = params or GpsEstimatorParams()
        self._nav = Navigator(
            rig, self.needs, known_start=False, priors=priors,
            heading_sigma_deg=params.heading_sigma_deg, baro_sigma_m=params.baro_sigma_m,
        )  # fmt: skip
        self._satellites = SatelliteAiding(self._nav, FollowingAnchor(params.follow_period_s))

    def update(self, obs: Observation) -> Estimate:
        """Processes the arrived messages and returns the estimate at ``obs.tick``."""
        for epoch in self._nav.epochs(obs):
            if epoch.fix is not None:
                self._satellites.take(epoch.fix)
        return self._satellites.estimate(obs, {})
