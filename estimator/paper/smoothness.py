"""Smoothness of the surface around each return, and the choice of edge and planar points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_REACH = 5
"""neighbours on each side along the track of one laser"""


@njit(cache=True)
def lidar_smoothness(
    points: Array, pulses: Indices, lasers: int, max_gap: int
) -> tuple[Array, NDArray[np.bool_]]:
    """Eq. 6: ``f_l = |sum_j (p_i - p_j)| / (|S| |p_i|)`` of (N, 3) points, seen from the sensor.

    ``pulses`` (N,): ascending number of each return's pulse in its scan; pulse k belongs to laser
    ``k mod lasers``, and S are the up to five returns before and five after on the same laser's
    track, none more than ``max_gap`` of its pulses away. The extraction lost the norm around the
    sum; it is that of Zhang and Singh's LOAM, which the paper cites. NaN where fewer than six
    neighbours exist.

    Also returns which points border on something nearer: an outline that moves with the viewpoint,
    no edge of the surface it lies on (N,).
    """
    count = points.shape[0]
    scores = np.full(count, np.nan)
    shadowed = np.zeros(count, dtype=np.bool_)
    order = np.argsort(pulses % lasers, kind="mergesort")
    for at in range(count):
        i = order[at]
        own = np.sqrt(points[i, 0] ** 2 + points[i, 1] ** 2 + points[i, 2] ** 2)
        total = np.zeros(3)
        used = 0
        for side in (-1, 1):
            for step in range(1, _REACH + 1):
                other = at + side * step
                if other < 0 or other >= count:
                    break
                j = order[other]
                if pulses[j] % lasers != pulses[i] % lasers:
                    break
                if abs(pulses[j] - pulses[i]) > max_gap * lasers:
                    break
                for c in range(3):
                    total[c] += points[i, c] - points[j, c]
                used += 1
                if step == 1:
                    near = np.sqrt(points[j, 0] ** 2 + points[j, 1] ** 2 + points[j, 2] ** 2)
                    if near < 0.97 * own - 0.15:
                        shadowed[i] = True
        if used >= 6:
            norm = np.sqrt(total[0] ** 2 + total[1] ** 2 + total[2] ** 2)
            scores[i] = norm / (used * own)
    return scores, shadowed


def fused_smoothness(f_l: Array, f_c: Array, weight: float) -> Array:
    """Eq. 7: ``f_s = f_l + lambda f_c``. Where no image covers a return (``f_c`` NaN) there is
    nothing to fuse and ``f_s = f_l``."""
    return f_l + weight * np.where(np.isnan(f_c), 0.0, f_c)


@dataclass(frozen=True, slots=True)
class FeaturePoints:
    """Indices of the chosen returns."""

    edges: Indices
    planes: Indices


def sort_out_features(
    scores: Array,
    shadowed: NDArray[np.bool_],
    directions: Array,
    *,
    cells: tuple[int, int],
    edges: int,
    edge_threshold: float,
) -> FeaturePoints:
    """Edge points (largest f_s) and planar points (smallest f_s), spread over the view.

    ``scores`` (N,) f_s, NaN to leave out; ``directions`` (N, 2) x / z and y / z in the sensor.
    The view is cut into ``cells`` (columns, rows); every cell gives its smallest score as planar
    and its largest as edge candidate; planar scores must lie below ``edge_threshold``, those of
    edges above it, and of these the ``edges`` largest stay. Returns in shadow are neither.
    """
    usable = np.flatnonzero(np.isfinite(scores) & ~shadowed)
    if len(usable) == 0:
        return FeaturePoints(usable, usable)
    where = directions[usable]
    low, high = where.min(axis=0), where.max(axis=0)
    grid = np.array(cells)
    cell = ((where - low) / np.maximum(high - low, 1e-9) * grid).astype(np.int64)
    cell = np.minimum(cell, grid - 1)
    sector = cell[:, 1] * grid[0] + cell[:, 0]
    order = np.lexsort((scores[usable], sector))
    ends = np.flatnonzero(np.diff(sector[order], append=-1))
    starts = np.concatenate([[0], ends[:-1] + 1])
    planes = usable[order[starts]]
    planes = planes[scores[planes] <= edge_threshold]
    candidates = usable[order[ends]]
    candidates = candidates[scores[candidates] > edge_threshold]
    strongest = np.argsort(-scores[candidates], kind="stable")[:edges]
    return FeaturePoints(np.sort(candidates[strongest]), np.sort(planes))
