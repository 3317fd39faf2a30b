"""Inertial propagation: strapdown integration of an integrating IMU, and its linearisation.

The navigation state is that of the IMU frame: rotation ``world_from_imu``, position and velocity in
the odometry frame, gyroscope and accelerometer bias. Each sample is the mean over the interval that
ends at its tick, so a step from tick to tick needs one sample and no interpolation.

Error state, in this order, three each: rotation (right perturbation, ``R = R_hat exp(e)``),
position, velocity, gyroscope bias, accelerometer bias (Sola 2017, "Quaternion kinematics for the
error-state Kalman filter", section 5, with Hamilton and local angular error).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numba import njit
from numpy.typing import NDArray

from touchdown.sim.api import GRAVITY_MPS2, ImuParams
from touchdown.sim.frames import Pose

Array = NDArray[np.float64]

ROTATION = slice(0, 3)
POSITION = slice(3, 6)
VELOCITY = slice(6, 9)
GYRO_BIAS = slice(9, 12)
ACCEL_BIAS = slice(12, 15)
STATE_DIM = 15
SCALE_DIM = 6
"""relative scale errors of gyroscope and accelerometer, three each"""
CROSS_DIM = 6
"""responses of each axis of the gyroscope to rates about the two others, in the order of
``CROSS_AXES``"""
IMU_DIM = SCALE_DIM + CROSS_DIM + 9
"""the two before, and the responses of each axis of the gyroscope to specific force along x, y, z,
rad/s per m/s^2"""
CROSS_AXES = np.array([[0, 1], [0, 2], [1, 0], [1, 2], [2, 0], [2, 1]])
"""(6, 2): axis of the gyroscope, axis of the rate"""


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
    (``estimator/livo/online_calibration.py``); the last 21 are ``imu_errors``"""

    @property
    def pose(self) -> Pose:
        """odom_from_imu."""
        return Pose(self.rotation, self.position)

    @property
    def imu_errors(self) -> Array:
        """(21,) relative scale errors of gyroscope and accelerometer, by axis, the gyroscope's
        misalignment, rad, and its g-sensitivity; zero without a calibration."""
        return self.calibration[-IMU_DIM:] if len(self.calibration) else np.zeros(IMU_DIM)

    def corrected(self, gyro: Array, force: Array) -> tuple[Array, Array]:
        """Returns (N, 3) samples less bias, scale error, misalignment and g-sensitivity."""
        errors = self.imu_errors
        response = np.diag(1.0 - errors[:3])
        response[CROSS_AXES[:, 0], CROSS_AXES[:, 1]] = -errors[SCALE_DIM:][:CROSS_DIM]
        by_force = errors[SCALE_DIM + CROSS_DIM :].reshape(3, 3)
        specific_force = (force - self.accel_bias) * (1.0 - errors[3:SCALE_DIM])
        return (gyro - self.gyro_bias) @ response.T - specific_force @ by_force.T, specific_force

    def copy(self) -> NavState:
        """Returns a deep copy."""
        return NavState(
            self.tick,
            self.rotation.copy(),
            self.position.copy(),
            self.velocity.copy(),
            self.gyro_bias.copy(),
            self.accel_bias.copy(),
            self.calibration.copy(),
        )


@njit(cache=True)
def exp_so3(vector: Array) -> Array:
    """Rodrigues for kernels: (3,) rad -> (3, 3)."""
    x, y, z = vector[0], vector[1], vector[2]
    angle2 = x * x + y * y + z * z
    if angle2 < 1e-12:
        sine, cosine = 1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0
    else:
        angle = np.sqrt(angle2)
        sine, cosine = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle2
    out = np.empty((3, 3))
    out[0, 0] = 1.0 - cosine * (y * y + z * z)
    out[1, 1] = 1.0 - cosine * (x * x + z * z)
    out[2, 2] = 1.0 - cosine * (x * x + y * y)
    out[0, 1] = cosine * x * y - sine * z
    out[1, 0] = cosine * x * y + sine * z
    out[0, 2] = cosine * x * z + sine * y
    out[2, 0] = cosine * x * z - sine * y
    out[1, 2] = cosine * y * z - sine * x
    out[2, 1] = cosine * y * z + sine * x
    return out


@njit(cache=True)
def exp_so3_each(vectors: Array) -> Array:
    """(N, 3) rad -> (N, 3, 3)."""
    out = np.empty((vectors.shape[0], 3, 3))
    for i in range(vectors.shape[0]):
        out[i] = exp_so3(vectors[i])
    return out


@njit(cache=True)
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
    rotations[0], positions[0], velocities[0] = rotation, position, velocity
    for i in range(count):
        middle = rotations[i] @ exp_so3(0.5 * step_s * gyro[i])
        acceleration = middle @ force[i]
        acceleration[2] -= gravity
        rotations[i + 1] = rotations[i] @ exp_so3(step_s * gyro[i])
        positions[i + 1] = (
            positions[i] + step_s * velocities[i] + 0.5 * step_s * step_s * acceleration
        )
        velocities[i + 1] = velocities[i] + step_s * acceleration
    return rotations, positions, velocities


@njit(cache=True)
def _skew(v: Array) -> Array:
    out = np.zeros((3, 3))
    out[0, 1], out[0, 2], out[1, 2] = -v[2], v[1], -v[0]
    out[1, 0], out[2, 0], out[2, 1] = v[2], -v[1], v[0]
    return out


@njit(cache=True)
def transition(
    rotations: Array, gyro: Array, force: Array, step_s: float, densities: Array
) -> tuple[Array, Array, Array]:
    """Error-state transition (15, 15), accumulated noise (15, 15) and derivative by the scale
    and other ``imu_errors`` (15, 21) over N samples.

    ``rotations`` as from ``integrate``; ``densities``: gyroscope rad/s/sqrt(Hz), accelerometer
    m/s^2/sqrt(Hz), gyroscope bias walk rad/s^2/sqrt(Hz), accelerometer bias walk m/s^3/sqrt(Hz).
    """
    total = np.eye(15)
    noise = np.zeros((15, 15))
    by_errors = np.zeros((15, 21))
    step = np.eye(15)
    for i in range(gyro.shape[0]):
        middle = rotations[i] @ exp_so3(0.5 * step_s * gyro[i])
        rotation = exp_so3(-step_s * gyro[i])
        lever = -step_s * (middle @ _skew(force[i]))
        step[0:3, 0:3] = rotation
        step[6:9, 0:3] = lever
        step[3:6, 0:3] = 0.5 * step_s * lever
        for k in range(3):
            step[3 + k, 6 + k] = step_s
            step[k, 9 + k] = -step_s
        step[6:9, 12:15] = -step_s * middle
        step[3:6, 12:15] = -0.5 * step_s * step_s * middle
        total = step @ total
        noise = step @ noise @ step.T
        by_errors = step @ by_errors
        for k in range(6):
            by_errors[CROSS_AXES[k, 0], 6 + k] -= step_s * gyro[i, CROSS_AXES[k, 1]]
        for a in range(3):
            for b in range(3):
                by_errors[a, 12 + 3 * a + b] -= step_s * force[i, b]
        for k in range(3):
            by_errors[k, k] -= step_s * gyro[i, k]
            for a in range(3):
                by_errors[6 + a, 3 + k] -= step_s * middle[a, k] * force[i, k]
                by_errors[3 + a, 3 + k] -= 0.5 * step_s * step_s * middle[a, k] * force[i, k]
            noise[k, k] += step_s * densities[0] ** 2
            noise[6 + k, 6 + k] += step_s * densities[1] ** 2
            noise[9 + k, 9 + k] += step_s * densities[2] ** 2
            noise[12 + k, 12 + k] += step_s * densities[3] ** 2
    return total, noise, by_errors


class ImuBuffer:
    """IMU samples newer than the filter's state, oldest first, in arrays of fixed capacity.

    ``capacity`` bounds the memory; pushing onto a full buffer raises RuntimeError, which the owner
    avoids by propagating the filter.
    """

    def __init__(self, imu: ImuParams, step_s: float, capacity: int = 512) -> None:
        self.step_s = step_s
        densities = [imu.gyro_density, imu.accel_density, imu.gyro_bias_walk, imu.accel_bias_walk]
        self.densities: Array = np.array(densities)
        """(4,) as ``transition`` takes them"""
        self.count = 0
        self._ticks = np.zeros(capacity, dtype=np.int64)
        self._gyro = np.zeros((capacity, 3))
        self._force = np.zeros((capacity, 3))
        self._stationary = np.zeros(capacity, dtype=np.bool_)

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

    def samples(self, count: int) -> tuple[NDArray[np.int64], Array, Array, NDArray[np.bool_]]:
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


def propagate_nominal(
    state: NavState, ticks: NDArray[np.int64], gyro: Array, force: Array, step_s: float
) -> NavState:
    """The state after N samples ((N, 3) raw gyro and specific force)."""
    if len(gyro) == 0:
        return state
    rotations, positions, velocities = integrate(
        state.rotation,
        state.position,
        state.velocity,
        *state.corrected(gyro, force),
        step_s,
        GRAVITY_MPS2,
    )
    return NavState(
        int(ticks[-1]),
        rotations[-1],
        positions[-1],
        velocities[-1],
        state.gyro_bias,
        state.accel_bias,
        state.calibration,
    )
