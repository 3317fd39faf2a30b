"""Site selection: candidate landing sites of a map, best first (section 4 of the paper)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.api import Estimate, MapView
from touchdown.landing.api import Candidate, CostmapView, LandingParams, Selection
from touchdown.landing.selection.clustering import Clusters, bandwidths, quick_shift
from touchdown.landing.selection.costmap import compute_costmap
from touchdown.landing.selection.elevation_raster import (
    ElevationRaster,
    dilated,
    distance_to,
    observed_raster,
)
from touchdown.landing.selection.landable import (
    FOOTPRINT_M,
    LandableMap,
    assess,
    explain,
    fit_footprint,
    ground_planes,
)
from touchdown.landing.selection.plants import standing_plants, without_plants
from touchdown.landing.selection.risk import safe_probability
from touchdown.landing.selection.traffic import surfaces_of_sites, traffic_penalty, traffic_zone

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]
Mask = NDArray[np.bool_]

_AVOID_M = 3.0
"""radius around a refused site in which no site is accepted again"""
_ENOUGH_ROOM_M = 1.0
_ROOM_WEIGHT = 0.1
_PLENTY_M = 3.0
"""room from which the rank by risk no longer rises"""
_APART_M = 3.0
"""least distance between candidates"""
_PLANTS_PENALTY = 0.15
"""off the value of a site among low plants: bare ground is seen, theirs is inferred"""


NOTHING_MAPPED = Selection(
    candidates=(),
    costmap=None,
    allowed=np.zeros((0, 0), np.bool_),
    probability=np.zeros((0, 0), np.float32),
    cluster=np.zeros((0, 0), np.int32),
    modes=np.zeros((0, 2), np.int32),
)


@dataclass(frozen=True, kw_only=True, slots=True)
class _Assessed:
    """Intermediate results of one map, (rows, cols)."""

    raster: ElevationRaster
    costmap: CostmapView
    landable: LandableMap
    allowed: Mask
    probability: Float32
    room_m: Float32
    """distance to the nearest cell that is not allowed"""
    margin_m: float


@dataclass(frozen=True, kw_only=True, slots=True)
class SelectionLimits:
    """Limits of one selection beyond those in ``LandingParams``; the defaults set none."""

    reach_m: float = np.inf
    """horizontal distance from the vehicle to a site that the remaining energy allows"""
    avoid_odom: Sequence[Array] = ()
    """(3,) each, sites that were refused already"""
    unsafe_ground_odom: Sequence[Array] = ()
    """(3,) each, sites refused for their kind of ground: the surfaces they lie on rank lower"""
    wind_mps: float = 0.0
    """estimated wind speed"""
    least_bad: bool = False
    """accept the most probable site where none is good enough"""


NO_LIMITS = SelectionLimits()


def select_sites(
    map_view: MapView,
    estimate: Estimate,
    params: LandingParams,
    *,
    footprint_radius_m: float,
    limits: SelectionLimits = NO_LIMITS,
) -> Selection:
    """Returns the candidate sites of the observed map: accepted ones first, then by the value of
    ``params.scorer`` minus the penalty of ``landing.selection.traffic``.

    Raises ValueError for an unknown scorer.
    """
    mapped = observed_raster(map_view.coarse)
    if mapped is None:
        return NOTHING_MAPPED
    plants = standing_plants(mapped)
    raster = without_plants(mapped, plants)
    drift_m = params.gust_drift_s * limits.wind_mps
    assessed = _assess(raster, estimate, limits.reach_m, params, params.map_margin_m, drift_m)
    for avoid in limits.avoid_odom:
        x, y = raster.offsets_from(avoid)
        np.logical_and(
            assessed.allowed, np.hypot(x[None, :], y[:, None]) > _AVOID_M, out=assessed.allowed
        )
    zone = traffic_zone(raster, assessed.landable)
    worse = zone
    if limits.unsafe_ground_odom:
        worse = zone | surfaces_of_sites(raster, limits.unsafe_ground_odom)
    value = _value_map(assessed, params) - traffic_penalty(worse, params)
    value -= np.float32(_PLANTS_PENALTY) * dilated(plants, FOOTPRINT_M / raster.cell_m)
    if limits.least_bad and not assessed.allowed.any() and np.isfinite(value).any():
        assessed.allowed.flat[int(np.nanargmax(value))] = True
    bandwidth, radius = bandwidths(footprint_radius_m / raster.cell_m)
    clusters = quick_shift(
        _cluster_map(assessed, params), bandwidth_cells=bandwidth, radius_cells=radius
    )
    spots = _best_spots(clusters, value, assessed)
    apart = _APART_M / raster.cell_m
    candidates = [
        _candidate(assessed, spot, raster.centre_of(*spot), params, certain=not limits.least_bad)
        for spot in _shortlist(spots, value, assessed.allowed, params.max_candidates, apart)
    ]
    candidates.sort(key=lambda site: not site.accepted)  # stable: best first within both
    return Selection(
        candidates=tuple(candidates),
        costmap=assessed.costmap,
        allowed=assessed.allowed,
        probability=assessed.probability,
        cluster=clusters.label,
        modes=clusters.modes,
        traffic_zone=zone,
    )


def _cluster_map(assessed: _Assessed, params: LandingParams) -> Float32:
    """Returns the density values for Quick Shift: C_sum, or the probability for the scorer
    ``risk``."""
    return assessed.costmap.total if params.scorer == "paper" else assessed.probability


def _value_map(assessed: _Assessed, params: LandingParams) -> Float32:
    """Returns the value of every cell as a site; NaN out of reach or unknown."""
    if params.scorer == "paper":
        return assessed.costmap.total
    energy = np.float32(params.energy_weight) * (1.0 - assessed.costmap.distance)
    room = np.minimum(assessed.room_m, _PLENTY_M) * np.float32(_ROOM_WEIGHT / _PLENTY_M)
    tilt = np.minimum(assessed.landable.slope_deg / np.float32(params.max_slope_deg), 1.0)
    value = assessed.probability - energy + room - np.float32(params.level_weight) * tilt
    return value.astype(np.float32)


def check_site(
    map_view: MapView, estimate: Estimate, params: LandingParams, xy_odom: Array
) -> tuple[Candidate, CostmapView | None]:
    """Returns the commanded site ``xy_odom`` (2,) as a candidate, accepted or refused with the
    reason, and the costmap.

    Its margin is smaller than that of selected sites, since an operator chose it.
    """
    mapped = observed_raster(map_view.coarse)
    if mapped is None:
        return _unmapped(xy_odom), None
    raster = without_plants(mapped, standing_plants(mapped))
    assessed = _assess(raster, estimate, np.inf, params, params.low_margin_m, 0.0)
    spot = raster.cell_of(xy_odom)
    if not raster.contains(*spot):
        return _unmapped(xy_odom), assessed.costmap
    assessed.allowed[spot] = assessed.landable.mask[spot]
    return _candidate(assessed, spot, xy_odom, params), assessed.costmap


def _unmapped(xy: Array, why: str = "outside what was mapped") -> Candidate:
    return Candidate(
        position_odom=np.array([xy[0], xy[1], np.nan]),
        normal_odom=np.array([0.0, 0.0, 1.0]),
        score=0.0,
        flatness=0.0,
        smoothness=0.0,
        distance=0.0,
        slope_deg=float("nan"),
        roughness_m=float("nan"),
        clearance_m=0.0,
        accepted=False,
        reason=f"refused: {why}",
    )


def _assess(
    raster: ElevationRaster,
    estimate: Estimate,
    reach_m: float,
    params: LandingParams,
    margin_m: float,
    drift_m: float,
) -> _Assessed:
    planes = ground_planes(raster, params)
    position = estimate.odom_from_body.translation
    costmap = compute_costmap(raster, planes, position, reach_m, params)
    landable = assess(raster, planes, params, margin_m=margin_m, min_returns=params.min_returns)
    if params.scorer == "paper":
        allowed = landable.mask & np.isfinite(costmap.total)
        predicted = allowed.astype(np.float32)
    elif params.scorer == "risk":
        now_s = estimate.time_s
        predicted = safe_probability(raster, landable, params, now_s=now_s, drift_m=drift_m)
        allowed = (predicted >= params.min_safe_probability) & np.isfinite(costmap.distance)
    else:
        raise ValueError(f"landing.scorer is {params.scorer!r}: use 'risk' or 'paper'")
    return _Assessed(
        raster=raster,
        costmap=costmap,
        landable=landable,
        allowed=allowed,
        probability=predicted,
        room_m=distance_to(~allowed, raster.cell_m),
        margin_m=margin_m,
    )


def _best_spots(clusters: Clusters, value: Float32, assessed: _Assessed) -> list[tuple[int, int]]:
    """Returns one cell for each cluster: the allowed one of highest value, with a bonus for up to
    1 m of room; the mode itself where no cell of the cluster is allowed."""
    spots = clusters.modes.copy()
    room = np.minimum(assessed.room_m, _ENOUGH_ROOM_M) / _ENOUGH_ROOM_M
    cells = np.flatnonzero(assessed.allowed & (clusters.label >= 0))
    merit = value.ravel()[cells] + _ROOM_WEIGHT * room.ravel()[cells]
    label = clusters.label.ravel()[cells]
    best = np.full(spots.shape[0], -np.inf, np.float32)
    np.maximum.at(best, label, merit)
    winners = np.flatnonzero(merit == best[label])[::-1]  # ties: the first cell is written last
    rows, cols = np.divmod(cells[winners], value.shape[1])
    spots[label[winners]] = np.column_stack([rows, cols])
    return [(int(row), int(col)) for row, col in spots]


def _shortlist(
    spots: list[tuple[int, int]],
    value: Float32,
    allowed: NDArray[np.bool_],
    limit: int,
    apart_cells: float,
) -> list[tuple[int, int]]:
    """Returns the best ``limit`` spots at the least distance from one another. Two thirds are
    reserved for allowed ones, so that refused ones of high value are listed too."""
    filled = np.nan_to_num(value, nan=-np.inf)
    by_value = sorted(spots, key=lambda spot: (-float(filled[spot]), spot))
    chosen: list[tuple[int, int]] = []
    for wanted, most in ((True, (2 * limit + 2) // 3), (False, limit)):
        for spot in by_value:
            if len(chosen) >= most:
                break
            if bool(allowed[spot]) is wanted and all(
                np.hypot(spot[0] - other[0], spot[1] - other[1]) >= apart_cells for other in chosen
            ):
                chosen.append(spot)
    return chosen


def _candidate(
    assessed: _Assessed,
    spot: tuple[int, int],
    xy: Array,
    params: LandingParams,
    *,
    certain: bool = True,
) -> Candidate:
    """Returns the site at ``xy`` (2,) in the cell ``spot``. Where it must be ``certain``, the plane
    through the whole footprint is checked too."""
    costmap = assessed.costmap
    xy = np.asarray(xy, dtype=np.float64)
    plane = fit_footprint(assessed.raster, xy)
    if plane is None:
        return _unmapped(xy, _refusal(assessed, spot, params))
    predicted = float(assessed.probability[spot])
    refusal = None
    if not assessed.allowed[spot]:
        refusal = _refusal(assessed, spot, params)
    elif certain and plane.slope_deg > params.max_slope_deg - params.slope_margin_deg:
        refusal = f"slope {plane.slope_deg:.1f} deg over the footprint"
    elif certain and plane.roughness_m > params.max_step_m - params.step_margin_m:
        refusal = f"{plane.roughness_m:.2f} m off its plane"
    room = float(assessed.room_m[spot])
    figures = (
        f"slope {plane.slope_deg:.1f} deg, roughness {plane.roughness_m:.2f} m, "
        f"clearance {room:.1f} m, C_sum {_value(costmap.total, spot):.2f}"
    )
    if params.scorer == "risk":
        figures += f", safe with probability {predicted:.3f}"
    verdict = "landable" if certain or predicted >= params.min_safe_probability else "the least bad"
    return Candidate(
        position_odom=plane.position,
        normal_odom=plane.normal,
        score=_value(costmap.total, spot),
        flatness=_value(costmap.flatness, spot),
        smoothness=_value(costmap.smoothness, spot),
        distance=_value(costmap.distance, spot),
        slope_deg=plane.slope_deg,
        roughness_m=plane.roughness_m,
        clearance_m=room,
        accepted=refusal is None,
        reason=f"{verdict}: {figures}" if refusal is None else f"refused: {refusal}",
        safe_probability=predicted if params.scorer == "risk" else float("nan"),
    )


def _refusal(assessed: _Assessed, spot: tuple[int, int], params: LandingParams) -> str:
    landable = assessed.landable
    if not landable.mask[spot]:
        return explain(assessed.raster, landable, *spot, params, assessed.margin_m)
    predicted = float(assessed.probability[spot])
    if predicted < params.min_safe_probability and params.scorer == "risk":
        return f"safe with probability {predicted:.2f} (at least {params.min_safe_probability:.2f})"
    return "seen from closer it was not landable, or out of reach"


def _value(layer: Float32, spot: tuple[int, int]) -> float:
    value = float(layer[spot])
    return value if np.isfinite(value) else 0.0
