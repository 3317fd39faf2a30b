"""Planes of image features from nearby LIDAR returns.

In a pinhole image the inverse depth of a plane is linear in the pixel, so that the plane
``n . P = 1`` of a feature is a small linear fit to the returns projected around it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from touchdown.estimator.filtering.error_state import Frame
from touchdown.sim.frames import Pose

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]

_CLOSE = 0.4
"""share of the neighbourhood whose returns give the depth of a feature on no plane"""
_MOST_SCATTER = 0.05
"""of the depth; beyond it the depth counts as unknown"""
_SIGMA_FACTOR = 2.0
"""assigned sigma in standard deviations of the scatter: the error is the same in all images that
show the feature"""


class RecentReturns:
    """Returns of the last few scans, odom frame, in a ring buffer of fixed size."""

    def __init__(self, scans: int = 15, per_scan: int = 12000) -> None:
        self._points = np.zeros((scans * per_scan, 3), dtype=np.float32)
        self._counts = np.zeros(scans, dtype=np.int64)
        self._per_scan = per_scan
        self._next = 0

    def add(self, points_odom: Array) -> None:
        """Adds at most ``per_scan`` evenly strided of (N, 3) points."""
        stride = max(1, -(-len(points_odom) // self._per_scan))
        part = points_odom[::stride]
        start = self._next * self._per_scan
        self._points[start : start + len(part)] = part
        self._counts[self._next] = len(part)
        self._next = (self._next + 1) % len(self._counts)

    def median_height(self) -> float | None:
        """Median height of the newest scan, m; None without returns."""
        newest = (self._next - 1) % len(self._counts)
        start, count = newest * self._per_scan, int(self._counts[newest])
        if count == 0:
            return None
        return float(np.median(self._points[start : start + count : 8, 2]))

    def view(self) -> tuple[Float32, NDArray[np.int64], int]:
        """All slots (S * per_scan, 3), the number filled in each, and ``per_scan``."""
        return self._points, self._counts, self._per_scan


class _Cells(NamedTuple):
    """Returns sorted by image cell, in normalised units."""

    starts: NDArray[np.int64]  # (rows * cols + 1,) first return of each cell
    seen: Array  # (K, 3) x, y, 1 / depth
    width: float  # of the image on each side of its axis
    height: float
    side: float  # of a cell


@njit(cache=True)
def _shape(width: float, height: float, side: float) -> tuple[int, int]:
    """Rows and columns of cells."""
    return int(2.0 * height / side) + 1, int(2.0 * width / side) + 1


@njit(cache=True)
def _project_into_cells(
    returns: tuple[Float32, NDArray[np.int64], int],
    camera_from_odom: Frame,
    width: float,
    height: float,
    cell: float,
) -> _Cells:
    """Sorts the visible ``returns``, as ``RecentReturns.view`` has them, by image cell."""
    points, counts, per_scan = returns
    rotation, translation = camera_from_odom
    rows, cols = _shape(width, height, cell)
    total = 0
    for s in range(counts.shape[0]):
        total += counts[s]
    seen = np.empty((total, 3))
    where = np.empty(total, dtype=np.int64)
    starts = np.zeros(rows * cols + 1, dtype=np.int64)
    kept = 0
    for s in range(counts.shape[0]):
        for i in range(s * per_scan, s * per_scan + counts[s]):
            px, py, pz = points[i, 0], points[i, 1], points[i, 2]
            z = rotation[2, 0] * px + rotation[2, 1] * py + rotation[2, 2] * pz + translation[2]
            if z < 0.1:
                continue
            x = rotation[0, 0] * px + rotation[0, 1] * py + rotation[0, 2] * pz + translation[0]
            y = rotation[1, 0] * px + rotation[1, 1] * py + rotation[1, 2] * pz + translation[1]
            x, y = x / z, y / z
            if abs(x) >= width or abs(y) >= height:
                continue
            slot = int((y + height) / cell) * cols + int((x + width) / cell)
            seen[kept, 0], seen[kept, 1], seen[kept, 2] = x, y, 1.0 / z
            where[kept] = slot
            starts[slot + 1] += 1
            kept += 1
    for k in range(rows * cols):
        starts[k + 1] += starts[k]
    cursor = starts[:-1].copy()
    ordered = np.empty((kept, 3))
    for i in range(kept):
        ordered[cursor[where[i]]] = seen[i]
        cursor[where[i]] += 1
    return _Cells(starts, ordered, width, height, cell)


@njit(cache=True)
def _gather(ray: Array, cells: _Cells, radius: float, near: Array) -> int:
    """Writes the returns within ``radius`` of a ray (2,) into ``near`` (M, 3): offset in radii and
    inverse depth; returns their number, M at most."""
    starts, seen, width, height, cell = cells
    rows, cols = _shape(width, height, cell)
    reach, count = int(np.ceil(radius / cell)), 0
    col, row = int((ray[0] + width) / cell), int((ray[1] + height) / cell)
    for r in range(max(0, row - reach), min(rows, row + reach + 1)):
        first = r * cols + max(0, col - reach)
        final = r * cols + min(cols, col + reach + 1)
        for i in range(starts[first], starts[final]):
            dx, dy = seen[i, 0] - ray[0], seen[i, 1] - ray[1]
            if dx * dx + dy * dy <= radius * radius and count < near.shape[0]:
                near[count, 0], near[count, 1] = dx / radius, dy / radius
                near[count, 2] = seen[i, 2]
                count += 1
    return count


@njit(cache=True)
def _fit_planes(
    rays: Array, cells: _Cells, radius: float, min_points: int, depth_tolerance: float
) -> tuple[NDArray[np.bool_], Array]:
    """Fits ``1 / z = a + b x + c y`` around each of (N, 2) rays; refuses depth steps."""
    valid = np.zeros(rays.shape[0], dtype=np.bool_)
    planes = np.zeros((rays.shape[0], 3))
    near = np.empty((512, 3))
    for k in range(rays.shape[0]):
        count = _gather(rays[k], cells, radius, near)
        if count < min_points:
            continue
        normal = np.zeros((3, 3))
        right = np.zeros(3)
        row_k = np.ones(3)
        for i in range(count):
            row_k[1], row_k[2] = near[i, 0], near[i, 1]
            for a in range(3):
                right[a] += row_k[a] * near[i, 2]
                for b in range(3):
                    normal[a, b] += row_k[a] * row_k[b]
        # returns on one line, or all to one side, leave the feature's own depth open
        if abs(normal[0, 1]) > 0.5 * count or abs(normal[0, 2]) > 0.5 * count:
            continue
        if normal[1, 1] < 0.03 * count or normal[2, 2] < 0.03 * count:
            continue
        fit = np.linalg.solve(normal + 1e-6 * count * np.eye(3), right)
        if not fit[0] > 1e-3:
            continue
        worst, total = 0.0, 0.0
        for i in range(count):
            predicted = fit[0] + fit[1] * near[i, 0] + fit[2] * near[i, 1]
            error = (near[i, 2] - predicted) / (fit[0] * fit[0])
            total += error * error
            worst = max(worst, abs(error))
        if np.sqrt(total / count) > depth_tolerance or worst > 4.0 * depth_tolerance:
            continue
        valid[k] = True
        planes[k, 0] = fit[1] / radius
        planes[k, 1] = fit[2] / radius
        planes[k, 2] = fit[0] - (fit[1] * rays[k, 0] + fit[2] * rays[k, 1]) / radius
    return valid, planes


@njit(cache=True)
def _rough_depths(
    rays: Array, cells: _Cells, radius: float, min_points: int, most_share: float
) -> tuple[NDArray[np.bool_], Array, Array]:
    """Depth of the foremost returns within ``radius`` of (N, 2) rays, and their scatter."""
    valid = np.zeros(rays.shape[0], dtype=np.bool_)
    depths, sigmas = np.zeros(rays.shape[0]), np.zeros(rays.shape[0])
    near = np.empty((256, 3))
    for k in range(rays.shape[0]):
        count = _gather(rays[k], cells, radius, near)
        if count < min_points:
            continue
        # the camera sees what is in front; returns from elsewhere looked past it
        two_thirds = (2 * count + 2) // 3
        front = np.sort(1.0 / near[:count, 2])[:two_thirds]
        depth = front[len(front) // 2]
        sigma = np.std(front)
        if sigma > most_share * depth:
            continue
        valid[k], depths[k], sigmas[k] = True, depth, sigma
    return valid, depths, sigmas


def feature_planes(
    rays: Array,
    recent: RecentReturns,
    camera_from_odom: Pose,
    half_view: tuple[float, float],
    *,
    radius: float,
    min_points: int = 6,
    depth_tolerance_m: float = 0.06,
) -> tuple[NDArray[np.bool_], Array, Array]:
    """Planes of features seen along (N, 2) normalised ``rays`` (x / z, y / z).

    ``half_view``: the image's half extents in the same units; ``radius``: of the neighbourhood.
    Returns valid (N,), planes (N, 3) with ``n . P = 1`` in the camera frame, and sigmas (N,), m
    along the ray, 0 for planes. A neighbourhood whose returns scatter by more than
    ``depth_tolerance_m`` is no plane, as in foliage: its feature is assigned the depth of the
    foremost returns close by, as a plane that faces the camera, and a sigma from their scatter.
    """
    width, height = half_view[0] * 1.02, half_view[1] * 1.02
    cells = _project_into_cells(recent.view(), Frame.of(camera_from_odom), width, height, radius)
    valid, planes = _fit_planes(rays, cells, radius, min_points, depth_tolerance_m)
    sigmas = np.zeros(len(rays))
    open_ = np.flatnonzero(~valid)
    rough, depths, scatter = _rough_depths(
        rays[open_], cells, _CLOSE * radius, min_points, _MOST_SCATTER
    )
    chosen = open_[rough]
    valid[chosen] = True
    facing = np.column_stack([rays[chosen], np.ones(len(chosen))])
    planes[chosen] = facing / (depths[rough] * np.einsum("ij,ij->i", facing, facing))[:, None]
    sigmas[chosen] = _SIGMA_FACTOR * scatter[rough]
    return valid, planes, sigmas
