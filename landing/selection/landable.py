"""Where the ground itself allows a landing: the check that decides acceptance.

Every cell is examined for defects of its own (unknown, water, steep, step, object, traffic); a
site is landable when its footprint, widened by the error of the map, holds none of them and
nothing tall stands around it. Geometry only: what kind of place it is remains for the classifier.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.landing.api import LandingParams
from touchdown.landing.selection.elevation_raster import (
    ElevationRaster,
    PlaneField,
    dilated,
    disc_maximum,
    fit_planes,
)

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]
Mask = NDArray[np.bool_]

FOOTPRINT_M = 1.0
"""no defect within this distance of the touchdown point"""
_TALL_M = 0.25
_NEVER_HIGHEST = np.float32(-1e6)
_STEP_HALF_WIDTH_M = 0.2
_PEAK_ALLOWANCE_M = 0.05
"""how far the highest return of flat ground may stick out beyond a real object: LIDAR noise"""
_ROUGH_STD_M = 0.05
"""spread of returns within a cell above LIDAR noise (2 cm) and the slope inside the cell"""
_MOVING_STD_M = 0.15
_MOVING_SHARE = 0.4
_MOVING_WIDTH_M = 1.0
_MOVING_MARGIN_M = 3.0
_WATER_WINDOW_M = 1.0
_WATER_MIN_MISSING = 3.0


class Defect(IntEnum):
    """What is wrong with a cell; 0 is nothing. Higher ones win where several apply."""

    NONE = 0
    UNKNOWN = 1
    SPARSE = 2
    ROUGH = 3
    STEEP = 4
    STEP = 5
    OBSTACLE = 6
    MOVING = 7
    WATER = 8


_WORDS = {
    Defect.UNKNOWN: "ground not seen",
    Defect.SPARSE: "too few returns",
    Defect.ROUGH: "returns spread in height",
    Defect.STEEP: "too steep",
    Defect.STEP: "a step",
    Defect.OBSTACLE: "an object",
    Defect.MOVING: "something moves there",
    Defect.WATER: "pulses do not come back (water)",
}


@dataclass(frozen=True, kw_only=True, slots=True)
class LandableMap:
    """Result for a whole terrain, (rows, cols)."""

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
    """The plane through one site, from the cells within the footprint radius."""

    position: Array
    """(3,) centre on the plane"""
    normal: Array
    slope_deg: float
    roughness_m: float
    """largest |residual| of a cell's mean height"""


def water_cells(raster: ElevationRaster, max_ratio: float) -> Mask:
    """Cells around which more than ``max_ratio`` of the pulses never came back."""
    size = 2 * round(0.5 * _WATER_WINDOW_M / raster.cell_m) + 1
    window = (size, size)
    missing = cv2.boxFilter(raster.missing, -1, window, normalize=False,
                            borderType=cv2.BORDER_CONSTANT)  # fmt: skip
    hits = cv2.boxFilter(raster.count, -1, window, normalize=False,
                         borderType=cv2.BORDER_CONSTANT)  # fmt: skip
    return (missing >= _WATER_MIN_MISSING) & (missing > max_ratio * (missing + hits))


def moving_cells(raster: ElevationRaster) -> Mask:
    """Where something passed, widened by the room that traffic takes.

    A cell over which a vehicle drove gave mostly ground and now and then a roof: wide spread, mean
    near the lowest return. A crown that lets pulses through has its mean up in the leaves, and a
    standing object spreads the returns of its edge alone, so narrow patches are opened away.
    """
    with np.errstate(invalid="ignore"):
        mostly_ground = raster.height - raster.low < _MOVING_SHARE * (raster.high - raster.low)
        spread = mostly_ground & (raster.std > _MOVING_STD_M)
    width = 2 * round(0.5 * _MOVING_WIDTH_M / raster.cell_m) + 1
    blobs = cv2.morphologyEx(
        spread.astype(np.uint8),
        cv2.MORPH_OPEN,
        np.ones((width, width), np.uint8),
        borderType=cv2.BORDER_CONSTANT,
        borderValue=0,
    )
    return dilated(blobs > 0, _MOVING_MARGIN_M / raster.cell_m)


def ground_planes(raster: ElevationRaster, params: LandingParams) -> PlaneField:
    """The plane through the ground around every cell."""
    return fit_planes(raster.height, raster.cell_m, params.normal_half_width_m)


def assess(
    raster: ElevationRaster,
    planes: PlaneField,
    params: LandingParams,
    *,
    margin_m: float,
    min_returns: float,
) -> LandableMap:
    """Examines every cell.

    ``planes``: see ``ground_planes``; ``margin_m`` widens the footprint and the clear radius by
    the error of map and position; ``min_returns``: a cell with fewer is too thinly seen to trust.
    """
    cell, known = raster.cell_m, raster.known
    slope = np.rad2deg(planes.angle_rad)
    reach = max(round(_STEP_HALF_WIDTH_M / cell), 1)
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
            (Defect.ROUGH, raster.std > _ROUGH_STD_M),
            (Defect.STEEP, slope > params.max_slope_deg - params.slope_margin_deg),
            (Defect.STEP, known & (step > params.max_step_m - params.step_margin_m)),
            (Defect.OBSTACLE, peak > params.max_step_m + _PEAK_ALLOWANCE_M),
            (Defect.MOVING, moving_cells(raster)),
            (Defect.WATER, water_cells(raster, params.max_missing_ratio)),
        )
        for kind, where in rules:
            defect[where] = kind
        clear_cells = (params.clear_radius_m + margin_m) / cell
        tall = disc_maximum(raster.high, clear_cells) - raster.height
        mask = ~dilated(defect > 0, (FOOTPRINT_M + margin_m) / cell) & (tall <= _TALL_M)
    mask &= _inside(raster.shape, (FOOTPRINT_M + margin_m) / cell)
    return LandableMap(
        mask=mask,
        defect=defect,
        slope_deg=slope,
        step_m=step,
        peak_m=peak,
        tall_m=tall.astype(np.float32),
    )


def _inside(shape: tuple[int, int], border_cells: float) -> Mask:
    """Cells whose footprint lies within the raster."""
    inside = np.zeros(shape, bool)
    border = int(np.ceil(border_cells))
    inside[border : max(shape[0] - border, 0), border : max(shape[1] - border, 0)] = True
    return inside


def fit_footprint(
    raster: ElevationRaster, xy: Array, radius_m: float = FOOTPRINT_M
) -> Footprint | None:
    """Plane through the known cells within ``radius_m`` of ``xy``; None if fewer than half of
    them are known."""
    local = raster.window(xy, radius_m)
    x, y = local.offsets_from(xy)
    xx, yy = np.meshgrid(x, y)
    inside = xx**2 + yy**2 <= radius_m**2
    use = inside & local.known
    if use.sum() < max(0.5 * np.pi * (radius_m / local.cell_m) ** 2, 6.0):
        return None
    design = np.column_stack([xx[use], yy[use], np.ones(int(use.sum()))])
    solution = np.linalg.lstsq(design, local.height[use].astype(np.float64), rcond=None)[0]
    residual = local.height[use] - design @ solution
    normal = np.array([-solution[0], -solution[1], 1.0])
    normal /= np.linalg.norm(normal)
    return Footprint(
        position=np.array([xy[0], xy[1], solution[2]]),
        normal=normal,
        slope_deg=float(np.rad2deg(np.arccos(min(normal[2], 1.0)))),
        roughness_m=float(np.abs(residual).max()),
    )


def explain(
    raster: ElevationRaster, landable: LandableMap, row: int, col: int, params: LandingParams,
    margin_m: float,
) -> str:  # fmt: skip
    """Why (row, col) is not landable, in words with figures."""
    radius = (FOOTPRINT_M + margin_m) / raster.cell_m
    reach = int(np.ceil(radius))
    top, left = max(row - reach, 0), max(col - reach, 0)
    defect = landable.defect[top : row + reach + 1, left : col + reach + 1]
    r, c = np.indices(defect.shape)
    away = np.hypot(r + top - row, c + left - col)
    wrong = (defect > 0) & (away <= radius)
    if not wrong.any():
        tall = float(landable.tall_m[row, col])
        if tall > _TALL_M:
            around = params.clear_radius_m + margin_m
            return f"something {tall:.2f} m high within {around:.1f} m (limit {_TALL_M:.2f} m)"
        return "the footprint reaches beyond the map"
    nearest = np.where(wrong, away, np.inf)
    r, c = np.unravel_index(int(np.argmin(nearest)), nearest.shape)
    metres = float(nearest[r, c]) * raster.cell_m
    r, c = r + top, c + left
    kind = Defect(int(landable.defect[r, c]))
    figure = {
        Defect.STEEP: f" ({landable.slope_deg[r, c]:.1f} deg, limit {params.max_slope_deg:.1f})",
        Defect.STEP: f" ({landable.step_m[r, c]:.2f} m, limit {params.max_step_m:.2f})",
        Defect.OBSTACLE: f" ({landable.peak_m[r, c]:.2f} m, limit {params.max_step_m:.2f})",
        Defect.ROUGH: f" (standard deviation {raster.std[r, c]:.2f} m)",
        Defect.SPARSE: f" ({raster.count[r, c]:.0f})",
        Defect.WATER: f" ({raster.missing[r, c]:.0f} missing, {raster.count[r, c]:.0f} seen)",
    }.get(kind, "")
    return f"{_WORDS[kind]}{figure} {metres:.1f} m away"
