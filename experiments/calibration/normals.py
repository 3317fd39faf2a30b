"""Difference of normals: flatness of points at two scales.

Ioannou, Taati, Harrap and Greenspan, "Difference of normals as a multi-scale operator in
unorganized point clouds", 3DIMPVT 2012, which the paper applies to find the board.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]


FEWEST_NEIGHBOURS = 5
_UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def voxel_means(points: Array, voxel_m: float) -> Array:
    """(M, 3) mean of the points (N, 3) in every occupied voxel: evens out density and noise."""
    if not len(points):
        return points.copy()
    cells = np.floor(points / voxel_m).astype(np.int64)
    cells -= cells.min(axis=0)
    extent = cells.max(axis=0) + 1
    key = (cells[:, 0] * extent[1] + cells[:, 1]) * extent[2] + cells[:, 2]
    _, member, count = np.unique(key, return_inverse=True, return_counts=True)
    sums = np.stack([np.bincount(member, points[:, axis]) for axis in range(3)], axis=1)
    return sums / count[:, None]


def difference_of_normals(
    points: Array, small_radius_m: float, large_radius_m: float
) -> tuple[Array, Array]:
    """Half the length of the difference between the normals at two radii, (N,) in [0, 1/sqrt(2)],
    and the normals (N, 3) at the small one, turned towards the origin.

    A point with fewer than five neighbours within the small radius has difference ``inf``.
    """
    pairs = cKDTree(points).query_pairs(large_radius_m, output_type="ndarray")
    apart = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    near = pairs[apart <= small_radius_m]
    small, enough = _normals(points, near)
    large, _ = _normals(points, pairs)
    difference = 0.5 * np.linalg.norm(small - large, axis=1)
    return np.where(enough, difference, np.inf), small


def _normals(points: Array, pairs: Indices) -> tuple[Array, Mask]:
    """Normals (N, 3) of the planes through every point's neighbours (pairs hold every pair once)
    and itself, and the mask (N,) of points with enough neighbours."""
    size = len(points)
    one = np.concatenate([pairs[:, 0], pairs[:, 1]])
    other = np.concatenate([pairs[:, 1], pairs[:, 0]])
    offset = points[other] - points[one]
    count = np.bincount(one, minlength=size) + 1.0
    sums = np.stack([np.bincount(one, offset[:, a], size) for a in range(3)], axis=1)
    mean = sums / count[:, None]
    scatter = np.empty((size, 3, 3))
    for a, b in _UPPER:
        moment = np.bincount(one, offset[:, a] * offset[:, b], size) / count
        scatter[:, a, b] = scatter[:, b, a] = moment - mean[:, a] * mean[:, b]
    normals = np.linalg.eigh(scatter)[1][:, :, 0]
    away = np.einsum("ij,ij->i", normals, points) > 0.0
    normals[away] *= -1.0
    return normals, count > FEWEST_NEIGHBOURS
