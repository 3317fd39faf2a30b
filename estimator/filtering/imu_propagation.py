"""Inertial propagation: strapdown integration of an integrating IMU, and its linearisation.

The navigation state is that of the IMU frame: rotation ``world_from_imu``, position and velocity in
the odometry frame, gyroscope and accelerometer bias. Each sample is the mean over the interval that
ends at its tick, so a step from tick to tick needs one sample and no interpolation.

Errors of rotation are right perturbations, ``R = R_hat exp(e)`` (Sola 2017, "Quaternion kinematics
for the error-state Kalman filter", section 5, with Hamilton and local angular error); their order
is that of ``error_state``.
"""

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numba import njit

from touchdown.estimator.filtering.error_state import (
    ACCEL_BIAS,
    ACCEL_SCALE,
    CROSS_AXES,
    GYRO_BIAS,
    GYRO_BY_FORCE,
    GYRO_CROSS,
    GYRO_SCALE,
    IMU_DIM,
    IMU_ERRORS,
    POSITION,
    ROTATION,
    STATE_DIM,
    VELOCITY,
)
from touchdown.estimator.filtering.vectors import Vector
from touchdown.sim.api import GRAVITY_MPS2, ImuSheet
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array, Indices, Mask

_NO_ERRORS = np.zeros(IMU_DIM)


@dataclass(slots=True)
class NavState:
    """Nominal state at ``tick``; arrays are replaced, never written in place."""

    tick: int
    rotation: Array
    """(3, 3) world_from_imu"""
    position: Array
    """(3,) m"""
    velocity: Array
    """(3,) m/s"""
    gyro_bias: Array
    """(3,) rad/s"""
    accel_bias: Array
    """(3,) m/s^2"""
    calibration: Array = field(default_factory=lambda: np.zeros(0))
    """estimated errors of the given calibration, if any
    (``estimator/filtering/online_calibration.py``); the last 21 are ``imu_errors``"""

    @property
    def pose(self) -> Pose:
        """odom_from_imu."""
        return Pose(self.rotation, self.position)

    @property
    def imu_errors(self) -> Array:
        """(21,) relative scale errors of gyroscope and accelerometer, by axis, the gyroscope's
        misalignment, rad, and its g-sensitivity; zero without a calibration."""
        return self.calibration[IMU_ERRORS] if len(self.calibration) else _NO_ERRORS

    def corrected(self, gyro: Array, force: Array) -> tuple[Array, Array]:
        """Returns (N, 3) samples less bias, scale error, misalignment and g-sensitivity."""
        return _corrected(gyro, force, self.gyro_bias, self.accel_bias, self.imu_errors)


class NoiseDensities(NamedTuple):
    """White noise of an IMU, and the walk of its biases."""

    gyro: float  # rad/s/sqrt(Hz)
    accel: float  # m/s^2/sqrt(Hz)
    gyro_walk: float  # rad/s^2/sqrt(Hz)
    accel_walk: float  # m/s^3/sqrt(Hz)


@njit(cache=True, error_model="numpy")
def exp_so3(vector: Array) -> Array:
    """Rodrigues for kernels: (3,) rad -> (3, 3)."""
    out = np.empty((3, 3))
    exp_so3_into(vector, out)
    return out


@njit(cache=True, error_model="numpy")
def exp_so3_into(vector: Array | Vector, out: Array) -> None:
    """Writes ``exp_so3`` of a vector into ``out``."""
    x, y, z = vector[0], vector[1], vector[2]
    angle2 = x * x + y * y + z * z
    if angle2 < 1e-12:
        sine, cosine = 1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0
    else:
        angle = np.sqrt(angle2)
        sine, cosine = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle2
    out[0, 0] = 1.0 - cosine * (y * y + z * z)
    out[1, 1] = 1.0 - cosine * (x * x + z * z)
    out[2, 2] = 1.0 - cosine * (x * x + y * y)
    out[0, 1] = cosine * x * y - sine * z
    out[1, 0] = cosine * x * y + sine * z
    out[0, 2] = cosine * x * z + sine * y
    out[2, 0] = cosine * x * z - sine * y
    out[1, 2] = cosine * y * z - sine * x
    out[2, 1] = cosine * y * z + sine * x


@njit(cache=True, error_model="numpy")
def exp_so3_each(vectors: Array) -> Array:
    """(N, 3) rad -> (N, 3, 3)."""
    out = np.empty((vectors.shape[0], 3, 3))
    for i in range(vectors.shape[0]):
        exp_so3_into(vectors[i], out[i])
    return out


@njit(cache=True, error_model="numpy")
def integrate(
    rotation: Array,
    position: Array,
    velocity: Array,
    gyro: Array,
    force: Array,
    step_s: float,
    gravity: float,
) -> tuple[Array, Array, Array]:
    """Integrates (N, 3) bias-free samples from one nominal state.

    Returns rotations (N + 1, 3, 3), positions and velocities (N + 1, 3); entry 0 is the start. The
    specific force is taken at the attitude of the interval's middle (exact to second order).
    """
    count = gyro.shape[0]
    rotations = np.empty((count + 1, 3, 3))
    positions = np.empty((count + 1, 3))
    velocities = np.empty((count + 1, 3))
    # Elements one by one: assigning a slice makes Numba compile the text of its error.
    for a in range(3):
        positions[0, a], velocities[0, a] = position[a], velocity[a]
        for b in range(3):
            rotations[0, a, b] = rotation[a, b]
    for i in range(count):
        middle = rotations[i] @ exp_so3(0.5 * step_s * gyro[i])
        acceleration = middle @ force[i]
        acceleration[2] -= gravity
        turned = rotations[i] @ exp_so3(step_s * gyro[i])
        for a in range(3):
            positions[i + 1, a] = positions[i, a] + step_s * velocities[i, a]
            positions[i + 1, a] += 0.5 * step_s * step_s * acceleration[a]
            velocities[i + 1, a] = velocities[i, a] + step_s * acceleration[a]
            for b in range(3):
                rotations[i + 1, a, b] = turned[a, b]
    return rotations, positions, velocities


@njit(cache=True, error_model="numpy")
def _corrected(
    gyro: Array, force: Array, gyro_bias: Array, accel_bias: Array, errors: Array
) -> tuple[Array, Array]:
    """See ``NavState.corrected``; ``errors`` (21,)."""
    rates, forces, rate = np.empty(gyro.shape), np.empty(gyro.shape), np.empty(3)
    by_force = errors[GYRO_BY_FORCE].reshape(3, 3)
    for i in range(gyro.shape[0]):
        for a in range(3):
            rate[a] = gyro[i, a] - gyro_bias[a]
            rates[i, a] = (1.0 - errors[GYRO_SCALE.start + a]) * rate[a]
            scale = 1.0 - errors[ACCEL_SCALE.start + a]
            forces[i, a] = scale * (force[i, a] - accel_bias[a])
        for k in range(CROSS_AXES.shape[0]):
            rates[i, CROSS_AXES[k, 0]] -= errors[GYRO_CROSS.start + k] * rate[CROSS_AXES[k, 1]]
        for a in range(3):
            for b in range(3):
                rates[i, a] -= by_force[a, b] * forces[i, b]
    return rates, forces


@njit(cache=True, error_model="numpy")
def skew_of(v: Array) -> Array:
    out = np.zeros((3, 3))
    out[0, 1], out[0, 2], out[1, 2] = -v[2], v[1], -v[0]
    out[1, 0], out[2, 0], out[2, 1] = v[2], -v[1], v[0]
    return out


@njit(cache=True, error_model="numpy")
def transition(
    rotations: Array, gyro: Array, force: Array, step_s: float, densities: NoiseDensities
) -> tuple[Array, Array, Array]:
    """Error-state transition (15, 15), accumulated noise (15, 15) and derivative by the scale
    and other ``imu_errors`` (15, 21) over N samples.

    ``rotations`` as from ``integrate``.
    """
    total = np.eye(STATE_DIM)
    noise = np.zeros((STATE_DIM, STATE_DIM))
    by_errors = np.zeros((STATE_DIM, IMU_DIM))
    step = np.eye(STATE_DIM)
    r, p, v = ROTATION.start, POSITION.start, VELOCITY.start
    for i in range(gyro.shape[0]):
        middle = rotations[i] @ exp_so3(0.5 * step_s * gyro[i])
        lever = middle @ skew_of(force[i])
        exp_so3_into(-step_s * gyro[i], step[ROTATION, ROTATION])
        for k in range(3):
            step[p + k, v + k] = step_s
            step[r + k, GYRO_BIAS.start + k] = -step_s
            for a in range(3):
                step[v + a, r + k] = -step_s * lever[a, k]
                step[p + a, r + k] = 0.5 * step_s * step[v + a, r + k]
                step[v + a, ACCEL_BIAS.start + k] = -step_s * middle[a, k]
                step[p + a, ACCEL_BIAS.start + k] = -0.5 * step_s * step_s * middle[a, k]
        total = step @ total
        noise = step @ noise @ step.T
        by_errors = step @ by_errors
        for k in range(CROSS_AXES.shape[0]):
            own, about = CROSS_AXES[k, 0], CROSS_AXES[k, 1]
            by_errors[r + own, GYRO_CROSS.start + k] -= step_s * gyro[i, about]
        for a in range(3):
            own = GYRO_BY_FORCE.start + 3 * a
            for b in range(3):
                by_errors[r + a, own + b] -= step_s * force[i, b]
        for k in range(3):
            by_errors[r + k, GYRO_SCALE.start + k] -= step_s * gyro[i, k]
            for a in range(3):
                moved = step_s * middle[a, k] * force[i, k]
                by_errors[v + a, ACCEL_SCALE.start + k] -= moved
                by_errors[p + a, ACCEL_SCALE.start + k] -= 0.5 * step_s * moved
            noise[r + k, r + k] += step_s * densities.gyro**2
            noise[v + k, v + k] += step_s * densities.accel**2
            noise[GYRO_BIAS.start + k, GYRO_BIAS.start + k] += step_s * densities.gyro_walk**2
            noise[ACCEL_BIAS.start + k, ACCEL_BIAS.start + k] += step_s * densities.accel_walk**2
    return total, noise, by_errors


class ImuBuffer:
    """IMU samples newer than the filter's state, oldest first, in arrays of fixed capacity.

    ``capacity`` bounds the memory; pushing onto a full buffer raises RuntimeError, which the owner
    avoids by propagating the filter.
    """

    def __init__(self, imu: ImuSheet, step_s: float, capacity: int = 512) -> None:
        self.step_s = step_s
        self.densities = NoiseDensities(
            imu.gyro_density, imu.accel_density, imu.gyro_bias_walk, imu.accel_bias_walk
        )
        self.count = 0
        self._ticks = np.zeros(capacity, dtype=np.int64)
        self._gyro = np.zeros((capacity, 3))
        self._force = np.zeros((capacity, 3))
        self._stationary = np.zeros(capacity, dtype=np.bool_)

    def expect(self, gyro_density: float, accel_density: float) -> None:
        """Adds white noise to that of the densities."""
        known = self.densities
        self.densities = known._replace(
            gyro=math.hypot(known.gyro, gyro_density), accel=math.hypot(known.accel, accel_density)
        )

    def push(self, tick: int, gyro: Array, force: Array, stationary: bool) -> None:
        """Appends one sample; ``stationary``: the rotors cannot lift the vehicle now."""
        if self.count == len(self._ticks):
            raise RuntimeError("the IMU buffer is full: the filter was not advanced")
        i = self.count
        self._ticks[i], self._stationary[i] = tick, stationary
        self._gyro[i], self._force[i] = gyro, force
        self.count += 1

    def until(self, tick: int) -> int:
        """Returns the number of buffered samples at or before ``tick``."""
        return int(np.searchsorted(self._ticks[: self.count], tick, side="right"))

    def samples(self, count: int) -> tuple[Indices, Array, Array, Mask]:
        """Returns the oldest ``count``."""
        return (
            self._ticks[:count],
            self._gyro[:count],
            self._force[:count],
            self._stationary[:count],
        )

    def drop(self, count: int) -> None:
        """Removes the oldest ``count``."""
        for array in (self._ticks, self._gyro, self._force, self._stationary):
            array[: self.count - count] = array[count : self.count].copy()
        self.count -= count


class Passage(NamedTuple):
    """The way of a state over N samples."""

    end: NavState
    gyro: Array  # (N, 3) rad/s, corrected
    force: Array  # (N, 3) m/s^2, likewise
    rotations: Array  # (N + 1, 3, 3), from the start on
    positions: Array  # (N + 1, 3)


def propagate_nominal(
    state: NavState, ticks: Indices, gyro: Array, force: Array, step_s: float
) -> Passage:
    """Propagates a state over N samples ((N, 3) raw gyro and specific force)."""
    gyro, force = state.corrected(gyro, force)
    rotations, positions, velocities = integrate(
        state.rotation, state.position, state.velocity, gyro, force, step_s, GRAVITY_MPS2
    )
    end = NavState(
        int(ticks[-1]) if len(ticks) else state.tick, rotations[-1], positions[-1], velocities[-1],
        state.gyro_bias, state.accel_bias, state.calibration,
    )  # fmt: skip
    return Passage(end, gyro, force, rotations, positions)
