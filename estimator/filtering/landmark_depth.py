"""Planes of image features from nearby LIDAR returns.

In a pinhole image the inverse depth of a plane is linear in the pixel, so that the plane
``n . P = 1`` of a feature is a small linear fit to the returns projected around it.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from touchdown.estimator.filtering.deskew import moved
from touchdown.estimator.filtering.error_state import Frame
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array, Float32, Indices, Int32, Mask

_CLOSE = 0.4
"""fraction of the neighbourhood whose returns give the depth of a feature on no plane"""
_MAX_SCATTER = 0.05
"""fraction of the depth; beyond it the depth counts as unknown"""
_SIGMA_FACTOR = 2.0
"""assigned sigma in standard deviations of the scatter: the error is the same in all images that
show the feature"""


_IDENTITY = Frame(np.eye(3), np.zeros(3))


class RecentReturns:
    """Returns of the last few ``scans``, odom frame, ``per_scan`` of each at most."""

    def __init__(self, scans: int = 15, per_scan: int = 12000) -> None:
        self._scans = [np.zeros((0, 3), np.float32)] * scans
        self._all = np.zeros((scans * per_scan, 3), np.float32)
        self._per_scan = per_scan
        self._next = 0

    def add(self, points: Array, odom_from_points: Frame = _IDENTITY) -> None:
        """Adds at most ``per_scan`` evenly strided of (N, 3) points."""
        stride = max(1, -(-len(points) // self._per_scan))
        chosen = np.arange(0, len(points), stride)
        self._scans[self._next] = moved(points, chosen, odom_from_points).astype(np.float32)
        self._next = (self._next + 1) % len(self._scans)

    def median_height(self) -> float | None:
        """Median height of the newest scan, m; None without returns."""
        newest = self._scans[self._next - 1]
        return float(np.median(newest[::8, 2])) if len(newest) else None

    def points(self) -> Float32:
        """All of them (N, 3), until the next call."""
        return np.concatenate(self._scans, out=self._all[: sum(map(len, self._scans))])


class _Cells(NamedTuple):
    """Returns sorted by image cell, in normalised units."""

    starts: Indices  # (rows * cols + 1,) first return of each cell
    seen: Float32  # (K, 3) x, y, 1 / depth
    width: float  # of the image on each side of its axis
    height: float
    side: float  # of a cell


@njit(cache=True, error_model="numpy")
def _shape(width: float, height: float, side: float) -> tuple[int, int]:
    """Rows and columns of cells."""
    return int(2.0 * height / side) + 1, int(2.0 * width / side) + 1


@njit(cache=True, error_model="numpy")
def _sort_into_cells(
    rays: Array, points: Float32, camera_from_odom: Frame, width: float, height: float, cell: float
) -> _Cells:
    """Sorts (P, 3) ``points`` by image cell: those visible in the cells around any of (N, 2)
    rays."""
    rows, cols = _shape(width, height, cell)
    near = np.zeros(rows * cols + 1, np.bool_)  # the last: out of view
    for k in range(rays.shape[0]):
        row, col = int((rays[k, 1] + height) / cell), int((rays[k, 0] + width) / cell)
        for a in range(max(0, row - 1), min(rows, row + 2)):
            for b in range(max(0, col - 1), min(cols, col + 2)):
                near[a * cols + b] = True
    starts, kept = np.zeros(rows * cols + 1, dtype=np.int64), 0
    where, chosen = np.empty(len(points), np.int32), np.empty(len(points), np.int32)
    _locate(points, camera_from_odom, (width, height, 1.0 / cell), cols, where)
    for i in range(len(points)):
        chosen[kept] = i
        kept += near[where[i]]
        starts[where[i] + 1] += near[where[i]]
    for k in range(rows * cols):
        starts[k + 1] += starts[k]
    cursor, ordered = starts.copy(), np.empty((starts[-1], 3), np.float32)
    r, t = camera_from_odom
    for k in range(kept):
        i = chosen[k]
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        inverse = 1.0 / (r[2, 0] * x + r[2, 1] * y + r[2, 2] * z + t[2])
        at = cursor[where[i]]
        ordered[at, 0] = (r[0, 0] * x + r[0, 1] * y + r[0, 2] * z + t[0]) * inverse
        ordered[at, 1] = (r[1, 0] * x + r[1, 1] * y + r[1, 2] * z + t[1]) * inverse
        ordered[at, 2] = inverse
        cursor[where[i]] += 1
    return _Cells(starts, ordered, width, height, cell)


_BLOCK = 256


@njit(cache=True, error_model="numpy")
def _locate(
    points: Float32,
    camera_from_odom: Frame,
    view: tuple[float, float, float],
    cols: int,
    cells: Int32,
) -> None:
    """Writes the cells (N,) of (N, 3) points, -1 for those out of ``view``: half width, half
    height, cells per unit. Block by block and without branches, the processor takes several points
    at a time."""
    r, t = camera_from_odom.rotation.astype(np.float32), camera_from_odom.translation
    xx, xy, xz, xt = r[0, 0], r[0, 1], r[0, 2], np.float32(t[0])
    yx, yy, yz, yt = r[1, 0], r[1, 1], r[1, 2], np.float32(t[1])
    zx, zy, zz, zt = r[2, 0], r[2, 1], r[2, 2], np.float32(t[2])
    width, height, scale = np.float32(view[0]), np.float32(view[1]), np.float32(view[2])
    nearest, one, none, per_row = np.float32(0.1), np.float32(1.0), np.int32(-1), np.int32(cols)
    px, py = np.empty(_BLOCK, np.float32), np.empty(_BLOCK, np.float32)
    pz = np.empty(_BLOCK, np.float32)
    for start in range(0, points.shape[0], _BLOCK):
        part = cells[start : start + _BLOCK]
        for i in range(part.shape[0]):
            px[i], py[i], pz[i] = points[start + i, 0], points[start + i, 1], points[start + i, 2]
        for i in range(part.shape[0]):
            z = zx * px[i] + zy * py[i] + zz * pz[i] + zt
            inverse = one / max(z, nearest)
            x = (xx * px[i] + xy * py[i] + xz * pz[i] + xt) * inverse
            y = (yx * px[i] + yy * py[i] + yz * pz[i] + yt) * inverse
            inside = (z >= nearest) & (abs(x) < width) & (abs(y) < height)
            column, row = np.int32((x + width) * scale), np.int32((y + height) * scale)
            part[i] = row * per_row + column if inside else none


@njit(cache=True, error_model="numpy")
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


@njit(cache=True, error_model="numpy")
def _fit_planes(
    rays: Array, cells: _Cells, radius: float, min_points: int, depth_tolerance: float
) -> tuple[Mask, Array]:
    """Fits ``1 / z = a + b x + c y`` around each of (N, 2) rays; refuses depth steps."""
    valid = np.zeros(rays.shape[0], dtype=np.bool_)
    planes = np.zeros((rays.shape[0], 3))
    near = np.empty((512, 3))
    for k in range(rays.shape[0]):
        count = _gather(rays[k], cells, radius, near)
        if count < min_points:
            continue
        sx, sy, sxx, sxy, syy = 0.0, 0.0, 0.0, 0.0, 0.0
        d, dx, dy = 0.0, 0.0, 0.0
        for i in range(count):
            x, y, inverse = near[i, 0], near[i, 1], near[i, 2]
            sx, sy, sxx, sxy, syy = sx + x, sy + y, sxx + x * x, sxy + x * y, syy + y * y
            d, dx, dy = d + inverse, dx + x * inverse, dy + y * inverse
        # returns on one line, or all to one side, leave the feature's own depth open
        if abs(sx) > 0.5 * count or abs(sy) > 0.5 * count:
            continue
        if sxx < 0.03 * count or syy < 0.03 * count:
            continue
        ridge = 1e-6 * count
        n, sxx, syy = count + ridge, sxx + ridge, syy + ridge
        of_a, of_b, of_c = sxx * syy - sxy * sxy, sy * sxy - sx * syy, sx * sxy - sy * sxx
        det = n * of_a + sx * of_b + sy * of_c
        a = (of_a * d + of_b * dx + of_c * dy) / det
        b = (of_b * d + (n * syy - sy * sy) * dx + (sx * sy - n * sxy) * dy) / det
        c = (of_c * d + (sx * sy - n * sxy) * dx + (n * sxx - sx * sx) * dy) / det
        if not a > 1e-3:
            continue
        worst, total = 0.0, 0.0
        for i in range(count):
            error = (near[i, 2] - (a + b * near[i, 0] + c * near[i, 1])) / (a * a)
            total += error * error
            worst = max(worst, abs(error))
        if np.sqrt(total / count) > depth_tolerance or worst > 4.0 * depth_tolerance:
            continue
        valid[k] = True
        planes[k, 0], planes[k, 1] = b / radius, c / radius
        planes[k, 2] = a - (b * rays[k, 0] + c * rays[k, 1]) / radius
    return valid, planes


@njit(cache=True, error_model="numpy")
def _rough_depths(
    rays: Array, cells: _Cells, radius: float, min_points: int, max_fraction: float
) -> tuple[Mask, Array, Array]:
    """Depth of the foremost returns within ``radius`` of (N, 2) rays, and their scatter."""
    valid = np.zeros(rays.shape[0], dtype=np.bool_)
    depths, sigmas = np.zeros(rays.shape[0]), np.zeros(rays.shape[0])
    near, front = np.empty((256, 3)), np.empty(256)
    for k in range(rays.shape[0]):
        count = _gather(rays[k], cells, radius, near)
        if count < min_points:
            continue
        for i in range(count):
            front[i] = 1.0 / near[i, 2]
        front[:count].sort()
        # the camera sees what is in front; returns from elsewhere looked past it
        two_thirds = (2 * count + 2) // 3
        depth, sigma = front[two_thirds // 2], front[:two_thirds].std()
        if sigma > max_fraction * depth:
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
) -> tuple[Mask, Array, Array]:
    """Planes of features seen along (N, 2) normalised ``rays`` (x / z, y / z).

    ``half_view``: the image's half extents in the same units; ``radius``: of the neighbourhood.
    Returns valid (N,), planes (N, 3) with ``n . P = 1`` in the camera frame, and sigmas (N,), m
    along the ray, 0 for planes. A neighbourhood whose returns scatter by more than
    ``depth_tolerance_m`` is no plane, as in foliage: its feature is assigned the depth of the
    foremost returns close by, as a plane that faces the camera, and a sigma from their scatter.
    """
    width, height = half_view[0] * 1.02, half_view[1] * 1.02
    rays, frame = np.ascontiguousarray(rays), Frame.of(camera_from_odom)
    cells = _sort_into_cells(rays, recent.points(), frame, width, height, radius)
    valid, planes = _fit_planes(rays, cells, radius, min_points, depth_tolerance_m)
    sigmas = np.zeros(len(rays))
    open_ = np.flatnonzero(~valid)
    rough, depths, scatter = _rough_depths(
        rays[open_], cells, _CLOSE * radius, min_points, _MAX_SCATTER
    )
    chosen = open_[rough]
    valid[chosen] = True
    facing = np.column_stack([rays[chosen], np.ones(len(chosen))])
    planes[chosen] = facing / (depths[rough] * np.einsum("ij,ij->i", facing, facing))[:, None]
    sigmas[chosen] = _SIGMA_FACTOR * scatter[rough]
    return valid, planes, sigmas
