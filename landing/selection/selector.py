"""Site selection: candidate landing sites of a map, best first (section 4 of the paper)."""

import dataclasses
from dataclasses import dataclass

import numpy as np

from touchdown.estimator.api import Estimate, MapView
from touchdown.landing.api import (
    Candidate,
    CostmapView,
    LandingParams,
    Selection,
    SelectorInput,
    SelectorRig,
    SemanticView,
    SiteRule,
    TermLayer,
)
from touchdown.landing.selection.clustering import Clusters, bandwidths, quick_shift
from touchdown.landing.selection.costmap import c_sum, distance, flatness_of, smoothness_of
from touchdown.landing.selection.ground.elevation_raster import distance_to, observed_raster
from touchdown.landing.selection.ground.landable import (
    Refusal,
    assess,
    fit_footprint,
    ground_planes,
    plane_refusal,
)
from touchdown.landing.selection.ground.plants import standing_plants, without_plants
from touchdown.landing.selection.ground.traffic import surfaces_of_sites, traffic_zone
from touchdown.landing.selection.probability import probability, risk_features
from touchdown.landing.selection.ranking import ranked
from touchdown.landing.selection.terms import (
    Inputs,
    allowed_ground,
    checks_ground,
    cluster_bonus,
    layers_of,
    passing,
    refusal_of,
    score_of,
    terms_at,
)
from touchdown.sim.typing import Array, Float32, Mask

NOTHING_MAPPED = Selection(
    candidates=(),
    costmap=None,
    allowed=np.zeros((0, 0), np.bool_),
    probability=np.zeros((0, 0), np.float32),
    cluster=np.zeros((0, 0), np.int32),
    modes=np.zeros((0, 2), np.int32),
)


@dataclass(frozen=True, kw_only=True, slots=True)
class Assessed:
    """One map and what a selector makes of it, (rows, cols)."""

    site: Inputs
    c_sum: Float32
    allowed: Mask
    """cells that pass the gates"""
    avoided: Mask
    """cells near a site that was refused already"""
    zone: Mask
    """cells near traffic"""
    margin_m: float
    layers: tuple[TermLayer, ...]
    score: Float32


def select_sites(seen: SelectorInput, rig: SelectorRig) -> Selection:
    """Returns the candidate sites of the observed map by ``rig.landing.selector``, a shipped one:
    accepted ones first, then by their score. In an emergency the best site is accepted where none
    is good enough."""
    params = rig.landing
    found = _assess(seen, params, params.map_margin_m)
    if found is None:
        return NOTHING_MAPPED
    site, score = found.site, found.score
    if seen.emergency and not found.allowed.any() and np.isfinite(score).any():
        found.allowed.flat[int(np.nanargmax(score))] = True
    by_score = site.selector.clusters == "score"
    bandwidth, radius = bandwidths(rig.vehicle.footprint_radius_m / site.raster.cell_m, params)
    clusters = quick_shift(
        score if by_score else site.probability, bandwidth_cells=bandwidth, radius_cells=radius
    )
    bonus = cluster_bonus(site)
    spots = _best_spots(clusters, clusters.density if by_score else score + bonus, found.allowed)
    candidates = [
        dataclasses.replace(
            _candidate(found, spot, site.raster.centre_of(*spot), certain=not seen.emergency),
            cluster_bonus=float(bonus[spot]),
        )
        for spot in _shortlist(spots, score, found.allowed, site.raster.cell_m, params)
    ]
    return Selection(
        candidates=ranked(candidates),
        costmap=_shown(found, seen.semantics),
        allowed=found.allowed,
        probability=site.probability,
        cluster=clusters.label,
        modes=clusters.modes,
        traffic_zone=found.zone,
    )


def check_site(
    map_view: MapView, estimate: Estimate, params: LandingParams, xy_odom: Array
) -> tuple[Candidate, CostmapView | None]:
    """Returns the commanded site ``xy_odom`` (2,) as a candidate, accepted or refused with the
    reason, and the costmap.

    Its margin is smaller than that of selected sites, since an operator chose it.
    """
    seen = SelectorInput(map_view=map_view, estimate=estimate)
    found = _assess(seen, params, params.low_margin_m)
    if found is None:
        return unmapped(xy_odom), None
    spot = found.site.raster.cell_of(xy_odom)
    if not found.site.raster.contains(*spot):
        return unmapped(xy_odom), _shown(found)
    if checks_ground(found.site.selector):
        found.allowed[spot] = found.site.landable.mask[spot]
    candidate = _candidate(found, spot, xy_odom)
    if candidate.accepted:
        candidate = dataclasses.replace(candidate, rule="commanded")
    return candidate, _shown(found)


_OUTSIDE = Refusal("not_seen", "outside what was mapped")


def unmapped(xy: Array, refusal: Refusal = _OUTSIDE) -> Candidate:
    """Returns the site at ``xy`` (2,), whose ground is unknown, refused."""
    return Candidate(
        position_odom=np.array([xy[0], xy[1], np.nan]),
        c_sum=0.0,
        slope_deg=float("nan"),
        roughness_m=float("nan"),
        clearance_m=0.0,
        accepted=False,
        reason=f"refused: {refusal.text}",
        rule=refusal.rule,
    )


def _assess(seen: SelectorInput, params: LandingParams, margin_m: float) -> Assessed | None:
    """Returns the terms, gates and score of the observed map; None where nothing was mapped."""
    mapped = observed_raster(seen.map_view.coarse)
    if mapped is None:
        return None
    selector = params.chosen_selector
    plants = standing_plants(mapped, params.ground)
    raster = without_plants(mapped, plants, params.ground)
    planes = ground_planes(raster, params)
    position = seen.estimate.odom_from_body.translation
    landable = assess(raster, planes, params, margin_m=margin_m, min_returns=params.min_returns)
    zone = traffic_zone(raster, landable, params)
    reach_m = seen.reach_m if "reach" in selector.gates else np.inf
    drift_m, now_s = params.gust_drift_s * seen.wind_mps, seen.estimate.time_s
    features = risk_features(raster, landable, params, plants, now_s=now_s, drift_m=drift_m)
    site = Inputs(
        params=params,
        selector=selector,
        raster=raster,
        landable=landable,
        vehicle_odom=position,
        smoothness=smoothness_of(raster, params),
        flatness=flatness_of(raster, planes, params),
        distance=distance(raster, position, reach_m),
        probability=probability(features, params.risk_weights),
        traffic=zone | surfaces_of_sites(raster, tuple(seen.unsafe_ground_odom), params),
        plants=plants,
        ground=allowed_ground(seen.semantics, raster, params),
        clearance_m=np.zeros(raster.shape, np.float32),
    )
    allowed = passing(site)
    site = dataclasses.replace(site, clearance_m=distance_to(~allowed, raster.cell_m))
    avoided = np.zeros(raster.shape, np.bool_)
    for avoid in seen.avoid_odom:
        x, y = raster.offsets_from(avoid)
        avoided |= np.hypot(x[None, :], y[:, None]) <= params.refused_radius_m
    layers = layers_of(site)
    return Assessed(
        site=site,
        c_sum=c_sum(site.smoothness, site.flatness, site.distance, params),
        allowed=allowed & ~avoided,
        avoided=avoided,
        zone=zone,
        margin_m=margin_m,
        layers=layers,
        score=score_of(layers, raster.shape),
    )


def _shown(found: Assessed, semantics: SemanticView | None = None) -> CostmapView:
    """Returns the costmap with what ranks the sites."""
    site = found.site
    return CostmapView(
        origin_xy_m=site.raster.origin_xy_m,
        cell_m=site.raster.cell_m,
        total=found.c_sum,
        flatness=site.flatness,
        smoothness=site.smoothness,
        distance=site.distance,
        rgb=np.nan_to_num(site.raster.rgb).astype(np.uint8),
        value=found.score,
        allowed=found.allowed,
        terms=found.layers,
        semantics=semantics,
    )


def _best_spots(clusters: Clusters, merit: Float32, allowed: Mask) -> list[tuple[int, int]]:
    """Returns one cell for each cluster: the allowed one of highest ``merit`` (rows, cols); the
    mode itself where no cell of the cluster is allowed."""
    spots = clusters.modes.copy()
    cells = np.flatnonzero(allowed & (clusters.label >= 0))
    merits = merit.ravel()[cells]
    label = clusters.label.ravel()[cells]
    best = np.full(spots.shape[0], -np.inf, np.float32)
    np.maximum.at(best, label, merits)
    winners = np.flatnonzero(merits == best[label])[::-1]  # ties: the first cell is written last
    rows, cols = np.divmod(cells[winners], merit.shape[1])
    spots[label[winners]] = np.column_stack([rows, cols])
    return [(int(row), int(col)) for row, col in spots]


def _shortlist(
    spots: list[tuple[int, int]],
    value: Float32,
    allowed: Mask,
    cell_m: float,
    params: LandingParams,
) -> list[tuple[int, int]]:
    """Returns the spots of highest value, at most ``max_candidates`` with ``candidate_spacing_m``
    between any two. Two thirds are reserved for allowed ones, so that refused ones of high value
    are listed too."""
    limit = params.max_candidates
    apart = params.candidate_spacing_m / cell_m
    filled = np.nan_to_num(value, nan=-np.inf)
    by_value = sorted(spots, key=lambda spot: (-float(filled[spot]), spot))
    chosen: list[tuple[int, int]] = []
    for wanted, maximum in ((True, (2 * limit + 2) // 3), (False, limit)):
        for spot in by_value:
            if len(chosen) >= maximum:
                break
            if bool(allowed[spot]) is wanted and all(
                np.hypot(spot[0] - other[0], spot[1] - other[1]) >= apart for other in chosen
            ):
                chosen.append(spot)
    return chosen


def _candidate(
    found: Assessed, spot: tuple[int, int], xy: Array, *, certain: bool = True
) -> Candidate:
    """Returns the site at ``xy`` (2,) in the cell ``spot``. Where it must be ``certain``, the plane
    through the whole footprint is checked too."""
    site, params = found.site, found.site.params
    xy = np.asarray(xy, dtype=np.float64)
    plane = fit_footprint(site.raster, xy, params.ground.footprint_m)
    if plane is None:
        return unmapped(xy, _refusal(found, spot))
    predicted = float(site.probability[spot])
    refusal = None
    if not found.allowed[spot]:
        refusal = _refusal(found, spot)
    elif certain and checks_ground(site.selector):
        refusal = plane_refusal(plane, params, margins=True)
    clearance, value = float(site.clearance_m[spot]), float(found.score[spot])
    figures = (
        f"score {value:.3f}, slope {plane.slope_deg:.1f} deg, roughness {plane.roughness_m:.2f} m, "
        f"clearance {clearance:.1f} m, safe with probability {predicted:.3f}"
    )
    good = certain or predicted >= params.min_safe_probability
    verdict = "landable" if good else "the least bad"
    preferred: SiteRule = "lower_value" if good else "least_bad"  # `ranked` names the highest
    total = float(found.c_sum[spot])
    return Candidate(
        position_odom=plane.position,
        c_sum=total if np.isfinite(total) else 0.0,
        slope_deg=plane.slope_deg,
        roughness_m=plane.roughness_m,
        clearance_m=clearance,
        accepted=refusal is None,
        reason=f"{verdict}: {figures}" if refusal is None else f"refused: {refusal.text}",
        rule=preferred if refusal is None else refusal.rule,
        value=value,
        terms=terms_at(found.layers, spot),
        step_m=_highest_step(site, spot),
        safe_probability=predicted,
    )


def _refusal(found: Assessed, spot: tuple[int, int]) -> Refusal:
    """Returns why the cell ``spot`` is not allowed."""
    if found.avoided[spot]:
        radius_m = found.site.params.refused_radius_m
        return Refusal("near_refused_site", f"within {radius_m:g} m of a site that was refused")
    return refusal_of(found.site, spot, found.margin_m)


def _highest_step(site: Inputs, spot: tuple[int, int]) -> float:
    """Returns the highest step around the known cells of the footprint of ``spot``."""
    reach = int(site.params.ground.footprint_m / site.raster.cell_m)
    rows, cols = (slice(max(at - reach, 0), at + reach + 1) for at in spot)
    step = site.landable.step_m[rows, cols]
    r, c = np.indices(step.shape)
    away = np.hypot(r + rows.start - spot[0], c + cols.start - spot[1])
    inside = site.raster.known[rows, cols] & (away <= reach)
    return float(step[inside].max()) if inside.any() else float("nan")
