"""Level surfaces in a scan: where a deck is found, and its plane."""

from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from touchdown.sim.typing import Array, Indices, Mask

CELL_M = 0.45
_SPREAD_M, _STEP_M = 0.15, 0.10
"""largest spread of the heights in a cell, and step to the next"""
_FEWEST = 2
_RING_M = 2.0
"""width of what is looked at around a surface"""


class Surface(NamedTuple):
    """A connected level surface."""

    cells: Array
    """(N, 3) means of the points of its cells"""
    returns: int
    """number of the points"""
    clipped: bool
    """it goes on beyond the field of view"""

    @property
    def area_m2(self) -> float:
        """Of its cells."""
        return len(self.cells) * CELL_M**2

    @property
    def height_m(self) -> float:
        """Mean of its cells."""
        return float(self.cells[:, 2].mean())


def surfaces(points: Array, at_edge: Mask) -> list[Surface]:
    """The level surfaces of (N, 3) points, largest first; ``at_edge`` (N,): the point lies at the
    edge of the field of view."""
    index = np.floor(points[:, :2] / CELL_M).astype(np.int64)
    keys = (index[:, 0] << 32) + index[:, 1]
    order = np.argsort(keys, kind="stable")
    key, first, count = np.unique(keys[order], return_index=True, return_counts=True)
    if not len(key):
        return []
    placed = points[order]
    mean = np.add.reduceat(placed, first, axis=0) / count[:, None]
    heights = placed[:, 2]
    spread = np.maximum.reduceat(heights, first) - np.minimum.reduceat(heights, first)
    edge = np.logical_or.reduceat(at_edge[order], first)
    flat = (count >= _FEWEST) & (spread < _SPREAD_M)
    key, mean, edge, count = key[flat], mean[flat], edge[flat], count[flat]
    if not len(key):
        return []
    pairs = [_neighbours(key, mean[:, 2], offset) for offset in (1, 1 << 32)]
    one, other = np.concatenate(pairs, axis=1)
    graph = coo_matrix((np.ones(len(one), np.int8), (one, other)), shape=(len(key),) * 2)
    number, label = connected_components(graph, directed=False)
    sizes = np.bincount(label, minlength=number)
    found = np.argsort(-sizes, kind="stable")[:8]
    return [
        Surface(mean[own], int(count[own].sum()), bool(edge[own].any()))
        for own in (label == one for one in found)
    ]


def thinning_part(surface: Surface, points: Array) -> float:
    """Density of the returns around ``surface`` at its height, over that on it: 0 where it ends,
    more where returns only become rare, as those of a glint on water do. ``points`` (N, 3)."""
    cells = surface.cells
    low, high = cells[:, :2].min(axis=0) - _RING_M, cells[:, :2].max(axis=0) + _RING_M
    plane = fit_plane(cells, cells[:, :2].mean(axis=0))
    rise = points[:, 2] - plane.height - (points[:, :2] - cells[:, :2].mean(axis=0)) @ plane.slopes
    level = (np.abs(rise) < _STEP_M) & ((points[:, :2] > low) & (points[:, :2] < high)).all(axis=1)
    away, _ = cKDTree(cells[:, :2]).query(points[level, :2], distance_upper_bound=_RING_M)
    around = np.isfinite(away) & (away > 1.5 * CELL_M)
    radius = np.sqrt(surface.area_m2 / np.pi)
    ring = np.pi * ((radius + _RING_M) ** 2 - (radius + CELL_M) ** 2)
    return float(around.sum() / ring * surface.area_m2 / surface.returns)


def _neighbours(key: Indices, height: Array, offset: int) -> Indices:
    """(2, M) pairs of cells ``offset`` apart of about the same height."""
    at = np.searchsorted(key, key + offset)
    at[at == len(key)] = 0
    joined = np.flatnonzero((key[at] == key + offset) & (np.abs(height[at] - height) < _STEP_M))
    return np.stack([joined, at[joined]])


class PlaneFit(NamedTuple):
    """z = height + slopes . (xy - at)."""

    height: float
    slopes: Array
    """(2,)"""
    slope_sigma: float
    middle: Array
    """(3,) mean of the points on it"""


def fit_plane(points: Array, at_xy: Array, rounds: int = 3, within_m: float = 0.06) -> PlaneFit:
    """Least squares through (N, 3) points, those off by more than ``within_m`` left out."""
    used = np.ones(len(points), bool)
    local = np.column_stack([np.ones(len(points)), points[:, :2] - at_xy])
    solution = np.zeros(3)
    for _ in range(rounds):
        solution, *_ = np.linalg.lstsq(local[used], points[used, 2], rcond=None)
        residual = np.abs(points[:, 2] - local @ solution)
        kept = residual < max(within_m, 2.0 * float(np.median(residual)))
        if kept.sum() < 3:
            break
        used = kept
    narrow = np.sqrt(np.linalg.eigvalsh(np.cov(local[used, 1:].T))[0]) if used.sum() > 3 else 0.0
    sigma = 0.01 / max(float(narrow), 1e-3)
    return PlaneFit(float(solution[0]), solution[1:], sigma, points[used].mean(axis=0))
