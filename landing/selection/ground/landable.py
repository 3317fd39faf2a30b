"""Geometric check of the ground: the cells at which a touchdown is safe.

Every cell is checked for defects (unknown, water, steep, step, object, traffic). A site is landable
if its footprint, widened by the error of the map, contains none and nothing tall stands around it.
The class of the ground is checked by ``landing.classification``.
"""

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.landing.api import GroundParams, LandingParams, SiteRule
from touchdown.landing.selection.ground.elevation_raster import (
    ElevationRaster,
    PlaneField,
    dilated,
    disc_maximum,
    fit_planes,
)
from touchdown.sim.typing import Array, Float32, Mask

_NEVER_HIGHEST = np.float32(-1e6)


class Defect(IntEnum):
    """Defect of a cell; 0 is none. Where several apply, the highest is kept."""

    NONE = 0
    UNKNOWN = 1
    SPARSE = 2
    ROUGH = 3
    STEEP = 4
    STEP = 5
    OBSTACLE = 6
    MOVING = 7
    WATER = 8


class Refusal(NamedTuple):
    """Rule that refuses a site, and the reason as text."""

    rule: SiteRule
    text: str


_REFUSALS = {
    Defect.UNKNOWN: Refusal("not_seen", "ground not seen"),
    Defect.SPARSE: Refusal("few_returns", "too few returns"),
    Defect.ROUGH: Refusal("rough", "returns spread in height"),
    Defect.STEEP: Refusal("steep", "too steep"),
    Defect.STEP: Refusal("step", "a step"),
    Defect.OBSTACLE: Refusal("object", "an object"),
    Defect.MOVING: Refusal("motion", "motion observed"),
    Defect.WATER: Refusal("water", "missing pulses (water)"),
}


@dataclass(frozen=True, kw_only=True, slots=True)
class LandableMap:
    """Result of the check of a whole raster, (rows, cols)."""

    mask: Mask
    """a touchdown at this cell's centre is safe by geometry"""
    defect: NDArray[np.uint8]
    """``Defect`` of the cell itself"""
    slope_deg: Float32
    step_m: Float32
    peak_m: Float32
    """highest return above the local plane"""
    tall_m: Float32
    """highest return within the clear radius above the cell's own ground"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Footprint:
    """Plane through the cells within the footprint radius of a site."""

    position: Array
    """(3,) centre on the plane"""
    slope_deg: float
    roughness_m: float
    """largest |residual| of a cell's mean height"""


def water_cells(raster: ElevationRaster, params: LandingParams) -> Mask:
    """Returns the mask of cells around which more than ``max_missing_ratio`` of the pulses are
    missing."""
    size = 2 * round(0.5 * params.ground.water_window_m / raster.cell_m) + 1
    window = (size, size)
    missing = cv2.boxFilter(raster.missing, -1, window, normalize=False,
                            borderType=cv2.BORDER_CONSTANT)  # fmt: skip
    hits = cv2.boxFilter(raster.count, -1, window, normalize=False,
                         borderType=cv2.BORDER_CONSTANT)  # fmt: skip
    many = missing >= params.ground.water_min_missing
    return many & (missing > params.max_missing_ratio * (missing + hits))


def moving_cells(raster: ElevationRaster, limits: GroundParams) -> Mask:
    """Returns the mask of cells that a moving object passed, widened by the clearance of traffic.

    A cell that a vehicle drove over has mostly returns of the ground and a few of its roof: a wide
    spread with the mean near the lowest return. In a tree crown the mean lies high, and a static
    object spreads returns at its edge only: such narrow regions are removed by morphological
    opening.
    """
    with np.errstate(invalid="ignore"):
        mostly_ground = raster.height - raster.low < limits.moving_fraction * (
            raster.high - raster.low
        )
        spread = mostly_ground & (raster.std > limits.moving_std_m)
    width = 2 * round(0.5 * limits.moving_width_m / raster.cell_m) + 1
    blobs = cv2.morphologyEx(
        spread.astype(np.uint8),
        cv2.MORPH_OPEN,
        np.ones((width, width), np.uint8),
        borderType=cv2.BORDER_CONSTANT,
        borderValue=0,
    )
    return dilated(blobs > 0, limits.moving_margin_m / raster.cell_m)


def max_slope_deg(params: LandingParams, *, margins: bool) -> float:
    """Returns the steepest ground that is landed on; with ``margins`` less, for the error of what a
    map shows of single cells, or from survey height."""
    return params.max_slope_deg - (params.slope_margin_deg if margins else 0.0)


def max_step_m(params: LandingParams, *, margins: bool) -> float:
    """Returns the highest step that is landed on, as for `max_slope_deg`."""
    return params.max_step_m - (params.step_margin_m if margins else 0.0)


def _highest_peak_m(params: LandingParams) -> float:
    return params.max_step_m + params.ground.peak_allowance_m


def plane_refusal(plane: Footprint, params: LandingParams, *, margins: bool) -> Refusal | None:
    """Returns why the plane of a footprint is not landed on; None where it is."""
    if plane.slope_deg > max_slope_deg(params, margins=margins):
        return Refusal("footprint_slope", f"slope {plane.slope_deg:.1f} deg over the footprint")
    if plane.roughness_m > max_step_m(params, margins=margins):
        return Refusal("footprint_roughness", f"{plane.roughness_m:.2f} m off its plane")
    return None


def ground_planes(raster: ElevationRaster, params: LandingParams) -> PlaneField:
    """Returns the plane through the ground around every cell."""
    return fit_planes(raster.height, raster.cell_m, params.normal_half_width_m)


def assess(
    raster: ElevationRaster,
    planes: PlaneField,
    params: LandingParams,
    *,
    margin_m: float,
    min_returns: float,
) -> LandableMap:
    """Checks every cell.

    ``planes``: of ``ground_planes``; ``margin_m``: error of map and position, by which footprint
    and clear radius are widened; ``min_returns``: a cell with fewer counts as sparse.
    """
    cell, known, limits = raster.cell_m, raster.known, params.ground
    footprint_cells = (limits.footprint_m + margin_m) / cell
    slope = np.rad2deg(planes.angle_rad)
    reach = max(round(limits.step_half_width_m / cell), 1)
    square = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    top = cv2.dilate(np.where(known, raster.height, _NEVER_HIGHEST), square)
    bottom = cv2.erode(np.where(known, raster.height, -_NEVER_HIGHEST), square)
    with np.errstate(invalid="ignore"):
        step = (top - bottom).astype(np.float32)
        peak = (raster.high - planes.level).astype(np.float32)
        defect = np.zeros(raster.shape, np.uint8)
        rules: tuple[tuple[Defect, Mask], ...] = (
            (Defect.SPARSE, raster.count < min_returns),
            (Defect.UNKNOWN, ~known | ~np.isfinite(slope)),
            (Defect.ROUGH, raster.std > limits.rough_std_m),
            (Defect.STEEP, slope > max_slope_deg(params, margins=True)),
            (Defect.STEP, known & (step > max_step_m(params, margins=True))),
            (Defect.OBSTACLE, peak > _highest_peak_m(params)),
            (Defect.MOVING, moving_cells(raster, limits)),
            (Defect.WATER, water_cells(raster, params)),
        )
        for found, where in rules:
            defect[where] = found
        clear_cells = (params.clear_radius_m + margin_m) / cell
        tall = disc_maximum(raster.high, clear_cells) - raster.height
        mask = ~dilated(defect > 0, footprint_cells) & (tall <= limits.tall_m)
    mask &= inner_cells(raster.shape, footprint_cells)
    return LandableMap(
        mask=mask,
        defect=defect,
        slope_deg=slope,
        step_m=step,
        peak_m=peak,
        tall_m=tall.astype(np.float32),
    )


def inner_cells(shape: tuple[int, int], border_cells: float) -> Mask:
    """Returns the mask of cells at least ``border_cells`` away from the border."""
    inside = np.zeros(shape, bool)
    border = int(np.ceil(border_cells))
    inside[border : max(shape[0] - border, 0), border : max(shape[1] - border, 0)] = True
    return inside


def fit_footprint(raster: ElevationRaster, xy: Array, radius_m: float) -> Footprint | None:
    """Returns the plane through the known cells within ``radius_m`` of ``xy``; None if fewer than
    half of the cells are known."""
    cell = raster.cell_m
    reach = int(np.ceil(radius_m / cell))
    row, col = raster.cell_of(xy)
    rows, cols = (slice(max(at - reach, 0), max(at + reach + 1, 0)) for at in (row, col))
    height = raster.height[rows, cols]
    corner = raster.origin_xy_m + np.array([cols.start, rows.start]) * cell
    yy, xx = (np.indices(height.shape) + 0.5) * cell + corner[::-1, None, None]
    xx, yy = xx - xy[0], yy - xy[1]
    use = (xx**2 + yy**2 <= radius_m**2) & np.isfinite(height)
    if use.sum() < max(0.5 * np.pi * (radius_m / cell) ** 2, 6.0):
        return None
    design = np.column_stack([xx[use], yy[use], np.ones(int(use.sum()))])
    solution = np.linalg.lstsq(design, height[use].astype(np.float64), rcond=None)[0]
    residual = height[use] - design @ solution
    normal = np.array([-solution[0], -solution[1], 1.0])
    normal /= np.linalg.norm(normal)
    return Footprint(
        position=np.array([xy[0], xy[1], solution[2]]),
        slope_deg=float(np.rad2deg(np.arccos(min(normal[2], 1.0)))),
        roughness_m=float(np.abs(residual).max()),
    )


def explain(
    raster: ElevationRaster, landable: LandableMap, row: int, col: int, params: LandingParams,
    margin_m: float,
) -> Refusal:  # fmt: skip
    """Returns why the cell (row, col) is not landable, the text with figures."""
    radius, tallest = (params.ground.footprint_m + margin_m) / raster.cell_m, params.ground.tall_m
    reach = int(np.ceil(radius))
    top, left = max(row - reach, 0), max(col - reach, 0)
    defect = landable.defect[top : row + reach + 1, left : col + reach + 1]
    r, c = np.indices(defect.shape)
    away = np.hypot(r + top - row, c + left - col)
    defective = (defect > 0) & (away <= radius)
    if not defective.any():
        tall = float(landable.tall_m[row, col])
        if tall > tallest:
            around = params.clear_radius_m + margin_m
            text = f"something {tall:.2f} m high within {around:.1f} m (limit {tallest:.2f} m)"
            return Refusal("tall_neighbour", text)
        return Refusal("map_edge", "the footprint reaches beyond the map")
    nearest = np.where(defective, away, np.inf)
    r, c = np.unravel_index(int(np.argmin(nearest)), nearest.shape)
    metres = float(nearest[r, c]) * raster.cell_m
    r, c = r + top, c + left
    found = Defect(int(landable.defect[r, c]))
    steepest, step = max_slope_deg(params, margins=True), max_step_m(params, margins=True)
    figure = {
        Defect.STEEP: f" ({landable.slope_deg[r, c]:.1f} deg, limit {steepest:.1f})",
        Defect.STEP: f" ({landable.step_m[r, c]:.2f} m, limit {step:.2f})",
        Defect.OBSTACLE: f" ({landable.peak_m[r, c]:.2f} m, limit {_highest_peak_m(params):.2f})",
        Defect.ROUGH: f" (standard deviation {raster.std[r, c]:.2f} m)",
        Defect.SPARSE: f" ({raster.count[r, c]:.0f})",
        Defect.WATER: f" ({raster.missing[r, c]:.0f} missing, {raster.count[r, c]:.0f} seen)",
    }.get(found, "")
    refusal = _REFUSALS[found]
    return refusal._replace(text=f"{refusal.text}{figure} {metres:.1f} m away")
