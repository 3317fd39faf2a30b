"""Online calibration: errors of the mounts, the lens, the clocks and the scale of the IMU.

Thirty-eight errors of the given calibration: a small rotation (rad) and translation (m) of the
LIDAR in the IMU frame, the relative error of either focal length, the error of the principal point
(pixels), the offset by which the camera's clock is ahead of the IMU's (s), rotation and translation
of the camera in the IMU frame, the relative scale errors of gyroscope and accelerometer, the
misalignment of the gyroscope's axes and their response to specific force.

A rotation of the LIDAR is observable in the map: the same ground, seen once ahead and once below,
must have one height. Both the present returns and those of the map move with it, as in the
derivatives here and in ``anchored_update``. That of the camera is observable against the LIDAR: the
direction in which images say the vehicle moves must keep the height that the scans measure.

A clock offset is observable where the vehicle rotates or accelerates: each image is taken a little
before the pose at its stamp, and is displaced by the offset times the twist (Li and Mourikis,
"Online temporal calibration for camera-IMU systems", IJRR 33, 2014).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.api import LivoParams
from touchdown.estimator.filtering.imu_propagation import (
    CROSS_DIM,
    IMU_DIM,
    SCALE_DIM,
    exp_so3_each,
)
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.frames import Pose, so3_exp

Array = NDArray[np.float64]

MOUNT_ROTATION = slice(0, 3)
MOUNT_TRANSLATION = slice(3, 6)
FOCAL = slice(6, 8)
CENTER = slice(8, 10)
CLOCK = 10
CAMERA_ROTATION = slice(11, 14)
CAMERA_TRANSLATION = slice(14, 17)
SHARED_DIM = 17
"""parameters that scans and images depend on directly"""
CALIBRATION_DIM = SHARED_DIM + IMU_DIM
MOUNT_DIM = 6
"""rotation and translation of the LIDAR's mount"""


def prior_sigmas(params: LivoParams) -> Array:
    """Standard deviations (38,), or (0,) without online calibration; rad, m, 1, pixels, s, 1,
    rad, rad/s per m/s^2."""
    if not params.use_calibration:
        return np.zeros(0)
    sigmas = [
        np.radians(params.mount_rotation_sigma_deg),
        params.mount_translation_sigma_m,
        params.focal_sigma,
        params.center_sigma_px,
        params.camera_clock_sigma_s,
        np.radians(params.camera_rotation_sigma_deg),
        params.camera_translation_sigma_m,
        params.imu_scale_sigma,
        np.radians(params.gyro_misalignment_sigma_deg),
        params.gyro_g_sigma,
    ]
    return np.repeat(sigmas, [3, 3, 2, 2, 1, 3, 3, SCALE_DIM, CROSS_DIM, 9])


def calibration_diagnostics(calibration: Array) -> dict[str, float]:
    """Returns the estimated calibration errors for the recording; empty without online
    calibration."""
    if not len(calibration):
        return {}
    rotation = np.degrees(calibration[MOUNT_ROTATION])
    camera = np.degrees(calibration[CAMERA_ROTATION])
    return {
        "calibration_roll_deg": float(rotation[0]),
        "calibration_pitch_deg": float(rotation[1]),
        "calibration_yaw_deg": float(rotation[2]),
        "calibration_camera_roll_deg": float(camera[0]),
        "calibration_camera_pitch_deg": float(camera[1]),
        "calibration_camera_yaw_deg": float(camera[2]),
        "calibration_focal": float(calibration[FOCAL].mean()),
        "calibration_clock_ms": 1e3 * float(calibration[CLOCK]),
    }


def corrected_mount(imu_from_lidar: Pose, calibration: Array) -> Pose:
    """Returns the LIDAR's given mount corrected by ``calibration`` (38,) or (0,)."""
    return _moved(imu_from_lidar, calibration, MOUNT_ROTATION, MOUNT_TRANSLATION)


def corrected_camera(imu_from_camera: Pose, calibration: Array) -> Pose:
    """Returns the camera's given mount corrected by ``calibration`` (38,) or (0,)."""
    return _moved(imu_from_camera, calibration, CAMERA_ROTATION, CAMERA_TRANSLATION)


def _moved(mount: Pose, calibration: Array, rotation: slice, translation: slice) -> Pose:
    if not len(calibration):
        return mount
    return Pose(
        so3_exp(calibration[rotation]) @ mount.rotation,
        mount.translation + calibration[translation],
    )


def corrected_intrinsics(camera: CameraIntrinsics, calibration: Array) -> Array:
    """Returns fx, fy, cx, cy (4,) corrected by ``calibration`` (38,)."""
    focal = np.array([camera.fx, camera.fy]) * (1.0 + calibration[FOCAL])
    center = np.array([camera.cx, camera.cy]) + calibration[CENTER]
    return np.concatenate([focal, center])


def exposed(poses: list[Pose], twists: Array, delays_s: Array, calibration: Array) -> list[Pose]:
    """Returns the poses (odom_from_imu) at the exposures of images.

    ``poses``: those of the filter; ``twists`` (N, 6): angular rates (IMU frame, rad/s) and
    velocities (odometry frame, m/s); ``delays_s`` (N,): stamps of the images less the
    instants of the poses.
    """
    clock = calibration[CLOCK] if len(calibration) else 0.0
    moves = (delays_s - clock)[:, None] * twists
    rotations = exp_so3_each(np.ascontiguousarray(moves[:, :3]))
    return [
        Pose(pose.rotation @ rotations[k], pose.translation + moves[k, 3:])
        for k, pose in enumerate(poses)
    ]


def landmark_jacobians(
    rays: Array,
    planes: Array,
    sensor: Array,
    imu_from_camera: Pose,
    twist: Array,
    camera: CameraIntrinsics,
) -> Array:
    """Derivatives of landmarks by the shared calibration, (N, 3, 17), in the IMU frame of their
    keyframe.

    ``rays`` (N, 3) with z = 1 and ``planes`` (N, 3), ``n . P = 1``: the landmark is their
    intersection. ``sensor`` (3,): position of the LIDAR. All in the camera frame;
    ``imu_from_camera`` rotates it into the IMU's. ``twist`` (6,): angular rate and velocity of the
    IMU at the keyframe, in its own frame. Returns taken a little earlier or later need no
    correction: their scans were registered to this moment.
    """
    along = np.einsum("ij,ij->i", rays, planes)[:, None]
    beams = rays / along - sensor
    rotation, lever = imu_from_camera.rotation, imu_from_camera.translation
    out = np.zeros((len(rays), 3, SHARED_DIM))
    reach = rays / along
    # the plane moves by n . (rotation x beam + translation), the landmark by as much along its ray
    out[:, :, MOUNT_ROTATION] = reach[:, :, None] * np.cross(beams, planes)[:, None, :] @ rotation.T
    out[:, :, MOUNT_TRANSLATION] = reach[:, :, None] * planes[:, None, :] @ rotation.T
    # from an earlier pose the ground lies further on: rotated and translated about the IMU
    ahead = (np.cross(twist[:3], reach @ rotation.T + lever) + twist[3:]) @ rotation
    out[:, :, CLOCK] = reach * np.einsum("ij,ij->i", planes, ahead)[:, None]
    bends = np.zeros((len(rays), 3, 4))
    bends[:, 0, 0], bends[:, 1, 1] = -rays[:, 0], -rays[:, 1]
    bends[:, 0, 2], bends[:, 1, 3] = -1.0 / camera.fx, -1.0 / camera.fy
    # a ray that bends meets the same plane elsewhere
    across = np.einsum("ij,ijk->ik", planes, bends)
    out[:, :, 6:10] = (bends - rays[:, :, None] * (across / along)[:, None, :]) / along[:, :, None]
    # so does one that turns about the camera, or starts beside it: axes of the IMU
    unit = rotation[None]
    rotated = np.cross(unit, reach[:, None, :]).swapaxes(1, 2)
    for part, moves in (
        (CAMERA_ROTATION, rotated),
        (CAMERA_TRANSLATION, np.broadcast_to(rotation.T, (len(rays), 3, 3))),
    ):
        off = np.einsum("ij,ijk->ik", planes, moves)
        out[:, :, part] = moves - reach[:, :, None] * off[:, None, :]
    out[:] = rotation @ out
    return out
