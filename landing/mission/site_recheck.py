"""The recheck of the site from 10 m and 4 m, on the fine map, and the best ground in view for a
descent that can neither choose a site nor look for another."""

from dataclasses import dataclass

import numpy as np

from touchdown.estimator.api import MapView
from touchdown.landing.api import LandingParams
from touchdown.landing.selection.ground.elevation_raster import (
    ElevationRaster,
    dilated,
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
from touchdown.landing.selection.probability import probability, risk_features
from touchdown.sim.typing import Array, Float32, Mask

_POOL = 2
"""fine cells merged along each axis, for enough returns in each"""
MIN_RETURNS = 3.0
_ENOUGH_CLEARANCE_M = 1.0
REACH_M = 8.0
_PER_M = 0.01
"""probability that a metre of way is worth where nothing is landable"""
_ASIDE_M, _BELOW_M = 1.0, 1.0
"""distances kept on the way from what stands beside it and below the legs"""
_APART_M = 0.5
"""distance between two cells whose ways are tried"""


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


def best_ground(
    map_view: MapView, here_odom: Array, legs_odom: float, params: LandingParams, now_s: float
) -> Recheck:
    """Returns where to land within `REACH_M` of ``here_odom`` (2,) or (3,), by the fine map before
    the coarse one: the nearest landable ground, less its clearance up to a metre, else that of the
    highest probability of a safe touchdown. Nothing in the straight way there stands higher than a
    metre below ``legs_odom``, the height of the legs. No position where no ground is known."""
    here, half = here_odom[:2], REACH_M + params.clear_radius_m + params.ground.footprint_m
    judged = []
    fine = fine_window(map_view, here, REACH_M, params)
    if fine is not None:
        judged.append(_judged(fine, params, params.low_margin_m, MIN_RETURNS, now_s))
    coarse = observed_raster(map_view.coarse, here, half)
    if coarse is not None and min(coarse.shape) > 8:
        plants = standing_plants(coarse, params.ground)
        coarse = without_plants(coarse, plants, params.ground)
        raster, landable, safe = _judged(
            coarse, params, params.map_margin_m, params.min_returns, now_s
        )
        seen = _seen(coarse, fine)  # better by the fine map
        judged.append((raster, landable & ~seen, np.where(seen, np.float32(0.0), safe)))
    for certain in (True, False):
        for raster, landable, safe in judged:
            x, y = raster.offsets_from(here)
            away = np.hypot(x[None, :], y[:, None]).astype(np.float32)
            if raster.contains(*raster.cell_of(here)):
                away[raster.cell_of(here)] = 0.0
            clear = np.minimum(distance_to(~landable, raster.cell_m), _ENOUGH_CLEARANCE_M)
            merit, where = (clear - away, landable) if certain else (safe - _PER_M * away, safe > 0)
            merit = np.where(where & (away <= REACH_M), merit, np.float32(-np.inf))
            cell = _reached(raster, merit, here, legs_odom)
            if cell is None:
                continue
            xy = here if cell == raster.cell_of(here) else raster.centre_of(*cell)
            plane = fit_footprint(raster, xy, params.ground.footprint_m)
            if plane is not None:
                text = f"{away[cell]:.1f} m away, safe with probability {safe[cell]:.2f}"
                return Recheck(position_odom=plane.position, reason=text)
    return Recheck(position_odom=None, reason="no ground in view")


def _judged(
    raster: ElevationRaster,
    params: LandingParams,
    margin_m: float,
    min_returns: float,
    now_s: float,
) -> tuple[ElevationRaster, Mask, Float32]:
    """The raster, its landable cells and the probability of a safe touchdown in each."""
    planes = ground_planes(raster, params)
    landable = assess(raster, planes, params, margin_m=margin_m, min_returns=min_returns)
    plants = np.zeros(raster.shape, np.bool_)
    features = risk_features(raster, landable, params, plants, now_s=now_s)
    return raster, landable.mask, probability(features, params.risk_weights)


def _seen(coarse: ElevationRaster, fine: ElevationRaster | None) -> Mask:
    """The cells of ``coarse`` in whose centres ``fine`` knows the ground."""
    seen = np.zeros(coarse.shape, np.bool_)
    if fine is not None:
        x, y = coarse.offsets_from(fine.origin_xy_m)
        cols, rows = (np.floor(at / fine.cell_m).astype(int) for at in (x, y))
        inside = [(at >= 0) & (at < n) for at, n in zip((rows, cols), fine.shape, strict=True)]
        seen[np.ix_(*inside)] = fine.known[np.ix_(rows[inside[0]], cols[inside[1]])]
    return seen


def _reached(
    raster: ElevationRaster, merit: Float32, here: Array, legs_m: float
) -> tuple[int, int] | None:
    """Returns the cell of the highest finite ``merit`` with a clear way from ``here`` (2,)."""
    with np.errstate(invalid="ignore"):
        high = dilated(raster.high > legs_m - _BELOW_M, _ASIDE_M / raster.cell_m)
    start, left = np.array(raster.cell_of(here)), merit.copy()
    rows, cols = np.indices(merit.shape)
    while np.isfinite(left).any():
        row, col = divmod(int(np.argmax(left)), merit.shape[1])
        span = max(abs(row - start[0]), abs(col - start[1]), 1)
        way = np.rint(np.linspace(start, (row, col), span + 1)).astype(int)
        way = way[((way >= 0) & (way < merit.shape)).all(axis=1)]
        if not high[way[:, 0], way[:, 1]].any():
            return row, col
        left[np.hypot(rows - row, cols - col) * raster.cell_m < _APART_M] = -np.inf
    return None
