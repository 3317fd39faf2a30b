"""Rendered and scanned views of a chessboard, the input of a calibration."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from zlib import crc32

import numpy as np

from touchdown.experiments.api import CalibrationView, Chessboard
from touchdown.experiments.config.schema import Config
from touchdown.experiments.scene_tools.posed_views import posed_sensors
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.frames import Pose, so3_exp
from touchdown.sim.geometry.lens import project
from touchdown.sim.posed_sensors import PosedSensors
from touchdown.sim.typing import Array, Image

SECONDS_PER_VIEW = 1.0
"""LIDAR time per view, in which the pattern fills up"""
_HEIGHT_M = 5.5
"""Height of the vehicle over its pose at rest while it is calibrated"""
_PIXELS_PER_SQUARE = 96
_NEAR_M, _FAR_M = 1.8, 3.4
_TILT_RAD = np.deg2rad([18.0, 45.0])
_ROLL_RAD = np.deg2rad(25.0)
_EDGE_PX = 12.0
_MAX_OBLIQUE = np.cos(np.deg2rad(52.0))
_LIDAR_HALF_VIEW = np.tan(0.5 * np.deg2rad([81.7, 25.1]))
_MIN_SEEN = 0.6
"""Least fraction of the board within the LIDAR's field of view"""
_GOLDEN_ANGLE = np.pi * (3.0 - 5.0**0.5)
_PLASTIC = np.array([0.7548776662466927, 0.5698402909980532])
"""Steps of the plane's low-discrepancy sequence (Roberts 2018)."""
_MAX_TRIES = 400


@dataclass(frozen=True, slots=True)
class CameraAndLidar:
    """True calibration of both sensors."""

    camera: CameraIntrinsics
    camera_from_lidar: Pose


def chessboard_image(board: Chessboard) -> Image:
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
) -> tuple[list[CalibrationView], CameraAndLidar]:
    """``count`` views of the board in front of the configured sensors, with all noise, and the true
    calibration. ``progress`` is called with the number of finished views after each."""
    from touchdown.scenes.calibration_room import BOARD_BODY, calibration_room

    if config.camera.lens == "fisheye":
        raise ValueError("the calibration is that of a pinhole camera; set camera.lens=pinhole")
    room = calibration_room(chessboard_image(board), *board.size_m, config.seed)
    sensors = posed_sensors(config, room)
    camera_from_lidar = sensors.mounts.camera.inverse() @ sensors.mounts.lidar
    truth = CameraAndLidar(sensors.intrinsics, camera_from_lidar)
    world_from_body = Pose(np.eye(3), room.model.qpos0[:3] + np.array([0.0, 0.0, _HEIGHT_M]))
    world_from_camera = world_from_body @ sensors.mounts.camera
    ticks = config.sim.lidar_scan_ticks
    scans = max(1, round(SECONDS_PER_VIEW * config.sim.tick_hz / ticks))
    views = []
    try:
        poses = board_poses(truth, board, count, config.seed)
        for number, camera_from_board in enumerate(poses):
            sensors.hold(BOARD_BODY, world_from_camera @ camera_from_board)
            # Later than the view before, so that neither noise nor scan pattern repeats.
            starts = range(number * scans * ticks, (number + 1) * scans * ticks, ticks)
            views.append(_view(sensors, world_from_body, starts))
            progress(number + 1)
    finally:
        sensors.close()
    return views, truth


def _view(sensors: PosedSensors, world_from_body: Pose, starts: range) -> CalibrationView:
    """An image and the LIDAR returns of the scans that begin at the ticks ``starts``."""
    from touchdown.sim.moving import BodyTrack

    clouds = []
    for start in starts:
        body = BodyTrack.at_rest(world_from_body, sensors.scan_times(start)[[0, -1]])
        if start == starts[0]:
            rgb = sensors.image(body, start).rgb
        scan = sensors.scan(body, start)
        clouds.append(scan.points[scan.ranges > 0.0])
    return CalibrationView(rgb=rgb, points=np.concatenate(clouds).astype(np.float64))


def board_poses(truth: CameraAndLidar, board: Chessboard, count: int, seed: int) -> Iterator[Pose]:
    """camera_from_board of ``count`` views: all over the image, near and far, tilted about both
    axes by 18 to 45 degrees, all corners in the image and most of the plate in the LIDAR's view.
    """
    rng = np.random.default_rng([seed, crc32(b"board poses")])
    camera = truth.camera
    size_px = np.array([camera.width, camera.height])
    for number in range(count):
        for attempt in range(_MAX_TRIES):
            spot = (0.5 + (number + 1) * _PLASTIC) % 1.0
            # Towards the middle with every failure: not every tilt fits everywhere.
            reach = 1.0 - attempt / _MAX_TRIES
            pixel = size_px * (0.5 + reach * (spot - 0.5 + rng.normal(0.0, 0.03, 2)))
            tilt = rng.uniform(*_TILT_RAD)
            direction = number * _GOLDEN_ANGLE + rng.normal(0.0, 0.2)
            depth = rng.uniform(_NEAR_M, _FAR_M)
            roll = rng.uniform(-_ROLL_RAD, _ROLL_RAD)
            pose = _board_pose(camera, pixel, depth, tilt, direction, roll)
            if _in_image(camera, board, pose) and _in_lidar(board, truth.camera_from_lidar, pose):
                break
        yield pose


def _board_pose(
    k: CameraIntrinsics, pixel: Array, depth: float, tilt: float, direction: float, roll: float
) -> Pose:
    """The board's middle at a pixel and depth, its face turned towards the camera and then tilted
    by ``tilt`` about the axis ``direction`` in its plane."""
    ray = np.array([(pixel[0] - k.cx) / k.fx, (pixel[1] - k.cy) / k.fy, 1.0])
    axis = np.array([np.cos(direction), np.sin(direction), 0.0])
    rotation = so3_exp(tilt * axis) @ so3_exp(np.array([0.0, 0.0, roll]))
    return Pose(rotation, depth * ray)


def _outline(board: Chessboard, steps: int) -> Array:
    """(steps^2, 3) points spread over the plate, its corners among them."""
    x, y = (np.linspace(-0.5, 0.5, steps) * side for side in board.size_m)
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    return np.column_stack([grid, np.zeros(len(grid))])


def _in_image(k: CameraIntrinsics, board: Chessboard, pose: Pose) -> bool:
    """True if the squares and half the rim, which the corner finder needs, are in the image and
    not seen too obliquely."""
    shrink = 1.0 - board.margin_m / np.array([*board.size_m, np.inf])
    points = pose.apply(_outline(board, 5) * shrink)
    pixels = project(k, points)[0]
    limit = np.array([k.width - 1, k.height - 1]) - _EDGE_PX
    ray = pose.translation / np.linalg.norm(pose.translation)
    inside = ((pixels > _EDGE_PX) & (pixels < limit)).all()
    return bool(inside and ray @ pose.rotation[:, 2] > _MAX_OBLIQUE)


def _in_lidar(board: Chessboard, camera_from_lidar: Pose, pose: Pose) -> bool:
    """True if the LIDAR, by its data sheet's field of view, sees enough of the plate."""
    points = (camera_from_lidar.inverse() @ pose).apply(_outline(board, 15))
    slope = np.abs(points[:, :2] / points[:, 2:])
    return float((slope < _LIDAR_HALF_VIEW).all(axis=1).mean()) >= _MIN_SEEN
