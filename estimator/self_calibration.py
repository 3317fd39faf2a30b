"""What the filter estimates of the rig while it flies: where the LIDAR really sits, and the lens.

Ten numbers, errors of what the estimator was told: a small turn (rad) and shift (m) of the LIDAR in
the IMU's frame, the relative error of either focal length, the shift of the principal point
(pixels). The camera's mount is taken as known; what is wrong with it looks like the LIDAR's.

A turn of the LIDAR shows in what it does to a map: the same ground, seen once ahead and once below,
must lie at one height. Both the returns of now and those that made the map move with it, which is
what the derivatives here and in ``anchored_update`` say.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim.api import CameraIntrinsics
from sim.frames import Pose, so3_exp

Array = NDArray[np.float64]

TURN = slice(0, 3)
SHIFT = slice(3, 6)
FOCAL = slice(6, 8)
CENTER = slice(8, 10)
CALIBRATION_DIM = 10
MOUNT_DIM = 6
"""turn and shift: what matters to a scan"""


def corrected_mount(imu_from_lidar: Pose, calibration: Array) -> Pose:
    """The told mount as ``calibration`` (10,) says it is."""
    turn = so3_exp(calibration[TURN])
    return Pose(turn @ imu_from_lidar.rotation, imu_from_lidar.translation + calibration[SHIFT])


def corrected_intrinsics(camera: CameraIntrinsics, calibration: Array) -> Array:
    """fx, fy, cx, cy (4,) as ``calibration`` (10,) says they are."""
    focal = np.array([camera.fx, camera.fy]) * (1.0 + calibration[FOCAL])
    center = np.array([camera.cx, camera.cy]) + calibration[CENTER]
    return np.concatenate([focal, center])


def landmark_jacobians(
    rays: Array, planes: Array, sensor: Array, imu_from_camera: Array, camera: CameraIntrinsics
) -> Array:
    """How landmarks move with the calibration, (N, 3, 10), in the IMU frame of their keyframe.

    ``rays`` (N, 3) with z = 1 and ``planes`` (N, 3), ``n . P = 1``: the landmark is where they
    meet. ``sensor`` (3,): where the LIDAR was. All in the camera frame; ``imu_from_camera`` (3, 3)
    turns it into the IMU's. That most returns came a little earlier or later, from elsewhere, does
    not matter: their scans were brought to agree with those of this moment.
    """
    along = np.einsum("ij,ij->i", rays, planes)[:, None]
    beams = rays / along - sensor
    out = np.empty((len(rays), 3, CALIBRATION_DIM))
    reach = rays / along
    # the plane moves by n . (turn x beam + shift), the landmark by as much along its ray
    out[:, :, TURN] = reach[:, :, None] * np.cross(beams, planes)[:, None, :] @ imu_from_camera.T
    out[:, :, SHIFT] = reach[:, :, None] * planes[:, None, :] @ imu_from_camera.T
    bends = np.zeros((len(rays), 3, 4))
    bends[:, 0, 0], bends[:, 1, 1] = -rays[:, 0], -rays[:, 1]
    bends[:, 0, 2], bends[:, 1, 3] = -1.0 / camera.fx, -1.0 / camera.fy
    # a ray that bends meets the same plane elsewhere
    across = np.einsum("ij,ijk->ik", planes, bends)
    out[:, :, 6:] = (bends - rays[:, :, None] * (across / along)[:, None, :]) / along[:, :, None]
    out[:] = imu_from_camera @ out
    return out
