"""A vector PID, every axis with its own gains and limits, and the cascade's gains in closed form
by the bandwidths in ``ControlParams``.

Every loop of the cascade sees, below the bandwidth of the loop inside it, an integrator: torque
over inertia gives angular rate, rate gives angle, thrust direction gives velocity, velocity gives
position. A proportional gain k on an integrator crosses 0 dB at k rad/s, and a PI corner at
k / ratio costs atan(1 / ratio) of phase there. ``controller.design`` checks the margins of these
gains against the full linear model, motor lag and sampling included.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from touchdown.controller.api import ControlParams
from touchdown.sim.typing import Array


@dataclass(frozen=True, kw_only=True, slots=True)
class PidGains:
    """Gains and limits of n axes, each (n,): output = kp e + integral of (ki e) - kd rate."""

    kp: Array
    ki: Array
    kd: Array
    integral_limit: Array
    """bound on the magnitude of the integral's part of the output"""


class VectorPid:
    """PID whose derivative acts on a given rate, so that a step of the reference does not kick.

    One control step is ``output`` followed by ``settle``, which integrates: the
    saturation is known only after the actuators were commanded. Anti-windup by back-calculation:
    the undelivered output enters the integral at the rate ``ki / kp``, the time constant of the
    integral itself (Astrom and Hagglund, 1995, section 3.5).
    """

    def __init__(self, gains: PidGains, step_s: float) -> None:
        self.gains = gains
        self._step_s = step_s
        self._tracking = np.where(gains.kp > 0.0, gains.ki / np.where(gains.kp > 0, gains.kp, 1), 0)
        self.reset()

    def reset(self) -> None:
        """Forgets the integral."""
        size = self.gains.kp.size
        self.integral = np.zeros(size)
        self._error = np.zeros(size)

    def output(self, error: Array, rate: Array) -> Array:
        """(n,) demand for the ``error`` (n,) and the ``rate`` (n,) at which it is being removed."""
        gains = self.gains
        self._error = error
        return _pid_output(error, rate, self.integral, gains.kp, gains.kd)

    def settle(self, missing: Array) -> None:
        """Integrates one step; ``missing`` (n,): delivered output less demanded output."""
        gains = self.gains
        self.integral = _pid_integral(
            self.integral,
            self._error,
            missing,
            gains.ki,
            self._tracking,
            gains.integral_limit,
            self._step_s,
        )


@njit(cache=True, error_model="numpy")
def _pid_output(error: Array, rate: Array, integral: Array, kp: Array, kd: Array) -> Array:
    return kp * error + integral - kd * rate


@njit(cache=True, error_model="numpy")
def _pid_integral(
    integral: Array,
    error: Array,
    missing: Array,
    ki: Array,
    tracking: Array,
    limit: Array,
    step_s: float,
) -> Array:
    grown = integral + step_s * (ki * error + tracking * missing)
    return np.minimum(np.maximum(grown, -limit), limit)


MAX_INTEGRAL_RADPS2 = np.array([8.0, 8.0, 2.0])
"""Angular acceleration that the rate integrals may hold: offsets of the centre of mass."""
MAX_INTEGRAL_MPS2 = np.array([4.0, 4.0, 3.0])
"""Acceleration that the velocity integrals may hold: the drag of a strong wind, a thrust error."""


@dataclass(frozen=True, kw_only=True, slots=True)
class CascadeGains:
    """All gains of the cascade, each (3,) along its axes x, y, z."""

    position: Array
    """1/s, position error to velocity"""
    velocity: PidGains
    """velocity error (m/s) to acceleration (m/s^2)"""
    attitude: Array
    """1/s, rotation error (rad, body axes) to body rate"""
    rate: PidGains
    """body rate error (rad/s) to angular acceleration (rad/s^2)"""


def cascade_gains(params: ControlParams) -> CascadeGains:
    """Gains for the bandwidths ``params``."""
    position = np.array(
        [params.position_xy_radps, params.position_xy_radps, params.position_z_radps]
    )
    velocity = np.array(
        [params.velocity_xy_radps, params.velocity_xy_radps, params.velocity_z_radps]
    )
    attitude = np.array([params.attitude_radps, params.attitude_radps, params.yaw_radps])
    rate = np.array([params.rate_radps, params.rate_radps, params.yaw_rate_radps])
    # Acceleration feedback k makes the vehicle seem 1 + k times heavier: the other gains grow by
    # the same factor, so that the crossovers stay where they were asked for.
    heavier = 1.0 + params.acceleration_feedback
    return CascadeGains(
        position=position,
        velocity=PidGains(
            kp=heavier * velocity,
            ki=heavier * velocity**2 / params.velocity_integral_ratio,
            kd=np.full(3, params.acceleration_feedback),
            integral_limit=MAX_INTEGRAL_MPS2,
        ),
        attitude=attitude,
        rate=PidGains(
            kp=rate,
            ki=rate**2 / params.rate_integral_ratio,
            kd=rate * params.rate_derivative_s,
            integral_limit=MAX_INTEGRAL_RADPS2,
        ),
    )
