"""Site selection: candidate landing sites of a map, best first (section 4 of the paper)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.api import Estimate, MapView
from touchdown.landing.api import Candidate, CostmapView, LandingParams, Selection, SiteRule
from touchdown.landing.selection.clustering import Clusters, bandwidths, quick_shift
from touchdown.landing.selection.costmap import compute_costmap
from touchdown.landing.selection.elevation_raster import (
    ElevationRaster,
    distance_to,
    observed_raster,
)
from touchdown.landing.selection.landable import (
    FOOTPRINT_M,
    Refusal,
    assess,
    explain,
    fit_footprint,
    ground_planes,
)
from touchdown.landing.selection.plants import standing_plants, without_plants
from touchdown.landing.selection.ranking import ranked
from touchdown.landing.selection.risk import safe_probability
from touchdown.landing.selection.score import Assessed, Score, score_sites
from touchdown.landing.selection.traffic import surfaces_of_sites, traffic_zone

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]
Mask = NDArray[np.bool_]

NOTHING_MAPPED = Selection(
    candidates=(),
    costmap=None,
    allowed=np.zeros((0, 0), np.bool_),
    probability=np.zeros((0, 0), np.float32),
    cluster=np.zeros((0, 0), np.int32),
    modes=np.zeros((0, 2), np.int32),
)


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
    `landing.selection.score`.

    Raises ValueError for an unknown scorer.
    """
    mapped = observed_raster(map_view.coarse)
    if mapped is None:
        return NOTHING_MAPPED
    plants = standing_plants(mapped)
    raster = without_plants(mapped, plants)
    assessed = _assess(raster, estimate, params, params.map_margin_m, limits)
    zone = traffic_zone(raster, assessed.landable)
    close = zone
    if limits.unsafe_ground_odom:
        close = zone | surfaces_of_sites(raster, limits.unsafe_ground_odom)
    score = score_sites(assessed, close, plants, params)
    if limits.least_bad and not assessed.allowed.any() and np.isfinite(score.value).any():
        assessed.allowed.flat[int(np.nanargmax(score.value))] = True
    bandwidth, radius = bandwidths(footprint_radius_m / raster.cell_m)
    clusters = quick_shift(
        _cluster_map(assessed, params), bandwidth_cells=bandwidth, radius_cells=radius
    )
    bonus = _cluster_bonus(assessed, params)
    spots = _best_spots(clusters, score.value + bonus, assessed)
    candidates = [
        dataclasses.replace(
            _candidate(
                assessed, score, spot, raster.centre_of(*spot), params, certain=not limits.least_bad
            ),
            cluster_bonus=float(bonus[spot]),
        )
        for spot in _shortlist(spots, score.value, assessed, params)
    ]
    return Selection(
        candidates=ranked(candidates),
        costmap=_shown(assessed, score),
        allowed=assessed.allowed,
        probability=assessed.probability,
        cluster=clusters.label,
        modes=clusters.modes,
        traffic_zone=zone,
    )


def _cluster_map(assessed: Assessed, params: LandingParams) -> Float32:
    """Returns the density values for Quick Shift: C_sum, or the probability for the scorer
    ``risk``."""
    return assessed.costmap.total if params.scorer == "paper" else assessed.probability


def _shown(assessed: Assessed, score: Score) -> CostmapView:
    """Returns the costmap with what ranks the sites."""
    return dataclasses.replace(assessed.costmap, value=score.value, allowed=assessed.allowed)


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
    plants = standing_plants(mapped)
    raster = without_plants(mapped, plants)
    assessed = _assess(raster, estimate, params, params.low_margin_m, NO_LIMITS)
    zone = traffic_zone(raster, assessed.landable)
    score = score_sites(assessed, zone, plants, params)
    spot = raster.cell_of(xy_odom)
    if not raster.contains(*spot):
        return _unmapped(xy_odom), _shown(assessed, score)
    assessed.allowed[spot] = assessed.landable.mask[spot]
    candidate = _candidate(assessed, score, spot, xy_odom, params)
    if candidate.accepted:
        candidate = dataclasses.replace(candidate, rule="commanded")
    return candidate, _shown(assessed, score)


_OUTSIDE = Refusal("not_seen", "outside what was mapped")


def _unmapped(xy: Array, refusal: Refusal = _OUTSIDE) -> Candidate:
    return Candidate(
        position_odom=np.array([xy[0], xy[1], np.nan]),
        normal_odom=np.array([0.0, 0.0, 1.0]),
        c_sum=0.0,
        slope_deg=float("nan"),
        roughness_m=float("nan"),
        clearance_m=0.0,
        accepted=False,
        reason=f"refused: {refusal.text}",
        rule=refusal.rule,
    )


def _assess(
    raster: ElevationRaster,
    estimate: Estimate,
    params: LandingParams,
    margin_m: float,
    limits: SelectionLimits,
) -> Assessed:
    planes = ground_planes(raster, params)
    position = estimate.odom_from_body.translation
    costmap = compute_costmap(raster, planes, position, limits.reach_m, params)
    landable = assess(raster, planes, params, margin_m=margin_m, min_returns=params.min_returns)
    if params.scorer == "paper":
        allowed = landable.mask & np.isfinite(costmap.total)
        predicted = allowed.astype(np.float32)
    elif params.scorer == "risk":
        drift_m = params.gust_drift_s * limits.wind_mps
        now_s = estimate.time_s
        predicted = safe_probability(raster, landable, params, now_s=now_s, drift_m=drift_m)
        allowed = (predicted >= params.min_safe_probability) & np.isfinite(costmap.distance)
    else:
        raise ValueError(f"landing.scorer is {params.scorer!r}: use 'risk' or 'paper'")
    avoided = np.zeros(raster.shape, np.bool_)
    for avoid in limits.avoid_odom:
        x, y = raster.offsets_from(avoid)
        avoided |= np.hypot(x[None, :], y[:, None]) <= params.refused_radius_m
    return Assessed(
        raster=raster,
        costmap=costmap,
        landable=landable,
        allowed=allowed & ~avoided,
        avoided=avoided,
        probability=predicted,
        clearance_m=distance_to(~allowed, raster.cell_m),
        margin_m=margin_m,
        vehicle_odom=position,
    )


def _cluster_bonus(assessed: Assessed, params: LandingParams) -> Float32:
    """Returns what is added to the value of every cell where cells of one cluster are compared."""
    share = np.minimum(assessed.clearance_m, params.clearance_enough_m) / params.clearance_enough_m
    return (params.clearance_weight * share).astype(np.float32)


def _best_spots(clusters: Clusters, merit: Float32, assessed: Assessed) -> list[tuple[int, int]]:
    """Returns one cell for each cluster: the allowed one of highest ``merit`` (rows, cols); the
    mode itself where no cell of the cluster is allowed."""
    spots = clusters.modes.copy()
    cells = np.flatnonzero(assessed.allowed & (clusters.label >= 0))
    merits = merit.ravel()[cells]
    label = clusters.label.ravel()[cells]
    best = np.full(spots.shape[0], -np.inf, np.float32)
    np.maximum.at(best, label, merits)
    winners = np.flatnonzero(merits == best[label])[::-1]  # ties: the first cell is written last
    rows, cols = np.divmod(cells[winners], merit.shape[1])
    spots[label[winners]] = np.column_stack([rows, cols])
    return [(int(row), int(col)) for row, col in spots]


def _shortlist(
    spots: list[tuple[int, int]], value: Float32, assessed: Assessed, params: LandingParams
) -> list[tuple[int, int]]:
    """Returns the spots of highest value, at most ``max_candidates`` with ``candidate_spacing_m``
    between any two. Two thirds are reserved for allowed ones, so that refused ones of high value
    are listed too."""
    limit = params.max_candidates
    apart = params.candidate_spacing_m / assessed.raster.cell_m
    filled = np.nan_to_num(value, nan=-np.inf)
    by_value = sorted(spots, key=lambda spot: (-float(filled[spot]), spot))
    chosen: list[tuple[int, int]] = []
    for wanted, most in ((True, (2 * limit + 2) // 3), (False, limit)):
        for spot in by_value:
            if len(chosen) >= most:
                break
            if bool(assessed.allowed[spot]) is wanted and all(
                np.hypot(spot[0] - other[0], spot[1] - other[1]) >= apart for other in chosen
            ):
                chosen.append(spot)
    return chosen


def _candidate(
    assessed: Assessed,
    score: Score,
    spot: tuple[int, int],
    xy: Array,
    params: LandingParams,
    *,
    certain: bool = True,
) -> Candidate:
    """Returns the site at ``xy`` (2,) in the cell ``spot``. Where it must be ``certain``, the plane
    through the whole footprint is checked too."""
    xy = np.asarray(xy, dtype=np.float64)
    plane = fit_footprint(assessed.raster, xy)
    if plane is None:
        return _unmapped(xy, _refusal(assessed, spot, params))
    predicted = float(assessed.probability[spot])
    refusal = None
    if not assessed.allowed[spot]:
        refusal = _refusal(assessed, spot, params)
    elif certain and plane.slope_deg > params.max_slope_deg - params.slope_margin_deg:
        text = f"slope {plane.slope_deg:.1f} deg over the footprint"
        refusal = Refusal("footprint_slope", text)
    elif certain and plane.roughness_m > params.max_step_m - params.step_margin_m:
        refusal = Refusal("footprint_roughness", f"{plane.roughness_m:.2f} m off its plane")
    clearance, value = float(assessed.clearance_m[spot]), float(score.value[spot])
    figures = (
        f"score {value:.3f}, slope {plane.slope_deg:.1f} deg, roughness {plane.roughness_m:.2f} m, "
        f"clearance {clearance:.1f} m"
    )
    if params.scorer == "risk":
        figures += f", safe with probability {predicted:.3f}"
    good = certain or predicted >= params.min_safe_probability
    verdict = "landable" if good else "the least bad"
    preferred: SiteRule = "lower_value" if good else "least_bad"  # `ranked` names the highest
    c_sum = float(assessed.costmap.total[spot])
    return Candidate(
        position_odom=plane.position,
        normal_odom=plane.normal,
        c_sum=c_sum if np.isfinite(c_sum) else 0.0,
        slope_deg=plane.slope_deg,
        roughness_m=plane.roughness_m,
        clearance_m=clearance,
        accepted=refusal is None,
        reason=f"{verdict}: {figures}" if refusal is None else f"refused: {refusal.text}",
        rule=preferred if refusal is None else refusal.rule,
        value=value,
        terms=score.terms_at(spot),
        step_m=_highest_step(assessed, spot),
        safe_probability=predicted if params.scorer == "risk" else float("nan"),
    )


def _highest_step(assessed: Assessed, spot: tuple[int, int]) -> float:
    """Returns the highest step around the known cells of the footprint of ``spot``."""
    reach = int(FOOTPRINT_M / assessed.raster.cell_m)
    rows, cols = (slice(max(at - reach, 0), at + reach + 1) for at in spot)
    step = assessed.landable.step_m[rows, cols]
    r, c = np.indices(step.shape)
    away = np.hypot(r + rows.start - spot[0], c + cols.start - spot[1])
    inside = assessed.raster.known[rows, cols] & (away <= reach)
    return float(step[inside].max()) if inside.any() else float("nan")


def _refusal(assessed: Assessed, spot: tuple[int, int], params: LandingParams) -> Refusal:
    """Returns why the cell ``spot`` is not allowed: what the map shows there, for the scorer
    ``risk`` with the probability that follows from it."""
    landable, predicted = assessed.landable, float(assessed.probability[spot])
    if assessed.avoided[spot]:
        text = f"within {params.refused_radius_m:g} m of a site that was refused"
        return Refusal("near_refused_site", text)
    unlikely = params.scorer == "risk" and predicted < params.min_safe_probability
    chance = f"safe with probability {predicted:.2f} (at least {params.min_safe_probability:.2f})"
    if not landable.mask[spot]:
        found = explain(assessed.raster, landable, *spot, params, assessed.margin_m)
        return found._replace(text=f"{found.text}; {chance}") if unlikely else found
    if unlikely:
        return Refusal("low_probability", chance)
    return Refusal("out_of_reach", "out of reach of the remaining energy")
