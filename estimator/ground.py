"""Height of the ground from the histograms of a map's returns: under plants and passing traffic.

Over plants some pulses return from the leaves and some from the ground beneath; where a car drove
by, some return from its roof. The mean of a cell lies between. The ground is the lowest level at
which returns gather: from the lowest returns of a cell, mean shift (Fukunaga and Hostetler 1975)
climbs to the nearest mode of their density. Since few pulses pass dense plants, the returns of the
neighbours count too, moved along the slope of the ground. A cell whose returns lie within the noise
of the ranges shows one surface, and is left as it is: what is solid keeps its height and its steps.
So is water, which returns few of the pulses: nothing grows there, and its lowest returns come from
below.
"""

from typing import Any, NamedTuple

import cv2
import numba
import numpy as np

from touchdown.estimator.parameters import HEIGHT_BIN_M
from touchdown.sim.typing import Array, Bytes, Float32, Mask

ONE_SURFACE_STD_M = 0.04
"""spread of the returns of one surface: range noise of 2 to 3 cm and the slope within a cell"""
_FEW = 6.0
"""returns, up to which a cell says nothing by itself: those around it decide"""
_OVERHANG_M = 0.5
"""height above most of the cells around it, from which a cell shows what stands or hangs there
alone"""
_WINDOW_M = 0.05
"""half width of the kernel of the mean shift: twice the noise of the ranges"""
_MIN_FRACTION = 0.03
_FEW_FRACTION = 0.15
"""fraction of the returns that lie below the start; fewer are errors"""
_NEIGHBOUR_WEIGHT = 0.5
_REACH_M = 0.2
"""distance to the neighbours along each axis"""
_SLOPE_REACH_M = 0.4
_SLOPE_LIMIT = 0.6
"""tangent of 31 degrees"""
_MIN_STD_M = 0.02
"""noise of one range"""
_BINS = 96
"""number of bins for the returns of a cell and its neighbours, more than those of a cell, for their
slope"""
_STEPS = 30
_CONVERGED_M = 1e-4


class _Heights(NamedTuple):
    """Histograms of the returns of each cell."""

    histogram: Bytes  # (rows, cols, bins)
    base: Float32  # (rows, cols) m, lower side of the first bin
    ends: Bytes  # (rows, cols, 2) first and one past the last bin with returns


def ground_of(
    layers: tuple[Float32, Float32, Float32, Float32],
    histogram: Bytes | None,
    base: Float32 | None,
    cell_m: float,
    box: tuple[slice, slice],
    where: Mask | None = None,
) -> tuple[Float32, Float32]:
    """Implements ``GridMap.ground``: height and standard deviation. ``layers``: number, mean height
    and standard deviation of the returns and pulses without return, (rows, cols)."""
    (top, bottom, _), (left, right, _) = (
        part.indices(size) for part, size in zip(box, layers[0].shape, strict=True)
    )
    edge = round((_REACH_M + _SLOPE_REACH_M) / cell_m)
    around = np.s_[max(top - edge, 0) : bottom + edge, max(left - edge, 0) : right + edge]
    count, mean, spread, missing = (layer[around] for layer in layers)
    with np.errstate(invalid="ignore", divide="ignore"):
        noise = np.maximum(spread, np.float32(_MIN_STD_M))
        std: Float32 = (noise / np.sqrt(np.maximum(count, 1.0))).astype(np.float32)
    height = mean.copy()
    above, beside = top - around[0].start, left - around[1].start
    inner = np.s_[above : above + max(bottom - top, 0), beside : beside + max(right - left, 0)]
    wanted = np.zeros(mean.shape, np.bool_)
    wanted[inner] = True if where is None else where
    if histogram is not None and base is not None and wanted.any():
        several = (missing <= count) & ((count <= _FEW) | (spread > ONE_SURFACE_STD_M))
        reach, slope_reach = max(round(_REACH_M / cell_m), 1), round(_SLOPE_REACH_M / cell_m)
        square = np.ones((2 * slope_reach + 1, 2 * slope_reach + 1), np.uint8)
        near: Bytes = cv2.dilate(wanted.astype(np.uint8), square).astype(np.uint8)
        own, ends = mean.copy(), np.empty((*mean.shape, 2), np.uint8)
        # Whole maps, windows and read-only views become one type, so that kernels compile once.
        bins, lowest = _fixed(histogram[around]), _fixed(base[around])
        count, spread = _fixed(count), _fixed(spread)
        _own_modes(bins, lowest, spread, near, own, ends)
        _pooled_modes(
            _Heights(bins, lowest, ends), count, (wanted, several), own, cell_m,
            (slope_reach, reach), height, std,
        )  # fmt: skip
    return height[inner], std[inner]


def _fixed(layer: Any) -> Any:
    """A contiguous array that is not written."""
    layer = np.ascontiguousarray(layer).view()
    layer.flags.writeable = False
    return layer


@numba.njit(cache=True, error_model="numpy")
def _climb(weights: Array, low: int) -> tuple[float, float, float]:
    """Mean shift from bin ``low`` of ``weights`` (K,): the mode in metres above the first bin's
    lower side, the weight within the window and the standard deviation there."""
    x = (low + 0.5) * HEIGHT_BIN_M
    inside = second = 0.0
    for _ in range(_STEPS):
        total = first = inside = second = 0.0
        start = max(int((x - _WINDOW_M) / HEIGHT_BIN_M), 0)
        end = min(int((x + _WINDOW_M) / HEIGHT_BIN_M) + 1, weights.shape[0])
        for k in range(start, end):
            away = (k + 0.5) * HEIGHT_BIN_M - x
            fraction = (1.0 - (away / _WINDOW_M) ** 2) * weights[k]
            if fraction > 0.0:
                total += fraction
                first += fraction * away
                inside += weights[k]
                second += weights[k] * away * away
        if total <= 0.0:
            break
        x += first / total
        if abs(first) <= _CONVERGED_M * total:
            break
    return x, inside, np.sqrt(second / inside) if inside > 0.0 else 0.0


@numba.njit(cache=True, error_model="numpy")
def _start(weights: Array, first: int, fraction: float) -> int:
    """First bin from ``first`` on up to which more than a few returns lie; -1 if there is none."""
    total = 0.0
    for k in range(weights.shape[0]):
        total += weights[k]
    needed, found = max(fraction * total, 1e-6), 0.0
    for k in range(first, weights.shape[0]):
        found += weights[k]
        if found >= needed:
            return k
    return -1


@numba.njit(cache=True, error_model="numpy")
def _own_modes(
    histogram: Bytes, base: Float32, spread: Float32, near: Bytes, own: Float32, ends: Bytes
) -> None:
    """Writes the lowest mode of each cell ``near`` of several surfaces into ``own``, and the first
    and one past the last bin with returns of every one into ``ends`` (rows, cols, 2), without the
    outer bins, which hold all that is lower and higher."""
    rows, cols, bins = histogram.shape
    weights = np.zeros(bins)
    for row in range(rows):
        for col in range(cols):
            if near[row, col] == 0:
                continue
            low, high = bins - 1, 0
            for k in range(1, bins):
                weights[k] = histogram[row, col, k]
                if weights[k] > 0.0 and k < bins - 1:
                    low, high = min(low, k), k + 1
            ends[row, col, 0], ends[row, col, 1] = low, high
            if not spread[row, col] > ONE_SURFACE_STD_M:
                continue
            start = _start(weights, 0, _MIN_FRACTION)
            if 0 <= start < bins - 1:
                own[row, col] = base[row, col] + _climb(weights[: bins - 1], start)[0]


@numba.njit(cache=True, error_model="numpy")
def _slope_at(own: Float32, row: int, col: int, reach: int, slope: Array) -> None:
    """Writes the rise of ``own`` per column and per row, least squares over the window, into
    ``slope``; 0 where too few cells are known."""
    n = sx = sy = sz = sxx = syy = sxy = sxz = syz = 0.0
    slope[:] = 0.0
    for a in range(max(row - reach, 0), min(row + reach + 1, own.shape[0])):
        for b in range(max(col - reach, 0), min(col + reach + 1, own.shape[1])):
            if np.isnan(own[a, b]):
                continue
            x, y, z = float(b - col), float(a - row), own[a, b] - own[row, col]
            n += 1.0
            sx, sy, sz = sx + x, sy + y, sz + z
            sxx, syy, sxy = sxx + x * x, syy + y * y, sxy + x * y
            sxz, syz = sxz + x * z, syz + y * z
    if n < 6.0:
        return
    cxx, cyy, cxy = sxx - sx * sx / n, syy - sy * sy / n, sxy - sx * sy / n
    cxz, cyz = sxz - sx * sz / n, syz - sy * sz / n
    determinant = cxx * cyy - cxy * cxy
    if determinant > 1e-3:
        slope[0] = (cxz * cyy - cyz * cxy) / determinant
        slope[1] = (cyz * cxx - cxz * cxy) / determinant


@numba.njit(cache=True, error_model="numpy")
def _stands_alone(own: Float32, row: int, col: int, reach: int, few: bool) -> bool:
    """True if a cell lies high above most of the known cells around it, or, with ``few`` returns in
    its histogram, far below them: an echo that came late."""
    known = below = above = 0
    for a in range(max(row - reach, 0), min(row + reach + 1, own.shape[0])):
        for b in range(max(col - reach, 0), min(col + reach + 1, own.shape[1])):
            if not np.isnan(own[a, b]):
                known += 1
                below += own[a, b] < own[row, col] - _OVERHANG_M
                above += own[a, b] > own[row, col] + _OVERHANG_M
    return 2 * below > known or (few and 2 * above > known)


@numba.njit(cache=True, error_model="numpy")
def _pool(
    heights: _Heights, at: tuple[int, int], reach: int, slope: tuple[float, float], lowest: float,
    weights: Array,
) -> None:  # fmt: skip
    """Writes the histogram of the returns of a cell and its neighbours, moved along the slope, into
    ``weights`` (K,), whose first bin begins at ``lowest``."""
    histogram, base, ends = heights
    row, col = at
    per_col, per_row = slope
    weights[:] = 0.0
    for a in range(max(row - reach, 0), min(row + reach + 1, base.shape[0])):
        for b in range(max(col - reach, 0), min(col + reach + 1, base.shape[1])):
            if np.isnan(base[a, b]):
                continue
            weight = 1.0 if a == row and b == col else _NEIGHBOUR_WEIGHT
            up = base[a, b] - per_col * (b - col) - per_row * (a - row) - lowest
            offset = int(np.floor(up / HEIGHT_BIN_M + 0.5))
            first = max(int(ends[a, b, 0]), -offset)
            for k in range(first, min(int(ends[a, b, 1]), weights.shape[0] - offset)):
                weights[k + offset] += weight * histogram[a, b, k]


@numba.njit(cache=True, error_model="numpy")
def _pooled_modes(
    heights: _Heights,
    count: Float32,
    masks: tuple[Mask, Mask],
    own: Float32,
    cell: float,
    reaches: tuple[int, int],
    height: Float32,
    std: Float32,
) -> None:
    """Writes the lowest mode of the returns of each cell of ``several`` surfaces and its
    neighbours, not below its own lowest returns, and its standard deviation; NaN for what stands
    alone."""
    histogram, base, ends = heights
    wanted, several = masks
    slope_reach, reach = reaches
    rows, cols, bins = histogram.shape
    weights, slope = np.zeros(_BINS), np.zeros(2)
    limit, below = _SLOPE_LIMIT * cell, (_BINS - bins) // 2
    for row in range(rows):
        for col in range(cols):
            if not wanted[row, col] or np.isnan(own[row, col]):
                continue
            few = count[row, col] <= _FEW
            within = histogram[row, col, : bins - 1].sum()
            if _stands_alone(own, row, col, slope_reach, few or within <= _FEW):
                height[row, col] = np.nan
                std[row, col] = np.nan
                continue
            if not several[row, col]:
                continue
            _slope_at(own, row, col, slope_reach, slope)
            per_col = min(max(slope[0], -limit), limit)
            per_row = min(max(slope[1], -limit), limit)
            lowest = base[row, col] - below * HEIGHT_BIN_M
            _pool(heights, (row, col), reach, (per_col, per_row), lowest, weights)
            if few:
                low = _start(weights, 0, _FEW_FRACTION)
            else:
                low = _start(weights, below + ends[row, col, 0], _MIN_FRACTION)
            if low < 0:
                continue
            mode, inside, deviation = _climb(weights, low)
            height[row, col] = lowest + mode
            std[row, col] = max(deviation, _MIN_STD_M) / np.sqrt(max(inside, 1.0))
