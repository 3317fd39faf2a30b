"""A bounded voxel-hash map of planes: running moments of the returns in each voxel.

Voxel planes with a covariance follow VoxelMap (Yuan et al. 2022). This map stores moments (ten
numbers a voxel), so that voxels can be merged exactly where a surface lies close to a voxel's face
and each side would hold only one half of its noise. A voxel also stores the position that it was
first seen from (later returns are registered to the first ones) and its anchor
(``estimator/filtering/anchors.py``).
"""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from touchdown.estimator.filtering.error_state import Frame
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array, Indices, Mask


class PlaneMatches(NamedTuple):
    """Planes of the map found for N points."""

    found: Mask  # (N,)
    normals: Array  # (N, 3) unit
    centres: Array  # (N, 3) m, a point on each plane
    variances: Array
    """(N, 3): m^2 of the returns about the plane (its thickness); m^2 of the plane's height at the
    point; rad^2 of the normal about either axis, by no more than ``_INDEPENDENT`` points"""
    sensors: Array  # (N, 3) m, position that each plane was first seen from
    anchors: NDArray[np.signedinteger]
    """(N,) index of the anchor that each plane belongs to; -1: none"""


class Voxels(NamedTuple):
    """The S slots of the hash table, as kernels take them."""

    keys: Indices  # (S,)
    moments: Array  # (S, 10), in the order of ``_COUNT`` and the following
    owners: NDArray[np.int16]  # (S,) index of the anchor; -1: none
    seen_from: Array  # (S, 3) m


_EMPTY = np.int64(-1)
_OFFSET = 1 << 20
# moments of a voxel: number of points, sums of their coordinates about the voxel's centre, and sums
# of products
_COUNT, _X, _Y, _Z, _XX, _XY, _XZ, _YY, _YZ, _ZZ = range(10)
_MOMENTS = 10
_INDEPENDENT = 25.0
"""most points of a voxel whose heights about its plane are independent of each other: plants and
bumps of the ground are wider than the gap between two"""
_FEW = 12
"""points below which a voxel of another anchor is taken over: a plane by fewer is hardly one"""
_NO_ANCHOR = -1


@njit(cache=True, error_model="numpy")
def _pack(ix: int, iy: int, iz: int) -> np.int64:
    return (
        (np.int64(ix + _OFFSET) << np.int64(42))
        | (np.int64(iy + _OFFSET) << np.int64(21))
        | np.int64(iz + _OFFSET)
    )


@njit(cache=True, error_model="numpy")
def _slot(keys: Indices, key: np.int64) -> int:
    """Slot that holds ``key``, or the empty slot where it belongs (linear probing)."""
    mask = keys.shape[0] - 1
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    slot = np.int64(mixed >> np.uint64(33)) & mask
    while keys[slot] != _EMPTY and keys[slot] != key:
        slot = (slot + 1) & mask
    return slot


@njit(cache=True, error_model="numpy")
def _add_moved(total: Array, m: Array, x: float, y: float, z: float) -> None:
    """Adds the moments ``m`` of points moved by (x, y, z) to ``total``."""
    n = m[_COUNT]
    total[_COUNT] += n
    total[_X] += m[_X] + n * x
    total[_Y] += m[_Y] + n * y
    total[_Z] += m[_Z] + n * z
    total[_XX] += m[_XX] + 2.0 * x * m[_X] + n * x * x
    total[_XY] += m[_XY] + x * m[_Y] + y * m[_X] + n * x * y
    total[_XZ] += m[_XZ] + x * m[_Z] + z * m[_X] + n * x * z
    total[_YY] += m[_YY] + 2.0 * y * m[_Y] + n * y * y
    total[_YZ] += m[_YZ] + y * m[_Z] + z * m[_Y] + n * y * z
    total[_ZZ] += m[_ZZ] + 2.0 * z * m[_Z] + n * z * z


@njit(cache=True, error_model="numpy")
def insert_points(
    voxels: Voxels,
    used: int,
    points: Array,
    sensor: Array,
    owner: int,
    voxel: float,
    max_count: int,
) -> int:
    """Adds (N, 3) points seen from ``sensor`` (3,), placed with anchor ``owner``; returns the
    number of used slots.

    A voxel holds the points of one anchor, that of its first point: those of another, with the
    drift between the two, would move its plane, unseen by the filter. One with fewer than
    ``_FEW`` points is given to ``owner`` and emptied.

    A voxel with ``max_count`` points is not changed: the cost of a scan stays constant. When the
    table is 70 % full, new voxels are rejected.
    """
    keys, moments, owners, seen_from = voxels
    limit = int(0.7 * keys.shape[0])
    one = np.zeros(_MOMENTS)
    one[_COUNT] = 1.0
    for i in range(points.shape[0]):
        x, y, z = points[i, 0] / voxel, points[i, 1] / voxel, points[i, 2] / voxel
        ix, iy, iz = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
        key = _pack(ix, iy, iz)
        slot = _slot(keys, key)
        m = moments[slot]
        if keys[slot] == _EMPTY:
            if used >= limit:
                continue
            keys[slot] = key
            used += 1
        elif owners[slot] != owner:
            if m[_COUNT] >= _FEW:
                continue
            m[:] = 0.0
        if m[_COUNT] >= max_count:
            continue
        if m[_COUNT] == 0.0:
            owners[slot] = owner
            for a in range(3):
                seen_from[slot, a] = sensor[a]
        x, y, z = x - (ix + 0.5), y - (iy + 0.5), z - (iz + 0.5)
        _add_moved(m, one, x * voxel, y * voxel, z * voxel)
    return used


@njit(cache=True, error_model="numpy")
def reassign_voxels(voxels: Voxels, gone: int, successor: int, move: Frame, voxel: float) -> None:
    """Reassigns the voxels of anchor ``gone`` to ``successor``, moved by ``move``, millimetres, as
    their centroid moves. Indices of anchors behind ``gone`` decrease by one."""
    keys, moments, owners, _ = voxels
    mask = (np.int64(1) << np.int64(21)) - 1
    d, moved = np.empty(3), np.empty(_MOMENTS)
    for slot in range(keys.shape[0]):
        k = owners[slot]
        if keys[slot] == _EMPTY or k < gone:
            continue
        if k == gone:
            m = moments[slot]
            n = m[_COUNT]
            key = keys[slot]
            at = np.empty(3)
            for a in range(3):
                index = (key >> (42 - 21 * a)) & mask
                at[a] = (index - _OFFSET + 0.5) * voxel + (m[_X + a] / n if n > 0 else 0.0)
            for a in range(3):
                d[a] = move.translation[a] - at[a]
                for b in range(3):
                    d[a] += move.rotation[a, b] * at[b]
            moved[:] = 0.0
            _add_moved(moved, m, d[0], d[1], d[2])
            for a in range(_MOMENTS):
                m[a] = moved[a]
            k = successor
        owners[slot] = k - 1 if k > gone else k


@njit(cache=True, error_model="numpy")
def smallest_eigen(cov: Array) -> tuple[float, float, float, float, float, float]:
    """Eigenvalues (ascending) and the unit eigenvector of the smallest, of a symmetric 3x3.

    Closed form (Smith 1961); the vector is the largest cross product of two rows of C - l I.
    """
    a, b, c = cov[0, 0], cov[1, 1], cov[2, 2]
    d, e, f = cov[0, 1], cov[0, 2], cov[1, 2]
    q = (a + b + c) / 3.0
    p2 = (a - q) ** 2 + (b - q) ** 2 + (c - q) ** 2 + 2.0 * (d * d + e * e + f * f)
    p = np.sqrt(p2 / 6.0)
    if p < 1e-12:
        return q, q, q, 0.0, 0.0, 1.0
    ra, rb, rc, rd, re, rf = (a - q) / p, (b - q) / p, (c - q) / p, d / p, e / p, f / p
    half_det = 0.5 * (
        ra * (rb * rc - rf * rf) - rd * (rd * rc - rf * re) + re * (rd * rf - rb * re)
    )
    phi = np.arccos(min(1.0, max(-1.0, half_det))) / 3.0
    high = q + 2.0 * p * np.cos(phi)
    low = q + 2.0 * p * np.cos(phi + 2.0 * np.pi / 3.0)
    mid = 3.0 * q - high - low
    a, b, c = a - low, b - low, c - low
    best, nx, ny, nz = -1.0, 0.0, 0.0, 1.0
    for k in range(3):
        if k == 0:
            cx, cy, cz = d * f - e * b, e * d - a * f, a * b - d * d
        elif k == 1:
            cx, cy, cz = d * c - e * f, e * e - a * c, a * f - d * e
        else:
            cx, cy, cz = b * c - f * f, f * e - d * c, d * f - b * e
        norm2 = cx * cx + cy * cy + cz * cz
        if norm2 > best:
            best, nx, ny, nz = norm2, cx, cy, cz
    if best < 1e-30:
        return low, mid, high, 0.0, 0.0, 1.0
    scale = 1.0 / np.sqrt(best)
    return low, mid, high, nx * scale, ny * scale, nz * scale


@njit(cache=True, error_model="numpy")
def _side(at: float, face: float) -> int:
    """On which side of a voxel a coordinate about its centre lies beyond ``face``; 0: on none."""
    return int(at > face) - int(at < -face)


@njit(cache=True, error_model="numpy")
def _gather(
    keys: Indices,
    moments: Array,
    x: float,
    y: float,
    z: float,
    voxel: float,
    margin: float,
    total: Array,
) -> tuple[float, float, float]:
    """Writes into ``total`` (11,) the moments about the centre of the voxel of (x, y, z), merged
    with the neighbours whose face is within ``margin``, and last the slot with most points. Returns
    that centre."""
    ix, iy, iz = np.floor(x / voxel), np.floor(y / voxel), np.floor(z / voxel)
    centre = ((ix + 0.5) * voxel, (iy + 0.5) * voxel, (iz + 0.5) * voxel)
    face = 0.5 * voxel - margin
    sx, sy, sz = _side(x - centre[0], face), _side(y - centre[1], face), _side(z - centre[2], face)
    total[:] = 0.0
    maximum = 0.0
    for corner in range(8):
        dx, dy, dz = sx * (corner & 1), sy * ((corner >> 1) & 1), sz * (corner >> 2)
        if (dx != 0) + (dy != 0) + (dz != 0) != (corner & 1) + ((corner >> 1) & 1) + (corner >> 2):
            continue
        slot = _slot(keys, _pack(int(ix) + dx, int(iy) + dy, int(iz) + dz))
        if keys[slot] == _EMPTY:
            continue
        m = moments[slot]
        if m[_COUNT] > maximum:
            maximum = m[_COUNT]
            total[_MOMENTS] = slot
        _add_moved(total, m, dx * voxel, dy * voxel, dz * voxel)
    return centre


@njit(cache=True, error_model="numpy")
def match_planes(
    voxels: Voxels, points: Array, voxel: float, margin: float, min_count: int, max_thickness: float
) -> PlaneMatches:
    """Returns the plane of the voxel of each of (N, 3) points.

    A voxel is planar if its smallest standard deviation is below ``max_thickness`` and three times
    below the next one.
    """
    keys, moments, owners, seen_from = voxels
    count = points.shape[0]
    found = np.zeros(count, dtype=np.bool_)
    normals = np.zeros((count, 3))
    centres = np.zeros((count, 3))
    variances = np.zeros((count, 3))
    sensors = np.zeros((count, 3))
    anchors = np.full(count, _NO_ANCHOR, dtype=np.int16)
    total = np.zeros(_MOMENTS + 1)
    cov = np.zeros((3, 3))
    for i in range(count):
        cx, cy, cz = _gather(
            keys, moments, points[i, 0], points[i, 1], points[i, 2], voxel, margin, total
        )
        n = total[_COUNT]
        if n < min_count:
            continue
        mx, my, mz = total[_X] / n, total[_Y] / n, total[_Z] / n
        cov[0, 0] = total[_XX] / n - mx * mx
        cov[0, 1] = total[_XY] / n - mx * my
        cov[0, 2] = total[_XZ] / n - mx * mz
        cov[1, 1] = total[_YY] / n - my * my
        cov[1, 2] = total[_YZ] / n - my * mz
        cov[2, 2] = total[_ZZ] / n - mz * mz
        low, mid, _, nx, ny, nz = smallest_eigen(cov)
        low = max(low, 1e-6)
        if low > max_thickness * max_thickness or mid < 9.0 * low:
            continue
        dx = points[i, 0] - cx - mx
        dy = points[i, 1] - cy - my
        dz = points[i, 2] - cz - mz
        along = dx * nx + dy * ny + dz * nz
        reach2 = dx * dx + dy * dy + dz * dz - along * along
        found[i] = True
        normals[i, 0], normals[i, 1], normals[i, 2] = nx, ny, nz
        centres[i, 0], centres[i, 1], centres[i, 2] = cx + mx, cy + my, cz + mz
        variances[i, 0] = low
        variances[i, 1] = low / n * (1.0 + reach2 / mid)
        variances[i, 2] = low / (min(n, _INDEPENDENT) * mid)
        slot = int(total[_MOMENTS])
        for a in range(3):
            sensors[i, a] = seen_from[slot, a]
        anchors[i] = owners[slot]
    return PlaneMatches(found, normals, centres, variances, sensors, anchors)


class PlaneMap:
    """Map of planes, odom frame; memory fixed by ``capacity`` (a power of 2).

    ``voxel_m``: side; ``max_points``: a voxel ignores further returns after so many.
    """

    def __init__(self, voxel_m: float, capacity: int = 1 << 17, max_points: int = 150) -> None:
        self.voxel_m = voxel_m
        self.max_points = max_points
        self.used = 0
        self._voxels = Voxels(
            np.full(capacity, _EMPTY, dtype=np.int64),
            np.zeros((capacity, _MOMENTS)),
            np.full(capacity, _NO_ANCHOR, dtype=np.int16),
            np.zeros((capacity, 3)),
        )

    def insert(self, points: Array, sensor: Array | None = None, owner: int = _NO_ANCHOR) -> None:
        """Adds (N, 3) points seen from ``sensor`` (3,), odom frame. ``owner``: see
        ``insert_points``; without it the voxels have no anchor."""
        self.used = insert_points(
            self._voxels, self.used, points, np.zeros(3) if sensor is None else sensor, owner,
            self.voxel_m, self.max_points,
        )  # fmt: skip

    def reassign(self, gone: int, successor: int, move: Pose) -> None:
        """Reassigns the voxels of anchor ``gone``, see ``reassign_voxels``."""
        reassign_voxels(self._voxels, gone, successor, Frame.of(move), self.voxel_m)

    def match(
        self, points_odom: Array, min_count: int = 8, max_thickness_m: float = 0.05
    ) -> PlaneMatches:
        """Returns the planes of (N, 3) points, see ``match_planes``. Anything thicker than
        ``max_thickness_m`` is foliage, whose height changes with the viewing angle."""
        margin = 0.12 * self.voxel_m
        return match_planes(
            self._voxels, points_odom, self.voxel_m, margin, min_count, max_thickness_m
        )
