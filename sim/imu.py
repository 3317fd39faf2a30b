"""An integrating IMU: mean angular rate and specific force a sample, with its errors."""

import math
from collections.abc import Iterator
from zlib import crc32

import numpy as np
from numba import njit

from touchdown.sim.api import GRAVITY_MPS2, ImuParams, ImuSample
from touchdown.sim.frames import Pose, cross, matrix_from_quat_wxyz
from touchdown.sim.typing import Array
from touchdown.sim.vibration import PropellerVibration

TEMPERATURE_COEFFICIENTS = (math.radians(0.015), 0.2e-3 * GRAVITY_MPS2)
"""rad/s and m/s^2 a kelvin: typical drift of the offsets of gyroscope and accelerometer (Bosch
BMI088, data sheet), taken for a standard deviation"""
WARM_UP_S = 60.0
"""time constant of the temperature after switching on; assumed"""
_DRAWN = 64


class ImuErrors:
    """Turn-on errors of one IMU, drawn from the seed: scale, alignment of the axes, response of the
    gyroscope to specific force, saturation."""

    def __init__(self, params: ImuParams, seed: int) -> None:
        scale, bend = params.scale_sigma, math.radians(params.misalignment_sigma_deg)
        self.matrix = np.eye(6)
        """(6, 6): measured rate and force from the true ones"""
        # Each error has its own stream, so that one at 0 leaves the draws of the others alone.
        for start in (0, 3):
            name = b"gyro" if start == 0 else b"accel"
            block = self.matrix[start : start + 3, start : start + 3]
            block += np.diag(scale * _normal(seed, name + b" scale", 3))
            across = ~np.eye(3, dtype=bool)
            block[across] += bend * _normal(seed, name + b" misalignment", 6)
        response = _normal(seed, b"gyro g sensitivity", 9).reshape(3, 3)
        self.matrix[:3, 3:] = params.gyro_g_sensitivity * response
        limits = np.repeat([params.gyro_range, params.accel_range], 3)
        self._limits = np.where(limits > 0.0, limits, np.inf)
        self._min = -self._limits
        self.distorts = bool((self.matrix != np.eye(6)).any())
        """False: the matrix is the identity"""
        self.saturates = bool(np.isfinite(self._limits).any())

    def sizes(self) -> dict[str, float]:
        """Root mean squares over the axes of both sensors: relative errors of scale, and
        misalignments in degrees."""
        blocks = np.array([self.matrix[:3, :3], self.matrix[3:, 3:]]) - np.eye(3)
        own = np.eye(3, dtype=bool)
        return {
            "imu_scale": float(np.sqrt((blocks[:, own] ** 2).mean())),
            "imu_misalignment_deg": math.degrees(float(np.sqrt((blocks[:, ~own] ** 2).mean()))),
        }

    def saturated(self, measured: Array) -> Array:
        """(6,) within the ranges."""
        return np.minimum(np.maximum(measured, self._min), self._limits)


def _normal(seed: int, name: bytes, count: int) -> Array:
    return np.random.default_rng([seed, crc32(b"imu " + name)]).standard_normal(count)


class ImuSensor:
    """Samples every ``imu_ticks`` ticks of ``tick_hz``.

    White noise of density d averages to d / sqrt(T) over a sample of T seconds. The bias starts at
    a random turn-on value, walks by w sqrt(T) a sample and drifts as the sensor warms up. The
    vibration of ``vibration_*_density`` is white as well: the lines of propellers at
    different speeds, folded by the sampling, fill the whole band. That of ``vibration_harmonics``
    and ``vibration_broadband`` is `vibration.PropellerVibration`.

    A sample is made in the order of a real one: motion and vibration of the sensor, then scale,
    misalignment and g-sensitivity, then bias and noise, then saturation.
    """

    def __init__(
        self,
        params: ImuParams,
        tick_hz: int,
        imu_ticks: int,
        seed: int,
        hover_radps: float = 0.0,
        rotors: int = 4,
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
        self._drift: Array | None = None
        if params.warm_up_k > 0.0:
            coefficients = _stack(*TEMPERATURE_COEFFICIENTS) * _normal(seed, b"temperature", 6)
            self._drift = params.warm_up_k * coefficients
        self.errors = ImuErrors(params, seed)
        self._propellers: PropellerVibration | None = None
        if params.vibration_harmonics or params.vibration_broadband:
            self._propellers = PropellerVibration(
                params, self._period_s, hover_radps, seed, rotors=rotors
            )
        self._stopped = np.zeros(rotors)

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
        square of the rotor speeds over that in hover; ``rotor_speeds``: (R,) rad/s now, None: at
        rest. Rotations of more than 170 degrees a sample are beyond it."""
        measured = _ideal(
            rotation_start, rotation_end, velocity_start, velocity_end, self._period_s
        )
        noise, step, shaking = next(self._randomness)
        if self._propellers is not None:
            measured += self._propellers.sample(
                self._stopped if rotor_speeds is None else rotor_speeds
            )
        if self.errors.distorts:
            measured = self.errors.matrix @ measured
        measured += self._bias + noise + shake * shaking
        if self._drift is not None:
            measured -= self._drift * math.expm1(-tick / (self._tick_hz * WARM_UP_S))
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


class MountedImu:
    """An IMU at its place on the vehicle: it measures the motion of its own point."""

    def __init__(self, sensor: ImuSensor, body_from_imu: Pose, hover_square: float) -> None:
        """``hover_square``: sum of the squares of the rotor speeds in hover, (rad/s)^2."""
        self.sensor, self._hover_square = sensor, hover_square
        self._mount = body_from_imu.rotation
        self._lever = self._mount.T @ body_from_imu.translation
        self._is_off = bool(self._lever.any())

    def start(self, quat: Array, velocity: Array, angular_velocity: Array) -> None:
        """Begins a sample: world_from_body wxyz, world velocity (3,) m/s of the body origin, body
        rate (3,) rad/s."""
        self._rotation = matrix_from_quat_wxyz(quat) @ self._mount
        self._velocity = self._own_velocity(velocity, angular_velocity)

    def sample(
        self, tick: int, quat: Array, velocity: Array, angular_velocity: Array, rotors: Array
    ) -> ImuSample:
        """The sample that ends at ``tick``; motion as for ``start``, rotor speeds (R,) rad/s."""
        rotation, moved = self._rotation, self._velocity
        self.start(quat, velocity, angular_velocity)
        return self.sensor.sample(
            tick,
            rotation,
            self._rotation,
            moved,
            self._velocity,
            float(rotors @ rotors) / self._hover_square,
            rotors,
        )

    def _own_velocity(self, velocity: Array, angular_velocity: Array) -> Array:
        """(3,) m/s, world axes, of the IMU's own point, a new array."""
        own = velocity.copy()
        if self._is_off:
            own += self._rotation @ cross(self._mount.T @ angular_velocity, self._lever)
        return own


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
