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
    distance, gap = np.empty(NEIGHBOURS), np.empty((3, 2 * reach + 1))
    for i in range(count):
        first = np.floor(points[i] / voxel) - reach
        for a in range(3):
            # least squared distance of the point from each layer of voxels
            for k in range(2 * reach + 1):
                face = first[a] + k + (k < reach)
                gap[a, k] = 0.0 if k == reach else (points[i, a] - face * voxel) ** 2
        have, worst = 0, np.inf
        for turn in range(2 * reach + 1):
            # the layers of the point's own height first
            kz = reach + (turn + 1) // 2 * (1 if turn % 2 else -1)
            for ky in range(2 * reach + 1):
                if gap[2, kz] + gap[1, ky] >= worst:
                    continue
                for kx in range(2 * reach + 1):
                    if gap[2, kz] + gap[1, ky] + gap[0, kx] >= worst:
                        continue
                    key = _pack(int(first[0]) + kx, int(first[1]) + ky, int(first[2]) + kz)
                    slot = _slot(keys, key)
                    if keys[slot] == _EMPTY:
                        continue
                    n = sums[slot, _COUNT]
                    x, y, z = sums[slot, _X] / n, sums[slot, _Y] / n, sums[slot, _Z] / n
                    d2 = (x - points[i, 0]) ** 2
                    d2 += (y - points[i, 1]) ** 2 + (z - points[i, 2]) ** 2
                    if d2 >= worst:
                        continue
                    at = min(have, NEIGHBOURS - 1)
                    while at > 0 and distance[at - 1] > d2:
                        distance[at] = distance[at - 1]
                        near[i, at] = near[i, at - 1]
                        at -= 1
                    distance[at] = d2
                    near[i, at, 0], near[i, at, 1], near[i, at, 2] = x, y, z
                    have = min(have + 1, NEIGHBOURS)
                    if have == NEIGHBOURS:
                        worst = distance[NEIGHBOURS - 1]
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
