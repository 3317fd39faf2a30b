"""Extrinsics: pose of the LIDAR in the camera frame, from planes that both see (Zou, Sun and Kong
2024, Eqs. 4 and 5)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from touchdown.experiments.calibration.board_plane import BoardPlane
from touchdown.experiments.calibration.chessboard import CameraPlanes
from touchdown.sim.frames import Pose, so3_exp
from touchdown.sim.typing import Array, Indices, Mask

MIN_VIEWS = 3
_TRIALS = 300
_MAX_ANGLE = np.deg2rad(3.0)
_MAX_OFFSET_M = 0.05
_MIN_SPREAD = 0.05
"""Smallest singular value of the normals, over the root of their number; that of tilts of 5
degrees."""
_CONVERGED = 1e-12


@dataclass(frozen=True, kw_only=True, slots=True)
class ExtrinsicFit:
    """Result of ``solve_extrinsics``."""

    camera_from_lidar: Pose
    covariance: Array
    """(6, 6) rotation (rad, applied on the left), translation (m)"""
    rms_m: float
    """of all residuals"""


def plane_residuals(
    points: Array, normal: Array, distance: float, camera_from_lidar: Pose
) -> Array:
    """Distances (N,) of LIDAR points (N, 3) from a plane of the camera frame: the terms whose
    squares Eq. 5 sums, theta^T (R p + t) + d."""
    return camera_from_lidar.apply(points) @ normal + distance


def agreeing_views(
    planes: CameraPlanes, boards: Sequence[BoardPlane], rng: np.random.Generator
) -> tuple[Pose, Indices]:
    """Returns a closed-form initial pose and the views consistent with it, by random triples of
    views.

    Raises ValueError if fewer than three views agree, or all have the same tilt.
    """
    normals = np.array([board.normal for board in boards])
    distances = np.array([board.distance for board in boards])
    views = len(boards)
    if views < MIN_VIEWS:
        raise ValueError(_too_few(views))
    best = np.arange(0)
    for _ in range(_TRIALS):
        triple = rng.permutation(views)[:MIN_VIEWS]
        if _spread(normals[triple]) < _MIN_SPREAD:
            continue
        start = closed_form(planes, normals, distances, triple)
        agree = np.flatnonzero(_agrees(start, planes, normals, distances))
        if len(agree) > len(best):
            best = agree
    if len(best) >= MIN_VIEWS and _spread(normals[best]) >= _MIN_SPREAD:
        return closed_form(planes, normals, distances, best), best
    if _spread(normals) < _MIN_SPREAD:
        raise ValueError(
            "the boards are tilted too much alike to fix the LIDAR's place: tilt them about both "
            "axes, by 20 degrees and more"
        )
    raise ValueError(_too_few(len(best)))


def closed_form(planes: CameraPlanes, normals: Array, distances: Array, views: Indices) -> Pose:
    """Rotation from the normals (Wahba's problem) and translation from the distances by least
    squares: with n_c = R n_l, Eq. 3 leaves n_c . t = d_l - d_c for every view."""
    in_camera = planes.normals[views]
    rotation, _ = Rotation.align_vectors(in_camera, normals[views])
    offsets = distances[views] - planes.distances[views]
    translation: Array = np.linalg.lstsq(in_camera, offsets, rcond=None)[0].astype(np.float64)
    return Pose(rotation.as_matrix(), translation)


def solve_extrinsics(
    planes: CameraPlanes, boards: Sequence[BoardPlane], views: Indices, start: Pose
) -> ExtrinsicFit:
    """Solves Eq. 5 over ``views`` by Levenberg-Marquardt: every view has the same weight, however
    many points its board has."""
    blocks = [
        (boards[view].points, planes.normals[view], float(planes.distances[view])) for view in views
    ]

    def moved(step: Array) -> Pose:
        return Pose(so3_exp(step[:3]) @ start.rotation, start.translation + step[3:])

    def weighted(step: Array) -> Array:
        pose = moved(step)
        return np.concatenate(
            [plane_residuals(*block, pose) / len(block[0]) ** 0.5 for block in blocks]
        )

    found = least_squares(
        weighted, np.zeros(6), method="lm", xtol=_CONVERGED, ftol=_CONVERGED, gtol=_CONVERGED
    )
    pose = moved(found.x)
    squares = [plane_residuals(*block, pose) ** 2 for block in blocks]
    return ExtrinsicFit(
        camera_from_lidar=pose,
        covariance=_covariance(blocks, pose, planes.of_views(views.tolist())),
        rms_m=float(np.sqrt(np.concatenate(squares).mean())),
    )


_Block = tuple[Array, Array, float]


def _jacobian(block: _Block, pose: Pose) -> Array:
    """(N, 6) of a view's residuals: n . (w x R p) = w . (R p x n), and n for the translation."""
    points, normal, _ = block
    rotated = points @ pose.rotation.T
    return np.hstack([np.cross(rotated, normal), np.broadcast_to(normal, rotated.shape)])


def _covariance(blocks: Sequence[_Block], pose: Pose, planes: CameraPlanes) -> Array:
    """Covariance (6, 6). The minimum moves by -H^-1 (J^T W e) with the errors e of the residuals:
    those of the LIDAR are independent from return to return, those of a camera plane are shared by
    all its returns, and the lens's by all views."""
    matrix, from_lidar = np.zeros((6, 6)), np.zeros((6, 6))
    by_plane = np.zeros((6, 4 * len(blocks)))
    for k, block in enumerate(blocks):
        residuals, jacobian = plane_residuals(*block, pose), _jacobian(block, pose)
        count = len(residuals)
        matrix += jacobian.T @ jacobian / count
        scored = (residuals - residuals.mean())[:, None] * jacobian
        from_lidar += scored.T @ scored / count**2
        lifted = np.column_stack([pose.apply(block[0]), np.ones(count)])
        by_plane[:, 4 * k : 4 * k + 4] = jacobian.T @ lifted / count
    from_camera = by_plane @ planes.covariance @ by_plane.T
    inverse = np.linalg.inv(matrix)
    return inverse @ (from_lidar + from_camera) @ inverse


def _agrees(pose: Pose, planes: CameraPlanes, normals: Array, distances: Array) -> Mask:
    cosine = np.einsum("ij,ij->i", planes.normals, normals @ pose.rotation.T)
    offset = planes.normals @ pose.translation - (distances - planes.distances)
    return np.asarray((cosine > np.cos(_MAX_ANGLE)) & (np.abs(offset) < _MAX_OFFSET_M))


def _spread(normals: Array) -> float:
    """Smallest singular value of normals (V, 3) over sqrt(V): 0 if they do not span space."""
    return float(np.linalg.svd(normals, compute_uv=False)[-1] / np.sqrt(len(normals)))


def _too_few(views: int) -> str:
    return (
        f"only {views} views show the board to camera and LIDAR alike; calibration needs "
        f"{MIN_VIEWS} or more"
    )
