"""Evaluation of a calibration against the truth: errors, stated uncertainty, and consistency."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.api import CalibrationResult, Chessboard
from touchdown.experiments.calibration.calibrate import calibrate
from touchdown.experiments.calibration.figures import write_figures
from touchdown.experiments.calibration.views import calibration_views
from touchdown.experiments.config.schema import Config
from touchdown.experiments.flight.platform import limit_threads
from touchdown.experiments.io.calibration_file import write_calibration
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.frames import Pose, so3_log

Array = NDArray[np.float64]

CONSISTENT_EXTRINSICS, CONSISTENT_CAMERA = 22.46, 27.88
"""0.999 quantiles of chi-square with 6 and 9 degrees of freedom"""


def run_calibration(
    config: Config,
    count: int,
    out: Path,
    images: Path | None,
    note: Callable[[str], None] = lambda text: None,
) -> dict[str, Any]:
    """Renders ``count`` views, calibrates, writes the calibration file and, into the folder
    ``images``, figures; returns the report. Raises ValueError when too few views are usable,
    UsageError for files that cannot be written."""
    limit_threads()
    board = Chessboard()
    views, truth = calibration_views(
        config, board, count, lambda done: note(f"view {done} of {count}")
    )
    note("calibrating")
    result = calibrate(views, board, config.seed)
    write_calibration(out, result)
    if images is not None:
        write_figures(images, views, result, board)
    return {
        "file": str(out),
        "seed": config.seed,
        "views": {
            "given": count,
            "used": len(result.used),
            "refused": {str(number): why for number, why in sorted(result.refused.items())},
        },
        "residuals": {
            "reprojection_rms_px": result.reprojection_rms_px,
            "plane_rms_m": result.plane_rms_m,
        },
        **errors(result, truth.camera, truth.camera_from_lidar),
    }


def errors(
    result: CalibrationResult, camera: CameraIntrinsics, camera_from_lidar: Pose
) -> dict[str, Any]:
    """Errors against the true calibration, the standard deviations that the calibration states,
    and the squared errors in units of its covariance, whose mean is the number of parameters."""
    found = result.camera_from_lidar
    rotation = so3_log(found.rotation @ camera_from_lidar.rotation.T)
    translation = found.translation - camera_from_lidar.translation
    lens = _lens(result.camera) - _lens(camera)
    of_k = 100.0 * lens[:4] / _lens(camera)[:4]
    outside = _nees(np.concatenate([rotation, translation]), result.extrinsic_covariance)
    inside = _nees(lens, result.camera_covariance)
    sigma = np.sqrt(np.diag(result.extrinsic_covariance))
    sigma_k = np.sqrt(np.diag(result.camera_covariance))
    return {
        "error": {
            "rotation_deg": float(np.rad2deg(np.linalg.norm(rotation))),
            "translation_m": float(np.linalg.norm(translation)),
            "camera_percent": dict(zip(("fx", "fy", "cx", "cy"), of_k.tolist(), strict=True)),
            "camera_worst_percent": float(np.abs(of_k).max()),
        },
        "stated_sigma": {
            "rotation_deg": np.rad2deg(sigma[:3]).tolist(),
            "translation_m": sigma[3:].tolist(),
            "camera_px": sigma_k[:4].tolist(),
            "distortion": sigma_k[4:].tolist(),
        },
        "consistency": {
            "extrinsics_nees": outside,
            "extrinsics_limit": CONSISTENT_EXTRINSICS,
            "camera_nees": inside,
            "camera_limit": CONSISTENT_CAMERA,
            "consistent": outside < CONSISTENT_EXTRINSICS and inside < CONSISTENT_CAMERA,
        },
    }


def _lens(camera: CameraIntrinsics) -> Array:
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion])


def _nees(error: Array, covariance: Array) -> float:
    return float(error @ np.linalg.solve(covariance, error))
