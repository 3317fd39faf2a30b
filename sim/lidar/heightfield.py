"""Fast ray casting on open terrain.

Most pulses of a LIDAR that looks down meet nothing but the height field. Where one may land is
guessed from the last one and settled by Newton's method, a fifth of the work of a general ray cast.
That nothing is met before follows from a horizon map (Max, "Horizon mapping: shadows for
bump-mapped surfaces", The Visual Computer 4, 1988): how steep a ray has to be that comes down in a
cell. All other rays are left to the general ray caster.
"""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from touchdown.sim.geometry.ray_target import Hits
from touchdown.sim.typing import Array, Bytes, Float32, Indices

_SLOPES: Array = np.array([np.inf, 3.4, 2.4, 1.7, 1.2, 0.84, 0.6, 0.42, 0.3])
"""Levels of the horizon map, metres down per metre along; inf where something stands"""
_FLATTEST = -0.28
"""Downward part of a ray that is less steep than the last of them"""
_TRIES = 3
_MAX_PIECES = 64
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
    free: Bytes
    """(4, rows - 1, cols - 1) level of the horizon map: a steeper ray that comes down in the cell
    has met nothing before. Rays come from greater x and y, smaller x, smaller y, both smaller."""

    @staticmethod
    def of(geom: int, origin: Array, cell: Array, heights: Array, clutter: Array) -> "GroundGrid":
        """``clutter`` (T, 3, 3): corners of all other fixed triangles in the world. The grid made
        has cells of half the side, since what stands on one leaves all of it to others."""
        nodes, cell = _halved(heights.astype(np.float32)), np.asarray(cell, np.float64) / 2
        near, right = nodes[:-1, :-1], nodes[:-1, 1:]
        above, far = nodes[1:, :-1], nodes[1:, 1:]
        corners = np.array([near, right, above, far], dtype=np.float64)
        low = corners.min(axis=0)
        closed = np.full(low.shape, -np.inf)
        _close(closed, low, origin, cell, clutter)
        east = np.maximum(abs(right - near), abs(far - above)) / cell[0]
        north = np.maximum(abs(far - right), abs(above - near)) / cell[1]
        slope = np.where(closed > -np.inf, np.inf, np.hypot(east, north))
        lids = np.maximum(corners.max(axis=0), closed)
        free = np.zeros((4, *low.shape), dtype=np.uint8)
        for quadrant in range(4):
            turned = np.s_[:: 2 * (quadrant // 2) - 1, :: 2 * (quadrant % 2) - 1]
            part = np.zeros(low.shape, dtype=np.uint8)
            lid, floor, steep = (np.ascontiguousarray(one[turned]) for one in (lids, low, slope))
            _map_horizon(lid, floor, steep, min(cell), part)
            free[quadrant][turned] = part
        return GroundGrid(geom, np.asarray(origin, dtype=np.float64), cell, nodes, free)

    def land(self, rays: Float32, hits: Hits) -> Indices:
        """Fills in ``hits`` of the rays (N, 6): those that fall on open ground. The others, which
        are returned, meet nothing."""
        return _land(rays, self.geom, self.origin, self.cell, self.heights, self.free, hits)


def _halved(heights: Float32) -> Float32:
    """The same surface with twice as many cells in rows and columns."""
    rows, cols = heights.shape
    out = np.empty((2 * rows - 1, 2 * cols - 1), dtype=np.float32)
    out[::2, ::2] = heights
    out[1::2, ::2] = 0.5 * (heights[:-1] + heights[1:])
    out[::2, 1::2] = 0.5 * (heights[:, :-1] + heights[:, 1:])
    out[1::2, 1::2] = 0.5 * (heights[:-1, :-1] + heights[1:, 1:])
    return out


@njit(cache=True, error_model="numpy")
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
        pieces = min(max(1, math.ceil(span)), _MAX_PIECES)
        for i in range(pieces):
            for j in range(pieces - i):
                _close_piece(closed, ground, origin, cell, corner, across, along, i, j, pieces)


@njit(cache=True, error_model="numpy")
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
    left = front = np.inf
    right = back = top = -np.inf
    for n in range(4):
        a, b = (i + n % 2) / pieces, (j + n // 2) / pieces
        if a + b > 1.0 + 1e-9:
            continue
        x = corner[0] + a * (across[0] - corner[0]) + b * (along[0] - corner[0])
        y = corner[1] + a * (across[1] - corner[1]) + b * (along[1] - corner[1])
        z = corner[2] + a * (across[2] - corner[2]) + b * (along[2] - corner[2])
        left, right = min(left, x), max(right, x)
        front, back, top = min(front, y), max(back, y), max(top, z)
    rows, cols = closed.shape
    first_row = max(0, math.floor((front - _BEAM_M - origin[1]) / cell[1]))
    last_row = min(rows - 1, math.floor((back + _BEAM_M - origin[1]) / cell[1]))
    first_col = max(0, math.floor((left - _BEAM_M - origin[0]) / cell[0]))
    last_col = min(cols - 1, math.floor((right + _BEAM_M - origin[0]) / cell[0]))
    for row in range(first_row, last_row + 1):
        for col in range(first_col, last_col + 1):
            if top >= ground[row, col]:
                closed[row, col] = max(closed[row, col], top)


@njit(cache=True, error_model="numpy")
def _map_horizon(lids: Array, low: Array, slope: Array, side: float, free: Bytes) -> None:
    """Fills one quadrant of `GroundGrid.free`, turned so that the rays come from smaller rows and
    columns, from the highest and lowest points of all cells and the slopes of the ground."""
    rows, cols = lids.shape
    for level in range(1, _SLOPES.shape[0]):
        drop = _SLOPES[level] * side
        over = lids.copy()  # and falls by a drop at most from cell to cell
        for row in range(1, rows):
            for col in range(1, cols):
                before = max(over[row - 1, col], over[row, col - 1], over[row - 1, col - 1])
                over[row, col] = max(over[row, col], before - drop)
        for row in range(3, rows):
            for col in range(3, cols):
                # A ray has risen by a drop before it leaves the neighbours, which it only meets if
                # they are as steep as itself.
                beyond = max(over[row - 2, col], over[row - 2, col - 1], over[row - 2, col - 2],
                             over[row - 1, col - 2], over[row, col - 2])  # fmt: skip
                steep = max(slope[row - 1, col], slope[row, col - 1], slope[row - 1, col - 1])
                if beyond - drop < low[row, col] and max(steep, slope[row, col]) < _SLOPES[level]:
                    free[row, col] = level


@njit(cache=True, nogil=True, error_model="numpy")
def _land(
    rays: Float32,
    ground_geom: int,
    origin: Array,
    cell: Array,
    heights: Float32,
    free: Bytes,
    hits: Hits,
) -> Indices:
    """As `GroundGrid.land`."""
    distance, geom, cosine = hits
    _, rows, cols = free.shape
    scale_x, scale_y, one = 1.0 / cell[0], 1.0 / cell[1], np.uint64(1)
    others = np.empty(rays.shape[0], dtype=np.int64)
    count, level = 0, heights[rows // 2, cols // 2]
    for i in range(rays.shape[0]):
        distance[i], geom[i], cosine[i] = np.inf, -1, 0.0
        others[count] = i
        count += 1
        dz = float(rays[i, 5])
        if dz > _FLATTEST:
            continue
        # Position and slope in cells; z stays in metres.
        u, v, z = (rays[i, 0] - origin[0]) * scale_x, (rays[i, 1] - origin[1]) * scale_y, rays[i, 2]
        du, dv = rays[i, 3] * scale_x, rays[i, 4] * scale_y
        t = (level - z) / dz
        for _ in range(_TRIES):
            col = np.uint64(min(max(int(u + t * du), 0), cols - 1))
            row = np.uint64(min(max(int(v + t * dv), 0), rows - 1))
            near, right = heights[row, col], heights[row, col + one]
            above, far = heights[row + one, col], heights[row + one, col + one]
            x, y = u - float(col), v - float(row)
            lower = x - y + t * (du - dv) >= 0.0
            gx, gy = right - near if lower else far - above, far - right if lower else above - near
            t = (near + gx * x + gy * y - z) / (dz - gx * du - gy * dv)
            x, y = x + t * du, y + t * dv
            found = (x >= 0.0) & (x < 1.0) & (y >= 0.0) & (y < 1.0) & (lower == (x - y >= 0.0))
            if found:
                break
        level = near
        slope = _SLOPES[free[np.uint64(2 * (dv > 0.0) + (du > 0.0)), row, col]]
        flat = rays[i, 3] * rays[i, 3] + rays[i, 4] * rays[i, 4]
        inside = (u >= 0.0) & (u < cols) & (v >= 0.0) & (v < rows)  # nothing is known beyond
        if found & inside & (t >= 0.0) & (dz * dz > slope * slope * flat):
            gx, gy = gx * scale_x, gy * scale_y
            lean = gx * rays[i, 3] + gy * rays[i, 4] - dz
            distance[i], geom[i] = t, ground_geom
            cosine[i] = lean / math.sqrt(gx * gx + gy * gy + 1.0)
            count -= 1
    return others[:count].copy()
