"""What the filter may conclude while the vehicle stands on the ground with its rotors slow."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimator.eskf import Eskf
from estimator.imu_propagation import GYRO_BIAS, POSITION, ROTATION, VELOCITY, NavState
from sim.api import GRAVITY_MPS2
from sim.frames import so3_log

Array = NDArray[np.float64]

_RATE_LIMIT = 0.03
"""rad/s, of the mean over the samples, bias removed"""
_FORCE_LIMIT = 0.25
"""m/s^2, between the mean specific force and gravity"""
_SHAKE_LIMIT = 0.35
"""m/s^2, standard deviation of the specific force: a settling or bumped vehicle is not still"""
_VELOCITY_SIGMA = 2e-3
_POSITION_SIGMA = 1e-3
_ROTATION_SIGMA = 3e-4


class Stillness:
    """Zero-velocity, zero-rate and unmoved-pose updates (Foxlin 2005), for as long as it stands."""

    def __init__(self, gyro_density: float, step_s: float) -> None:
        self._gyro_density = gyro_density
        self._step_s = step_s
        self._anchor: NavState | None = None

    def holds(self, state: NavState, gyro: Array, force: Array, resting: NDArray[np.bool_]) -> bool:
        """Whether (N, 3) samples, all taken with the rotors too slow to lift, show no motion."""
        if len(gyro) < 6 or not bool(resting.all()):
            return False
        rate = np.linalg.norm(gyro.mean(axis=0) - state.gyro_bias)
        pull = np.linalg.norm((force - state.accel_bias).mean(axis=0))
        shake = float(force.std(axis=0).max())
        quiet = abs(float(pull) - GRAVITY_MPS2) < _FORCE_LIMIT and shake < _SHAKE_LIMIT
        return bool(rate < _RATE_LIMIT) and quiet

    def update(self, eskf: Eskf, gyro: Array, force: Array, resting: NDArray[np.bool_]) -> bool:
        """Applies the updates if ``holds``; returns whether it did."""
        if not self.holds(eskf.state, gyro, force, resting):
            self._anchor = None
            return False
        if self._anchor is None:
            self._anchor = eskf.state
        anchor, state = self._anchor, eskf.state
        duration = len(gyro) * self._step_s
        residual = np.concatenate(
            [
                so3_log(state.rotation.T @ anchor.rotation),
                anchor.position - state.position,
                -state.velocity,
                gyro.mean(axis=0) - state.gyro_bias,
            ]
        )
        gyro_variance = self._gyro_density**2 / duration
        variances = np.repeat(
            [_ROTATION_SIGMA**2, _POSITION_SIGMA**2, _VELOCITY_SIGMA**2, gyro_variance], 3
        )
        touched = np.r_[ROTATION, POSITION, VELOCITY, GYRO_BIAS]
        information = np.diag(1.0 / variances)
        delta = eskf.gain(touched, information, residual / variances)
        eskf.state, eskf.clones = eskf.boxplus(state, eskf.clones, delta)
        eskf.absorb(touched, information)
        return True
