"""PID gains in closed form from the bandwidths in ``ControlParams``.

Every loop of the cascade sees, below the bandwidth of the loop inside it, an integrator: torque
over inertia gives angular rate, rate gives angle, thrust direction gives velocity, velocity gives
position. A proportional gain k on an integrator crosses 0 dB at k rad/s, and a PI corner at
k / ratio costs atan(1 / ratio) of phase there. ``controller.design`` checks the margins of these
gains against the full linear model, motor lag and sampling included.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from touchdown.controller.api import ControlParams
from touchdown.controller.pid import PidGains

Array = NDArray[np.float64]

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
    """Gains for the bandwidths ``params``; raises ValueError when one is not positive."""
    position = np.array(
        [params.position_xy_radps, params.position_xy_radps, params.position_z_radps]
    )
    velocity = np.array(
        [params.velocity_xy_radps, params.velocity_xy_radps, params.velocity_z_radps]
    )
    attitude = np.array([params.attitude_radps, params.attitude_radps, params.yaw_radps])
    rate = np.array([params.rate_radps, params.rate_radps, params.yaw_rate_radps])
    ratios = [params.rate_integral_ratio, params.velocity_integral_ratio]
    if not np.all(np.concatenate([position, velocity, attitude, rate, ratios]) > 0.0):
        raise ValueError("every *_radps and *_integral_ratio of [control] must be above 0")
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
