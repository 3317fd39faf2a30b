"""The error state by name: the one place that knows the order of its coordinates.

- navigation state, 15: rotation (right perturbation), position, velocity, biases of gyroscope and
  accelerometer;
- shared calibration, 17: mounts, lens and camera clock, on which scans and images depend;
- errors of the IMU, 21: scales, misalignment, g-sensitivity, which act through the propagation;
- clones, 6 each: rotation, position.

A filter has both parts of the calibration or neither. A measurement touches the pose, the shared
calibration and a few clones, in this order; its normal equations are over these coordinates alone.
Kernels take their columns from here (a slice's ``start`` is a constant to them).
"""

from typing import NamedTuple

import numpy as np

from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.frames import Pose, so3_exp, so3_log
from touchdown.sim.typing import Array

# the navigation state; a pose, of the state, a clone or a measurement, has the first two
ROTATION = slice(0, 3)
POSITION = slice(3, 6)
VELOCITY = slice(6, 9)
GYRO_BIAS = slice(9, 12)
ACCEL_BIAS = slice(12, 15)
POSE = slice(0, 6)
NAVIGATION = slice(0, 15)
POSE_DIM = 6
CLONE_DIM = POSE_DIM
STATE_DIM = 15

# the shared calibration
MOUNT_ROTATION = slice(0, 3)
"""rotation of the LIDAR's mount; its translation follows"""
MOUNT_TRANSLATION = slice(3, 6)
FOCAL = slice(6, 8)
CENTER = slice(8, 10)
CLOCK = 10
CAMERA_ROTATION = slice(11, 14)
CAMERA_TRANSLATION = slice(14, 17)
MOUNT_DIM = 6
SHARED_DIM = 17

# the errors of the IMU
GYRO_SCALE = slice(0, 3)
ACCEL_SCALE = slice(3, 6)
GYRO_CROSS = slice(6, 12)
"""responses of each axis of the gyroscope to rates about the two others, by ``CROSS_AXES``"""
GYRO_BY_FORCE = slice(12, 21)
"""responses of each axis of the gyroscope to specific force along x, y, z, rad/s per m/s^2"""
CROSS_AXES = np.array([[0, 1], [0, 2], [1, 0], [1, 2], [2, 0], [2, 1]])
"""(6, 2): axis of the gyroscope, axis of the rate"""
IMU_DIM = 21
CALIBRATION_DIM = SHARED_DIM + IMU_DIM


def after(start: int, block: slice) -> slice:
    """The block behind ``start`` other coordinates."""
    return slice(start + block.start, start + block.stop)


IMU_ERRORS = slice(SHARED_DIM, CALIBRATION_DIM)
"""errors of the IMU among those of a calibration (38,)"""


class Frame(NamedTuple):
    """A rigid transform, as kernels take it."""

    rotation: Array  # (3, 3)
    translation: Array  # (3,) m

    @staticmethod
    def of(pose: Pose) -> "Frame":
        """The transform of a pose, in one layout: kernels compile once."""
        return Frame(np.ascontiguousarray(pose.rotation), pose.translation)


class Frames(NamedTuple):
    """K rigid transforms, as kernels take them."""

    rotations: Array  # (K, 3, 3)
    translations: Array  # (K, 3) m

    @staticmethod
    def of(poses: list[Pose]) -> "Frames":
        """The transforms of poses."""
        rotations = np.array([pose.rotation for pose in poses]).reshape(-1, 3, 3)
        translations = np.array([pose.translation for pose in poses]).reshape(-1, 3)
        return Frames(rotations, translations)

    def poses(self) -> list[Pose]:
        """The transforms one by one."""
        return [Pose(r, t) for r, t in zip(self.rotations, self.translations, strict=True)]


def moved_by(pose: Pose, error: Array) -> Pose:
    """The pose with an error (6,) added."""
    return Pose(pose.rotation @ so3_exp(error[ROTATION]), pose.translation + error[POSITION])


def error_between(start: Pose, end: Pose) -> Array:
    """(6,) the error that moves ``start`` to ``end``."""
    rotation = so3_log(start.rotation.T @ end.rotation)
    return np.concatenate([rotation, end.translation - start.translation])


class Pinhole(NamedTuple):
    """A lens without distortion, pixels."""

    fx: float
    fy: float
    cx: float
    cy: float

    @staticmethod
    def of(camera: CameraIntrinsics) -> "Pinhole":
        """The lens of a camera, its distortion left out."""
        return Pinhole(camera.fx, camera.fy, camera.cx, camera.cy)
