"""The chessboard in images: corners, camera matrix, lens, and the planes of the board.

Camera calibration from planes: Zhang, "A flexible new technique for camera calibration", PAMI 2000.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from touchdown.experiments.api import Chessboard
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.frames import skew, so3_exp, so3_right_jacobian
from touchdown.sim.typing import Array, Bytes

LENS_PARAMETERS = 9
"""fx, fy, cx, cy, k1, k2, p1, p2, k3"""
_POSE_PARAMETERS = 6
_REFINE_FRACTION = 0.45
"""of the distance between corners: half the side of the window that refines a corner"""
_SMOOTHING_PX = 1.0
"""Edges sharper than pixels pull corners towards the pixel grid: for rendered corners of known
position, this halves the error."""


@dataclass(frozen=True, kw_only=True, slots=True)
class CameraFit:
    """Camera and board poses of the least-squares fit to the corners."""

    camera: CameraIntrinsics
    rotation_vectors: Array
    """(V, 3) camera_from_board"""
    translations: Array
    """(V, 3) m"""
    covariance: Array
    """(9 + 6 V, 9 + 6 V): lens, then rotation vector and translation of every view"""
    rms_px: float
    """of the residuals of one coordinate"""


@dataclass(frozen=True, kw_only=True, slots=True)
class CameraPlanes:
    """The board's planes in the camera frame, normals . p + distances = 0 (Eq. 3, second line),
    normals towards the camera."""

    normals: Array
    """(V, 3)"""
    distances: Array
    """(V,) m"""
    covariance: Array
    """(4 V, 4 V) of normal and distance, view by view"""

    def of_views(self, views: Sequence[int]) -> "CameraPlanes":
        """Returns the planes of the given views."""
        chosen = (4 * np.array(views, np.int64)[:, None] + np.arange(4)).ravel()
        return CameraPlanes(
            normals=self.normals[list(views)],
            distances=self.distances[list(views)],
            covariance=self.covariance[np.ix_(chosen, chosen)],
        )


def board_corners(board: Chessboard) -> Array:
    """(rows * columns, 3) inner corners in the board frame, row by row."""
    row, col = np.mgrid[: board.rows, : board.columns]
    x = (col.ravel() - 0.5 * (board.columns - 1)) * board.square_m
    y = (row.ravel() - 0.5 * (board.rows - 1)) * board.square_m
    return np.column_stack([x, y, np.zeros(x.size)])


def find_corners(rgb: Bytes, board: Chessboard) -> Array | None:
    """(rows * columns, 2) pixels of the inner corners, pixel centres at integers, in the order of
    `board_corners`; None unless all of them are seen."""
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    found, rough = cv2.findChessboardCorners(
        grey,
        (board.columns, board.rows),
        flags=cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE,
    )
    if not found:
        return None
    grid = rough.reshape(board.rows, board.columns, 2)
    gaps = [np.linalg.norm(np.diff(grid, axis=axis), axis=2).min() for axis in (0, 1)]
    half = max(2, int(_REFINE_FRACTION * min(gaps)))
    smooth = cv2.GaussianBlur(grey, (0, 0), _SMOOTHING_PX)
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-4)
    refined = cv2.cornerSubPix(smooth, rough, (half, half), (-1, -1), stop)
    return np.asarray(refined, np.float64).reshape(-1, 2)


def fit_camera(
    corners: Sequence[Array], board: Chessboard, image_size: tuple[int, int]
) -> CameraFit:
    """Camera matrix (Eq. 2, skew 0), distortion and board poses from the corners of three or more
    views; ``image_size`` is (width, height)."""
    object_points = board_corners(board).astype(np.float32)
    _, matrix, distortion, rotations, places = cv2.calibrateCamera(
        [object_points] * len(corners),
        [view.astype(np.float32) for view in corners],
        image_size,
        None,
        None,
    )
    lens = np.array(
        [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *np.ravel(distortion)[:5]]
    )
    rotation_vectors = np.reshape(rotations, (-1, 3)).astype(np.float64)
    translations = np.reshape(places, (-1, 3)).astype(np.float64)
    residuals, jacobian = _linearised(lens, rotation_vectors, translations, corners, board)
    freedom = residuals.size - jacobian.shape[1]
    variance = float(residuals @ residuals) / freedom
    # Columns differ by powers of ten: the inverse is taken of a matrix with unit diagonal.
    scale = 1.0 / np.linalg.norm(jacobian, axis=0)
    scaled = jacobian * scale
    covariance = variance * np.linalg.inv(scaled.T @ scaled) * np.outer(scale, scale)
    (width, height), (fx, fy, cx, cy) = image_size, lens[:4].tolist()
    return CameraFit(
        camera=CameraIntrinsics(
            width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, distortion=lens[4:].copy()
        ),
        rotation_vectors=rotation_vectors,
        translations=translations,
        covariance=covariance,
        rms_px=variance**0.5,
    )


def camera_planes(fit: CameraFit) -> CameraPlanes:
    """Returns the board's planes of a fit and their covariance from that of lens and poses. As all
    views share the lens, the errors of the planes are correlated."""
    views = len(fit.translations)
    normals, distances = np.empty((views, 3)), np.empty(views)
    spread = np.zeros((4 * views, len(fit.covariance)))
    for k, (vector, origin) in enumerate(zip(fit.rotation_vectors, fit.translations, strict=True)):
        rotation = so3_exp(vector)
        normals[k] = -rotation[:, 2]
        distances[k] = -normals[k] @ origin
        rotated = rotation @ skew(np.array([0.0, 0.0, 1.0])) @ so3_right_jacobian(vector)
        rows, first = 4 * k, LENS_PARAMETERS + _POSE_PARAMETERS * k
        spread[rows : rows + 3, first : first + 3] = rotated
        spread[rows + 3, first : first + 3] = -origin @ rotated
        spread[rows + 3, first + 3 : first + 6] = -normals[k]
    return CameraPlanes(
        normals=normals, distances=distances, covariance=spread @ fit.covariance @ spread.T
    )


def _linearised(
    lens: Array,
    rotation_vectors: Array,
    translations: Array,
    corners: Sequence[Array],
    board: Chessboard,
) -> tuple[Array, Array]:
    """Residuals (2 C V,) in pixels and their Jacobian with respect to lens and poses."""
    points = board_corners(board)
    fx, fy, cx, cy = lens[:4]
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    rows, poses = 2 * len(points), _POSE_PARAMETERS
    residuals = np.empty(rows * len(corners))
    jacobian = np.zeros((residuals.size, LENS_PARAMETERS + poses * len(corners)))
    for k, seen in enumerate(corners):
        projected, partial = cv2.projectPoints(
            points, rotation_vectors[k], translations[k], matrix, lens[4:]
        )[:2]
        block, first = slice(rows * k, rows * (k + 1)), LENS_PARAMETERS + poses * k
        residuals[block] = (seen - projected.reshape(-1, 2)).ravel()
        jacobian[block, first : first + poses] = partial[:, :poses]
        jacobian[block, :LENS_PARAMETERS] = partial[:, poses : poses + LENS_PARAMETERS]
    return residuals, jacobian
