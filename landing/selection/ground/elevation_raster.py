"""The observed part of an elevation map as rasters, and operations on them.

A raster is an array (rows, cols) of cells, row = y, column = x, in the odom frame of
``estimator.api.GridMap``.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.api import GridMap, Ground
from touchdown.sim.typing import Array, Float32, Mask

_Sums = tuple[float, float, float, float, float, float, float, float, float]
_LAYERS = {
    "count": "count", "height": "height_m", "std": "height_std_m", "low": "min_height_m",
    "high": "max_height_m", "rgb": "rgb", "intensity": "intensity", "missing": "missing",
    "last_seen": "last_seen_s",
}  # fmt: skip
"""layers of a raster, and of ``GridMap``"""


@dataclass(frozen=True, kw_only=True, slots=True)
class ElevationRaster:
    """Layers of the observed part of a map; unobserved cells have count 0 and NaN elsewhere."""

    origin_xy_m: Array
    cell_m: float
    count: Float32
    height: Float32
    """mean of the returns"""
    ground: Callable[[Mask], Ground]
    """height of the ground under the cells of a mask (rows, cols): see ``GridMap.ground``"""
    std: Float32
    low: Float32
    high: Float32
    rgb: Float32
    """(rows, cols, 3), 0..255, NaN where uncoloured"""
    intensity: Float32
    missing: Float32
    last_seen: Float32
    """time of the newest return, s"""

    @property
    def known(self) -> Mask:
        """Cells with a height."""
        return np.isfinite(self.height)

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of rows and columns."""
        return self.height.shape  # type: ignore[return-value]

    def cell_of(self, xy: Array) -> tuple[int, int]:
        """Returns (row, col) of the cell that contains ``xy``; may lie outside."""
        col, row = np.floor((np.asarray(xy)[:2] - self.origin_xy_m) / self.cell_m).astype(int)
        return int(row), int(col)

    def contains(self, row: int, col: int) -> bool:
        """True if the cell lies within the raster."""
        return 0 <= row < self.shape[0] and 0 <= col < self.shape[1]

    def centre_of(self, row: int, col: int) -> Array:
        """Returns x, y (2,) of a cell's centre."""
        return self.origin_xy_m + (np.array([col, row]) + 0.5) * self.cell_m

    def offsets_from(self, xy: Array) -> tuple[Array, Array]:
        """Returns x of every column (cols,) and y of every row (rows,) relative to ``xy``."""
        rows, cols = self.shape
        x = self.origin_xy_m[0] + (np.arange(cols) + 0.5) * self.cell_m - xy[0]
        y = self.origin_xy_m[1] + (np.arange(rows) + 0.5) * self.cell_m - xy[1]
        return x, y


def observed_raster(
    grid: GridMap, xy: Array | None = None, half_width_m: float = 0.0
) -> ElevationRaster | None:
    """Returns the bounding box of all cells with returns or missing pulses, of the whole map or of
    the square of ``half_width_m`` around ``xy`` (2,); None where there are none.

    The layers are views: the mapper writes to them in later control steps."""
    seen = (grid.count > 0.0) | (grid.missing > 0.0)
    if xy is not None:
        x, y = (np.asarray(xy)[:2] - grid.origin_xy_m) / grid.cell_m
        cells = np.arange(max(seen.shape)) + 0.5
        reach = half_width_m / grid.cell_m + 1.0
        seen &= np.abs(cells[: seen.shape[0], None] - y) <= reach
        seen &= np.abs(cells[None, : seen.shape[1]] - x) <= reach
    rows, cols = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    if rows.size == 0:
        return None
    box = np.s_[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1]
    return ElevationRaster(
        origin_xy_m=grid.origin_xy_m + np.array([cols[0], rows[0]]) * grid.cell_m,
        cell_m=grid.cell_m,
        ground=partial(grid.ground, box),
        **{name: getattr(grid, layer)[box] for name, layer in _LAYERS.items()},
    )


def _pooled_ground(raster: ElevationRaster, factor: int, where: Mask) -> Ground:
    """Means of the cells that are merged into one."""
    rows, cols = where.shape
    wanted = np.zeros(raster.shape, np.bool_)
    wanted[: rows * factor, : cols * factor] = where.repeat(factor, 0).repeat(factor, 1)
    whole = np.s_[: rows * factor, : cols * factor]
    merged = (
        layer[whole].reshape(rows, factor, cols, factor).swapaxes(1, 2).reshape(rows, cols, -1)
        for layer in raster.ground(wanted)
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of cells without any
        return Ground(*(np.nanmean(cells, axis=2) for cells in merged))


def pooled(raster: ElevationRaster, factor: int) -> ElevationRaster:
    """Merges ``factor`` x ``factor`` cells into one: weighted mean, total spread, highest return.

    Rows and columns at the end that do not fill a merged cell are dropped."""
    rows, cols = (n // factor for n in raster.shape)

    def blocks(layer: Float32) -> Float32:
        cut = layer[: rows * factor, : cols * factor]
        return cut.reshape(rows, factor, cols, factor, *layer.shape[2:])

    count = blocks(raster.count)
    weight = np.where(np.isfinite(blocks(raster.height)), np.maximum(count, 1e-6), 0.0)
    total = weight.sum(axis=(1, 3))
    safe_total = np.where(total > 0.0, total, np.nan)
    mean = np.nansum(weight * blocks(raster.height), axis=(1, 3)) / safe_total
    spread = blocks(raster.std) ** 2 + (blocks(raster.height) - mean[:, None, :, None]) ** 2
    variance = np.nansum(weight * spread, axis=(1, 3)) / safe_total
    intensity = np.nansum(weight * blocks(raster.intensity), axis=(1, 3)) / safe_total
    high = np.where(np.isfinite(blocks(raster.high)), blocks(raster.high), -np.inf)
    top = high.max(axis=(1, 3))
    low = np.where(np.isfinite(blocks(raster.low)), blocks(raster.low), np.inf)
    bottom = low.min(axis=(1, 3))
    coloured = np.isfinite(blocks(raster.rgb))
    rgb_sum = np.where(coloured, blocks(raster.rgb), 0.0).sum(axis=(1, 3))
    rgb_number = coloured.sum(axis=(1, 3))
    rgb = np.where(rgb_number > 0, rgb_sum / np.maximum(rgb_number, 1), np.nan)
    return ElevationRaster(
        origin_xy_m=raster.origin_xy_m,
        cell_m=raster.cell_m * factor,
        count=count.sum(axis=(1, 3)).astype(np.float32),
        height=mean.astype(np.float32),
        ground=partial(_pooled_ground, raster, factor),
        std=np.sqrt(variance).astype(np.float32),
        low=np.where(np.isfinite(bottom), bottom, np.nan).astype(np.float32),
        high=np.where(np.isfinite(top), top, np.nan).astype(np.float32),
        rgb=rgb.astype(np.float32),
        intensity=intensity.astype(np.float32),
        missing=blocks(raster.missing).sum(axis=(1, 3)).astype(np.float32),
        last_seen=blocks(raster.last_seen).max(axis=(1, 3)),
    )


@dataclass(frozen=True, kw_only=True, slots=True)
class PlaneField:
    """Least-squares plane of the square window around every cell; NaN where too few cells of the
    window are known."""

    angle_rad: Float32
    """angle between the plane's normal and the vertical, (rows, cols)"""
    level: Float32
    """height of the plane at the cell's centre"""


def fit_planes(
    height: Float32, cell_m: float, half_width_m: float, *, min_fraction: float = 0.6
) -> PlaneField:
    """Fits planes by running sums of moments: the cost does not depend on the window.

    ``height`` (rows, cols): float32, metres, NaN unknown. A window with less than ``min_fraction``
    of its cells known, or whose known cells lie on a line, gives NaN."""
    reach = max(round(half_width_m / cell_m), 1)
    enough = min_fraction * (2 * reach + 1) ** 2
    rise, level = (np.empty(height.shape, np.float32) for _ in range(2))
    _sliding_planes(height, reach, enough, rise, level)
    return PlaneField(angle_rad=np.arctan(np.sqrt(rise) / np.float32(cell_m)), level=level)


@numba.njit(cache=True)
def _add_row(height: Float32, row: int, sign: float, base: float, sums: Array) -> None:
    """Adds or subtracts one row to the column sums of n, y, z, yy, yz."""
    y = float(row)
    for col in range(height.shape[1]):
        z = height[row, col] - base
        if np.isnan(z):
            continue
        sums[col, 0] += sign
        sums[col, 1] += sign * y
        sums[col, 2] += sign * z
        sums[col, 3] += sign * y * y
        sums[col, 4] += sign * y * z


@numba.njit(cache=True)
def _with_column(w: _Sums, sums: Array, col: int, sign: float) -> _Sums:
    """Adds or subtracts one column to the window sums n, x, y, z, xx, xy, yy, xz, yz."""
    x = float(col)
    n, y, z, yy, yz = sums[col, 0], sums[col, 1], sums[col, 2], sums[col, 3], sums[col, 4]
    return (
        w[0] + sign * n, w[1] + sign * x * n, w[2] + sign * y, w[3] + sign * z,
        w[4] + sign * x * x * n, w[5] + sign * x * y, w[6] + sign * yy,
        w[7] + sign * x * z, w[8] + sign * yz,
    )  # fmt: skip


@numba.njit(cache=True)
def _sliding_planes(
    height: Float32, reach: int, enough: float, rise: Float32, level: Float32
) -> None:
    """Window sums slide along the rows; row and column numbers are the coordinates. ``rise``: the
    square of the plane's gradient, metres per cell."""
    rows, cols = height.shape
    base = 0.0
    for value in height.flat:
        if not np.isnan(value):
            base = float(value)
            break
    sums, windows = np.zeros((cols, 5)), np.empty((9, cols))
    for row in range(min(reach, rows)):
        _add_row(height, row, 1.0, base, sums)
    for row in range(rows):
        if row + reach < rows:
            _add_row(height, row + reach, 1.0, base, sums)
        if row - reach - 1 >= 0:
            _add_row(height, row - reach - 1, -1.0, base, sums)
        w = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        for col in range(min(reach, cols)):
            w = _with_column(w, sums, col, 1.0)
        for col in range(cols):
            if col + reach < cols:
                w = _with_column(w, sums, col + reach, 1.0)
            if col - reach - 1 >= 0:
                w = _with_column(w, sums, col - reach - 1, -1.0)
            for k in range(len(w)):
                windows[k, col] = w[k]
        _planes_of_row(windows, (row, base), enough, rise[row], level[row])


@numba.njit(cache=True, error_model="numpy")
def _planes_of_row(
    w: Array, at: tuple[int, float], enough: float, rise: Float32, level: Float32
) -> None:
    """Planes from the sums of each window, without a branch: divisions fill the lanes."""
    row, base = at
    for col in range(w.shape[1]):
        n = w[0, col]
        mx, my, mz = w[1, col] / n, w[2, col] / n, w[3, col] / n
        cxx, cxy, cyy = w[4, col] / n - mx * mx, w[5, col] / n - mx * my, w[6, col] / n - my * my
        cxz, cyz = w[7, col] / n - mx * mz, w[8, col] / n - my * mz
        determinant = cxx * cyy - cxy * cxy
        gx = (cxz * cyy - cyz * cxy) / determinant
        gy = (cyz * cxx - cxz * cxy) / determinant
        good = (n >= enough) & (n >= 3.0) & (determinant >= 1e-2)
        rise[col] = gx * gx + gy * gy if good else np.nan
        level[col] = base + mz + gx * (col - mx) + gy * (row - my) if good else np.nan


def distance_to(mask: Mask, cell_m: float) -> Float32:
    """Returns the exact Euclidean distance in metres from every cell to the nearest True cell; 1e6
    if there is none."""
    if not mask.any():
        return np.full(mask.shape, 1e6, np.float32)
    free = (~mask).astype(np.uint8)
    pixels = cv2.distanceTransform(free, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return (pixels * np.float32(cell_m)).astype(np.float32)


def disc_widths(radius_cells: float) -> NDArray[np.int64]:
    """Returns how far each row of the disc reaches to each side, in cells."""
    rows = np.arange(-int(radius_cells), int(radius_cells) + 1)
    return np.sqrt(radius_cells**2 - rows**2).astype(np.int64)


def disc_maximum(layer: Float32, radius_cells: float) -> Float32:
    """Returns the maximum over the disc of ``radius_cells`` around each cell. NaN cells are left
    out; -inf where the disc has no other."""
    lowest = np.float32(-np.inf)
    return _over_disc(np.where(np.isfinite(layer), layer, lowest), radius_cells, -np.inf)


def dilated(mask: Mask, radius_cells: float) -> Mask:
    """Returns the mask of cells whose centre lies within ``radius_cells`` of that of a True
    cell."""
    return _over_disc(mask.astype(np.uint8), radius_cells, 0.0) > 0


def _over_disc(layer: NDArray[Any], radius_cells: float, outside: float) -> NDArray[Any]:
    widths = disc_widths(radius_cells)
    across = np.abs(np.arange(widths.size) - widths.size // 2)
    disc = (across[None, :] <= widths[:, None]).astype(np.uint8)
    return cv2.dilate(layer, disc, borderType=cv2.BORDER_CONSTANT, borderValue=outside)
