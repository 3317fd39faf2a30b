"""Gravity alignment: roll and pitch of a vehicle at rest, from its accelerometer.

At rest the specific force is gravity's reaction plus the accelerometer's bias. One cannot be told
from the other: a levelled attitude errs by the bias over gravity, and the errors of attitude and
bias are correlated from then on. The update keeps that correlation, so that a later turn about the
vertical, which separates the two, corrects both (Titterton and Weston, "Strapdown inertial
navigation technology", 2004, on alignment).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.filtering.eskf import Eskf
from touchdown.estimator.filtering.imu_propagation import ACCEL_BIAS, ROTATION
from touchdown.sim.api import GRAVITY_MPS2
from touchdown.sim.frames import skew, so3_log

Array = NDArray[np.float64]

_UP = np.array([0.0, 0.0, GRAVITY_MPS2])
_ITERATIONS = 4


def align_with_gravity(eskf: Eskf, force: Array, sigma_mps2: float) -> None:
    """Updates attitude and accelerometer bias by the mean specific force (3,) at rest, IMU frame.

    ``sigma_mps2``: standard deviation of that mean. Roll and pitch may be off by tens of degrees.
    """
    prior, clones = eskf.state, eskf.clones
    touched = np.r_[ROTATION, ACCEL_BIAS]
    information = np.zeros((6, 6))
    for _ in range(_ITERATIONS):
        state = eskf.state
        reaction = state.rotation.T @ _UP
        by_error = np.hstack([skew(reaction), np.eye(3)])
        residual = force - reaction - state.accel_bias
        information = by_error.T @ by_error / sigma_mps2**2
        vector = by_error.T @ residual / sigma_mps2**2
        offset = np.concatenate(
            [so3_log(prior.rotation.T @ state.rotation), state.accel_bias - prior.accel_bias]
        )
        delta = eskf.correction(touched, information, vector + information @ offset)
        eskf.state, eskf.clones = eskf.boxplus(prior, clones, delta)
    eskf.update_covariance(touched, information)
