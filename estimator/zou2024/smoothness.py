"""Smoothness of the surface around each return, and the choice of edge and planar points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from touchdown.estimator.typing import Array, Indices, Mask

_REACH = 5
"""neighbours on each side along the track of one laser"""


@njit(cache=True)
def lidar_smoothness(
    points: Array, pulses: Indices, lasers: int, max_gap: int
) -> tuple[Array, Mask]:
    """Eq. 6: ``f_l = |sum_j (p_i - p_j)| / (|S| |p_i|)`` of (N, 3) points, seen from the sensor.

    ``pulses`` (N,): ascending number of each return's pulse in its scan; pulse k belongs to laser
    ``k mod lasers``, and S are the up to five returns before and five after on the same laser's
    track, none more than ``max_gap`` of its pulses away. The extraction lost the norm around the
    sum; it is that of Zhang and Singh's LOAM, which the paper cites. NaN where fewer than six
    neighbours exist.

    Also returns which points border on something nearer: an outline that moves with the viewpoint,
    no edge of the surface it lies on (N,).
    """
    count, reach = points.shape[0], max_gap * lasers
    scores = np.full(count, np.nan)
    shadowed = np.zeros(count, dtype=np.bool_)
    order, starts = _by_laser(pulses, lasers)
    x, y, z = points[:, 0][order], points[:, 1][order], points[:, 2][order]
    number, ranges = pulses[order], np.sqrt(x * x + y * y + z * z)
    for laser in range(lasers):
        first, end = starts[laser], starts[laser + 1]
        for at in range(first, end):
            tx, ty, tz, used, own = 0.0, 0.0, 0.0, 0, ranges[at]
            for j in range(max(at - _REACH, first), min(at + _REACH + 1, end)):
                if j == at or abs(number[j] - number[at]) > reach:
                    continue
                tx, ty, tz = tx + x[at] - x[j], ty + y[at] - y[j], tz + z[at] - z[j]
                used += 1
                if abs(j - at) == 1 and ranges[j] < 0.97 * own - 0.15:
                    shadowed[order[at]] = True
            if used >= 6:
                scores[order[at]] = np.sqrt(tx * tx + ty * ty + tz * tz) / (used * own)
    return scores, shadowed


@njit(cache=True)
def _by_laser(pulses: Indices, lasers: int) -> tuple[Indices, Indices]:
    """Indices (N,) of the returns, those of one laser after another, and where each one's start."""
    starts = np.zeros(lasers + 1, np.int64)
    for pulse in pulses:
        starts[pulse % lasers + 1] += 1
    starts = np.cumsum(starts)
    cursor, order = starts.copy(), np.empty(pulses.shape[0], np.int64)
    for i in range(pulses.shape[0]):
        order[cursor[pulses[i] % lasers]] = i
        cursor[pulses[i] % lasers] += 1
    return order, starts


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
    shadowed: Mask,
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
    planes, candidates = _extremes(scores, usable, directions, cells)
    planes = planes[scores[planes] <= edge_threshold]
    candidates = candidates[scores[candidates] > edge_threshold]
    strongest = np.argsort(-scores[candidates], kind="stable")[:edges]
    return FeaturePoints(np.sort(candidates[strongest]), np.sort(planes))


@njit(cache=True)
def _extremes(
    scores: Array, usable: Indices, directions: Array, cells: tuple[int, int]
) -> tuple[Indices, Indices]:
    """Of the ``usable`` returns, those with the smallest and the largest score of each sector."""
    low, high = directions[usable[0]].copy(), directions[usable[0]].copy()
    for i in usable:
        for a in range(2):
            low[a], high[a] = min(low[a], directions[i, a]), max(high[a], directions[i, a])
    columns, rows = cells
    scale_x, scale_y = columns / max(high[0] - low[0], 1e-9), rows / max(high[1] - low[1], 1e-9)
    least = np.full(columns * rows, -1, np.int64)
    most = least.copy()
    for i in usable:
        column = min(int((directions[i, 0] - low[0]) * scale_x), columns - 1)
        sector = min(int((directions[i, 1] - low[1]) * scale_y), rows - 1) * columns + column
        if least[sector] < 0 or scores[i] < scores[least[sector]]:
            least[sector] = i
        if most[sector] < 0 or scores[i] >= scores[most[sector]]:
            most[sector] = i
    return least[least >= 0], most[most >= 0]
