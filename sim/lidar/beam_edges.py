"""Pulses whose beams an edge may divide, in compiled single-threaded loops."""

import math

import numpy as np
from numba import njit

from touchdown.sim.typing import Float32, Indices, Int32

_MAP_CELLS = 256.0
"""Along half a side of the octahedral map of a view: cells of 0.2 to 0.45 degrees."""
_NEIGHBOUR_SQUARED = np.float32(math.radians(0.7) ** 2)
_STEP_M, _SLACK = np.float32(0.05), np.float32(1.5)
_MIN_SQUARE = np.float32(0.05**2)


@njit(cache=True, nogil=True, error_model="numpy")
def _view_map(nominal: Float32, chosen: Indices) -> tuple[Int32, Int32, int]:
    """The ``chosen`` (C,) directions on the octahedral map of the sphere, seen from +z: the part of
    the map that they fill, flat, with one of them in each cell or C; their cells (C,); its
    width."""
    size = chosen.shape[0]
    cols, rows = np.empty(size, np.int32), np.empty(size, np.int32)
    for k in range(size):
        x, y, z = nominal[chosen[k], 0], nominal[chosen[k], 1], nominal[chosen[k], 2]
        scale = 1.0 / (abs(x) + abs(y) + abs(z))
        u, v = x * scale, y * scale
        if z < 0.0:
            u, v = math.copysign(1.0 - abs(v), u), math.copysign(1.0 - abs(u), v)
        cols[k], rows[k] = int((u + 1.0) * _MAP_CELLS), int((v + 1.0) * _MAP_CELLS)
    cols -= cols.min() - 1
    rows -= rows.min() - 1
    width = cols.max() + 2
    cells = rows * np.int32(width) + cols
    grid = np.full(width * (rows.max() + 2), size, dtype=np.int32)
    for k in range(size):
        grid[cells[k]] = k
    return grid, cells, width


@njit(cache=True, nogil=True, error_model="numpy")
def near_edges(
    nominal: Float32, distance: Float32, cosine: Float32, candidates: Indices
) -> Indices:
    """Those of the ``candidates`` (C,) with a neighbour in the view, among the candidates of the
    same scan, that lies nearer or farther than the slope of either surface explains, or with no
    neighbour that could decide. It has no branches, which would be guessed wrong at every edge."""
    size = candidates.shape[0]
    if not size:
        return candidates
    grid, cells, width = _view_map(nominal, candidates)
    seen = np.empty((size + 1, 8), np.float32)  # of one length with the lines of a cache
    seen[size] = np.nan  # nothing, which is neither nearer nor farther
    for k in range(size):
        i = candidates[k]
        seen[k, 0], seen[k, 1], seen[k, 2] = nominal[i, 0], nominal[i, 1], nominal[i, 2]
        seen[k, 3], seen[k, 4] = distance[i], _square(cosine[i])
    chosen = np.empty(size, dtype=np.int64)
    count = 0
    for k in range(size):
        edge, others = False, 0
        for row in range(-1, 2):
            start = np.uint64(cells[k] + row * width - 1)
            for col in range(3):
                j = np.uint64(grid[start + np.uint64(col)])
                x, y, z = seen[k, 0] - seen[j, 0], seen[k, 1] - seen[j, 1], seen[k, 2] - seen[j, 2]
                angle_squared = x * x + y * y + z * z
                edge |= (angle_squared < _NEIGHBOUR_SQUARED) & _apart(
                    seen[k, 3], seen[j, 3], seen[k, 4], seen[j, 4], angle_squared
                )
                others += (j != size) & (j != k)
        chosen[count] = candidates[k]
        count += edge | (others == 0)
    return chosen[:count].copy()


@njit(cache=True, forceinline=True, error_model="numpy")
def _square(cosine: np.float32) -> np.float32:
    """Square of a cosine, which counts as 0.05 at least."""
    return max(cosine * cosine, _MIN_SQUARE)


@njit(cache=True, forceinline=True, error_model="numpy")
def _apart(
    distance: np.float32,
    other: np.float32,
    square: np.float32,
    other_square: np.float32,
    angle_squared: np.float32,
) -> bool:
    """True if two hits lie at ranges that no plane through one of them explains. The angle between
    their rays and the cosines are given squared, and the comparison is of squares: this saves
    roots."""
    gap = abs(distance - other) - _STEP_M
    c = other_square if other_square < square else square
    reach = _SLACK * (other if other < distance else distance)
    wide = gap * gap * c > reach * reach * angle_squared * (np.float32(1.0) - c)
    return bool((gap > 0.0) & wide)  # not where neither hits anything


@njit(cache=True, nogil=True, error_model="numpy")
def probed_apart(
    pulses: Indices, count: int, distance: Float32, cosine: Float32, angle_squared: float
) -> Indices:
    """Those of ``pulses`` (K,) one of whose ends, an angle off the axis, finds another surface than
    the axis: positions in ``pulses``. ``distance`` and ``cosine``: of ``count`` axes, of K ends on
    one side and of K on the other."""
    size, angle = pulses.shape[0], np.float32(angle_squared)
    out = np.empty(size, dtype=np.int64)
    found = 0
    for k in range(size):
        d, c = distance[pulses[k]], _square(cosine[pulses[k]])
        one, two = count + k, count + size + k
        out[found] = k
        found += _apart(d, distance[one], c, _square(cosine[one]), angle) | _apart(
            d, distance[two], c, _square(cosine[two]), angle
        )
    return out[:found].copy()
