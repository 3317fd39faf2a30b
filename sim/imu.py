"""An integrating IMU: mean angular rate and specific force a sample, with bias and noise."""

from __future__ import annotations

import math
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from sim.api import GRAVITY_MPS2, ImuParams, ImuSample
from sim.frames import so3_exp, so3_log

Array = NDArray[np.float64]

_UP = np.array([0.0, 0.0, GRAVITY_MPS2])


class ImuSensor:
    """Samples every ``imu_ticks`` ticks of ``tick_hz``.

    White noise of density d averages to d / sqrt(T) over a sample of T seconds. The bias starts at
    a random turn-on value and walks by w sqrt(T) a sample. Vibration is white as well: the lines
    of four propellers at different speeds, folded by the sampling, fill the whole band.
    """

    def __init__(self, params: ImuParams, tick_hz: int, imu_ticks: int, seed: int) -> None:
        self._tick_hz = tick_hz
        self._period_s = imu_ticks / tick_hz
        self._rng = np.random.default_rng([seed, crc32(b"imu")])
        self._noise = _stack(params.gyro_density, params.accel_density) / math.sqrt(self._period_s)
        self._walk = _stack(params.gyro_bias_walk, params.accel_bias_walk) * math.sqrt(
            self._period_s
        )
        self._vibration = _stack(
            params.vibration_gyro_density, params.vibration_accel_density
        ) / math.sqrt(self._period_s)
        self._vibration_rng = np.random.default_rng([seed, crc32(b"imu vibration")])
        turn_on = _stack(params.gyro_bias_sigma, params.accel_bias_sigma)
        self._bias = turn_on * self._rng.standard_normal(6)

    @property
    def bias(self) -> Array:
        """(6,) true bias of the next sample, rad/s and m/s^2; a copy, for tests and records."""
        return self._bias.copy()

    def sample(
        self,
        tick: int,
        rotation_start: Array,
        rotation_end: Array,
        velocity_start: Array,
        velocity_end: Array,
        shake: float = 0.0,
    ) -> ImuSample:
        """The sample that ends at ``tick`` from the world_from_imu rotations (3, 3) at both ends of
        its period and the world velocities (3,) m/s of the IMU's own point. ``shake``: mean square
        of the rotor speeds over that in hover."""
        turn = so3_log(rotation_start.T @ rotation_end)
        rotation_mid = rotation_start @ so3_exp(0.5 * turn)
        acceleration = (velocity_end - velocity_start) / self._period_s
        ideal = np.concatenate([turn / self._period_s, rotation_mid.T @ (acceleration + _UP)])
        white, walk = self._rng.standard_normal((2, 6))
        measured = ideal + self._bias + self._noise * white
        if self._vibration.any():
            measured += shake * self._vibration * self._vibration_rng.standard_normal(6)
        self._bias = self._bias + self._walk * walk
        measured.setflags(write=False)
        return ImuSample(
            tick=tick,
            time_s=tick / self._tick_hz,
            angular_velocity=measured[:3],
            specific_force=measured[3:],
        )


def _stack(gyro: float, accel: float) -> Array:
    return np.array([gyro] * 3 + [accel] * 3)
