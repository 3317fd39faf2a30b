"""Online calibration: errors of the mounts, the lens, the clocks and the scale of the IMU.

Thirty-eight errors of the given calibration, by the names of ``error_state``: mounts of LIDAR and
camera in the IMU frame (rad, m), focal lengths (relative), principal point (pixels), the offset by
which the camera's clock is ahead of the IMU's (s), and the errors of the IMU.

A rotation of the LIDAR is observable in the map: the same ground, seen once ahead and once below,
must have one height. Both the present returns and those of the map move with it, as in the
derivatives here and in ``livo.scan_update``. That of the camera is observable against the LIDAR:
the direction in which images say the vehicle moves must keep the height that the scans measure.

A clock offset is observable where the vehicle rotates or accelerates: each image is taken a little
before the pose at its stamp, and is displaced by the offset times the twist (Li and Mourikis,
"Online temporal calibration for camera-IMU systems", IJRR 33, 2014).
"""

import math

import numpy as np
from numba import njit

from touchdown.estimator.api import CalibratedParams, CalibrationPriors
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
    Frame,
    Frames,
    Pinhole,
)
from touchdown.estimator.filtering.imu_propagation import exp_so3_each
from touchdown.estimator.filtering.vectors import UNIT, ZERO, Vector, along, cross, dot, turned, xyz
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.frames import Pose, so3_exp
from touchdown.sim.typing import Array


def prior_sigmas(params: CalibrationPriors) -> Array:
    """Standard deviations (38,), or (0,) without online calibration; rad, m, 1, pixels, s, 1,
    rad, rad/s per m/s^2. LIDAR and lens are exact, unless they are `CalibratedParams`."""
    if not params.use_calibration:
        return np.zeros(0)
    sigmas = np.zeros(CALIBRATION_DIM)
    if isinstance(params, CalibratedParams):
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
    return params.prior_scale * sigmas


def calibration_diagnostics(calibration: Array) -> dict[str, float]:
    """Returns the estimated calibration errors for the recording; empty without online
    calibration."""
    if not len(calibration):
        return {}
    found = {
        f"calibration_{which}{axis}_deg": math.degrees(angle)
        for which, part in (("", MOUNT_ROTATION), ("camera_", CAMERA_ROTATION))
        for axis, angle in zip(("roll", "pitch", "yaw"), calibration[part], strict=True)
    }
    found["calibration_focal"] = float(calibration[FOCAL].mean())
    return found | {"calibration_clock_ms": 1e3 * float(calibration[CLOCK])}


def corrected_mount(imu_from_lidar: Pose, calibration: Array) -> Pose:
    """Returns the LIDAR's given mount corrected by ``calibration`` (38,) or (0,)."""
    return _corrected(imu_from_lidar, calibration, MOUNT_ROTATION, MOUNT_TRANSLATION)


def corrected_camera(imu_from_camera: Pose, calibration: Array) -> Pose:
    """Returns the camera's given mount corrected by ``calibration`` (38,) or (0,)."""
    return _corrected(imu_from_camera, calibration, CAMERA_ROTATION, CAMERA_TRANSLATION)


def _corrected(mount: Pose, calibration: Array, rotation: slice, translation: slice) -> Pose:
    if not len(calibration):
        return mount
    turn, shift = so3_exp(calibration[rotation]), calibration[translation]
    return Pose(turn @ mount.rotation, mount.translation + shift)


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
    turns = exp_so3_each(np.ascontiguousarray(moves[:, ROTATION]))
    rotations, translations = Frames.of(poses)
    return Frames(rotations @ turns, translations + moves[:, POSITION]).poses()


@njit(cache=True, error_model="numpy")
def landmark_jacobians(
    rays: Array, planes: Array, sensor: Array, imu_from_camera: Frame, twist: Array, lens: Pinhole
) -> Array:
    """Derivatives of landmarks by the shared calibration, (N, 3, 17), in the IMU frame of their
    keyframe.

    ``rays`` (N, 3) with z = 1 and ``planes`` (N, 3), ``n . P = 1``: the landmark is their
    intersection. ``sensor`` (3,): position of the LIDAR. All in the camera frame;
    ``imu_from_camera`` rotates it into the IMU's. ``twist`` (6,): angular rate and velocity of the
    IMU at the keyframe, in its own frame. Returns taken a little earlier or later need no
    correction: their scans were registered to this moment.
    """
    out = np.zeros((len(rays), 3, SHARED_DIM))
    rotation = imu_from_camera.rotation
    for i in range(len(rays)):
        ray, n, jacobian = xyz(rays[i]), xyz(planes[i]), out[i]
        fraction = dot(ray, n)
        reach = (ray[0] / fraction, ray[1] / fraction, ray[2] / fraction)
        beam, far = along(reach, -1.0, xyz(sensor)), turned(rotation, reach)
        # the plane moves by n . (rotation x beam + translation), the landmark by as much along its
        # ray
        turn, plane = turned(rotation, cross(beam, n)), turned(rotation, n)
        # from an earlier pose the ground lies further on: rotated and translated about the IMU
        arm = along(far, 1.0, xyz(imu_from_camera.translation))
        move = cross(xyz(twist[ROTATION]), arm)
        ahead = dot(plane, along(move, 1.0, xyz(twist[POSITION])))
        for a in range(3):
            for b in range(3):
                jacobian[a, MOUNT_ROTATION.start + b] = far[a] * turn[b]
                jacobian[a, MOUNT_TRANSLATION.start + b] = far[a] * plane[b]
            jacobian[a, CLOCK] = far[a] * ahead
        # a ray that bends meets the same plane elsewhere
        for axis in range(2):
            f = lens.fx if axis == 0 else lens.fy
            move = along(ZERO, -reach[axis], UNIT[axis])
            _meet(move, plane, far, rotation, jacobian, FOCAL.start + axis)
            move = along(ZERO, -1.0 / (f * fraction), UNIT[axis])
            _meet(move, plane, far, rotation, jacobian, CENTER.start + axis)
        # so does one that turns about the camera, or starts beside it: axes of the IMU
        for axis in range(3):
            own = xyz(rotation[axis])
            move = cross(own, reach)
            _meet(move, plane, far, rotation, jacobian, CAMERA_ROTATION.start + axis)
            _meet(own, plane, far, rotation, jacobian, CAMERA_TRANSLATION.start + axis)
    return out


@njit(cache=True, error_model="numpy")
def _meet(
    move: Vector, plane: Vector, far: Vector, rotation: Array, jacobian: Array, column: int
) -> None:
    """Writes the motion of a landmark ``far`` on ``plane``, IMU frame, whose ray moves by ``move``
    there, camera frame, into a column."""
    moved = turned(rotation, move)
    moved = along(moved, -dot(plane, moved), far)
    for a in range(3):
        jacobian[a, column] = moved[a]
