"""The surface below the vehicle: returns of the last scans on a grid that moves with it.

Cells lie along the axes of odom and stay where they are for seconds: what an estimate drifts by in
that time is less than a cell. Nothing is kept for longer.
"""

from typing import NamedTuple

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from touchdown.sim.api import LidarScan
from touchdown.sim.frames import Pose, PoseHistory
from touchdown.sim.typing import Array, Float32

CELL_M = 0.2
CELLS, WIDE_CELLS = 90, 150
"""along a side: the swath of a 70 degree field of view from 12 m, and some way of the vehicle; of a
LIDAR that looks around, as far as a rider comes in the last seconds"""
_AROUND = 0.5
"""cosine of the angle from straight down beyond which one that looks around sees, too"""
TALL_M = 0.25
"""height above the ground from which a return is from something that stands on it: above grass,
meadow and the roughness of what is landed on"""
_TALL_SHARE = 0.6
"""of a cell's returns: through plants and dust more of them come from the ground"""
_ASIDE_TALL_M, _ASIDE_SHARE = 0.35, 0.25
"""the same of what is seen from the side: pulses pass between legs and under an animal"""
_STEEP, _UP_M = 3.0, 3.0
"""distance as a multiple of the LIDAR's height, and that height, from which on plants that are seen
along their tops seem to rise"""
_FREE_M = 0.15
_WIDEST_M = 2.2
"""width up to which something stands on the ground rather than being it"""
_RECENTRE_M = 1.0
_KNOTS = 5
"""poses along a scan"""
_MEMORY_S = 2.0
"""age at which the lowest returns of a cell are forgotten at first; twice that at last"""
_PLANE_OFF_M = 0.3
_LOWEST_M = 0.05
"""by which noise takes the lowest of many returns below the ground"""
_DRIFT_M = 0.04
"""difference of the lowest returns of two scans beyond noise"""

Mask = NDArray[np.bool_]


class Layers(NamedTuple):
    """What the last two scans show, (N, N) for a grid of N cells along a side, row = y."""

    tall: Mask
    """something stands there"""
    alone: Mask
    """the last scan alone shows it"""
    newest: Mask
    """the last scan alone has a return from above the ground there"""
    steep: Mask
    """it is looked at from above rather than along the ground"""
    free: Mask
    """ground without anything on it"""
    returns: Float32
    """number of them"""
    fresh: Float32
    """the same of the last scan"""
    low: Float32
    """z of the lowest return of the last seconds; inf without one"""
    ground: Float32
    """z of the ground, odom frame; NaN where it is not known"""
    high: Float32
    """z of the highest return; -inf without one"""


class _Scan(NamedTuple):
    """One scan: cells and heights of its returns, number and highest of each cell."""

    cells: NDArray[np.int64]
    heights: Float32
    returns: Float32
    high: Float32


class Surface:
    """Returns of the last scans about the vehicle."""

    def __init__(self, body_from_lidar: Pose) -> None:
        self._body_from_lidar = body_from_lidar
        self._renewed_s = -np.inf
        self._lows = np.full((2, CELLS, CELLS), np.inf, np.float32)
        self._sized = False
        self._before: _Scan | None = None
        self._around = False
        """whether the LIDAR looks around"""
        self.corner: Array = np.zeros(2)
        """(2,) corner of the grid, odom frame, a multiple of the cell"""
        self.shift = (0, 0)
        """rows and columns by which the last scan has moved the grid"""

    def clear(self) -> None:
        """Forgets all."""
        self._lows.fill(np.inf)
        self._renewed_s = -np.inf
        self._before = None

    def add(self, scan: LidarScan, poses: PoseHistory) -> Layers | None:
        """Returns what a scan and the one before show; None where the poses of the body do not
        span it."""
        knots = [
            poses.at(time_s) for time_s in np.linspace(scan.start_time_s, scan.end_time_s, _KNOTS)
        ]
        if any(pose is None for pose in knots):
            return None
        mounted = [pose @ self._body_from_lidar for pose in knots if pose is not None]
        if not self._sized:
            self._sized = True
            down = -scan.directions @ self._body_from_lidar.rotation[2].astype(np.float32)
            self._around = float(np.quantile(down, 0.1)) < _AROUND
            if self._around:
                self._lows = np.full((2, WIDE_CELLS, WIDE_CELLS), np.inf, np.float32)
        size = self._lows.shape[1:]
        middle = mounted[-1].translation[:2]
        self._follow(middle)
        if scan.end_time_s - self._renewed_s > _MEMORY_S:
            self._renewed_s = scan.end_time_s
            self._lows[1] = self._lows[0]
            self._lows[0].fill(np.inf)
        count = np.zeros(size, np.float32)
        low = np.full(size, np.inf, np.float32)
        high = np.full(size, -np.inf, np.float32)
        cells, heights = binned(
            scan.directions, scan.ranges, scan.time_offsets,
            np.stack([pose.rotation for pose in mounted]),
            np.stack([pose.translation for pose in mounted]) - [*self.corner, 0.0],
            (scan.end_time_s - scan.start_time_s) / (_KNOTS - 1),
            count, low, high,
        )  # fmt: skip
        self._keep(low)
        before, self._before = self._before, _Scan(cells, heights, count, high)
        lowest = np.minimum(self._lows[0], self._lows[1])
        ground = ground_below(lowest)
        at = (np.arange(size[0]) + 0.5) * CELL_M + self.corner[:, None] - middle[:, None]
        away, up = np.hypot(at[0], at[1][:, None]), mounted[-1].translation[2] - ground
        aside = (away > up) & self._around
        steep = (away < _STEEP * up) & (up > _UP_M)
        newest = high > ground + TALL_M
        alone = _stands(self._before, ground, aside)
        stands, fresh = alone, count
        if before is not None and self.shift == (0, 0):
            both = _Scan(
                np.concatenate([before.cells, cells]), np.concatenate([before.heights, heights]),
                before.returns + count, np.maximum(before.high, high),
            )  # fmt: skip
            stands = alone | _stands(both, ground, aside)
            _, _, count, high = both
        free = (count > 0.0) & (high < ground + _FREE_M)
        return Layers(stands, alone, newest, steep, free, count, fresh, lowest, ground, high)

    def _keep(self, low: Float32) -> None:
        """Adds the lowest returns of a scan. The ones before move with the ground as it is now: the
        height that an estimate gives may drift."""
        before = np.minimum(self._lows[0], self._lows[1])
        both = np.isfinite(low) & np.isfinite(before)
        if both.any():
            off = float(np.median(low[both] - before[both]))
            if abs(off) > _DRIFT_M:
                self._lows += np.float32(off)
        self._lows[0] = np.minimum(self._lows[0], low)

    def _follow(self, middle: Array) -> None:
        """Moves the grid by whole cells where the vehicle has left its middle."""
        centred = np.round((middle - 0.5 * self._lows.shape[1] * CELL_M) / CELL_M)
        before = np.round(self.corner / CELL_M)
        self.shift = (0, 0)
        if np.max(np.abs(centred - before)) * CELL_M > _RECENTRE_M:
            cols, rows = (before - centred).astype(int).tolist()
            self.shift = rows, cols
            self.corner = centred * CELL_M
            self._lows = np.stack([shifted(low, self.shift, np.inf) for low in self._lows])


def _stands(scan: _Scan, ground: Float32, aside: Mask) -> Mask:
    """Where something stands on the ground. ``aside``: what is seen from the side."""
    above, count = scan.heights - ground.ravel()[scan.cells], scan.returns

    def taller(least_m: float) -> Float32:
        per_cell = np.bincount(scan.cells[above > least_m], minlength=count.size)
        return per_cell.reshape(count.shape).astype(np.float32)

    pulses = np.maximum(count, 1.0)
    stands: Mask = (taller(TALL_M) >= _TALL_SHARE * pulses) & (count >= 2.0)
    if aside.any():
        tall = taller(_ASIDE_TALL_M)
        stands |= aside & (tall >= _ASIDE_SHARE * pulses) & (tall >= 2)
    return stands


def shifted(layer: NDArray, by: tuple[int, int], blank: float) -> NDArray:  # type: ignore[type-arg]
    """Returns a layer moved by rows and columns, with ``blank`` in what comes in."""
    moved = np.full_like(layer, blank)
    rows, cols = layer.shape
    (r, c), size = by, max(rows, cols)
    if max(abs(r), abs(c)) < size:
        moved[max(r, 0) : rows + min(r, 0), max(c, 0) : cols + min(c, 0)] = layer[
            max(-r, 0) : rows + min(-r, 0), max(-c, 0) : cols + min(-c, 0)
        ]
    return moved


def ground_below(lows: Float32) -> Float32:
    """Returns the ground under the lowest returns (N, N), +inf where there are none: their
    plane, and what of the rest is wider than ``_WIDEST_M``. NaN where nothing is near."""
    known = np.isfinite(lows)
    if known.sum() < 10:
        return np.full_like(lows, np.nan)
    plane = _plane(lows, known)
    rest = np.where(known, lows - plane, np.float32(np.inf))
    window = np.ones((1 + 2 * int(0.5 * _WIDEST_M / CELL_M),) * 2, np.uint8)
    lowest = cv2.erode(rest, window, borderType=cv2.BORDER_CONSTANT, borderValue=np.inf)
    lowest = np.where(known, lowest, np.float32(-np.inf))
    opened = cv2.dilate(lowest, window, borderType=cv2.BORDER_CONSTANT, borderValue=-np.inf)
    return np.where(np.isfinite(opened), plane + opened + _LOWEST_M, np.nan).astype(np.float32)


def _plane(lows: Float32, known: Mask) -> Float32:
    """Returns the plane (N, N) of most of the lowest returns, from below."""
    rows, cols = np.nonzero(known)
    z = lows[known].astype(np.float64)
    design = np.column_stack([np.ones(z.size), cols, rows]).astype(np.float64)
    solution = np.array([np.quantile(z, 0.3), 0.0, 0.0])
    for limit in (4.0 * _PLANE_OFF_M, 2.0 * _PLANE_OFF_M, _PLANE_OFF_M):
        near = np.abs(z - design @ solution) < limit
        if near.sum() < 10:
            break
        kept = design[near]
        normal = kept.T @ kept + 1e-6 * np.eye(3)
        solution = np.linalg.solve(normal, kept.T @ z[near])
    at = np.arange(len(lows))
    plane = solution[0] + solution[1] * at[None, :] + solution[2] * at[:, None]
    return plane.astype(np.float32)


@njit(cache=True, error_model="numpy")
def binned(
    directions: Float32,
    ranges: Float32,
    times: Float32,
    rotations: Array,
    positions: Array,
    step_s: float,
    count: Float32,
    low: Float32,
    high: Float32,
) -> tuple[NDArray[np.int64], Float32]:
    """Adds the returns of a scan to the layers; returns the flat cells of those inside and their
    heights. ``rotations`` (K, 3, 3), ``positions`` (K, 3): of the LIDAR every ``step_s`` seconds of
    the scan, from the corner of the grid."""
    cells = np.empty(ranges.shape[0], np.int64)
    heights = np.empty(ranges.shape[0], np.float32)
    point, inside, last = np.empty(3), 0, rotations.shape[0] - 2
    size = count.shape[0]
    for i in range(ranges.shape[0]):
        r = ranges[i]
        if not 0.0 < r < 60.0:
            continue
        at = times[i] / step_s
        k = min(max(int(at), 0), last)
        f = at - k
        x, y, z = r * directions[i, 0], r * directions[i, 1], r * directions[i, 2]
        for axis in range(3):
            turn, then = rotations[k, axis], rotations[k + 1, axis]
            point[axis] = (
                (turn[0] + f * (then[0] - turn[0])) * x
                + (turn[1] + f * (then[1] - turn[1])) * y
                + (turn[2] + f * (then[2] - turn[2])) * z
                + positions[k, axis] + f * (positions[k + 1, axis] - positions[k, axis])
            )  # fmt: skip
        col, row = int(np.floor(point[0] / CELL_M)), int(np.floor(point[1] / CELL_M))
        if not (0 <= col < size and 0 <= row < size):
            continue
        height = np.float32(point[2])
        count[row, col] += 1.0
        low[row, col] = min(low[row, col], height)
        high[row, col] = max(high[row, col], height)
        cells[inside] = row * size + col
        heights[inside] = height
        inside += 1
    return cells[:inside], heights[:inside]
