"""The constants of a flight that an estimator does not know, and what it knows of them."""

from __future__ import annotations

import math
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.config.schema import Config
from touchdown.experiments.flight.estimator_calibration import (
    DISTORTION_SHARE,
    corner_displacement_px,
)
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.lidar.range_errors import SHARES

Array = NDArray[np.float64]

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
    sigmas[RANGE] = config.lidar.range_bias_m * np.array(SHARES) / np.sqrt([3.0, 3.0, 48.0])
    sigmas[EYE_MOUNT] = np.repeat(
        [
            math.radians(errors.imu_camera_rotation_sigma_deg),
            errors.imu_camera_translation_sigma_m,
        ],
        3,
    )
    bent = DISTORTION_SHARE * errors.distortion_sigma_px / corner_displacement_px(lens)
    sigmas[LENS] = [*[errors.center_sigma_px] * 2, *[errors.focal_sigma] * 2, *bent]
    sigmas[CLOCK] = config.camera.stamp_delay_s
    return np.maximum(sigmas, _CERTAIN)
