"""Noise densities of the IMU as measured in flight.

A data sheet gives the noise of a sensor at rest. In flight the propellers shake it, by an amount
that depends on the airframe, the mount and the rotor speeds. The second difference of successive
samples suppresses the motion of the vehicle, which is smooth at the sampling rate, and passes
vibration and noise: for white noise of variance v it has the variance 6 v.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from touchdown.sim.api import ImuParams

Array = NDArray[np.float64]

_MEMORY_S = 1.0
"""time constant of the variance"""


class MeasuredNoise:
    """White-noise densities of gyroscope and accelerometer by axis: the larger of those of the data
    sheet and those measured over the last second."""

    def __init__(self, imu: ImuParams, step_s: float) -> None:
        self._sheet = np.repeat(
            [[imu.gyro_density], [imu.accel_density], [imu.gyro_bias_walk], [imu.accel_bias_walk]],
            3,
            axis=1,
        )
        self._step_s = step_s
        self._last = np.zeros((2, 6))
        """the two samples before the next"""
        self._seen = 0
        self._variance = np.zeros(6)

    def add(self, gyro: Array, force: Array) -> None:
        """Takes one sample: (3,) rad/s and (3,) m/s^2."""
        _add(self._last, self._variance, gyro, force, self._step_s / _MEMORY_S, self._seen >= 2)
        self._seen += 1

    @property
    def densities(self) -> Array:
        """(4, 3) rad/s/sqrt(Hz), m/s^2/sqrt(Hz), and those of the biases' walks."""
        out: Array = self._sheet.copy()
        import os
        a,b,c=map(float,os.environ.get("NOISE","1,1,0").split(","))
        measured = np.sqrt(self._variance * self._step_s).reshape(2, 3)
        out[:2] = np.maximum(out[:2]*np.array([[a],[b]]), c*measured)
        return out


@njit(cache=True)
def _add(
    last: Array, variance: Array, gyro: Array, force: Array, share: float, full: bool
) -> None:
    for k in range(6):
        value = gyro[k] if k < 3 else force[k - 3]
        if full:
            second = value - 2.0 * last[1, k] + last[0, k]
            variance[k] += share * (second * second / 6.0 - variance[k])
        last[0, k], last[1, k] = last[1, k], value
