"""Views of a chessboard, rendered and scanned: what the calibration works on."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING
from zlib import crc32

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.api import (
    CalibrationView,
    Chessboard,
)
from touchdown.experiments.config.schema import Config
from touchdown.sim.frames import Pose, so3_exp

if TYPE_CHECKING:
    from touchdown.sim.stand import SensorStand

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

SECONDS_PER_VIEW = 1.0
"""of LIDAR, whose pattern fills up meanwhile"""
_PIXELS_PER_SQUARE = 96
_NEAR_M, _FAR_M = 1.8, 3.4
_TILT_RAD = np.deg2rad([18.0, 45.0])
_TURN_RAD = np.deg2rad(25.0)
_EDGE_PX = 12.0
_MOST_OBLIQUE = np.cos(np.deg2rad(52.0))
_LIDAR_HALF_VIEW = np.tan(0.5 * np.deg2rad([81.7, 25.1]))
_LEAST_SEEN = 0.6
"""share of the board within the LIDAR's view"""
_GOLDEN_ANGLE = np.pi * (3.0 - 5.0**0.5)
_PLASTIC = np.array([0.7548776662466927, 0.5698402909980532])
"""Steps of the plane's low-discrepancy sequence (Roberts 2018)."""
_MOST_TRIES = 400


def chessboard_picture(board: Chessboard) -> Picture:
    """(H, W, 3) of the plate: black squares on white, the first one in the upper left corner."""
    side = _PIXELS_PER_SQUARE
    row, col = np.mgrid[: (board.rows + 1) * side, : (board.columns + 1) * side] // side
    squares = np.where((row + col) % 2 == 0, 25, 230).astype(np.uint8)
    rim = round(side * board.margin_m / board.square_m)
    return np.repeat(np.pad(squares, rim, constant_values=230)[:, :, None], 3, axis=2)


def calibration_views(
    config: Config,
    board: Chessboard,
    count: int,
    progress: Callable[[int], None] = lambda done: None,
) -> tuple[list[CalibrationView], SensorStand]:
    """``count`` views of the board, held in front of the sensors of ``config`` with all noise on;
    and the stand, which knows the true calibration. ``progress`` is called after every view."""
    stand = build_stand(config, chessboard_picture(board), board.size_m)
    views = []
    try:
        for number, camera_from_board in enumerate(
            board_poses(stand, board, count, config.seed), start=1
        ):
            world_from_camera = stand.world_from_body @ stand.body_from_camera
            view = stand.look(world_from_camera @ camera_from_board, SECONDS_PER_VIEW)
            clouds = [scan.points[scan.ranges > 0.0] for scan in view.scans]
            points = np.concatenate(clouds).astype(np.float64)
            views.append(CalibrationView(rgb=view.rgb, points=points))
            progress(number)
    finally:
        stand.close()
    return views, stand


def board_poses(stand: SensorStand, board: Chessboard, count: int, seed: int) -> Iterator[Pose]:
    """camera_from_board of ``count`` views: all over the picture, near and far, tilted about both
    axes by 18 to 45 degrees, all corners in the picture and most of the plate in the LIDAR's view.
    """
    rng = np.random.default_rng([seed, crc32(b"board poses")])
    camera_from_lidar = stand.body_from_camera.inverse() @ stand.body_from_lidar
    picture = np.array([stand.intrinsics.width, stand.intrinsics.height])
    for number in range(count):
        for attempt in range(_MOST_TRIES):
            place = (0.5 + (number + 1) * _PLASTIC) % 1.0
            # Towards the middle with every failure: not every tilt fits everywhere.
            reach = 1.0 - attempt / _MOST_TRIES
            pixel = picture * (0.5 + reach * (place - 0.5 + rng.normal(0.0, 0.03, 2)))
            tilt = rng.uniform(*_TILT_RAD)
            direction = number * _GOLDEN_ANGLE + rng.normal(0.0, 0.2)
            depth = rng.uniform(_NEAR_M, _FAR_M)
            pose = _held(stand, pixel, depth, tilt, direction, rng.uniform(-_TURN_RAD, _TURN_RAD))
            if _in_picture(stand, board, pose) and _in_lidar(board, camera_from_lidar, pose):
                break
        yield pose


def _held(
    stand: SensorStand, pixel: Array, depth: float, tilt: float, direction: float, turn: float
) -> Pose:
    """The board's middle at a pixel and depth, its face turned towards the camera and then tilted
    by ``tilt`` about the axis ``direction`` in its plane."""
    k = stand.intrinsics
    ray = np.array([(pixel[0] - k.cx) / k.fx, (pixel[1] - k.cy) / k.fy, 1.0])
    axis = np.array([np.cos(direction), np.sin(direction), 0.0])
    rotation = so3_exp(tilt * axis) @ so3_exp(np.array([0.0, 0.0, turn]))
    return Pose(rotation, depth * ray)


def _outline(board: Chessboard, steps: int) -> Array:
    """(steps^2, 3) points spread over the plate, its corners among them."""
    x, y = (np.linspace(-0.5, 0.5, steps) * side for side in board.size_m)
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    return np.column_stack([grid, np.zeros(len(grid))])


def _in_picture(stand: SensorStand, board: Chessboard, pose: Pose) -> bool:
    """Whether the squares and half the rim, which the corner finder wants, are in the picture and
    not seen too obliquely."""
    k = stand.intrinsics
    shrink = 1.0 - board.margin_m / np.array([*board.size_m, np.inf])
    points = pose.apply(_outline(board, 5) * shrink)
    pixels = cv2.projectPoints(points, np.zeros(3), np.zeros(3), k.matrix(), k.distortion)[0]
    pixels = pixels.reshape(-1, 2)
    limit = np.array([k.width - 1, k.height - 1]) - _EDGE_PX
    ray = pose.translation / np.linalg.norm(pose.translation)
    inside = ((pixels > _EDGE_PX) & (pixels < limit)).all()
    return bool(inside and ray @ pose.rotation[:, 2] > _MOST_OBLIQUE)


def _in_lidar(board: Chessboard, camera_from_lidar: Pose, pose: Pose) -> bool:
    """Whether the LIDAR, by its data sheet's field of view, sees enough of the plate."""
    points = (camera_from_lidar.inverse() @ pose).apply(_outline(board, 15))
    slope = np.abs(points[:, :2] / points[:, 2:])
    return float((slope < _LIDAR_HALF_VIEW).all(axis=1).mean()) >= _LEAST_SEEN


if TYPE_CHECKING:
    from touchdown.sim.stand import SensorStand


STAND_HEIGHT_M = 5.5
"""of the vehicle over the floor while it is calibrated"""


def build_stand(
    config: Config, picture: NDArray[np.uint8], size_m: tuple[float, float]
) -> SensorStand:
    """The configured camera and LIDAR, hung up in a room over a board of ``size_m`` (width, height)
    that shows ``picture`` (H, W, 3)."""
    from touchdown.scenes.authoring.calibration_room import BOARD_BODY, calibration_room
    from touchdown.sim.stand import SensorStand

    return SensorStand(
        calibration_room(picture, *size_m, config.seed),
        sim=config.sim,
        camera=config.camera,
        lidar=config.lidar,
        seed=config.seed,
        height_m=STAND_HEIGHT_M,
        board=BOARD_BODY,
    )
