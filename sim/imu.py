"""An integrating IMU: mean angular rate and specific force a sample, with its errors."""

from __future__ import annotations

import math
from collections.abc import Iterator
from zlib import crc32

import numpy as np
from numba import njit

from touchdown.sim.api import GRAVITY_MPS2, ImuParams, ImuSample
from touchdown.sim.imu_errors import ImuErrors
from touchdown.sim.typing import Array
from touchdown.sim.vibration import PropellerVibration

_DRAWN = 64
_STOPPED = np.zeros(4)


class ImuSensor:
    """Samples every ``imu_ticks`` ticks of ``tick_hz``.

    White noise of density d averages to d / sqrt(T) over a sample of T seconds. The bias starts at
    a random turn-on value and walks by w sqrt(T) a sample. The vibration of
    ``vibration_*_density`` is white as well: the lines of four propellers at different speeds,
    folded by the sampling, fill the whole band. That of ``vibration_harmonics`` and
    ``vibration_broadband`` is `vibration.PropellerVibration`.

    A sample is made in the order of a real one: motion and vibration of the sensor, then scale,
    misalignment and g-sensitivity, then bias and noise, then saturation.
    """

    def __init__(
        self, params: ImuParams, tick_hz: int, imu_ticks: int, seed: int, hover_radps: float = 0.0
    ) -> None:
        """``hover_radps``: rotor speed that the levels of the vibration belong to. ValueError:
        there is vibration and it is not positive."""
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
        self._randomness = self._draw()
        turn_on = _stack(params.gyro_bias_sigma, params.accel_bias_sigma)
        self._bias = turn_on * self._rng.standard_normal(6)
        self.errors = ImuErrors(params, seed)
        self._propellers: PropellerVibration | None = None
        if params.vibration_harmonics or params.vibration_broadband:
            self._propellers = PropellerVibration(params, self._period_s, hover_radps, seed)

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
        rotor_speeds: Array | None = None,
    ) -> ImuSample:
        """The sample that ends at ``tick``, from the world_from_imu rotations (3, 3) at both ends
        of its period and the world velocities (3,) m/s of the IMU's own point. ``shake``: mean
        square of the rotor speeds over that in hover; ``rotor_speeds``: (4,) rad/s now, None: at
        rest. Rotations of more than 170 degrees a sample are beyond it."""
        measured = _ideal(
            rotation_start, rotation_end, velocity_start, velocity_end, self._period_s
        )
        noise, step, shaking = next(self._randomness)
        if self._propellers is not None:
            measured += self._propellers.sample(_STOPPED if rotor_speeds is None else rotor_speeds)
        if self.errors.distorts:
            measured = self.errors.matrix @ measured
        measured += self._bias + noise + shake * shaking
        if self.errors.saturates:
            measured = self.errors.saturated(measured)
        self._bias = self._bias + step
        measured.setflags(write=False)
        return ImuSample(
            tick=tick,
            time_s=tick / self._tick_hz,
            angular_velocity=measured[:3],
            specific_force=measured[3:],
        )

    def _draw(self) -> Iterator[tuple[Array, Array, Array]]:
        """White noise, step of the bias and vibration in hover of one sample after the other, (6,)
        each; drawn for many at a time, which costs less."""
        while True:
            white, walk = np.moveaxis(self._rng.standard_normal((_DRAWN, 2, 6)), 1, 0)
            shaking = np.zeros((_DRAWN, 6))
            if self._vibration.any():
                shaking = self._vibration * self._vibration_rng.standard_normal((_DRAWN, 6))
            yield from zip(self._noise * white, self._walk * walk, shaking, strict=True)


def _stack(gyro: float, accel: float) -> Array:
    return np.array([gyro] * 3 + [accel] * 3)


@njit(cache=True, error_model="numpy")
def _ideal(
    rotation_start: Array,
    rotation_end: Array,
    velocity_start: Array,
    velocity_end: Array,
    period_s: float,
) -> Array:
    """(6,) mean body rate and specific force in the axes of half the rotation, without error."""
    scaled_axis = np.zeros(3)
    trace = 0.0
    for k in range(3):
        for row in range(3):
            trace += rotation_start[row, k] * rotation_end[row, k]
        # The antisymmetric part of start^T end is the sine times the axis.
        i, j = (k + 1) % 3, (k + 2) % 3
        for row in range(3):
            scaled_axis[k] += 0.5 * rotation_start[row, j] * rotation_end[row, i]
            scaled_axis[k] -= 0.5 * rotation_start[row, i] * rotation_end[row, j]
    sine = np.sqrt(scaled_axis[0] ** 2 + scaled_axis[1] ** 2 + scaled_axis[2] ** 2)
    angle = np.arctan2(sine, 0.5 * (trace - 1.0))
    axis = scaled_axis / sine if sine > 0.0 else scaled_axis
    push = (velocity_end - velocity_start) / period_s
    push[2] += GRAVITY_MPS2
    force = np.zeros(3)
    for k in range(3):
        for row in range(3):
            force[k] += rotation_start[row, k] * push[row]
    # Rodrigues' formula, back by half the rotation.
    along = axis[0] * force[0] + axis[1] * force[1] + axis[2] * force[2]
    cosine, half_sine = np.cos(0.5 * angle), -np.sin(0.5 * angle)
    out = np.empty(6)
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        across = axis[i] * force[j] - axis[j] * force[i]
        out[k] = angle * axis[k] / period_s
        out[3 + k] = cosine * force[k] + half_sine * across + (1.0 - cosine) * along * axis[k]
    return out
