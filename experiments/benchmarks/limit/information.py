"""Fisher information of a trajectory, with landmarks marginalised.

The error state is linear about the true trajectory and everything is Gaussian, so that the inverse
of the information is the posterior Cramér-Rao bound (Van Trees and Bell, "Bayesian Bounds", 2007;
Tichavsky, Muravchik and Nehorai, IEEE Trans. Signal Processing 46, 1998, whose recursion is the
elimination of the states in the order of time). Landmarks are unknown constants of the places that
a sensor sees: their Schur complement leaves what the sensor tells of the states that saw them.

Order of the unknowns: `STATE` of each state, one state after the other, then the constants of the
flight that an estimator does not know.
"""

import math
from collections.abc import Iterator, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from numpy.typing import NDArray

from touchdown.experiments.config.schema import Config
from touchdown.experiments.flight.estimator_calibration import (
    DISTORTION_FRACTION,
    corner_displacement_px,
)
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.lidar.range_errors import FRACTIONS
from touchdown.sim.typing import Array, Indices

STATE = 15
"""position and velocity (world), rotation vector (world axes), biases of gyroscope and
accelerometer"""
POSE = np.array([0, 1, 2, 6, 7, 8])
IMU_CONSTANTS = 27
"""gyroscope matrix, response of the gyroscope to force, accelerometer matrix: (3, 3) each"""
LANDMARK = 5
"""unknowns of a landmark, of which a sensor may use fewer"""
_LANDMARK_PRIOR = 1e-6
CONSTANTS = 51
IMU = slice(0, 27)
MOUNT = slice(27, 33)
"""of the LIDAR: rotation about it and translation, body axes"""
RANGE = slice(33, 36)
"""constant, time walk and incidence"""
EYE_MOUNT = slice(36, 42)
"""of the camera: rotation and translation, camera axes"""
LENS = slice(42, 50)
"""principal point (px), focal lengths (relative), k1, k2, p1, p2"""
CLOCK = slice(50, 51)
"""delay of the stamps of images, s"""
GROUPS = MappingProxyType(
    {
        "scale and alignment of the IMU": (IMU,),
        "mounts of LIDAR and camera": (MOUNT, EYE_MOUNT),
        "bias of the ranges": (RANGE,),
        "lens and clock of the camera": (LENS, CLOCK),
    }
)
_CERTAIN = 1e-9
"""standard deviation of what is known, which information needs above 0"""
_CHUNK = 2000


def constant_sigmas(config: Config, lens: CameraIntrinsics) -> Array:
    """(CONSTANTS,) standard deviations before the flight."""
    sigmas, errors, imu = np.zeros(CONSTANTS), config.calibration_error, config.imu
    bend = math.radians(imu.misalignment_sigma_deg)
    matrix = np.where(np.eye(3, dtype=bool), imu.scale_sigma, bend).ravel()
    sigmas[IMU] = np.concatenate([matrix, np.full(9, imu.gyro_g_sensitivity), matrix])
    sigmas[MOUNT] = np.repeat(
        [
            math.radians(errors.imu_lidar_rotation_sigma_deg),
            errors.imu_lidar_translation_sigma_m,
        ],
        3,
    )
    # Uniform between bounds, the last over half of its own.
    sigmas[RANGE] = config.lidar.range_bias_m * np.array(FRACTIONS) / np.sqrt([3.0, 3.0, 48.0])
    sigmas[EYE_MOUNT] = np.repeat(
        [
            math.radians(errors.imu_camera_rotation_sigma_deg),
            errors.imu_camera_translation_sigma_m,
        ],
        3,
    )
    bent = DISTORTION_FRACTION * errors.distortion_sigma_px / corner_displacement_px(lens)
    sigmas[LENS] = [*[errors.center_sigma_px] * 2, *[errors.focal_sigma] * 2, *bent]
    sigmas[CLOCK] = config.camera.stamp_delay_s
    return np.maximum(sigmas, _CERTAIN)


class Rows(NamedTuple):
    """Scalar measurements of landmarks from states, linear in the errors of all."""

    state: Indices
    """(N,)"""
    landmark: Indices
    """(N,)"""
    pose: Array
    """(N, 6) derivatives by position and rotation of the state"""
    constant: Array
    """(N, C) by all constants of the problem"""
    local: Array
    """(N, LANDMARK) by the landmark"""
    weight: Array
    """(N,) one over the variance, times the number of measurements that a row stands for"""
    copies: Array
    """(N,) how many landmarks of its kind the row's landmark stands for"""

    def with_common_error(self, sigma: float) -> "Rows":
        """The same with an error of this size that all measurements of a landmark from one state
        share, and that the next state does not."""
        pair = self.state * (self.landmark.max() + 1) + self.landmark
        _, own = np.unique(pair, return_inverse=True)
        together = np.bincount(own, self.weight)[own]
        return self._replace(weight=self.weight / (1.0 + sigma**2 * together))

    @staticmethod
    def joined(parts: Sequence["Rows"]) -> "Rows":
        """All rows of ``parts``, which are not empty."""
        return Rows._make(np.concatenate(column) for column in zip(*parts, strict=True))

    def chosen(self, which: NDArray[np.bool_]) -> "Rows":
        """Those of ``which`` (N,)."""
        return Rows._make(column[which] for column in self)


class Motion(NamedTuple):
    """One step of `imu_steps` between states."""

    transition: Array
    """(15, 15)"""
    by_constant: Array
    """(15, IMU_CONSTANTS)"""
    noise: Array
    """(15, 15) covariance"""


class Densities(NamedTuple):
    """White noise of gyroscope and accelerometer, and random walks of their biases, each per square
    root of Hz."""

    gyro: float
    accel: float
    gyro_walk: float
    accel_walk: float

    def powers(self) -> Array:
        """(15,) of the derivative of the error state; position has none."""
        levels = [0.0, self.accel, self.gyro, self.gyro_walk, self.accel_walk]
        return np.repeat(np.square(levels), 3)


def imu_motion(
    rotations: Array, rates: Array, forces: Array, step_s: float, densities: Densities
) -> Motion:
    """The error's motion over (M,) steps of ``step_s`` with attitudes (M, 3, 3) world_from_imu,
    angular rates (M, 3) and specific forces (M, 3), both in IMU axes."""
    transition, by_constant = np.eye(STATE), np.zeros((STATE, IMU_CONSTANTS))
    noise, powers = np.zeros((STATE, STATE)), densities.powers()
    p, v, turn, gyro, accel = (slice(k, k + 3) for k in range(0, STATE, 3))
    for rotation, rate, force in zip(rotations, rates, forces, strict=True):
        change, given = np.zeros((STATE, STATE)), np.zeros((STATE, IMU_CONSTANTS))
        change[p, v] = np.eye(3)
        change[v, turn] = -skews(rotation @ force)
        change[v, accel] = change[turn, gyro] = -rotation
        given[turn, :9], given[turn, 9:18] = np.kron(-rotation, rate), np.kron(-rotation, force)
        given[v, 18:] = np.kron(-rotation, force)
        # Exact for white noise on an integrator: three terms of the exponential series.
        power = step_s * change
        squared = power @ power
        step = np.eye(STATE) + power + 0.5 * squared
        given = step_s * (np.eye(STATE) + 0.5 * power + squared / 6.0) @ given
        q = np.diag(powers)
        mixed = change @ q
        cross = mixed @ change.T
        grown = step_s * q + step_s**2 / 2.0 * (mixed + mixed.T) + step_s**3 / 3.0 * cross
        transition, by_constant = step @ transition, step @ by_constant + given
        noise = step @ noise @ step.T + grown
    return Motion(transition, by_constant, noise)


def motion_information(motions: Sequence[Motion], constants: int) -> Array:
    """Information that the IMU gives on ``len(motions) + 1`` states and ``constants`` constants, of
    which the first `IMU_CONSTANTS` are the IMU's."""
    count = STATE * (len(motions) + 1)
    total = np.zeros((count + constants, count + constants))
    for k, motion in enumerate(motions):
        root = np.linalg.inv(np.linalg.cholesky(motion.noise))
        jacobian = root @ np.hstack([motion.transition, -np.eye(STATE), motion.by_constant])
        at = np.append(np.arange(2 * STATE) + STATE * k, count + np.arange(IMU_CONSTANTS))
        total[np.ix_(at, at)] += jacobian.T @ jacobian
    return total


def landmark_informations(rows: Rows, counts: Sequence[int], constants: int) -> Iterator[Array]:
    """Information (15 K + C, 15 K + C) of ``rows`` on the first K states and ``constants`` C
    constants, whatever the landmarks are, for each K of the ascending ``counts``."""
    names, own = np.unique(rows.landmark, return_inverse=True)
    width = 6 * counts[-1] + constants
    total = np.zeros((width, width))
    cross = sp.csc_array((width, LANDMARK * len(names)))
    blocks = np.tile(_LANDMARK_PRIOR * np.eye(LANDMARK), (len(names), 1, 1))
    before = 0
    for count in counts:
        some = (rows.state >= before) & (rows.state < count)
        part, places, before = rows.chosen(some), own[some], count
        if len(part.state):
            left, right = _matrices(part, places, counts[-1], len(names))
            total += (left.T @ left).toarray()
            cross = cross + (left.T @ right).tocsc()
            blocks += _blocks(part, places, len(names))
        kept = np.append(np.arange(6 * count), np.arange(width - constants, width))
        reduced = total[np.ix_(kept, kept)] - _explained(cross, blocks, kept)
        at = np.append(_columns(count), STATE * count + np.arange(constants))
        spread = np.zeros((STATE * count + constants,) * 2)
        spread[np.ix_(at, at)] = reduced
        yield spread


def _explained(cross: sp.csc_array, blocks: Array, kept: Indices) -> Array:
    """What not knowing the landmarks takes from the information on the ``kept`` unknowns."""
    total = np.zeros((len(kept), len(kept)))
    for start in range(0, len(blocks), _CHUNK):
        some = np.linalg.inv(np.linalg.cholesky(blocks[start : start + _CHUNK]))
        part = cross[:, LANDMARK * start : LANDMARK * (start + len(some))].toarray()[kept]
        part = np.einsum("akj,kij->aki", part.reshape(len(kept), -1, LANDMARK), some)
        flat = part.reshape(len(kept), -1)
        total += flat @ flat.T
    return total


def _columns(states: int) -> Indices:
    return (STATE * np.arange(states)[:, None] + POSE).ravel()


def _matrices(rows: Rows, own: Indices, states: int, landmarks: int) -> tuple[sp.csr_array, ...]:
    """Whitened derivatives (N, 6 K + C) by poses and constants, (N, LANDMARK L) by landmarks."""
    root, count = np.sqrt(rows.weight * rows.copies)[:, None], len(rows.state)
    constants = rows.constant.shape[1]
    used = np.flatnonzero(rows.constant.any(axis=0))
    pose_at = 6 * rows.state[:, None] + np.arange(6)
    columns = np.hstack([pose_at, np.tile(6 * states + used, (count, 1))])
    values = root * np.hstack([rows.pose, rows.constant[:, used]])
    left = _csr(values, columns, 6 * states + constants)
    right = _csr(
        root * rows.local, LANDMARK * own[:, None] + np.arange(LANDMARK), LANDMARK * landmarks
    )
    return left, right


def _csr(values: Array, columns: Indices, width: int) -> sp.csr_array:
    starts = values.shape[1] * np.arange(len(values) + 1)
    return sp.csr_array((values.ravel(), columns.ravel(), starts), shape=(len(values), width))


def _blocks(rows: Rows, own: Indices, landmarks: int) -> Array:
    """(L, LANDMARK, LANDMARK) information on each landmark, which rows have in ``own`` (N,)."""
    blocks = np.empty((landmarks, LANDMARK, LANDMARK))
    for i in range(LANDMARK):
        for j in range(i + 1):
            weights = rows.weight * rows.copies * rows.local[:, i] * rows.local[:, j]
            blocks[:, i, j] = blocks[:, j, i] = np.bincount(own, weights, landmarks)
    return blocks


def bound(information: Array, wanted: Sequence[int] | Indices) -> Array:
    """Covariance of the ``wanted`` unknowns, the others unknown too: the block of the inverse.
    Raises numpy's LinAlgError where the information does not determine all of them."""
    # Unknowns have units from rad/s^2 to pixels: equal diagonals keep the factor accurate.
    scale = 1.0 / np.sqrt(np.diag(information))
    factor = scipy.linalg.cho_factor(information * scale * scale[:, None], lower=True)
    units = np.zeros((len(information), len(wanted)))
    units[wanted, np.arange(len(wanted))] = scale[wanted]
    return (scipy.linalg.cho_solve(factor, units) * scale[:, None])[wanted]


def skews(vectors: Array) -> Array:
    """(..., 3) -> (..., 3, 3): the matrix that multiplies from the left as a cross product."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
