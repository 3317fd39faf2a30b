"""Updates of the error-state filter by GPS velocity, magnetometer and barometer.

Error coordinates as in ``estimator.filtering.error_state``. The odometry frame has the axes of the
world.
"""

import math
from collections.abc import Sequence

import numpy as np

from touchdown.estimator.filtering.error_state import POSITION, ROTATION, VELOCITY
from touchdown.estimator.filtering.eskf import Eskf
from touchdown.sim.api import BarometerSample, GpsFix
from touchdown.sim.frames import cross, skew, wrap_angle
from touchdown.sim.typing import Array, Indices


def update(
    eskf: Eskf,
    touched: Indices,
    jacobian: Array,
    residual: Array,
    covariance: Array,
    gate: float = math.inf,
) -> float:
    """Updates the filter by an innovation ``residual`` (M,) with Jacobian (M, N) over the
    ``touched`` error coordinates and covariance (M, M). The covariance of an innovation beyond
    ``gate`` standard deviations is inflated so that it is ``gate`` away. Returns the normalised
    innovation in standard deviations, the root of NIS / M."""
    local = eskf.covariance[np.ix_(touched, touched)]
    spread = jacobian @ local @ jacobian.T + covariance
    squared = float(residual @ np.linalg.solve(spread, residual)) / len(residual)
    if squared > gate * gate:
        covariance = covariance * (squared / (gate * gate))
    weight = np.linalg.inv(covariance)
    information = jacobian.T @ weight @ jacobian
    eskf.apply(touched, information, jacobian.T @ (weight @ residual))
    return math.sqrt(squared)


def heading_of(rotation: Array, field_imu: Array) -> float:
    """Azimuth (rad from east) of the horizontal part of a field (3,), measured in the IMU frame,
    under ``rotation``."""
    east, north, _ = (rotation @ field_imu).tolist()
    return math.atan2(north, east)


def update_heading(eskf: Eskf, field_imu: Array, azimuth: float, sigma: float) -> None:
    """Updates the heading by a field (3,), IMU frame, of known ``azimuth``. Only the heading is
    corrected: the magnetometer's offsets would tilt the attitude."""
    rotation = eskf.state.rotation
    residual = wrap_angle(azimuth - heading_of(rotation, field_imu))
    update(
        eskf, np.arange(3)[ROTATION], rotation[2:3], np.array([residual]),
        np.array([[sigma * sigma]]), gate=3.0,
    )  # fmt: skip


def update_velocity(eskf: Eskf, fix: GpsFix, lever_imu: Array, rate_imu: Array) -> float:
    """Updates by the GPS velocity of an antenna at ``lever_imu`` (3,), with angular rate
    (3,) rad/s; returns the normalised innovation."""
    state = eskf.state
    swing = cross(rate_imu, lever_imu)
    jacobian = np.hstack([-state.rotation @ skew(swing), np.eye(3)])
    residual = fix.velocity_world - state.velocity - state.rotation @ swing
    variance = max(fix.sigma_velocity_mps, 1e-3) ** 2
    touched = np.r_[ROTATION, VELOCITY]
    return update(eskf, touched, jacobian, residual, variance * np.eye(3), gate=5.0)


class BaroHeight:
    """Barometric height relative to the position at switch-on."""

    def __init__(self, tick_hz: int, sigma_m: float) -> None:
        self._tick_hz, self._sigma_m = tick_hz, sigma_m
        self._sum, self._count = 0.0, 0

    def take(self, eskf: Eskf, samples: Sequence[BarometerSample], stationary: bool) -> None:
        """Averages on the ground, and measures the height in the air. ``samples`` are those since
        the last call, up to the filter's state."""
        heights = [s.altitude_m for s in samples if math.isfinite(s.altitude_m)]
        if not heights:
            return
        state = eskf.state
        if stationary:
            self._sum += sum(heights) - len(heights) * float(state.position[2])
            self._count += len(heights)
        elif self._count:
            age_s = state.tick / self._tick_hz - float(np.mean([s.time_s for s in samples]))
            then = float(state.position[2] - age_s * state.velocity[2])
            residual = float(np.mean(heights)) - self._sum / self._count - then
            variance = self._sigma_m**2 / len(heights)
            update(
                eskf, np.arange(6)[POSITION][2:], np.ones((1, 1)), np.array([residual]),
                np.array([[variance]]), gate=4.0,
            )  # fmt: skip
