"""Calibration from views of a chessboard (Zou, Sun and Kong 2024, section 3.2)."""

from __future__ import annotations

from collections.abc import Sequence
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

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

Array = NDArray[np.float64]

_MAX_APART_M = 0.5
"""between camera and LIDAR"""


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
