"""Calibration from views of a chessboard (Zou, Sun and Kong 2024, section 3.2), and its errors,
stated uncertainty and consistency against the truth."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np

from touchdown.experiments.api import CalibrationResult, CalibrationView, Chessboard
from touchdown.experiments.calibration.board_plane import BoardPlane, find_board
from touchdown.experiments.calibration.chessboard import (
    LENS_PARAMETERS,
    camera_planes,
    find_corners,
    fit_camera,
)
from touchdown.experiments.calibration.extrinsics import (
    MIN_VIEWS,
    agreeing_views,
    solve_extrinsics,
)
from touchdown.experiments.calibration.figures import write_figures
from touchdown.experiments.calibration.views import calibration_views
from touchdown.experiments.config.schema import Config
from touchdown.experiments.flight.platform import limit_threads
from touchdown.experiments.io.calibration_file import write_calibration
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.frames import Pose, so3_log
from touchdown.sim.typing import Array

_MAX_APART_M = 0.5
"""between camera and LIDAR"""
CONSISTENT_EXTRINSICS, CONSISTENT_CAMERA = 22.46, 27.88
"""0.999 quantiles of chi-square with 6 and 9 degrees of freedom"""


def calibrate(
    views: Sequence[CalibrationView], board: Chessboard, seed: int = 0
) -> CalibrationResult:
    """Returns camera matrix and lens from the images, then the LIDAR's pose in the camera frame
    from the planes. Every image with all corners contributes to the camera, even if the LIDAR
    misses the board. ``seed`` is that of RANSAC.

    Raises ValueError when fewer than three views are usable or all boards have the same tilt.
    """
    rng = np.random.default_rng([seed, crc32(b"calibration")])
    refused: dict[int, str] = {}
    corners = {}
    for number, view in enumerate(views):
        found = find_corners(view.rgb, board)
        if found is None:
            refused[number] = "the camera does not see all corners"
        else:
            corners[number] = found
    if len(corners) < MIN_VIEWS:
        raise ValueError(
            f"the camera sees the whole chessboard in only {len(corners)} of {len(views)} views; "
            f"calibration needs {MIN_VIEWS} or more"
        )
    height, width = views[0].rgb.shape[:2]
    camera = fit_camera(list(corners.values()), board, (width, height))
    seen: dict[int, BoardPlane] = {}
    for number, place in zip(corners, camera.translations, strict=True):
        plane = find_board(_as_far(views[number].points, place, board), board, rng)
        if plane is None:
            refused[number] = "no flat part of the LIDAR's cloud has the board's size"
        else:
            seen[number] = plane
    boards, numbers = list(seen.values()), list(seen)
    planes = camera_planes(camera).of_views([list(corners).index(number) for number in numbers])
    start, agree = agreeing_views(planes, boards, rng)
    fit = solve_extrinsics(planes, boards, agree, start)
    for row in sorted(set(range(len(numbers))) - set(agree.tolist())):
        refused[numbers[row]] = "the planes of camera and LIDAR do not match those of other views"
    used = tuple(numbers[row] for row in agree)
    return CalibrationResult(
        camera=camera.camera,
        camera_covariance=camera.covariance[:LENS_PARAMETERS, :LENS_PARAMETERS],
        camera_from_lidar=fit.camera_from_lidar,
        extrinsic_covariance=fit.covariance,
        reprojection_rms_px=camera.rms_px,
        plane_rms_m=fit.rms_m,
        used=used,
        refused=refused,
        corners=corners,
        board_points={number: seen[number].points for number in used},
    )


def _as_far(points: Array, board_in_camera: Array, board: Chessboard) -> Array:
    """Returns the points about as far from the LIDAR as the board (its middle, (3,)) is from the
    camera, which does not depend on the sensors' orientations."""
    slack = _MAX_APART_M + 0.5 * float(np.hypot(*board.size_m))
    ranges = np.linalg.norm(points, axis=1)
    near = np.abs(ranges - np.linalg.norm(board_in_camera)) < slack
    return points[near]


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
