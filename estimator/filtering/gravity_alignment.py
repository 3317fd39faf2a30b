"""Gravity alignment: roll and pitch of a vehicle at rest, from its accelerometer.

At rest the specific force is gravity's reaction, scaled, plus the accelerometer's bias. One cannot
be separated from the other: a levelled attitude errs by the bias over gravity, and the errors of
attitude and bias are correlated from then on. The update keeps that correlation, so that a later
rotation about the vertical, which separates the two, corrects both (Titterton and Weston,
"Strapdown inertial navigation technology", 2004, on alignment).
"""

from __future__ import annotations

import numpy as np

from touchdown.estimator.filtering.error_state import (
    ACCEL_BIAS,
    ACCEL_SCALE,
    IMU_DIM,
    ROTATION,
    after,
)
from touchdown.estimator.filtering.eskf import Eskf
from touchdown.estimator.typing import Array
from touchdown.sim.api import GRAVITY_MPS2
from touchdown.sim.frames import skew, so3_log

_UP = np.array([0.0, 0.0, GRAVITY_MPS2])
_ITERATIONS = 4


def align_with_gravity(eskf: Eskf, force: Array, sigma_mps2: float) -> None:
    """Updates attitude and accelerometer bias by the mean specific force (3,) at rest, IMU frame.

    ``sigma_mps2``: standard deviation of that mean. Roll and pitch may be off by tens of degrees.
    """
    prior, clones = eskf.state, eskf.clones
    touched = np.r_[ROTATION, ACCEL_BIAS]
    if eskf.shared:  # the accelerometer's scale
        touched = np.r_[touched, after(eskf.base - IMU_DIM, ACCEL_SCALE)]
    information, gains = np.zeros((len(touched), len(touched))), eskf.gains(0.0)
    for _ in range(_ITERATIONS):
        state = eskf.state
        reaction = state.rotation.T @ _UP
        scale = state.imu_errors[ACCEL_SCALE]
        by_error = np.hstack([skew(reaction), np.eye(3), np.diag(reaction)])[:, : len(touched)]
        residual = force - (1.0 + scale) * reaction - state.accel_bias
        information = by_error.T @ by_error / sigma_mps2**2
        vector = by_error.T @ residual / sigma_mps2**2
        moved = [
            so3_log(prior.rotation.T @ state.rotation),
            state.accel_bias - prior.accel_bias,
            scale - prior.imu_errors[ACCEL_SCALE],
        ]
        offset = np.concatenate(moved)[: len(touched)]
        vector = vector + information @ offset
        delta = eskf.correction(touched, information, vector, gains)
        eskf.state, eskf.clones = eskf.boxplus(prior, clones, delta)
    eskf.update_covariance(touched, information, gains)
