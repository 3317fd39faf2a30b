"""True heights, slopes, classes and landing safety of the ground, seen from above.

All values hold for time 0, without the vehicle and the moving bodies. The geometric rule at a
point (`scenes.api.TruthMaps.safe_geometry`) means:

- slope: the plane fitted within 0.5 m slopes by at most 5 deg, at the point and everywhere within
  0.5 m of it (so that the fits cover the disc of 1.0 m);
- step or object: no height within 1.0 m departs by more than 0.10 m from the plane fitted there,
  and none differs by more than 0.10 m from one 0.1 m away;
- nothing from 1.0 to 1.5 m stands more than 0.25 m over the same plane.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import ndimage

from touchdown.scenes.api import LAND_CLASSES, OTHER_CLASS_ID, SAFE_CLASSES, Array, Scene, TruthMaps
from touchdown.scenes.truth import static_surface

SLOPE_RADIUS_M = 0.5
PAD_RADIUS_M = 1.0
CLEAR_RADIUS_M = 1.5
MAX_SLOPE_DEG = 5.0
MAX_STEP_M = 0.10
STEP_REACH_M = 0.1
MAX_TALL_M = 0.25
PATCH_CELL_M = 0.02
SEARCH_M = 15.0
SEARCH_CELL_M = 0.05
_WATER = LAND_CLASSES.index("water")


@dataclass(frozen=True, kw_only=True, slots=True)
class TouchdownJudgement:
    """The true ground at one point."""

    slope_deg: float
    """of the plane fitted within 0.5 m"""
    roughness_m: float
    """standard deviation of the ground from this plane"""
    safe_geometry: bool
    """as in `scenes.api.TruthMaps`"""
    land_class: str
    """one of LAND_CLASSES or ``other``"""
    safe: bool
    """safe_geometry and a safe class"""
    obstacle_distance_m: float
    """horizontal distance to the nearest object that stands more than 0.25 m over the ground
    beneath it; 15 where there is none within 15 m"""


def truth_maps(scene: Scene, cell_m: float = 0.1, region: Array | None = None) -> TruthMaps:
    """Returns rasters of the whole scene, or of ``region`` [[x_min, y_min], [x_max, y_max]] (2, 2)
    metres, world frame.

    Cells are sampled at their centres; poles, rails and other geoms narrower than a cell also along
    their own middle line.
    Raises ValueError for a cell that is not positive and below 0.25 m, or an empty region.
    """
    if not 0.0 < cell_m <= 0.25:
        raise ValueError(f"cell_m is {cell_m}: give a length above 0 and up to 0.25 m")
    bounds = np.asarray(scene.bounds_xy_m if region is None else region, np.float64)
    count = np.round((bounds[1] - bounds[0]) / cell_m).astype(int)
    if (count < 1).any():
        raise ValueError(
            f"region {bounds.tolist()} is empty: give [[x_min, y_min], [x_max, y_max]]"
        )
    # The rule looks 1.5 m around, so rays are cast beyond the region.
    margin = int(np.ceil(CLEAR_RADIUS_M / cell_m)) + 1
    origin = bounds[0] - margin * cell_m
    shape = (int(count[1]) + 2 * margin, int(count[0]) + 2 * margin)
    heights, geoms = static_surface.cast_down(scene, origin, cell_m, shape)
    classes = static_surface.class_ids(scene, origin, cell_m, heights, geoms)
    static_surface.raise_thin_things(scene, heights, origin, cell_m)
    slope = fitted_slope_deg(heights, cell_m)
    rule = geometric_rule(heights, slope, classes == _WATER, cell_m)
    inside = (slice(margin, -margin), slice(margin, -margin))
    class_id, safe_geometry = classes[inside].copy(), rule[inside].copy()
    safe_ids = [LAND_CLASSES.index(name) for name in sorted(SAFE_CLASSES)]
    return TruthMaps(
        origin_xy_m=bounds[0].copy(),
        cell_m=cell_m,
        height_m=heights[inside].astype(np.float32),
        slope_deg=slope[inside].astype(np.float32),
        class_id=class_id,
        safe_geometry=safe_geometry,
        safe=safe_geometry & np.isin(class_id, safe_ids),
    )


def judge_touchdown(scene: Scene, xy: Array) -> TouchdownJudgement:
    """Judges one point, (2,) world, with rays 2 cm apart, so that thin objects count."""
    point = np.asarray(xy, np.float64)
    cells = int(np.ceil(CLEAR_RADIUS_M / PATCH_CELL_M)) + 1
    origin = point - (cells + 0.5) * PATCH_CELL_M
    shape = (2 * cells + 1, 2 * cells + 1)
    heights, geoms = static_surface.cast_down(scene, origin, PATCH_CELL_M, shape)
    classes = static_surface.class_ids(scene, origin, PATCH_CELL_M, heights, geoms)
    slope = fitted_slope_deg(heights, PATCH_CELL_M)
    only_here = np.zeros(heights.shape, bool)
    only_here[cells, cells] = True
    rule = geometric_rule(heights, slope, classes == _WATER, PATCH_CELL_M, only_here)
    here = int(classes[cells, cells])
    land_class = "other" if here == OTHER_CLASS_ID else LAND_CLASSES[here]
    safe_geometry = bool(rule[cells, cells])
    return TouchdownJudgement(
        slope_deg=float(slope[cells, cells]),
        roughness_m=_roughness_m(heights, cells),
        safe_geometry=safe_geometry,
        land_class=land_class,
        safe=safe_geometry and land_class in SAFE_CLASSES,
        obstacle_distance_m=_obstacle_distance(scene, point, float(heights[cells, cells])),
    )


def _roughness_m(heights: Array, cells: int) -> float:
    """Of a patch of (2 cells + 1)^2 heights, at its middle."""
    disc = _disc(SLOPE_RADIUS_M, PATCH_CELL_M)
    gradient = np.array(_gradient(heights, cells, cells, disc, PATCH_CELL_M))
    plane = PATCH_CELL_M * disc[:, ::-1] @ gradient
    return float(np.std(heights[cells + disc[:, 0], cells + disc[:, 1]] - plane))


def fitted_slope_deg(heights: Array, cell_m: float) -> Array:
    """Slope in degrees of the plane fitted within 0.5 m of each cell, (rows, cols); NaN where the
    disc leaves the raster or misses ground."""
    return _slope_map(heights, _disc(SLOPE_RADIUS_M, cell_m), cell_m)


def geometric_rule(
    heights: Array,
    slope_deg: Array,
    water: NDArray[np.bool_],
    cell_m: float,
    where: NDArray[np.bool_] | None = None,
) -> NDArray[np.bool_]:
    """The geometric rule (module docstring) at each cell, or only at the cells of ``where``.
    False where the disc of 1.5 m leaves the raster. All rasters (rows, cols)."""
    reach = max(1, round(STEP_REACH_M / cell_m))
    window = _disc_mask(reach * cell_m, cell_m)
    lowest = ndimage.minimum_filter(heights, footprint=window, mode="nearest")
    highest = ndimage.maximum_filter(heights, footprint=window, mode="nearest")
    # Neighbours on both sides of a cell: half the range of a slope, the whole of a step.
    step = np.maximum(highest - heights, heights - lowest)
    bad = ~(step <= MAX_STEP_M) | water
    steep = ~(slope_deg <= MAX_SLOPE_DEG)
    near_bad = _dilate(bad, PAD_RADIUS_M, cell_m)
    near_steep = _dilate(steep, PAD_RADIUS_M - SLOPE_RADIUS_M, cell_m)
    candidate = ~near_bad & ~near_steep
    if where is not None:
        candidate &= where
    pad = _disc(PAD_RADIUS_M, cell_m)
    clear = _disc(CLEAR_RADIUS_M, cell_m)
    return _clear_cells(heights, candidate, pad, clear, cell_m)


def _dilate(mask: NDArray[np.bool_], radius_m: float, cell_m: float) -> NDArray[np.bool_]:
    """Cells within ``radius_m`` of a set cell (exact Euclidean distance)."""
    window = _disc_mask(radius_m, cell_m).astype(np.uint8)
    return np.asarray(cv2.dilate(mask.astype(np.uint8), window) > 0)


def _disc_mask(radius_m: float, cell_m: float) -> NDArray[np.bool_]:
    reach = int(radius_m / cell_m + 1e-9)
    row, col = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    return np.hypot(row, col) * cell_m <= radius_m + 1e-9


def _disc(radius_m: float, cell_m: float) -> NDArray[np.int64]:
    """(K, 2) row and column offsets of the cells within ``radius_m``."""
    mask = _disc_mask(radius_m, cell_m)
    return np.argwhere(mask) - mask.shape[0] // 2


@njit(cache=True, error_model="numpy")
def _gradient(
    heights: Array, row: int, col: int, disc: NDArray[np.int64], cell_m: float
) -> tuple[float, float]:
    """dz/dx and dz/dy of the least-squares plane over ``disc``. On a symmetric disc the normal
    equations are diagonal: the gradient is sum(x z) / sum(x^2)."""
    sum_x, sum_y, norm = 0.0, 0.0, 0.0
    for k in range(disc.shape[0]):
        z = heights[row + disc[k, 0], col + disc[k, 1]]
        sum_y += disc[k, 0] * z
        sum_x += disc[k, 1] * z
        norm += disc[k, 0] * disc[k, 0]
    return sum_x / (norm * cell_m), sum_y / (norm * cell_m)


@njit(cache=True, error_model="numpy")
def _slope_map(heights: Array, disc: NDArray[np.int64], cell_m: float) -> Array:
    rows, cols = heights.shape
    reach = disc[:, 0].max()
    slope = np.full((rows, cols), np.nan)
    for row in range(reach, rows - reach):
        for col in range(reach, cols - reach):
            gx, gy = _gradient(heights, row, col, disc, cell_m)
            slope[row, col] = np.degrees(np.arctan(np.hypot(gx, gy)))
    return slope


@njit(cache=True, error_model="numpy")
def _clear_cells(
    heights: Array,
    candidate: NDArray[np.bool_],
    pad: NDArray[np.int64],
    clear: NDArray[np.int64],
    cell_m: float,
) -> NDArray[np.bool_]:
    """Candidates with no departure above 0.10 m from the pad's plane and nothing taller than
    0.25 m over it around the pad."""
    rows, cols = heights.shape
    reach = clear[:, 0].max()
    pad_reach2 = (PAD_RADIUS_M / cell_m + 1e-9) ** 2
    clear_cells = np.zeros((rows, cols), np.bool_)
    for row in range(reach, rows - reach):
        for col in range(reach, cols - reach):
            if not candidate[row, col]:
                continue
            gx, gy = _gradient(heights, row, col, pad, cell_m)
            mean = 0.0
            for k in range(pad.shape[0]):
                mean += heights[row + pad[k, 0], col + pad[k, 1]]
            mean /= pad.shape[0]
            fits = not np.isnan(mean)
            for k in range(clear.shape[0]):
                i, j = clear[k, 0], clear[k, 1]
                rise = heights[row + i, col + j] - mean - (gx * j + gy * i) * cell_m
                if i * i + j * j <= pad_reach2:
                    if not abs(rise) <= MAX_STEP_M:
                        fits = False
                        break
                elif rise > MAX_TALL_M:
                    fits = False
                    break
            clear_cells[row, col] = fits
    return clear_cells


def _obstacle_distance(scene: Scene, point: Array, height_m: float) -> float:
    """Distance to the nearest cell of 5 cm above the bare ground, or above
    the point where that lies on a deck. Searches squares of growing size."""
    on_deck = height_m - float(static_surface.bare_ground(scene, point, height_m)) > MAX_TALL_M
    for reach in (2.0, 5.0, SEARCH_M):
        cells = round(reach / SEARCH_CELL_M)
        origin = point - (cells + 0.5) * SEARCH_CELL_M
        shape = (2 * cells + 1, 2 * cells + 1)
        heights, _ = static_surface.cast_down(scene, origin, SEARCH_CELL_M, shape)
        offsets = (
            np.stack(np.meshgrid(*2 * [np.arange(-cells, cells + 1)]), axis=-1) * SEARCH_CELL_M
        )
        ground = static_surface.bare_ground(scene, point + offsets, height_m)
        if on_deck:
            ground = np.maximum(ground, height_m)
        tall = heights - ground > MAX_TALL_M
        if tall.any():
            nearest = float(np.hypot(*offsets[tall].T).min())
            if nearest <= reach:
                return nearest
    return SEARCH_M
