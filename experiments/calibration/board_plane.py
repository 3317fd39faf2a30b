"""Detection of the board in a LIDAR cloud: flat parts by difference of normals, planes by RANSAC,
the board by its size.

Ioannou, Taati, Harrap and Greenspan, "Difference of normals as a multi-scale operator in
unorganized point clouds", 3DIMPVT 2012, which the paper applies to find the board.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import open3d as o3d

from touchdown.experiments.api import Chessboard
from touchdown.sim.typing import Array, Mask

_VOXEL_M = 0.04
_SMALL_RADIUS_M, _LARGE_RADIUS_M = 0.11, 0.28
_MAX_DIFFERENCE = 0.12
"""Sine of half the angle between the normals at the two radii."""
_LINK_M = 0.09
"""Flat points nearer than this belong to one part."""
_MIN_VOXELS, _MIN_NEIGHBOURS = 60, 5
_TRIALS = 200
_INLIER_M = 0.02
"""of a voxel's mean"""
_GATE_SIGMAS = 4.0
_SLACK_M = 0.12
"""tolerance by which a part may exceed the plate"""
_SMALLEST_FRACTION = 0.4
"""of the plate that has to be seen"""
_RIM_M = 0.05
"""Returns nearer to the outline than this are left out: beams are split there."""
_MIN_RETURNS = 500
_CELL_M, _MIN_IN_CELL, _MIN_CELLS = 0.05, 8, 40


@dataclass(frozen=True, kw_only=True, slots=True)
class BoardPlane:
    """normal . p + distance = 0 (Eq. 3, first line) in the LIDAR frame."""

    normal: Array
    """(3,) unit, towards the LIDAR"""
    distance: float
    """m, positive"""
    points: Array
    """(N, 3) means of the board's returns over cells of 5 cm, LIDAR frame, m"""


def find_board(points: Array, board: Chessboard, rng: np.random.Generator) -> BoardPlane | None:
    """The board's plane and returns in a cloud (N, 3) of the LIDAR, seen from the origin; None
    when no flat part has the plate's size."""
    best, best_area = None, _SMALLEST_FRACTION * float(np.prod(board.size_m))
    for part in _flat_parts(points):
        normal, distance, inside = ransac_plane(part, _INLIER_M, _TRIALS, rng)
        members = part[inside]
        if len(members) < _MIN_VOXELS or not _fits(members, normal, board):
            continue
        area = _area(members, normal)
        if area > best_area:
            best, best_area = (normal, distance, members), area
    return None if best is None else _collect(points, *best)


def ransac_plane(
    points: Array, inlier_m: float, trials: int, rng: np.random.Generator
) -> tuple[Array, float, Mask]:
    """Fits the plane of most of ``points`` (N, 3) and refines it by least squares: returns the unit
    normal (3,) towards the origin, the distance from it, and the mask (N,) of inliers."""
    picks = rng.integers(0, len(points), (trials, 3))
    a, b, c = (points[picks[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1)
    proper = length > 1e-9
    normals[proper] /= length[proper, None]
    offsets = -np.einsum("ij,ij->i", normals, a)
    distances = np.abs(points @ normals.T + offsets)
    votes = np.where(proper, (distances < inlier_m).sum(axis=0), 0)
    inside = distances[:, int(np.argmax(votes))] < inlier_m
    normal, distance = fit_plane(points[inside])
    return normal, distance, np.abs(points @ normal + distance) < inlier_m


def fit_plane(points: Array) -> tuple[Array, float]:
    """Least squares plane of (N, 3) points: unit normal (3,) towards the origin, and distance."""
    mean = points.mean(axis=0)
    centred = points - mean
    normal = np.linalg.eigh(centred.T @ centred)[1][:, 0]
    distance = -float(normal @ mean)
    return (normal, distance) if distance > 0.0 else (-normal, -distance)


def difference_of_normals(
    cloud: o3d.geometry.PointCloud, small_radius_m: float, large_radius_m: float
) -> Array:
    """Half the length of the difference of the normals at two radii, (N,) in [0, 1/sqrt(2)]."""
    normals = []
    for radius in (small_radius_m, large_radius_m):
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamRadius(radius), False)
        cloud.orient_normals_towards_camera_location()
        normals.append(np.asarray(cloud.normals).copy())
    return 0.5 * np.linalg.norm(normals[0] - normals[1], axis=1)


def _flat_parts(points: Array) -> list[Array]:
    """Voxel means (M, 3) of the connected flat parts of a cloud (N, 3), largest first."""
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)).voxel_down_sample(_VOXEL_M)
    cloud, _ = cloud.remove_radius_outlier(_MIN_NEIGHBOURS, _SMALL_RADIUS_M)
    if len(cloud.points) < _MIN_VOXELS:
        return []
    difference = difference_of_normals(cloud, _SMALL_RADIUS_M, _LARGE_RADIUS_M)
    flat = cloud.select_by_index(np.flatnonzero(difference < _MAX_DIFFERENCE).tolist())
    label = np.asarray(flat.cluster_dbscan(_LINK_M, 1))
    count = np.bincount(label)
    order = np.argsort(-count, kind="stable")
    return [np.asarray(flat.points)[label == k] for k in order if count[k] >= _MIN_VOXELS]


def _on_plane(points: Array, normal: Array) -> Array:
    """(N, 2) float32 coordinates in the plane with that normal."""
    across = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    across /= np.linalg.norm(across)
    return np.asarray(points @ np.column_stack([across, np.cross(normal, across)]))


def _fits(members: Array, normal: Array, board: Chessboard) -> bool:
    """True if the smallest rectangle around a part fits into the plate."""
    rectangle = cv2.minAreaRect(_on_plane(members, normal).astype(np.float32))
    sides, plate = sorted(rectangle[1]), sorted(board.size_m)
    return all(side <= limit + _SLACK_M for side, limit in zip(sides, plate, strict=True))


def _area(members: Array, normal: Array) -> float:
    outline = cv2.convexHull(_on_plane(members, normal).astype(np.float32))
    return float(cv2.contourArea(outline))


def _collect(points: Array, normal: Array, distance: float, members: Array) -> BoardPlane | None:
    """Returns the means of the returns whose beams meet the plane within the part's outline, less
    its rim, and that lie near the plane."""
    outline = cv2.convexHull(_on_plane(members, normal).astype(np.float32)).reshape(-1, 2)
    near = points[np.abs(points @ normal + distance) < 10.0 * _INLIER_M]
    places = _on_plane(_along_beams(near, normal, distance), normal)
    inside = _inside(places, outline.astype(np.float64), _RIM_M)
    near, places = near[inside], places[inside]
    if len(near) < _MIN_RETURNS:
        return None
    offsets = near @ normal + distance
    offsets -= np.median(offsets)
    sigma = 1.4826 * float(np.median(np.abs(offsets)))
    kept = np.abs(offsets) <= _GATE_SIGMAS * sigma
    means = _cell_means(near[kept], places[kept])
    if len(means) < _MIN_CELLS:
        return None
    normal, distance = fit_plane(means)
    return BoardPlane(normal=normal, distance=distance, points=means)


def _along_beams(points: Array, normal: Array, distance: float) -> Array:
    """Intersections of the beams of ``points`` (N, 3) with a plane."""
    return points * (-distance / (points @ normal))[:, None]


def _cell_means(points: Array, places: Array) -> Array:
    """(M, 3) mean of the points in every square cell of the plane with enough of them, by the
    intersections of their beams with it, ``places`` (N, 2).

    A range's noise moves a return along its beam, so that on a slanted board the distance from the
    plane and the position on it are correlated, and planes through single returns turn towards the
    beam: by 0.1 degrees for 2 cm of noise on a board of a metre. Means of n returns, selected
    independently of the noise, turn n times less.
    """
    cells = np.floor(places / _CELL_M).astype(np.int64)
    _, member, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    sums = np.stack([np.bincount(member.ravel(), points[:, a]) for a in range(3)], axis=1)
    full = count >= _MIN_IN_CELL
    return np.asarray(sums[full] / count[full, None])


def _inside(places: Array, outline: Array, rim_m: float) -> Mask:
    """Mask of the positions (N, 2) inside a convex outline (K, 2) by at least ``rim_m``."""
    edges = np.roll(outline, -1, axis=0) - outline
    edges /= np.linalg.norm(edges, axis=1, keepdims=True)
    offset = places[:, None] - outline
    side = edges[:, 0] * offset[:, :, 1] - edges[:, 1] * offset[:, :, 0]
    sign = np.sign(np.median(side.mean(axis=0)))
    return np.asarray((sign * side > rim_m).all(axis=1))
