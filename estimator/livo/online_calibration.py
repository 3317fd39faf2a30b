"""Online calibration: errors of the LIDAR's mount, of the lens and of the camera's clock.

Eleven errors of the given calibration: a small rotation (rad) and translation (m) of the LIDAR in
the IMU frame, the relative error of either focal length, the shift of the principal point (pixels),
and the offset by which the camera's clock is ahead of the IMU's (s). The camera's mount is taken as
known; its error is attributed to the LIDAR's.

A rotation of the LIDAR is observable in the map: the same ground, seen once ahead and once below,
must have one height. Both the present returns and those of the map move with it, as in the
derivatives here and in ``anchored_update``.

A clock offset is observable where the vehicle rotates or accelerates: each image is taken a little
before the pose at its stamp, and is displaced by the offset times turn rate and velocity (Li and
Mourikis, "Online temporal calibration for camera-IMU systems", IJRR 33, 2014).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.api import LivoParams
from touchdown.estimator.filtering.imu_propagation import exp_so3_each
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.frames import Pose, so3_exp

Array = NDArray[np.float64]

TURN = slice(0, 3)
SHIFT = slice(3, 6)
FOCAL = slice(6, 8)
CENTER = slice(8, 10)
CLOCK = 10
CALIBRATION_DIM = 11
MOUNT_DIM = 6
"""rotation and translation of the mount, the part that affects scans"""


def prior_sigmas(params: LivoParams) -> Array:
    """Standard deviations (11,), or (0,) without online calibration; rad, m, 1, pixels, s."""
    if not params.use_calibration:
        return np.zeros(0)
    turn = np.radians(params.mount_turn_sigma_deg)
    shift, clock = params.mount_shift_sigma_m, params.camera_clock_sigma_s
    sigmas = [turn, shift, params.focal_sigma, params.center_sigma_px, clock]
    return np.repeat(sigmas, [3, 3, 2, 2, 1])


def calibration_diagnostics(calibration: Array) -> dict[str, float]:
    """Returns the estimated calibration errors for the recording; empty without online
    calibration."""
    if not len(calibration):
        return {}
    turn = np.degrees(calibration[TURN])
    return {
        "calibration_roll_deg": float(turn[0]),
        "calibration_pitch_deg": float(turn[1]),
        "calibration_yaw_deg": float(turn[2]),
        "calibration_focal": float(calibration[FOCAL].mean()),
        "calibration_clock_ms": 1e3 * float(calibration[CLOCK]),
    }


def corrected_mount(imu_from_lidar: Pose, calibration: Array) -> Pose:
    """Returns the given mount corrected by ``calibration`` (11,)."""
    turn = so3_exp(calibration[TURN])
    return Pose(turn @ imu_from_lidar.rotation, imu_from_lidar.translation + calibration[SHIFT])


def corrected_intrinsics(camera: CameraIntrinsics, calibration: Array) -> Array:
    """Returns fx, fy, cx, cy (4,) corrected by ``calibration`` (11,)."""
    focal = np.array([camera.fx, camera.fy]) * (1.0 + calibration[FOCAL])
    center = np.array([camera.cx, camera.cy]) + calibration[CENTER]
    return np.concatenate([focal, center])


def exposed(poses: list[Pose], motions: Array, calibration: Array) -> list[Pose]:
    """Returns the poses (odom_from_imu) at the exposures of images, from ``poses`` at their stamps.
    ``motions`` (N, 6): turn rates (IMU frame, rad/s) and velocities (odometry frame, m/s)."""
    if not len(calibration):
        return poses
    moves = -calibration[CLOCK] * motions
    turns = exp_so3_each(np.ascontiguousarray(moves[:, :3]))
    return [
        Pose(pose.rotation @ turns[k], pose.translation + moves[k, 3:])
        for k, pose in enumerate(poses)
    ]


def landmark_jacobians(
    rays: Array,
    planes: Array,
    sensor: Array,
    imu_from_camera: Pose,
    motion: Array,
    camera: CameraIntrinsics,
) -> Array:
    """Derivatives of landmarks by the calibration, (N, 3, 11), in the IMU frame of their keyframe.

    ``rays`` (N, 3) with z = 1 and ``planes`` (N, 3), ``n . P = 1``: the landmark is their
    intersection. ``sensor`` (3,): position of the LIDAR. All in the camera frame;
    ``imu_from_camera`` rotates it into the IMU's. ``motion`` (6,): turn rate and velocity of the
    IMU at the keyframe, in its own frame. Returns taken a little earlier or later need no
    correction: their scans were registered to this moment.
    """
    along = np.einsum("ij,ij->i", rays, planes)[:, None]
    beams = rays / along - sensor
    rotation, lever = imu_from_camera.rotation, imu_from_camera.translation
    out = np.empty((len(rays), 3, CALIBRATION_DIM))
    reach = rays / along
    # the plane moves by n . (turn x beam + shift), the landmark by as much along its ray
    out[:, :, TURN] = reach[:, :, None] * np.cross(beams, planes)[:, None, :] @ rotation.T
    out[:, :, SHIFT] = reach[:, :, None] * planes[:, None, :] @ rotation.T
    # from an earlier pose the ground lies further on: turned and shifted about the IMU
    ahead = (np.cross(motion[:3], reach @ rotation.T + lever) + motion[3:]) @ rotation
    out[:, :, CLOCK] = reach * np.einsum("ij,ij->i", planes, ahead)[:, None]
    bends = np.zeros((len(rays), 3, 4))
    bends[:, 0, 0], bends[:, 1, 1] = -rays[:, 0], -rays[:, 1]
    bends[:, 0, 2], bends[:, 1, 3] = -1.0 / camera.fx, -1.0 / camera.fy
    # a ray that bends meets the same plane elsewhere
    across = np.einsum("ij,ijk->ik", planes, bends)
    out[:, :, 6:10] = (bends - rays[:, :, None] * (across / along)[:, None, :]) / along[:, :, None]
    out[:] = rotation @ out
    return out
