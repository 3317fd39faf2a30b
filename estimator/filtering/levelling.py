"""Roll and pitch of a stationary vehicle from gravity."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from touchdown.sim.api import GRAVITY_MPS2, ImuParams

Array = NDArray[np.float64]

_HEADING_SIGMA = 2e-4
"""rad: the heading of the take-off is given"""
_CREEP_SIGMA = 1e-3
"""rad: wind and slow rotors shake a vehicle on its legs"""


def level_from_rest(forces: Array, yaw: float) -> Array:
    """world_from_body (3, 3) of heading ``yaw`` (rad) and of the roll and pitch at which the mean
    of specific forces (N, 3) m/s^2, body axes, points up. ValueError: there are none, or their
    mean is 0."""
    mean = np.asarray(forces, dtype=np.float64).reshape(-1, 3).sum(axis=0)
    size = float(np.linalg.norm(mean))
    if not size > 0.0:
        raise ValueError("specific forces at rest are needed to find roll and pitch")
    up = mean / size
    # world z in body axes is `up`; world x is the heading's forward, seen from the body
    pitch = math.asin(max(-1.0, min(1.0, -up[0])))
    roll = math.atan2(up[1], up[2])
    cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
    cy, sy = math.cos(yaw), math.sin(yaw)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def level_sigmas(imu: ImuParams) -> Array:
    """(3,) rad, body axes: errors of roll and pitch found by ``level_from_rest`` from the
    accelerometer's turn-on errors, and of the given heading."""
    bend = math.radians(imu.misalignment_sigma_deg)
    tilt = math.hypot(imu.accel_bias_sigma / GRAVITY_MPS2, bend, _CREEP_SIGMA)
    return np.array([tilt, tilt, _HEADING_SIGMA])
