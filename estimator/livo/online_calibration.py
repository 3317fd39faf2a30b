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
from touchdown.estimator.filtering.error_state import (
    ACCEL_SCALE,
    CALIBRATION_DIM,
    CAMERA_ROTATION,
    CAMERA_TRANSLATION,
    CENTER,
    CLOCK,
    FOCAL,
    GYRO_BY_FORCE,
    GYRO_CROSS,
    GYRO_SCALE,
    IMU_ERRORS,
    MOUNT_ROTATION,
    MOUNT_TRANSLATION,
    POSITION,
    ROTATION,
    SHARED_DIM,
    Pinhole,
)
from touchdown.estimator.filtering.imu_propagation import exp_so3_each
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.frames import Pose, so3_exp

Array = NDArray[np.float64]


def prior_sigmas(params: LivoParams) -> Array:
    """Standard deviations (38,), or (0,) without online calibration; rad, m, 1, pixels, s, 1,
    rad, rad/s per m/s^2."""
    if not params.use_calibration:
        return np.zeros(0)
    sigmas = np.zeros(CALIBRATION_DIM)
    sigmas[MOUNT_ROTATION] = np.radians(params.mount_rotation_sigma_deg)
    sigmas[MOUNT_TRANSLATION] = params.mount_translation_sigma_m
    sigmas[FOCAL] = params.focal_sigma
    sigmas[CENTER] = params.center_sigma_px
    sigmas[CLOCK] = params.camera_clock_sigma_s
    sigmas[CAMERA_ROTATION] = np.radians(params.camera_rotation_sigma_deg)
    sigmas[CAMERA_TRANSLATION] = params.camera_translation_sigma_m
    imu = sigmas[IMU_ERRORS]
    imu[GYRO_SCALE] = imu[ACCEL_SCALE] = params.imu_scale_sigma
    imu[GYRO_CROSS] = np.radians(params.gyro_misalignment_sigma_deg)
    imu[GYRO_BY_FORCE] = params.gyro_g_sigma
    return sigmas


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
    if not len(calibration):
        return imu_from_lidar
    turn, shift = calibration[MOUNT_ROTATION], calibration[MOUNT_TRANSLATION]
    return Pose(so3_exp(turn) @ imu_from_lidar.rotation, imu_from_lidar.translation + shift)


def corrected_camera(imu_from_camera: Pose, calibration: Array) -> Pose:
    """Returns the camera's given mount corrected by ``calibration`` (38,) or (0,)."""
    if not len(calibration):
        return imu_from_camera
    turn, shift = calibration[CAMERA_ROTATION], calibration[CAMERA_TRANSLATION]
    return Pose(so3_exp(turn) @ imu_from_camera.rotation, imu_from_camera.translation + shift)


def corrected_lens(camera: CameraIntrinsics, calibration: Array) -> Pinhole:
    """Returns the given lens corrected by ``calibration`` (38,) or (0,)."""
    if not len(calibration):
        return Pinhole.of(camera)
    (x, y), (u, v) = calibration[FOCAL], calibration[CENTER]
    return Pinhole(camera.fx * (1.0 + x), camera.fy * (1.0 + y), camera.cx + u, camera.cy + v)


def exposed(poses: list[Pose], twists: Array, delays_s: Array, calibration: Array) -> list[Pose]:
    """Returns the poses (odom_from_imu) at the exposures of images.

    ``poses``: those of the filter; ``twists`` (N, 6): angular rates (IMU frame, rad/s) and
    velocities (odometry frame, m/s); ``delays_s`` (N,): stamps of the images less the
    instants of the poses.
    """
    clock = calibration[CLOCK] if len(calibration) else 0.0
    moves = (delays_s - clock)[:, None] * twists
    rotations = exp_so3_each(np.ascontiguousarray(moves[:, ROTATION]))
    return [
        Pose(pose.rotation @ rotations[k], pose.translation + moves[k, POSITION])
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
    ahead = (np.cross(twist[ROTATION], reach @ rotation.T + lever) + twist[POSITION]) @ rotation
    out[:, :, CLOCK] = reach * np.einsum("ij,ij->i", planes, ahead)[:, None]
    bends = np.zeros((len(rays), 3, 4))
    bends[:, 0, 0], bends[:, 1, 1] = -rays[:, 0], -rays[:, 1]
    bends[:, 0, 2], bends[:, 1, 3] = -1.0 / camera.fx, -1.0 / camera.fy
    # a ray that bends meets the same plane elsewhere
    across = np.einsum("ij,ijk->ik", planes, bends)
    lens = slice(FOCAL.start, CENTER.stop)
    out[:, :, lens] = (bends - rays[:, :, None] * (across / along)[:, None, :]) / along[:, :, None]
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
