"""The global maps of edge and planar points: voxel centroids with nearest-neighbour search."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from touchdown.estimator.filtering.plane_map import _EMPTY, _pack, _slot

Array = NDArray[np.float64]

NEIGHBOURS = 5
"""k of Algorithm 1"""

_COUNT, _X, _Y, _Z = range(4)
"""of a voxel: number of points and sums of their coordinates"""


@njit(cache=True)
def _insert(
    keys: NDArray[np.int64], sums: Array, used: int, points: Array, voxel: float, max_count: int
) -> int:
    limit = int(0.7 * keys.shape[0])
    for i in range(points.shape[0]):
        key = _pack(
            int(np.floor(points[i, 0] / voxel)),
            int(np.floor(points[i, 1] / voxel)),
            int(np.floor(points[i, 2] / voxel)),
        )
        slot = _slot(keys, key)
        if keys[slot] == _EMPTY:
            if used >= limit:
                continue
            keys[slot] = key
            used += 1
        if sums[slot, _COUNT] >= max_count:
            continue
        sums[slot, _COUNT] += 1.0
        for c in range(3):
            sums[slot, _X + c] += points[i, c]
    return used


@njit(cache=True)
def _nearest(
    keys: NDArray[np.int64], sums: Array, points: Array, voxel: float, reach: int
) -> tuple[NDArray[np.bool_], Array]:
    """The five nearest centroids of each point among the voxels around its own."""
    count = points.shape[0]
    found = np.zeros(count, dtype=np.bool_)
    near = np.zeros((count, NEIGHBOURS, 3))
    distance = np.empty(NEIGHBOURS)
    for i in range(count):
        ix = int(np.floor(points[i, 0] / voxel))
        iy = int(np.floor(points[i, 1] / voxel))
        iz = int(np.floor(points[i, 2] / voxel))
        have = 0
        for dz in range(-reach, reach + 1):
            for dy in range(-reach, reach + 1):
                for dx in range(-reach, reach + 1):
                    slot = _slot(keys, _pack(ix + dx, iy + dy, iz + dz))
                    if keys[slot] == _EMPTY:
                        continue
                    n = sums[slot, _COUNT]
                    x, y, z = sums[slot, _X] / n, sums[slot, _Y] / n, sums[slot, _Z] / n
                    d2 = (x - points[i, 0]) ** 2
                    d2 += (y - points[i, 1]) ** 2 + (z - points[i, 2]) ** 2
                    if have == NEIGHBOURS and d2 >= distance[NEIGHBOURS - 1]:
                        continue
                    at = min(have, NEIGHBOURS - 1)
                    while at > 0 and distance[at - 1] > d2:
                        distance[at] = distance[at - 1]
                        near[i, at] = near[i, at - 1]
                        at -= 1
                    distance[at] = d2
                    near[i, at, 0], near[i, at, 1], near[i, at, 2] = x, y, z
                    have = min(have + 1, NEIGHBOURS)
        found[i] = have == NEIGHBOURS
    return found, near


class FeatureMap:
    """Running centroids of the feature points in every voxel, odom frame.

    ``voxel_m``: side; ``capacity``: slots of the hash table, a power of two, which bounds the
    memory (when it is 70 % full, new voxels are rejected); ``max_points``: a voxel ignores further
    points after so many, because the oldest carry the least drift. ``reach``: of the search, in
    voxels; five centroids on one line need two.
    """

    def __init__(self, voxel_m: float, capacity: int, max_points: int = 20, reach: int = 1) -> None:
        if capacity & (capacity - 1):
            raise ValueError(f"FeatureMap: capacity {capacity} must be a power of two")
        self.voxel_m = voxel_m
        self.max_points = max_points
        self.reach = reach
        self.used = 0
        self._keys = np.full(capacity, _EMPTY, dtype=np.int64)
        self._sums = np.zeros((capacity, 4))

    def insert(self, points_odom: Array) -> None:
        """Adds (N, 3) points."""
        self.used = _insert(
            self._keys, self._sums, self.used, points_odom, self.voxel_m, self.max_points
        )

    def nearest(self, points_odom: Array) -> tuple[NDArray[np.bool_], Array]:
        """Five nearest centroids of (N, 3) points, nearest first: found (N,) and (N, 5, 3). The
        search covers the voxel of the point and ``reach`` more on every side."""
        return _nearest(self._keys, self._sums, points_odom, self.voxel_m, self.reach)
