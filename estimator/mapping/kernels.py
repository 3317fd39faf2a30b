"""Compiled kernels of the mapper: colour, accumulate. One thread and a fixed order of sums,
so that the same scans give the same map to the bit."""

from typing import NamedTuple

import numba
import numpy as np

from touchdown.estimator.filtering.error_state import Frame
from touchdown.sim.typing import Bytes, Float32


class Pulses(NamedTuple):
    """N pulses in the odom frame."""

    origins: Float32  # (N, 3) m
    beams: Float32  # (N, 3) unit
    ranges: Float32  # (N,) m; 0: no return


class Grid(NamedTuple):
    """Where the cells of a grid lie."""

    x: float  # m, of the corner
    y: float
    cell: float  # m


class Lens(NamedTuple):
    """A lens as OpenCV describes it; of a fisheye p1 and p2 are its third and fourth term."""

    fx: float
    fy: float
    cx: float
    cy: float
    k1: float
    k2: float
    p1: float
    p2: float
    k3: float
    fisheye: bool


class Layers(NamedTuple):
    """Layers of a ``GridMap`` that returns are added to, (rows, cols) float32, ``rgb`` (rows, cols,
    3), and the number of coloured returns."""

    counts: Float32
    height_m: Float32
    height_std_m: Float32
    min_height_m: Float32
    max_height_m: Float32
    rgb: Float32
    rgb_count: Float32
    intensity: Float32
    missing: Float32
    last_seen_s: Float32


_BLOCK = 256
"""pulses whose pixel indices are computed before any pixel is read"""
_BINS_BELOW = 4
"""number of bins of a histogram below its first return"""
_LOW_RETURNS = 3
"""far below the others from which they are the ground"""


@numba.njit(cache=True, error_model="numpy")
def sample_colours(
    pulses: Pulses,
    window: tuple[int, int],
    skipped: tuple[int, int],
    image: Bytes,
    camera_from_odom: Frame,
    lens: Lens,
    colours: Float32,
) -> None:
    """Colours the returns of the pulses [first, last) of ``window`` that have no colour yet, all
    but those of ``skipped``.

    ``camera_from_odom``: at the exposure; image: (H, W, 3); ``colours``: (N, 3) float32, NaN where
    uncoloured. Nearest pixel. The LIDAR sits beside the camera, so what one sees the other sees.
    """
    origins, beams, ranges = pulses
    rotation, translation = camera_from_odom
    rows, cols = image.shape[0], image.shape[1]
    fx, fy, cx, cy, k1, k2, p1, p2, k3, fisheye = lens
    # Indices first, then pixels, block by block: without arithmetic in between, the processor
    # fetches many pixels at a time. A row of ``image`` by itself would be reference-counted.
    row_of, col_of = np.empty(_BLOCK, np.int32), np.empty(_BLOCK, np.int32)
    for block in range(window[0], window[1], _BLOCK):
        end = min(block + _BLOCK, window[1])
        for i in range(block, end):
            row_of[i - block] = -1
            r = ranges[i]
            if r <= 0.0 or skipped[0] <= i < skipped[1] or not np.isnan(colours[i, 0]):
                continue
            x = origins[i, 0] + r * beams[i, 0]
            y = origins[i, 1] + r * beams[i, 1]
            z = origins[i, 2] + r * beams[i, 2]
            zc = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z + translation[2]
            if not zc > 0.05:
                continue
            per_z = 1.0 / zc
            u = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z + translation[0]
            v = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z + translation[1]
            u, v = per_z * u, per_z * v
            q = u * u + v * v
            if q > 4.0:
                continue
            if fisheye:
                angle = np.arctan(np.sqrt(q))
                t = angle * angle
                bent = 1.0 + t * (k1 + t * (k2 + t * (p1 + t * p2)))
                bent *= angle / max(np.sqrt(q), 1e-9)
                ud, vd = u * bent, v * bent
            else:
                radial = 1.0 + q * (k1 + q * (k2 + q * k3))
                ud = u * radial + 2.0 * p1 * u * v + p2 * (q + 2.0 * u * u)
                vd = v * radial + p1 * (q + 2.0 * v * v) + 2.0 * p2 * u * v
            col = fx * ud + cx + 0.5
            row = fy * vd + cy + 0.5
            if 0.0 <= col < cols and 0.0 <= row < rows:
                row_of[i - block], col_of[i - block] = np.int32(row), np.int32(col)
        for i in range(block, end):
            if row_of[i - block] >= 0:
                row, col = np.uintp(row_of[i - block]), np.uintp(col_of[i - block])
                for k in range(3):
                    colours[i, k] = image[row, col, k]


@numba.njit(cache=True, error_model="numpy")
def accumulate_returns(
    pulses: Pulses,
    colours: Float32,
    intensities: Bytes,
    now: float,
    count_cap: float,
    extreme_memory: float,
    grid: Grid,
    layers: Layers,
) -> int:
    """Adds returns to a grid (layout of ``GridMap``); returns the number that fell inside.

    Running mean and variance with the weight of a new return never below 1 / ``count_cap``: up to
    that many returns the exact moments (Welford), after it an exponential memory. Extremes relax
    towards the mean with time constant ``extreme_memory`` seconds while unconfirmed.
    """
    origins, beams, ranges = pulses
    count, height, std, low, high, rgb, rgb_count, intensity, missing, last_seen = layers
    rows, cols = count.shape
    inside = 0
    per_cell, per_cap = 1.0 / grid.cell, 1.0 / count_cap
    known_idle, keep = 0.0, 1.0
    for i in range(ranges.shape[0]):
        r = ranges[i]
        if not r > 0.0:
            continue
        x = origins[i, 0] + r * beams[i, 0]
        y = origins[i, 1] + r * beams[i, 1]
        z = origins[i, 2] + r * beams[i, 2]
        across, along = (x - grid.x) * per_cell, (y - grid.y) * per_cell
        # Comparisons that no NaN passes.
        if not (0.0 <= across < cols and 0.0 <= along < rows and abs(z) < np.inf):
            continue
        col, row = np.uintp(across), np.uintp(along)  # unsigned: no index counts from the end
        inside += 1
        n = count[row, col] + 1.0
        if n > count_cap:
            n = count_cap
            missing[row, col] *= 1.0 - per_cap
        if np.isnan(height[row, col]):
            height[row, col] = z
            std[row, col] = 0.0
            low[row, col] = z
            high[row, col] = z
            intensity[row, col] = intensities[i]
        else:
            gain = 1.0 / n
            delta = z - height[row, col]
            variance = (1.0 - gain) * (std[row, col] * std[row, col] + gain * delta * delta)
            height[row, col] += gain * delta
            std[row, col] = np.sqrt(variance)
            idle = now - last_seen[row, col]
            if idle > 0.0:
                if idle != known_idle:  # many cells of a scan were seen last at the same time
                    known_idle, keep = idle, np.exp(-idle / extreme_memory)
                mean = height[row, col]
                high[row, col] = mean + keep * (high[row, col] - mean)
                low[row, col] = mean + keep * (low[row, col] - mean)
            high[row, col] = max(high[row, col], z)
            low[row, col] = min(low[row, col], z)
            intensity[row, col] += gain * (intensities[i] - intensity[row, col])
        count[row, col] = n
        last_seen[row, col] = now
        if not np.isnan(colours[i, 0]):
            m = min(rgb_count[row, col] + 1.0, count_cap)
            rgb_count[row, col] = m
            if m == 1.0:
                for k in range(3):
                    rgb[row, col, k] = colours[i, k]
            else:
                weight = 1.0 / m
                for k in range(3):
                    rgb[row, col, k] += weight * (colours[i, k] - rgb[row, col, k])
    return inside


@numba.njit(cache=True, error_model="numpy")
def accumulate_heights(
    pulses: Pulses, grid: Grid, bin_m: float, histogram: Bytes, base: Float32
) -> None:
    """Counts returns in the histograms of their cells (layout of ``GridMap``).

    The base of a cell follows its lowest return down. One that is lower by more than the whole
    histogram is an error, until the third of its kind: then the histogram begins anew there."""
    origins, beams, ranges = pulses
    rows, cols, bins = histogram.shape
    per_cell, per_bin = 1.0 / grid.cell, 1.0 / bin_m
    for i in range(ranges.shape[0]):
        r = ranges[i]
        if not r > 0.0:
            continue
        z = origins[i, 2] + r * beams[i, 2]
        across = (origins[i, 0] + r * beams[i, 0] - grid.x) * per_cell
        along = (origins[i, 1] + r * beams[i, 1] - grid.y) * per_cell
        if not (0.0 <= across < cols and 0.0 <= along < rows and abs(z) < np.inf):
            continue
        col, row = np.uintp(across), np.uintp(along)
        if np.isnan(base[row, col]):
            base[row, col] = z - (_BINS_BELOW + 0.5) * bin_m
        k = int(np.floor((z - base[row, col]) * per_bin))
        if k < 1 - bins:
            histogram[row, col, 0] += np.uint8(1)
            if histogram[row, col, 0] < _LOW_RETURNS:
                continue
            _raise_by(histogram[row, col], bins)
            base[row, col] = z - (_BINS_BELOW + 0.5) * bin_m
            k = _BINS_BELOW
        elif k < 1:
            _raise_by(histogram[row, col], 1 - k)
            base[row, col] -= (1 - k) * bin_m
            k = 1
        k = min(k, bins - 1)
        if histogram[row, col, k] == 255:
            for j in range(bins):
                histogram[row, col, j] >>= np.uint8(1)
        histogram[row, col, k] += np.uint8(1)


@numba.njit(cache=True, error_model="numpy")
def _raise_by(counts: Bytes, up: int) -> None:
    """Moves the returns of a histogram (bins,) up by ``up`` bins, except those of the first one,
    which are forgotten; the last bin keeps all that is higher."""
    bins = counts.shape[0]
    top = counts[max(bins - 1 - up, 1) :].sum()
    for k in range(bins - 2, 0, -1):
        counts[k] = counts[k - up] if k - up >= 1 else 0
    counts[bins - 1] = min(top, 255)
    counts[0] = 0


@numba.njit(cache=True, error_model="numpy")
def _cell_at(x: float, y: float, grid: Grid, shape: tuple[int, int]) -> tuple[int, int]:
    """Row and column of the cell at (x, y); a row of -1 beside the grid and for NaN."""
    col, row = np.floor((x - grid.x) / grid.cell), np.floor((y - grid.y) / grid.cell)
    if not (0 <= col < shape[1] and 0 <= row < shape[0]):
        return -1, -1
    return int(row), int(col)


@numba.njit(cache=True, error_model="numpy")
def update_ground_level(pulses: Pulses, blocks: Grid, level: Float32) -> None:
    """Updates the lowest return of every block of the scene, (rows, cols), NaN where nothing was
    seen: the level at which pulses without return are expected to have met the ground."""
    origins, beams, ranges = pulses
    for i in range(ranges.shape[0]):
        r = ranges[i]
        if not r > 0.0:
            continue
        x, y = origins[i, 0] + r * beams[i, 0], origins[i, 1] + r * beams[i, 1]
        z = origins[i, 2] + r * beams[i, 2]
        row, col = _cell_at(float(x), float(y), blocks, level.shape)
        if row >= 0 and np.isfinite(z) and not z >= level[row, col]:
            level[row, col] = z


@numba.njit(cache=True, error_model="numpy")
def _expected_level(x: float, y: float, fallback: float, blocks: Grid, level: Float32) -> float:
    """Level of the block at (x, y), else the lowest of its eight neighbours, else the fallback."""
    rows, cols = level.shape
    row, col = _cell_at(x, y, blocks, level.shape)
    if row < 0:
        return fallback
    if not np.isnan(level[row, col]):
        return level[row, col]
    best = np.inf
    for r in range(max(row - 1, 0), min(row + 2, rows)):
        for c in range(max(col - 1, 0), min(col + 2, cols)):
            if level[r, c] < best:
                best = level[r, c]
    return best if best < np.inf else fallback


@numba.njit(cache=True, error_model="numpy")
def locate_missing(
    pulses: Pulses,
    min_reach: float,
    max_reach: float,
    fallback: float,
    blocks: Grid,
    level: Float32,
    spots: Float32,
) -> int:
    """Expected ground points of pulses without return: writes (K, 2) x, y into ``spots`` and
    returns K. Three fixed-point steps of the beam against the block levels; only distances within
    (min_reach, max_reach) count, since beyond them a missing return carries no information."""
    origins, beams, ranges = pulses
    found = 0
    for i in range(ranges.shape[0]):
        if not ranges[i] <= 0.0 or not beams[i, 2] < -0.05:
            continue
        x, y, distance = float(origins[i, 0]), float(origins[i, 1]), 0.0
        for _ in range(3):
            ground = _expected_level(x, y, fallback, blocks, level)
            distance = (ground - origins[i, 2]) / beams[i, 2]
            x = origins[i, 0] + distance * beams[i, 0]
            y = origins[i, 1] + distance * beams[i, 1]
        if min_reach < distance < max_reach:
            spots[found, 0] = x
            spots[found, 1] = y
            found += 1
    return found


@numba.njit(cache=True, error_model="numpy")
def accumulate_missing(
    spots: Float32, grid: Grid, count_cap: float, count: Float32, missing: Float32
) -> None:
    """Counts pulses without return, (K, 2) x, y, in their cells. With many of them the count of
    returns fades, so that the ratio of both follows the recent past."""
    for i in range(spots.shape[0]):
        row, col = _cell_at(float(spots[i, 0]), float(spots[i, 1]), grid, count.shape)
        if row >= 0:
            if missing[row, col] + 1.0 > count_cap:
                missing[row, col] = count_cap
                count[row, col] *= 1.0 - 1.0 / count_cap
            else:
                missing[row, col] += 1.0
