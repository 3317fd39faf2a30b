"""Fast ray casting on open terrain.

Most pulses of a LIDAR that looks down meet nothing but the height field. Marching them over its
grid costs a third of a general ray cast. Cells that hold anything else are closed: a ray that comes
below the lid of such a cell is left to the general ray caster.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from touchdown.sim.geometry.ray_target import Hits
from touchdown.sim.typing import Array, Float32, Indices, Int32

_STEEPEST = -0.05
"""Rays flatter than this would cross too many cells: the general ray caster is faster."""
_BELOW_M = 1e-6
_BLOCK_BITS = 3
_BLOCK = 1 << _BLOCK_BITS
"""Cells along a side of the blocks that far-off rays skip at once."""
_MOST_PIECES = 64
_PAST_SIDE = 1e-9
_OVER, _FROM_BELOW = -1.0, -2.0
_BEAM_M = 0.15
"""Half a beam's width where it reaches the ground, with a margin."""


@dataclass(frozen=True, slots=True)
class GroundGrid:
    """A height field in world axes: node (row, col) at ``origin + (col, row) * cell``; a cell is
    cut from its (row, col) to its (row + 1, col + 1) corner."""

    geom: int
    origin: Array
    """(2,) world metres"""
    cell: Array
    """(2,) metres along x and y"""
    heights: Float32
    """(rows, cols) world metres"""
    lids: Float32
    """(rows - 1, cols - 1) highest ground, or higher where something else stands"""
    closed: Float32
    """(rows - 1, cols - 1) highest point of what else a beam in the cell may touch; -inf: none"""
    block_lids: Float32
    """the highest of ``lids`` in blocks of 8 x 8 cells"""

    @staticmethod
    def of(geom: int, origin: Array, cell: Array, heights: Array, clutter: Array) -> GroundGrid:
        """``clutter`` (T, 3, 3): corners of all other fixed triangles in the world."""
        corners = [heights[:-1, :-1], heights[:-1, 1:], heights[1:, :-1], heights[1:, 1:]]
        closed = np.full(corners[0].shape, -np.inf)
        _close(closed, np.min(corners, axis=0).astype(np.float64), origin, cell, clutter)
        up = np.float32(np.inf)
        lids = np.maximum(np.max(corners, axis=0), closed).astype(np.float32)
        lids = np.nextafter(lids, up)
        return GroundGrid(
            geom,
            np.asarray(origin, dtype=np.float64),
            np.asarray(cell, dtype=np.float64),
            np.ascontiguousarray(heights, dtype=np.float32),
            lids,
            np.nextafter(closed.astype(np.float32), up),
            _block_lids(lids),
        )

    def march(self, rays: Float32, hits: Hits) -> Indices:
        """Fills in ``hits`` of the rays (N, 6): those that fall on open ground. The others, which
        are returned, meet nothing."""
        return _march(
            rays, self.geom, self.origin, self.cell, self.heights, self.lids, self.closed,
            self.block_lids, hits.distance, hits.geom, hits.cosine,
        )  # fmt: skip


def _block_lids(lids: Float32) -> Float32:
    rows, cols = (-(-size // _BLOCK) for size in lids.shape)
    padded = np.full((rows * _BLOCK, cols * _BLOCK), -np.inf, dtype=np.float32)
    padded[: lids.shape[0], : lids.shape[1]] = lids
    blocks: Float32 = padded.reshape(rows, _BLOCK, cols, _BLOCK).max(axis=(1, 3))
    return blocks


@njit(cache=True)
def _close(closed: Array, ground: Array, origin: Array, cell: Array, clutter: Array) -> None:
    """Raises ``closed`` to other surfaces, triangles (T, 3, 3), with room around them for the width
    of a beam; what lies below ``ground`` closes nothing."""
    for k in range(clutter.shape[0]):
        corner, across, along = clutter[k, 0], clutter[k, 1], clutter[k, 2]
        span = 0.0
        for axis in range(2):
            low = min(corner[axis], across[axis], along[axis])
            span = max(span, (max(corner[axis], across[axis], along[axis]) - low) / cell[axis])
        # Pieces of about a cell, so that their boxes follow the slope of a large triangle.
        pieces = min(max(1, math.ceil(span)), _MOST_PIECES)
        for i in range(pieces):
            for j in range(pieces - i):
                _close_piece(closed, ground, origin, cell, corner, across, along, i, j, pieces)


@njit(cache=True)
def _close_piece(
    closed: Array,
    ground: Array,
    origin: Array,
    cell: Array,
    corner: Array,
    across: Array,
    along: Array,
    i: int,
    j: int,
    pieces: int,
) -> None:
    """The parallelogram (i, j) of a triangle cut into ``pieces`` along each side; where it sticks
    out, its box still holds the half that belongs to the triangle."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for n in range(4):
        a, b = (i + n % 2) / pieces, (j + n // 2) / pieces
        if a + b > 1.0 + 1e-9:
            continue
        for axis in range(3):
            at = corner[axis] + a * (across[axis] - corner[axis]) + b * (along[axis] - corner[axis])
            low[axis], high[axis] = min(low[axis], at), max(high[axis], at)
    rows, cols = closed.shape
    first_row = max(0, math.floor((low[1] - _BEAM_M - origin[1]) / cell[1]))
    last_row = min(rows - 1, math.floor((high[1] + _BEAM_M - origin[1]) / cell[1]))
    first_col = max(0, math.floor((low[0] - _BEAM_M - origin[0]) / cell[0]))
    last_col = min(cols - 1, math.floor((high[0] + _BEAM_M - origin[0]) / cell[0]))
    for row in range(first_row, last_row + 1):
        for col in range(first_col, last_col + 1):
            if high[2] >= ground[row, col]:
                closed[row, col] = max(closed[row, col], high[2])


@njit(cache=True, nogil=True, error_model="numpy")
def _march(
    rays: Float32,
    ground_geom: int,
    origin: Array,
    cell: Array,
    heights: Float32,
    lids: Float32,
    closed: Float32,
    block_lids: Float32,
    distance: Float32,
    geom: Int32,
    cosine: Float32,
) -> Indices:
    """Grid traversal after Amanatides and Woo, "A fast voxel traversal algorithm for ray tracing",
    Eurographics 1987. One function, since handing arrays on costs more than a step of the march."""
    rows, cols = lids.shape
    scale_x, scale_y = 1.0 / cell[0], 1.0 / cell[1]
    highest = float(block_lids.max())
    others = np.empty(rays.shape[0], dtype=np.int64)
    count = 0
    for i in range(rays.shape[0]):
        dz = float(rays[i, 5])
        distance[i], geom[i], cosine[i] = np.inf, -1, 0.0
        others[count] = i
        count += 1
        if dz > _STEEPEST:
            continue
        # Position and slope in cells; z stays in metres.
        u, v, z = (rays[i, 0] - origin[0]) * scale_x, (rays[i, 1] - origin[1]) * scale_y, rays[i, 2]
        du, dv = rays[i, 3] * scale_x, rays[i, 4] * scale_y
        wide_x, wide_y = abs(1.0 / du), abs(1.0 / dv)
        t = max(0.0, (highest - z) / dz)
        while True:  # over blocks, to the first that the ray may end in
            x, y = u + t * du, v + t * dv
            if not (0.0 <= x < cols and 0.0 <= y < rows):
                break
            block_x, block_y = int(x) >> _BLOCK_BITS, int(y) >> _BLOCK_BITS
            leave = t + min(
                _to_side(x, block_x * _BLOCK, _BLOCK, du, wide_x),
                _to_side(y, block_y * _BLOCK, _BLOCK, dv, wide_y),
            )
            lid = block_lids[block_y, block_x]
            if z + leave * dz <= lid:
                t = max(t, min(leave, (lid - z) / dz))
                break
            t = leave + _PAST_SIDE
        x, y = u + t * du, v + t * dv
        if not (0.0 <= x < cols and 0.0 <= y < rows):
            continue
        col, row = int(x), int(y)
        next_x = t + _to_side(x, col, 1, du, wide_x)
        next_y = t + _to_side(y, row, 1, dv, wide_y)
        while 0 <= col < cols and 0 <= row < rows:
            leave = min(next_x, next_y)
            low = z + leave * dz
            if low <= lids[row, col]:
                if low <= closed[row, col]:
                    break
                near, right = heights[row, col], heights[row, col + 1]
                above, far = heights[row + 1, col], heights[row + 1, col + 1]
                found, gx, gy = _land(
                    u - col, v - row, z, du, dv, dz, t, leave, near, right, above, far
                )
                if found >= 0.0:
                    gx, gy = gx * scale_x, gy * scale_y
                    distance[i], geom[i] = found, ground_geom
                    cosine[i] = (gx * rays[i, 3] + gy * rays[i, 4] - dz) / math.sqrt(
                        gx * gx + gy * gy + 1.0
                    )
                    count -= 1
                    break
                if found == _FROM_BELOW:
                    break
            t = leave
            if next_x < next_y:
                col += 1 if du > 0.0 else -1
                next_x += wide_x
            else:
                row += 1 if dv > 0.0 else -1
                next_y += wide_y
    return others[:count].copy()


@njit(cache=True, forceinline=True, error_model="numpy")
def _to_side(at: float, low: float, size: float, slope: float, wide: float) -> float:
    """Distance along a ray to where it leaves the interval of a given ``size`` from ``low``."""
    if slope == 0.0:
        return np.inf
    return ((low + size - at) if slope > 0.0 else (at - low)) * wide


@njit(cache=True, forceinline=True, error_model="numpy")
def _land(
    u: float,
    v: float,
    z: float,
    du: float,
    dv: float,
    dz: float,
    start: float,
    end: float,
    near: float,
    right: float,
    above: float,
    far: float,
) -> tuple[float, float, float]:
    """Distance between ``start`` and ``end`` at which a ray lands on one of the two triangles of a
    cell, and their slopes per cell. (u, v): its origin from the cell's corner (``near``); then come
    the corners beside it in x and y and the ``far`` one. Or `_OVER` or `_FROM_BELOW`."""
    if end == np.inf:  # straight down
        end = start + 2.0 * (z + start * dz - min(near, right, above, far) + 1.0) / -dz
    side_start = (u - v) + start * (du - dv)
    side_end = (u - v) + end * (du - dv)
    middle = end
    if side_start * side_end < 0.0:
        middle = start + (end - start) * side_start / (side_start - side_end)
    first, last, side = start, middle, side_start if middle < end else side_start + side_end
    for _ in range(2):
        gx = right - near if side >= 0.0 else far - above
        gy = far - right if side >= 0.0 else above - near
        over, gap = z - near - gx * u - gy * v, dz - gx * du - gy * dv
        begin, finish = over + first * gap, over + last * gap
        if begin < -_BELOW_M:
            return _FROM_BELOW, 0.0, 0.0
        if finish <= 0.0:
            return first + (last - first) * max(begin, 0.0) / max(begin - finish, 1e-12), gx, gy
        first, last, side = middle, end, side_end
        if last <= first:
            break
    return _OVER, 0.0, 0.0
