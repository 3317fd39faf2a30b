"""Sites that a selector offers, as candidates of a landing: looked up in the map, refused where
they cannot be taken, with the terms that rank them as the costmap.

An external selector offers sites; what the lander does with them is the same as with those of the
shipped selectors: the gate ``class``, the recheck and go-arounds.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from touchdown.landing.api import (
    Candidate,
    CostmapView,
    LandingParams,
    RankedSites,
    Selection,
    SelectorInput,
    Site,
    SiteRule,
    TermLayer,
)
from touchdown.landing.selection.ground.elevation_raster import (
    ElevationRaster,
    distance_to,
    observed_raster,
)
from touchdown.landing.selection.ground.landable import Refusal, fit_footprint
from touchdown.landing.selection.ranking import ranked
from touchdown.landing.selection.selector import NOTHING_MAPPED, unmapped
from touchdown.sim.typing import Array, Float32


def selection_of(offered: RankedSites, seen: SelectorInput, params: LandingParams) -> Selection:
    """Returns the first ``max_candidates`` of ``offered`` as candidates, accepted ones first, each
    part by value, and the terms as a costmap.

    Sites off the map, near a refused one and out of reach are refused; in an emergency the first of
    the refused ones that is mapped is accepted as the least bad where no other is."""
    raster = observed_raster(seen.map_view.coarse)
    if raster is None:
        return NOTHING_MAPPED
    sites = sorted(offered.sites, key=lambda site: -_value(site))[: params.max_candidates]
    costmap = _costmap(raster, [_cropped(layer, seen, raster) for layer in offered.layers])
    clearance_m = distance_to(~costmap.allowed, raster.cell_m)
    candidates = [_candidate(raster, site, seen, params, clearance_m) for site in sites]
    if seen.emergency and not any(site.accepted for site in candidates):
        candidates = _least_bad(candidates)
    return Selection(
        candidates=ranked(candidates),
        costmap=costmap,
        allowed=costmap.allowed,
        probability=_probability(costmap),
        cluster=np.full(raster.shape, -1, np.int32),
        modes=np.zeros((0, 2), np.int32),
    )


def _probability(costmap: CostmapView) -> Float32:
    """Returns the quantity of the term ``probability``; without one 1 where a site is accepted."""
    stated = [term.quantity for term in costmap.terms if term.name == "probability"]
    return stated[0] if stated else costmap.allowed.astype(np.float32)


def _value(site: Site) -> float:
    return float(sum(term.value for term in site.terms))


def _candidate(
    raster: ElevationRaster,
    site: Site,
    seen: SelectorInput,
    params: LandingParams,
    clearance_m: Float32,
) -> Candidate:
    xy = np.array(site.position_odom[:2], np.float64)
    plane = fit_footprint(raster, xy, params.ground.footprint_m)
    if plane is None:
        return dataclasses.replace(unmapped(xy), value=_value(site), terms=site.terms)
    refusal = _refusal(xy, site, seen, params)
    rule: SiteRule = "lower_value" if refusal is None else refusal.rule
    figures = f"score {_value(site):.3f}, slope {plane.slope_deg:.1f} deg, roughness "
    figures += f"{plane.roughness_m:.2f} m" + (f", {site.reason}" if site.reason else "")
    return Candidate(
        position_odom=plane.position,
        c_sum=0.0,
        slope_deg=plane.slope_deg,
        roughness_m=plane.roughness_m,
        clearance_m=float(clearance_m[raster.cell_of(xy)]),
        accepted=refusal is None,
        reason=f"landable: {figures}" if refusal is None else f"refused: {refusal.text}",
        rule=rule,
        value=_value(site),
        terms=site.terms,
    )


def _refusal(xy: Array, site: Site, seen: SelectorInput, params: LandingParams) -> Refusal | None:
    """Returns why a mapped site cannot be taken; None where it can."""
    if not site.accepted:
        return Refusal("by_selector", site.reason or "the selector refuses it")
    if (np.hypot(*(seen.avoid_odom[:, :2] - xy).T) <= params.refused_radius_m).any():
        text = f"within {params.refused_radius_m:g} m of a site that was refused"
        return Refusal("near_refused_site", text)
    away = float(np.hypot(*(xy - seen.estimate.odom_from_body.translation[:2])))
    if away > seen.reach_m:
        return Refusal("out_of_reach", "out of reach of the remaining energy")
    return None


def _least_bad(refused: Sequence[Candidate]) -> list[Candidate]:
    """Returns ``refused`` with the first one whose ground is known accepted."""
    for number, site in enumerate(refused):
        if np.isfinite(site.position_odom).all() and site.rule != "out_of_reach":
            reason = f"the least bad: {site.reason.removeprefix('refused: ')}"
            taken = dataclasses.replace(site, accepted=True, rule="least_bad", reason=reason)
            return [*refused[:number], taken, *refused[number + 1 :]]
    return list(refused)


def _cropped(layer: TermLayer, seen: SelectorInput, raster: ElevationRaster) -> TermLayer:
    """Returns a layer of the whole map on the cells of ``raster``."""
    grid = seen.map_view.coarse
    col, row = np.rint((raster.origin_xy_m - grid.origin_xy_m) / grid.cell_m).astype(int)
    box = np.s_[row : row + raster.shape[0], col : col + raster.shape[1]]
    return dataclasses.replace(
        layer,
        value=np.asarray(layer.value, np.float32)[box].copy(),
        quantity=np.asarray(layer.quantity, np.float32)[box].copy(),
    )


def _costmap(raster: ElevationRaster, layers: Sequence[TermLayer]) -> CostmapView:
    """Returns the sum of the terms over the coloured map; a level one without layers."""
    value = np.where(raster.known, np.float32(0.0), np.float32(np.nan))
    for layer in layers:
        value = value + layer.value
    unknown = np.full(raster.shape, np.nan, np.float32)
    return CostmapView(
        origin_xy_m=raster.origin_xy_m,
        cell_m=raster.cell_m,
        total=np.where(raster.known, np.float32(0.0), np.float32(np.nan)),
        flatness=unknown,
        smoothness=unknown,
        distance=unknown,
        rgb=np.nan_to_num(raster.rgb).astype(np.uint8),
        value=value,
        allowed=np.isfinite(value),
        terms=tuple(layers),
    )
