"""Position of the odometry frame in the world, from satellite fixes.

The odometry frame has the axes of the world and starts at the take-off spot; only its position in
the world is estimated, from fixes alone.
"""

from __future__ import annotations

import math

import numpy as np

from touchdown.estimator.typing import Array

_UNKNOWN_M2 = 1e6


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
            share = -math.expm1(-seconds / self._follow_s)
            self.offset = self.offset + share * (self._target - self.offset)


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
            share = -math.expm1(-seconds / self._correction_time_s)
            self.offset = self.offset + share * (self._mean[:, 0] - self.offset)
