"""The nominal calibration: what estimators are given, with its errors."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING
from zlib import crc32

import numpy as np

from touchdown.experiments.api import CalibrationErrorParams, StartParams
from touchdown.experiments.config.profiles import profile_values
from touchdown.experiments.config.schema import Config
from touchdown.experiments.errors import UsageError
from touchdown.sim.api import CameraIntrinsics, ImuSheet, SensorRig
from touchdown.sim.frames import Pose, rotation_from_yaw, so3_exp, so3_log, yaw_from_rotation
from touchdown.sim.typing import Array

if TYPE_CHECKING:
    from touchdown.experiments.io.calibration_file import CalibrationFile

_DISTORTION_TERMS = 4
"""k1, k2, p1 and p2"""
DISTORTION_FRACTION = 0.353
"""of the standard deviation of the largest displacement, what each of them causes alone: their
errors are independent, and there is a corner at which they add"""


def nominal_rig(rig: SensorRig, config: Config) -> SensorRig:
    """Returns the nominal calibration: ``rig`` with the calibration file
    ``config.calibration``, or else with the errors of ``config.calibration_error``, drawn from
    ``config.world_seed``; with the errors against the IMU, of readout and lever arms; and with the
    part of the take-off pose that ``config.start`` makes known.

    Without an error against the IMU the mount of the camera on the body is exact, and that of the
    LIDAR follows from it. Raises UsageError for a file that cannot be used.
    """
    errors, start = config.calibration_error, config.start
    content = check_calibration(config)
    rig = _apart(_with_known_imu(rig, config), errors, config.world_seed)
    if content is None:
        return known_start(erring_rig(rig, errors, config.world_seed), start)
    camera = content.intrinsics()
    if (camera.width, camera.height) != (rig.camera.width, rig.camera.height):
        raise UsageError(
            f"'{config.calibration}' is of a camera of {camera.width} x {camera.height} "
            f"pixels, the flight's has {rig.camera.width} x {rig.camera.height}"
        )
    # The file says how camera and LIDAR stand to one another; both are wrong against the IMU alike.
    rotated = _camera_against_imu(rig, errors, config.world_seed)
    return known_start(_with(rotated, camera, content.lidar_pose()), start)


def check_calibration(config: Config) -> CalibrationFile | None:
    """Reads the calibration file of a flight; None without one. Raises UsageError."""
    if config.calibration is None:
        return None
    from touchdown.experiments.io.calibration_file import read_calibration

    return read_calibration(Path(config.calibration))


def _with_known_imu(rig: SensorRig, config: Config) -> SensorRig:
    if not config.calibration_error.imu_sheet_of_profile:
        return rig
    known = {f"imu.{field.name}": field for field in fields(ImuSheet)}
    told = {key: value for key, value in profile_values(config.profile).items() if key in known}
    return replace(rig, imu=ImuSheet(**{known[key].name: told[key] for key in told}))


def known_start(rig: SensorRig, start: StartParams) -> SensorRig:
    """Returns the rig with the part of the take-off pose that ``start`` makes known."""
    if start.attitude_known:
        return rig
    pose = rig.world_from_body_start
    heading = rotation_from_yaw(yaw_from_rotation(pose.rotation))
    return replace(
        rig,
        world_from_body_start=Pose(heading, pose.translation),
        start_tilt_sigma_rad=math.radians(start.tilt_sigma_deg),
    )


def erring_rig(rig: SensorRig, params: CalibrationErrorParams, seed: int) -> SensorRig:
    """Returns the rig with normally distributed errors, or ``rig`` itself where all are 0.

    The error between camera and LIDAR comes first; those of either against the IMU are independent
    of it and of one another.
    """
    lidar = _lidar_against_imu(_relative(rig, params, seed), params, seed)
    return _distorted(_camera_against_imu(lidar, params, seed), params, seed)


def _relative(rig: SensorRig, params: CalibrationErrorParams, seed: int) -> SensorRig:
    """With the errors of camera_from_lidar and of the pinhole."""
    sigmas = (
        params.rotation_sigma_deg,
        params.translation_sigma_m,
        params.focal_sigma,
        params.center_sigma_px,
    )
    if not any(sigmas):
        return rig
    draws = _draws(seed, b"rig error", 10)
    rotation = np.deg2rad(params.rotation_sigma_deg) * draws[:3]
    translation = params.translation_sigma_m * draws[3:6]
    k, stretch, center = rig.camera, params.focal_sigma * draws[6:8], draws[8:]
    fx, fy = np.array([k.fx, k.fy]) * (1.0 + stretch)
    cx, cy = np.array([k.cx, k.cy]) + params.center_sigma_px * center
    camera = replace(k, fx=float(fx), fy=float(fy), cx=float(cx), cy=float(cy))
    true = rig.body_from_camera.inverse() @ rig.body_from_lidar
    return _with(
        rig, camera, Pose(so3_exp(rotation) @ true.rotation, true.translation + translation)
    )


def _with(rig: SensorRig, camera: CameraIntrinsics, camera_from_lidar: Pose) -> SensorRig:
    return replace(rig, camera=camera, body_from_lidar=rig.body_from_camera @ camera_from_lidar)


def calibration_errors(true: SensorRig, nominal: SensorRig) -> dict[str, float]:
    """``mount_error_deg``, the larger of the rotations by which camera and LIDAR sit otherwise on
    the IMU than the nominal calibration says, and ``lens_error_px``, by which a corner of the image
    is moved at most: principal point and distortion."""
    rotations = [
        np.linalg.norm(so3_log(getattr(true, name).rotation.T @ getattr(nominal, name).rotation))
        for name in ("body_from_camera", "body_from_lidar")
    ]
    one, other = true.camera, nominal.camera
    terms = np.abs(other.distortion - one.distortion)[:_DISTORTION_TERMS]
    moved = corner_displacement_px(one) * terms
    center = math.hypot(other.cx - one.cx, other.cy - one.cy)
    return {
        "mount_error_deg": math.degrees(float(max(rotations))),
        "lens_error_px": center + float(moved.sum()),
    }


def _camera_against_imu(rig: SensorRig, params: CalibrationErrorParams, seed: int) -> SensorRig:
    """With the error of the cameras' mount, which carries both of a stereo pair."""
    sigmas = params.imu_camera_rotation_sigma_deg, params.imu_camera_translation_sigma_m
    if not any(sigmas):
        return rig
    pair = rig.body_from_camera.inverse() @ rig.body_from_camera_right
    camera = _erring_mount(rig, "camera", seed, *sigmas)
    return replace(rig, body_from_camera=camera, body_from_camera_right=camera @ pair)


def _lidar_against_imu(rig: SensorRig, params: CalibrationErrorParams, seed: int) -> SensorRig:
    sigmas = params.imu_lidar_rotation_sigma_deg, params.imu_lidar_translation_sigma_m
    if not any(sigmas):
        return rig
    return replace(rig, body_from_lidar=_erring_mount(rig, "lidar", seed, *sigmas))


def _apart(rig: SensorRig, params: CalibrationErrorParams, seed: int) -> SensorRig:
    """With the errors of the readout and of the lever arms of antenna and rangefinder."""
    if params.readout_fraction:
        stretch = 1.0 + params.readout_fraction * _draws(seed, b"readout", 1)[0]
        rig = replace(rig, camera_readout_s=float(rig.camera_readout_s * stretch))
    if not params.lever_sigma_m:
        return rig
    gps, beam = rig.nav.gps, rig.nav.rangefinder
    levers = [
        params.lever_sigma_m * _draws(seed, b"lever arm of " + name, 3) + true
        for name, true in ((b"gps", gps.antenna_body_m), (b"rangefinder", beam.position_body_m))
    ]
    antenna, mount = (tuple(lever.tolist()) for lever in levers)
    nav = replace(
        rig.nav,
        gps=replace(gps, antenna_body_m=antenna),
        rangefinder=replace(beam, position_body_m=mount),
    )
    return replace(rig, nav=nav)


def _draws(seed: int, name: bytes, count: int) -> Array:
    return np.random.default_rng([seed, crc32(name)]).standard_normal(count)


def _erring_mount(
    rig: SensorRig, sensor: str, seed: int, rotation_sigma_deg: float, translation_sigma_m: float
) -> Pose:
    """Returns ``body_from_SENSOR`` with an error: a rotation about the sensor and a translation, in
    the IMU's axes."""
    draws = _draws(seed, f"imu mount of {sensor}".encode(), 6)
    rotation = so3_exp(np.deg2rad(rotation_sigma_deg) * draws[:3])
    true = rig.body_from_imu.inverse() @ getattr(rig, f"body_from_{sensor}")
    moved = true.translation + translation_sigma_m * draws[3:]
    return rig.body_from_imu @ Pose(rotation @ true.rotation, moved)


def _distorted(rig: SensorRig, params: CalibrationErrorParams, seed: int) -> SensorRig:
    if not params.distortion_sigma_px:
        return rig
    each = DISTORTION_FRACTION * params.distortion_sigma_px
    draws = _draws(seed, b"rig distortion", _DISTORTION_TERMS)
    error = np.append(each * draws / corner_displacement_px(rig.camera), 0.0)
    return replace(rig, camera=replace(rig.camera, distortion=rig.camera.distortion + error))


def corner_displacement_px(camera: CameraIntrinsics) -> Array:
    """(4,) pixels by which k1, k2, p1 and p2 of 1, or the four terms of a fisheye, displace the
    corner of the image that they displace most."""
    corners = [(u, v) for u in (0, camera.width - 1) for v in (0, camera.height - 1)]
    u, v = np.array(corners, dtype=np.float64).T
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    square = x * x + y * y
    if camera.lens == "fisheye":
        radial = np.hypot(camera.fx * x, camera.fy * y)
        return np.array([(radial * square**power).max() for power in (1, 2, 3, 4)])
    moved_x = np.stack([x * square, x * square**2, 2.0 * x * y, square + 2.0 * x * x])
    moved_y = np.stack([y * square, y * square**2, square + 2.0 * y * y, 2.0 * x * y])
    return np.hypot(camera.fx * moved_x, camera.fy * moved_y).max(axis=1)
