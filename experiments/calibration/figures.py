"""Figures of a calibration: boards with their corners, LIDAR returns over an image, and the
coloured cloud of one view (the paper's Fig. 2)."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.api import CalibrationResult, CalibrationView, Chessboard
from touchdown.experiments.scene_tools.views import write_image
from touchdown.scenes.api import Image
from touchdown.sim.frames import Pose, so3_exp
from touchdown.sim.geometry.lens import project
from touchdown.sim.typing import Array

_COLUMNS, _GAP = 4, 6
_SMALL = (424, 240)
_OVERLAY_STEP = 5
"""One of this many returns is drawn; no divisor of 6, since the LIDAR's six lasers take turns."""
_CLOUD_SIZE = (1200, 800)
_CLOUD_FOCAL = 1150.0
_UNSEEN = (70, 70, 74)
_BACKGROUND = 18
_BEHIND_M = 0.8


def write_figures(
    folder: Path, views: Sequence[CalibrationView], result: CalibrationResult, board: Chessboard
) -> None:
    """Writes boards.png, overlay.png and cloud.png. Raises UsageError where writing fails."""
    folder.mkdir(parents=True, exist_ok=True)
    write_image(folder / "boards.png", boards_image(views, result, board))
    shown = max(result.used, key=lambda number: len(result.board_points[number]))
    write_image(folder / "overlay.png", overlay_image(views[shown], result))
    write_image(folder / "cloud.png", cloud_image(views[shown], result, result.corners[shown]))


def boards_image(
    views: Sequence[CalibrationView], result: CalibrationResult, board: Chessboard
) -> Image:
    """All views with the corners that were found."""
    tiles = []
    for number, view in enumerate(views):
        tile = view.rgb[:, :, ::-1].copy()
        if number in result.corners:
            corners = result.corners[number].astype(np.float32).reshape(-1, 1, 2)
            cv2.drawChessboardCorners(tile, (board.columns, board.rows), corners, True)
        small = cv2.resize(tile, _SMALL, interpolation=cv2.INTER_AREA)
        text = str(number + 1) if number in result.used else f"{number + 1}: not used"
        cv2.putText(small, text, (8, 22), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (255, 255, 255), 2)
        tiles.append(small)
    rim = (_GAP // 2, _GAP // 2)
    framed = [np.pad(tile, (rim, rim, (0, 0)), constant_values=255) for tile in tiles]
    framed += [np.full_like(framed[0], 255)] * (-len(framed) % _COLUMNS)
    rows = [np.hstack(framed[k : k + _COLUMNS]) for k in range(0, len(framed), _COLUMNS)]
    return np.ascontiguousarray(np.vstack(rows)[:, :, ::-1])


def overlay_image(view: CalibrationView, result: CalibrationResult) -> Image:
    """The camera's image with the returns of the LIDAR, near red and far blue: a board's edge in
    the returns must lie on its edge in the image."""
    image = view.rgb.copy()
    points = view.points[::_OVERLAY_STEP]
    in_camera = result.camera_from_lidar.apply(points)
    low, high = np.percentile(in_camera[:, 2], [1.0, 99.0])
    fraction = np.clip((high - in_camera[:, 2]) / (high - low), 0.12, 0.95)
    tint = cv2.applyColorMap((255.0 * fraction).astype(np.uint8), cv2.COLORMAP_TURBO)
    _dot(image, _pixels(points, result), tint.reshape(-1, 3)[:, ::-1], 1)
    return image


def cloud_image(view: CalibrationView, result: CalibrationResult, corners: Array) -> Image:
    """The returns in the colours of the image, looked at from beside the camera: the squares
    must lie flat and undistorted on the board."""
    in_camera = result.camera_from_lidar.apply(view.points)
    pixels = np.rint(_pixels(view.points, result)).astype(np.int64)
    rows, cols = view.rgb.shape[:2]
    seen = ((pixels >= 0) & (pixels < [cols, rows])).all(axis=1)
    colour = np.tile(np.array(_UNSEEN, np.uint8), (len(pixels), 1))
    colour[seen] = view.rgb[pixels[seen, 1], pixels[seen, 0]]
    eye = _beside(in_camera, pixels, corners)
    placed = eye.apply(in_camera)
    width, height = _CLOUD_SIZE
    ahead = placed[:, 2] > 0.3
    spots = _CLOUD_FOCAL * placed[ahead, :2] / placed[ahead, 2:] + [0.5 * width, 0.4 * height]
    depth = placed[ahead, 2]
    order = np.argsort(-depth, kind="stable")  # what is nearer hides what is further
    image = np.full((height, width, 3), _BACKGROUND, np.uint8)
    _dot(image, spots[order], colour[ahead][order], 3)
    return image


def _beside(in_camera: Array, pixels: NDArray[np.int64], corners: Array) -> Pose:
    """eye_from_camera of an eye turned about the board's middle by 25 degrees and stepped back."""
    low, high = corners.min(axis=0), corners.max(axis=0)
    on_board = ((pixels >= low) & (pixels <= high)).all(axis=1)
    middle = np.median(in_camera[on_board], axis=0)
    rotation = so3_exp(np.deg2rad([-15.0, 20.0, 0.0]))
    distance = float(np.linalg.norm(middle)) + _BEHIND_M
    return Pose(rotation, np.array([0.0, 0.0, distance]) - rotation @ middle)


def _pixels(points: Array, result: CalibrationResult) -> Array:
    """(N, 2) pixels of LIDAR points (N, 3) by the calibration (Eqs. 1 and 2)."""
    return project(result.camera, result.camera_from_lidar.apply(points))[0]


def _dot(image: Image, pixels: Array, colours: NDArray[np.uint8], side: int) -> None:
    """Draws squares of ``side`` pixels; later ones cover earlier ones."""
    place = np.rint(pixels).astype(np.int64)
    for down, across in np.ndindex(side, side):
        col, row = place[:, 0] + across, place[:, 1] + down
        inside = (col >= 0) & (row >= 0) & (col < image.shape[1]) & (row < image.shape[0])
        image[row[inside], col[inside]] = colours[inside]
