"""What the filter estimates of the rig while it flies: where the LIDAR really sits, the lens, and
the camera's clock.

Eleven numbers, errors of what the estimator was told: a small turn (rad) and shift (m) of the LIDAR
in the IMU's frame, the relative error of either focal length, the shift of the principal point
(pixels), and how far the camera's clock is ahead of the IMU's (s). The camera's mount is taken as
known; what is wrong with it looks like the LIDAR's.

A turn of the LIDAR shows in what it does to a map: the same ground, seen once ahead and once below,
must lie at one height. Both the returns of now and those that made the map move with it, which is
what the derivatives here and in ``anchored_update`` say.

A clock that is ahead shows where the vehicle turns or changes its speed: each picture was taken a
little before the pose that its stamp tells, and so moved by turn rate and velocity times that (Li
and Mourikis, "Online temporal calibration for camera-IMU systems", IJRR 33, 2014).
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
"""turn and shift: what matters to a scan"""


def prior_sigmas(params: LivoParams) -> Array:
    """Standard deviations (11,), or (0,) where the rig is taken as told; rad, m, 1, pixels, s."""
    if not params.use_calibration:
        return np.zeros(0)
    turn = np.radians(params.mount_turn_sigma_deg)
    shift, clock = params.mount_shift_sigma_m, params.camera_clock_sigma_s
    sigmas = [turn, shift, params.focal_sigma, params.center_sigma_px, clock]
    return np.repeat(sigmas, [3, 3, 2, 2, 1])


def calibration_diagnostics(calibration: Array) -> dict[str, float]:
    """What is believed of the rig, for the recording; nothing where it is taken as told."""
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
    """The told mount as ``calibration`` (11,) says it is."""
    turn = so3_exp(calibration[TURN])
    return Pose(turn @ imu_from_lidar.rotation, imu_from_lidar.translation + calibration[SHIFT])


def corrected_intrinsics(camera: CameraIntrinsics, calibration: Array) -> Array:
    """fx, fy, cx, cy (4,) as ``calibration`` (11,) says they are."""
    focal = np.array([camera.fx, camera.fy]) * (1.0 + calibration[FOCAL])
    center = np.array([camera.cx, camera.cy]) + calibration[CENTER]
    return np.concatenate([focal, center])


def exposed(poses: list[Pose], motions: Array, calibration: Array) -> list[Pose]:
    """``poses`` (odom_from_imu) at the stamps of pictures, moved to when these were taken.
    ``motions`` (N, 6): turn rates (IMU frame, rad/s) and velocities (odometry frame, m/s) there."""
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
    """How landmarks move with the calibration, (N, 3, 11), in the IMU frame of their keyframe.

    ``rays`` (N, 3) with z = 1 and ``planes`` (N, 3), ``n . P = 1``: the landmark is where they
    meet. ``sensor`` (3,): where the LIDAR was. All in the camera frame; ``imu_from_camera`` turns
    it into the IMU's. ``motion`` (6,): turn rate and velocity of the IMU there, in its own frame.
    That most returns came a little earlier or later, from elsewhere, does not matter: their scans
    were brought to agree with those of this moment.
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
