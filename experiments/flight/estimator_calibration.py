"""The believed rig: the calibration that estimators are given, with its errors."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from zlib import crc32

import numpy as np

from touchdown.experiments.api import CalibrationErrorParams
from touchdown.experiments.config.schema import Config
from touchdown.experiments.errors import UsageError
from touchdown.experiments.io.calibration_file import CalibrationFile, read_calibration
from touchdown.sim.api import CameraIntrinsics, SensorRig
from touchdown.sim.frames import Pose, so3_exp


def believed_rig(rig: SensorRig, config: Config) -> SensorRig:
    """Returns the rig as estimators believe it: ``rig`` with the calibration file
    ``config.calibration``, or else with the errors of ``config.calibration_error``, drawn from the
    seed.

    The mount of the camera on the body is exact; that of the LIDAR follows from it. Raises
    UsageError for a file that cannot be used.
    """
    content = check_calibration(config)
    if content is not None:
        camera = content.intrinsics()
        if (camera.width, camera.height) != (rig.camera.width, rig.camera.height):
            raise UsageError(
                f"'{config.calibration}' is of a camera of {camera.width} x {camera.height} "
                f"pixels, the flight's has {rig.camera.width} x {rig.camera.height}"
            )
        return _with(rig, camera, content.lidar_pose())
    return erring_rig(rig, config.calibration_error, config.seed)


def check_calibration(config: Config) -> CalibrationFile | None:
    """Reads the calibration file of a flight; None without one. Raises UsageError."""
    return None if config.calibration is None else read_calibration(Path(config.calibration))


def erring_rig(rig: SensorRig, params: CalibrationErrorParams, seed: int) -> SensorRig:
    """Returns the rig with normally distributed errors, or ``rig`` itself where all are 0."""
    sigmas = (
        params.rotation_sigma_deg,
        params.translation_sigma_m,
        params.focal_sigma,
        params.center_sigma_px,
    )
    if not any(sigmas):
        return rig
    draw = np.random.default_rng([seed, crc32(b"rig error")]).standard_normal
    turn = np.deg2rad(params.rotation_sigma_deg) * draw(3)
    shift = params.translation_sigma_m * draw(3)
    stretch = 1.0 + params.focal_sigma * draw(2)
    center = params.center_sigma_px * draw(2)
    k = rig.camera
    camera = replace(
        k,
        fx=float(k.fx * stretch[0]),
        fy=float(k.fy * stretch[1]),
        cx=float(k.cx + center[0]),
        cy=float(k.cy + center[1]),
    )
    true = rig.body_from_camera.inverse() @ rig.body_from_lidar
    return _with(rig, camera, Pose(so3_exp(turn) @ true.rotation, true.translation + shift))


def _with(rig: SensorRig, camera: CameraIntrinsics, camera_from_lidar: Pose) -> SensorRig:
    return replace(rig, camera=camera, body_from_lidar=rig.body_from_camera @ camera_from_lidar)
