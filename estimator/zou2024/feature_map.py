"""The global maps of edge and planar points: voxel centroids with nearest-neighbour search."""

from typing import NamedTuple

import numpy as np
from numba import njit

from touchdown.estimator.filtering.error_state import Frame, Frames
from touchdown.estimator.filtering.plane_map import _EMPTY, _pack, _slot
from touchdown.estimator.filtering.vectors import along, turned, xyz
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array, Indices, Mask

NEIGHBOURS = 5
"""k of Algorithm 1"""

_COUNT, _X, _Y, _Z = range(4)
_CENTRE, _SENSOR = slice(1, 4), slice(4, 7)
_COLUMNS = 7
"""columns of a voxel: number of points, sums of their coordinates, and the position (3,) that it
was first seen from"""


_NO_OWNER = -1


class Voxels(NamedTuple):
    """The S slots of the hash table, as kernels take them."""

    keys: Indices  # (S,)
    sums: Array  # (S, 7)
    owners: Indices  # (S,) clone of the filter that a voxel belongs to; -1: none


class Seen(NamedTuple):
    """Circumstances of new points."""

    sensor: Array  # (3,) m, odom frame
    owner: int  # of new voxels
    moves: Frames  # that move points to where the owners' voxels are kept


class Nearest(NamedTuple):
    """The five nearest centroids of N points, nearest first."""

    found: Mask  # (N,)
    near: Array  # (N, 5, 3) where their owners put them now
    owners: Indices  # (N,) of the nearest
    sensors: Array  # (N, 3) m, where the nearest was first seen from


_NOWHERE = Seen(np.zeros(3), _NO_OWNER, Frames.of([]))


@njit(cache=True, error_model="numpy")
def _insert(
    voxels: Voxels, used: int, points: Array, seen: Seen, voxel: float, max_count: int
) -> int:
    keys, sums, owners = voxels
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
            keys[slot], owners[slot] = key, seen.owner
            sums[slot, _SENSOR] = seen.sensor
            used += 1
        if sums[slot, _COUNT] >= max_count:
            continue
        sums[slot, _COUNT] += 1.0
        k = owners[slot]
        for c in range(3):
            if k < 0:
                sums[slot, _X + c] += points[i, c]
                continue
            sums[slot, _X + c] += seen.moves.translations[k, c]
            for a in range(3):
                sums[slot, _X + c] += seen.moves.rotations[k, c, a] * points[i, a]
    return used


@njit(cache=True, error_model="numpy")
def _reassign(voxels: Voxels, gone: int, successor: int, move: Frame) -> None:
    """Gives the voxels of owner ``gone`` to ``successor``, moved by ``move``. Owners behind
    ``gone`` count one less."""
    keys, sums, owners = voxels
    place = xyz(move.translation)
    for slot in range(keys.shape[0]):
        k = owners[slot]
        if keys[slot] == _EMPTY or k < gone:
            continue
        if k == gone:
            row = sums[slot]
            centre = along(turned(move.rotation, xyz(row[_CENTRE])), row[_COUNT], place)
            sensor = along(turned(move.rotation, xyz(row[_SENSOR])), 1.0, place)
            for a in range(3):
                row[_CENTRE.start + a], row[_SENSOR.start + a] = centre[a], sensor[a]
            k = successor
        owners[slot] = k - 1 if k > gone else k


@njit(cache=True, error_model="numpy")
def _nearest(voxels: Voxels, points: Array, voxel: float, reach: int, moves: Frames) -> Nearest:
    """The five nearest centroids of each point among the voxels around its own. ``moves``: of the
    owners since their voxels were made, before distances are taken: a neighbour found where it was
    would lie beside the point by what its owner has been corrected, and pull the pose along."""
    keys, sums, owners = voxels
    count, layers = points.shape[0], 2 * reach + 1
    found = np.zeros(count, dtype=np.bool_)
    near = np.zeros((count, NEIGHBOURS, 3))
    whose, sensors = np.full(count, _NO_OWNER, np.int64), np.zeros((count, 3))
    distance, gap = np.empty(NEIGHBOURS), np.empty((3, layers))
    # the point's own layer first, then those around: what is near rules out what is far
    order = np.array([(turn + 1) // 2 * (1 if turn % 2 else -1) for turn in range(layers)])
    owned = moves.translations.shape[0] > 0
    for i in range(count):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        ix, iy, iz = np.floor(px / voxel), np.floor(py / voxel), np.floor(pz / voxel)
        for turn in range(layers):
            # least squared distance of the point from each layer of voxels
            step = order[turn]
            away = step + (step < 0)
            gap[0, turn] = ((ix + away) * voxel - px) ** 2 if step else 0.0
            gap[1, turn] = ((iy + away) * voxel - py) ** 2 if step else 0.0
            gap[2, turn] = ((iz + away) * voxel - pz) ** 2 if step else 0.0
        have, worst, nearest = 0, np.inf, -1
        for kz in range(layers):
            for ky in range(layers):
                if gap[2, kz] + gap[1, ky] >= worst:
                    continue
                for kx in range(layers):
                    if gap[2, kz] + gap[1, ky] + gap[0, kx] >= worst:
                        continue
                    key = _pack(int(ix) + order[kx], int(iy) + order[ky], int(iz) + order[kz])
                    slot = _slot(keys, key)
                    if keys[slot] == _EMPTY:
                        continue
                    n = sums[slot, _COUNT]
                    x, y, z = sums[slot, _X] / n, sums[slot, _Y] / n, sums[slot, _Z] / n
                    k = owners[slot]
                    if owned and k >= 0:
                        place = xyz(moves.translations[k])
                        x, y, z = along(turned(moves.rotations[k], (x, y, z)), 1.0, place)
                    d2 = (x - px) ** 2 + (y - py) ** 2 + (z - pz) ** 2
                    if d2 >= worst:
                        continue
                    at = min(have, NEIGHBOURS - 1)
                    while at > 0 and distance[at - 1] > d2:
                        distance[at] = distance[at - 1]
                        for c in range(3):
                            near[i, at, c] = near[i, at - 1, c]
                        at -= 1
                    distance[at] = d2
                    near[i, at, 0], near[i, at, 1], near[i, at, 2] = x, y, z
                    if at == 0:
                        nearest = slot
                    have = min(have + 1, NEIGHBOURS)
                    if have == NEIGHBOURS:
                        worst = distance[NEIGHBOURS - 1]
        found[i] = have == NEIGHBOURS
        if have > 0:
            whose[i], sensors[i] = owners[nearest], sums[nearest, _SENSOR]
    return Nearest(found, near, whose, sensors)


class FeatureMap:
    """Running centroids of the feature points in every voxel, odom frame.

    ``voxel_m``: side; ``capacity``: slots of the hash table, a power of two, which bounds the
    memory (when it is 70 % full, new voxels are rejected); ``max_points``: a voxel ignores further
    points after so many, because the oldest carry the least drift. ``reach``: of the search, in
    voxels; five centroids on one line need two.
    """

    def __init__(self, voxel_m: float, capacity: int, max_points: int = 20, reach: int = 1) -> None:
        self.voxel_m = voxel_m
        self.max_points = max_points
        self.reach = reach
        self.used = 0
        self._voxels = Voxels(
            np.full(capacity, _EMPTY, dtype=np.int64), np.zeros((capacity, _COLUMNS)),
            np.full(capacity, _NO_OWNER, dtype=np.int64),
        )  # fmt: skip

    def insert(self, points_odom: Array, seen: Seen = _NOWHERE) -> None:
        """Adds (N, 3) points."""
        self.used = _insert(
            self._voxels, self.used, points_odom, seen, self.voxel_m, self.max_points
        )

    def reassign(self, gone: int, successor: int, move: Pose) -> None:
        """Gives the voxels of owner ``gone`` to ``successor``, moved by ``move``."""
        _reassign(self._voxels, gone, successor, Frame.of(move))

    def nearest(self, points_odom: Array, moves: Frames = _NOWHERE.moves) -> Nearest:
        """Five nearest centroids of (N, 3) points. The search covers the voxel of the point and
        ``reach`` more on every side. ``moves``: of the owners since their voxels were made."""
        return _nearest(self._voxels, points_odom, self.voxel_m, self.reach, moves)
