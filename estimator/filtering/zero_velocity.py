"""Updates of the filter while the vehicle stands on the ground with slow rotors."""

import math
from typing import NamedTuple

import numpy as np

from touchdown.estimator.filtering.error_state import (
    ACCEL_BIAS,
    ACCEL_SCALE,
    GYRO_BIAS,
    GYRO_BY_FORCE,
    IMU_DIM,
    POSITION,
    ROTATION,
    VELOCITY,
    after,
    error_between,
)
from touchdown.estimator.filtering.eskf import Eskf
from touchdown.estimator.filtering.imu_propagation import NavState
from touchdown.sim.api import GRAVITY_MPS2, ImuSheet
from touchdown.sim.frames import skew, so3_log
from touchdown.sim.typing import Array, Indices, Mask

_RATE_LIMIT = 2e-3
"""rad/s, of the mean rate once the gyroscope bias is known"""
_FORCE_LIMIT = 0.03
"""m/s^2, between mean specific force and gravity once the accelerometer bias is known"""
_SHAKE_LIMIT = 0.1
"""m/s^2, standard deviation of the specific force: a settling or bumped vehicle is not
stationary"""
_SHAKES = 1.5
"""standard deviations of a noisy accelerometer at rest, beyond which it is shaken"""
_CHANCE = 23.5
"""sum of the squares of four normal deviates that one flight in ten thousand exceeds"""
_NOISIER, _SHAKEN = 1.5, 6.0
"""factors of noise that chance no longer makes, 33 samples of three axes show it to 7 %, and that
no sensor has: something shakes it"""
_VELOCITY_SIGMA = 5e-3
_POSITION_SIGMA = 2e-3
_ROTATION_SIGMA = 1e-3
_RATE_SIGMA = 1e-3
"""rad/s, beside the gyroscope's noise. These four are larger than a single update needs, because a
light vehicle creeps on its feet in the wind, and this error repeats from update to update."""
_UP = np.array([0.0, 0.0, GRAVITY_MPS2])
_ITERATIONS = 4


class RestJudgement(NamedTuple):
    """What samples at rest say against the data sheet of an IMU."""

    bias_factor: float
    """of the standard deviations of the biases; 1: nothing"""
    gyro_density: float
    """rad/s/sqrt(Hz) where it is beyond the sheet's, else 0"""
    accel_density: float
    """m/s^2/sqrt(Hz), likewise"""


def judge_rest(
    gyro: Array, force: Array, bias_sigmas: Array, imu: ImuSheet, step_s: float
) -> RestJudgement:
    """Judges (N, 3) samples, N >= 2, that were taken while the rotors stood still; ``bias_sigmas``
    (6,): rad/s and m/s^2, that of the last one along gravity.

    A vehicle at rest does not turn and feels gravity: mean rate and the excess of the mean force
    are biases. Where their squares over their variances are beyond chance, biases are larger than
    stated by the root of the mean square (the variance factor of an adjustment). Noise is that of
    the differences between samples, in which slow motion does not show.
    """
    sigmas = np.hypot(bias_sigmas[[0, 1, 2, 5]], [*3 * [_RATE_LIMIT], _FORCE_LIMIT])
    excess = np.linalg.norm(force.mean(axis=0)) - GRAVITY_MPS2
    square = float(np.sum((np.append(gyro.mean(axis=0), excess) / sigmas) ** 2))
    noise = [
        math.sqrt(0.5 * step_s * float(np.mean(np.diff(part, axis=0) ** 2)))
        for part in (gyro, force)
    ]
    stated = imu.gyro_density, imu.accel_density
    return RestJudgement(
        math.sqrt(square / len(sigmas)) if square > _CHANCE else 1.0,
        *(
            d if _NOISIER * known < d < _SHAKEN * known else 0.0
            for d, known in zip(noise, stated, strict=True)
        ),
    )


class ZeroVelocityUpdate:
    """Zero-velocity, zero-rate and constant-pose updates (Foxlin 2005) while the vehicle is
    stationary."""

    def __init__(self, gyro_density: float, step_s: float, attitude_known: bool = True) -> None:
        """``attitude_known``: hold the attitude of the first stationary moment, else the heading
        alone."""
        self._attitude_known = attitude_known
        self._gyro_density = gyro_density
        self._step_s = step_s
        self._shake_limit = _SHAKE_LIMIT
        self._anchor: NavState | None = None

    def expect(self, judged: RestJudgement) -> None:
        """Takes the noise of samples at rest for what it is there."""
        self._gyro_density = max(self._gyro_density, judged.gyro_density)
        noise = judged.accel_density / math.sqrt(self._step_s)
        self._shake_limit = math.hypot(_SHAKE_LIMIT, _SHAKES * noise)

    def holds(self, eskf: Eskf, gyro: Array, force: Array, stationary: Mask) -> bool:
        """True if (N, 3) samples, all taken with the rotors too slow to lift, show no motion: mean
        rate and force within four standard deviations of those of a stationary vehicle."""
        if len(gyro) < 6 or not bool(stationary.all()):
            return False
        state, variances = eskf.state, np.diag(eskf.covariance)
        rate, specific_force = (part.mean(axis=0) for part in state.corrected(gyro, force))
        specific_force = specific_force - GRAVITY_MPS2 * state.rotation[2]
        rate_limit = _RATE_LIMIT + 4.0 * np.sqrt(variances[GYRO_BIAS].max())
        force_sigma2 = variances[ACCEL_BIAS].max() + GRAVITY_MPS2**2 * variances[ROTATION].max()
        force_limit = _FORCE_LIMIT + 4.0 * np.sqrt(force_sigma2)
        return bool(
            np.abs(rate).max() < rate_limit
            and np.abs(specific_force).max() < force_limit
            and force.std(axis=0).max() < self._shake_limit
        )

    def update(self, eskf: Eskf, gyro: Array, force: Array, stationary: Mask) -> bool:
        """Applies the updates if ``holds``; returns True if so."""
        if not self.holds(eskf, gyro, force, stationary):
            self._anchor = None
            return False
        if self._anchor is None:
            self._anchor = eskf.state
        anchor, state = self._anchor, eskf.state
        duration = len(gyro) * self._step_s
        rates, specific_forces = state.corrected(gyro, force)
        stray = error_between(state.pose, anchor.pose)
        residual = np.concatenate([stray, -state.velocity, rates.mean(axis=0)])
        gyro_variance = self._gyro_density**2 / duration + _RATE_SIGMA**2
        variances = np.repeat(
            [_ROTATION_SIGMA**2, _POSITION_SIGMA**2, _VELOCITY_SIGMA**2, gyro_variance], 3
        )
        if not self._attitude_known:
            variances[:2] = np.inf
        by_errors, touched = _derivatives(specific_forces.mean(axis=0), eskf)
        weighted = by_errors.T / variances
        information = weighted @ by_errors
        eskf.apply(touched, information, weighted @ residual, eskf.gains(0.0))
        return True


def _derivatives(specific_force: Array, eskf: Eskf) -> tuple[Array, Indices]:
    """Derivatives (12, D) of the residuals by the error coordinates (D,) that are returned beside.

    At rest the gyroscope shows its bias and its response to gravity. Which of the two it is shows
    only in flight; their sum is what the measurement corrects.
    """
    touched = np.r_[ROTATION, POSITION, VELOCITY, GYRO_BIAS]
    if not eskf.shared:
        return np.eye(12), touched
    response = np.zeros((12, 9))
    response[9:] = np.kron(np.eye(3), specific_force)
    by_force = after(eskf.base - IMU_DIM, GYRO_BY_FORCE)
    return np.hstack([np.eye(12), response]), np.r_[touched, by_force]


def align_with_gravity(eskf: Eskf, force: Array, sigma_mps2: float) -> None:
    """Updates attitude and accelerometer bias by the mean specific force (3,) at rest, IMU frame.

    ``sigma_mps2``: standard deviation of that mean. Roll and pitch may be off by tens of degrees.
    At rest the force is gravity's reaction, scaled, plus the bias: a levelled attitude errs by the
    bias over gravity. The update keeps that correlation, so that a later rotation about the
    vertical, which separates the two, corrects both (Titterton and Weston, "Strapdown inertial
    navigation technology", 2004, on alignment).
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
