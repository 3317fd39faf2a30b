"""The recheck of the site from 10 m and 4 m, on the fine map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from touchdown.estimator.api import MapView
from touchdown.landing.api import LandingParams
from touchdown.landing.selection.ground.elevation_raster import (
    ElevationRaster,
    distance_to,
    observed_raster,
    pooled,
)
from touchdown.landing.selection.ground.landable import (
    assess,
    explain,
    fit_footprint,
    ground_planes,
    plane_refusal,
)
from touchdown.landing.selection.ground.plants import standing_plants, without_plants
from touchdown.sim.typing import Array

_POOL = 2
"""fine cells merged along each axis, for enough returns in each"""
MIN_RETURNS = 3.0
_ENOUGH_CLEARANCE_M = 1.0


@dataclass(frozen=True, kw_only=True, slots=True)
class Recheck:
    """Result of a recheck."""

    position_odom: Array | None
    """(3,) where to land; None where the ground is not landable"""
    reason: str
    height: str = ""
    """height above the site, as text"""
    unsafe_class: str = ""
    """reason why the class of the ground is refused; empty where it is not"""

    @property
    def passed(self) -> bool:
        """True where the vehicle may land at ``position_odom``."""
        return self.position_odom is not None and not self.unsafe_class

    @property
    def text(self) -> str:
        """What was found, with the height."""
        return f"at {self.height}: {self.unsafe_class or self.reason}"


def recheck_site(
    map_view: MapView, site_odom: Array, max_shift_m: float, params: LandingParams
) -> Recheck:
    """Checks the fine map around ``site_odom`` (3,).

    Keeps the site where it is landable, else moves it to the landable cell within ``max_shift_m``
    with the most clearance minus distance."""
    raster = fine_window(map_view, site_odom, max_shift_m, params)
    if raster is None:
        return Recheck(position_odom=None, reason="no fine map of the site")
    margin = params.low_margin_m
    planes = ground_planes(raster, params)
    landable = assess(raster, planes, params, margin_m=margin, min_returns=MIN_RETURNS)
    row, col = raster.cell_of(site_odom)
    if not raster.contains(row, col):
        return Recheck(position_odom=None, reason="the site lies outside the fine map")
    if landable.mask[row, col]:
        return _checked_plane(raster, site_odom[:2], params, "as selected")
    defect = explain(raster, landable, row, col, params, margin).text
    x, y = raster.offsets_from(site_odom)
    away = np.hypot(x[None, :], y[:, None])
    clearance = np.minimum(distance_to(~landable.mask, raster.cell_m), _ENOUGH_CLEARANCE_M)
    merit = np.where(landable.mask & (away <= max_shift_m), clearance - away, -np.inf)
    best = int(np.argmax(merit))
    if not np.isfinite(merit.flat[best]):
        return Recheck(position_odom=None, reason=f"not landable from closer: {defect}")
    row, col = divmod(best, raster.shape[1])
    return _checked_plane(
        raster, raster.centre_of(row, col), params, f"moved {away[row, col]:.1f} m: {defect}"
    )


def ground_under(map_view: MapView, xy_odom: Array, radius_m: float = 0.5) -> float:
    """Returns the height of the ground at ``xy_odom`` (2,).

    It is that of the plane through the cells within ``radius_m``, of the fine map where it is known
    there, else of the coarse one; NaN if neither is."""
    for grid in (map_view.fine, map_view.coarse):
        if grid is None:
            continue
        reach = int(np.ceil(1.5 * radius_m / grid.cell_m))
        col, row = np.floor((xy_odom[:2] - grid.origin_xy_m) / grid.cell_m).astype(int)
        rows, cols = grid.height_m.shape
        if not (reach <= row < rows - reach and reach <= col < cols - reach):
            continue
        near = np.s_[row - reach : row + reach + 1, col - reach : col + reach + 1]
        patch = grid.ground(near).height_m
        known = np.isfinite(patch)
        if known.mean() < 0.5:
            continue
        offset = (np.arange(-reach, reach + 1) + 0.5) * grid.cell_m
        x0 = grid.origin_xy_m + np.array([col, row]) * grid.cell_m - xy_odom[:2]
        xx, yy = np.meshgrid(offset + x0[0], offset + x0[1])
        design = np.column_stack([np.ones(int(known.sum())), xx[known], yy[known]])
        return float(np.linalg.lstsq(design, patch[known].astype(np.float64), rcond=None)[0][0])
    return float("nan")


def fine_window(
    map_view: MapView, site: Array, max_shift_m: float, params: LandingParams
) -> ElevationRaster | None:
    """Returns the fine map as a recheck looks at it: plants taken off, cells of 0.1 m; None where
    there is too little of it."""
    if map_view.fine is None:
        return None
    half = max_shift_m + params.clear_radius_m + params.ground.footprint_m
    window = observed_raster(map_view.fine, site, half)
    if window is None or min(window.shape) < 4 * _POOL:
        return None
    seen = pooled(window, _POOL)
    plants = standing_plants(seen, params.ground, fill_gaps=True)
    return without_plants(seen, plants, params.ground)


def _checked_plane(raster: ElevationRaster, xy: Array, params: LandingParams, how: str) -> Recheck:
    plane = fit_footprint(raster, xy, params.ground.footprint_m)
    if plane is None:
        return Recheck(position_odom=None, reason="the ground under the site is unknown")
    refusal = plane_refusal(plane, params, margins=False)  # many returns, from close
    if refusal is not None:
        return Recheck(position_odom=None, reason=refusal.text)
    return Recheck(
        position_odom=plane.position,
        reason=f"{how}; slope {plane.slope_deg:.1f} deg, roughness {plane.roughness_m:.2f} m",
    )
