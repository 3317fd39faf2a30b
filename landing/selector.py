"""From the map to a list of alternative landing sites, best first (section 4 of the paper)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.api import Estimate, MapView
from landing.api import Candidate, CostmapView, LandingParams, Selection
from landing.clustering import Clusters, bandwidths, quick_shift
from landing.costmap import compute_costmap
from landing.landable import LandableMap, assess, explain, fit_footprint, ground_planes
from landing.terrain import Terrain, observed_terrain
from landing.traffic import traffic_penalty

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]

_AVOID_M = 3.0
"""a site refused on a closer look is not offered again within this distance"""
_ENOUGH_CLEARANCE_M = 1.0
_ROOM_WEIGHT = 0.1
_APART_M = 3.0
"""alternatives closer than this are no alternatives"""


NOTHING_MAPPED = Selection(
    candidates=(),
    costmap=None,
    allowed=np.zeros((0, 0), np.bool_),
    probability=np.zeros((0, 0), np.float32),
)


@dataclass(frozen=True, kw_only=True, slots=True)
class _Judged:
    """One map with everything that was computed of it."""

    terrain: Terrain
    costmap: CostmapView
    landable: LandableMap
    margin_m: float


def select_sites(
    map_view: MapView,
    estimate: Estimate,
    params: LandingParams,
    *,
    footprint_radius_m: float,
    reach_m: float = np.inf,
    avoid_odom: Sequence[Array] = (),
) -> Selection:
    """Alternative sites in the observed map: accepted ones first, then by C_sum less the
    penalty of ``landing.traffic``.

    ``reach_m``: how far the energy left allows to fly; ``avoid_odom``: sites already refused.
    """
    terrain = observed_terrain(map_view.coarse)
    if terrain is None:
        return NOTHING_MAPPED
    judged = _judge(terrain, estimate, reach_m, params, params.map_margin_m)
    costmap, landable = judged.costmap, judged.landable
    bandwidth, radius = bandwidths(footprint_radius_m / terrain.cell_m)
    clusters = quick_shift(costmap.total, bandwidth_cells=bandwidth, radius_cells=radius)
    value = costmap.total - traffic_penalty(terrain, landable, params)
    allowed = landable.mask & np.isfinite(costmap.total)
    for avoid in avoid_odom:
        x, y = terrain.offsets_from(avoid)
        allowed &= np.hypot(x[None, :], y[:, None]) > _AVOID_M
    spots = _best_spots(clusters, value, allowed, landable)
    candidates = [
        _candidate(judged, spot, terrain.centre_of(*spot), bool(allowed[spot]), params)
        for spot in _shortlist(
            spots, value, allowed, params.max_candidates, _APART_M / terrain.cell_m
        )
    ]
    candidates.sort(key=lambda site: not site.accepted)  # stable: best first within both
    return Selection(
        candidates=tuple(candidates),
        costmap=costmap,
        allowed=allowed,
        probability=np.where(allowed, np.float32(1.0), np.float32(0.0)),
    )


def check_site(
    map_view: MapView, estimate: Estimate, params: LandingParams, xy_odom: Array
) -> tuple[Candidate, CostmapView | None]:
    """The commanded site ``xy_odom`` (2,) as a candidate: accepted or refused with the reason.

    Someone chose this place, so it needs less room to err than one that the map alone suggests.
    """
    terrain = observed_terrain(map_view.coarse)
    if terrain is None:
        return _unseen(xy_odom), None
    judged = _judge(terrain, estimate, np.inf, params, params.low_margin_m)
    spot = terrain.cell_of(xy_odom)
    if not terrain.contains(*spot):
        return _unseen(xy_odom), judged.costmap
    allowed = bool(judged.landable.mask[spot])
    return _candidate(judged, spot, xy_odom, allowed, params), judged.costmap


def _unseen(xy: Array) -> Candidate:
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
        reason="refused: outside what was mapped",
    )


def _judge(
    terrain: Terrain, estimate: Estimate, reach_m: float, params: LandingParams, margin_m: float
) -> _Judged:
    planes = ground_planes(terrain, params)
    position = estimate.odom_from_body.translation
    costmap = compute_costmap(terrain, planes, position, reach_m, params)
    landable = assess(terrain, planes, params, margin_m=margin_m, min_returns=params.min_returns)
    return _Judged(terrain=terrain, costmap=costmap, landable=landable, margin_m=margin_m)


def _best_spots(
    clusters: Clusters, value: Float32, allowed: NDArray[np.bool_], landable: LandableMap
) -> list[tuple[int, int]]:
    """One cell per cluster: the allowed one of highest cost value, room to err counting up to
    1 m of clearance; the mode itself where nothing in the cluster is allowed."""
    spots = clusters.modes.copy()
    room = np.minimum(landable.clearance_m, _ENOUGH_CLEARANCE_M) / _ENOUGH_CLEARANCE_M
    cells = np.flatnonzero(allowed & (clusters.label >= 0))
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
    """The best ``limit`` spots that keep apart; two thirds of the places are for allowed ones, if
    there are as many, so that refused ones of high value stay visible."""
    by_value = sorted(spots, key=lambda spot: (-float(value[spot]), spot))
    chosen: list[tuple[int, int]] = []
    for wanted, places in ((True, (2 * limit + 2) // 3), (False, limit)):
        for spot in by_value:
            if len(chosen) >= places:
                break
            if bool(allowed[spot]) is wanted and all(
                np.hypot(spot[0] - other[0], spot[1] - other[1]) >= apart_cells for other in chosen
            ):
                chosen.append(spot)
    return chosen


def _candidate(
    judged: _Judged, spot: tuple[int, int], xy: Array, allowed: bool, params: LandingParams
) -> Candidate:
    """The site at ``xy`` (2,) in the cell ``spot``; ``allowed`` by the geometric check and by
    earlier looks. The plane through the whole footprint has the last word."""
    terrain, costmap, landable = judged.terrain, judged.costmap, judged.landable
    row, col = spot
    xy = np.asarray(xy, dtype=np.float64)
    plane = fit_footprint(terrain, xy)
    clearance = float(landable.clearance_m[row, col])
    if plane is None:
        return _unseen(xy)
    accepted, reason = allowed, ""
    slope_limit = params.max_slope_deg - params.slope_margin_deg
    rough_limit = params.max_step_m - params.step_margin_m
    figures = (
        f"slope {plane.slope_deg:.1f} deg, roughness {plane.roughness_m:.2f} m, "
        f"clearance {clearance:.1f} m, C_sum {_value(costmap.total, spot):.2f}"
    )
    if not allowed:
        if landable.mask[row, col]:
            reason = "refused: seen from closer it was not landable, or out of reach"
        else:
            why = explain(terrain, landable, row, col, params, judged.margin_m)
            reason = f"refused: {why}"
    elif plane.slope_deg > slope_limit:
        accepted, reason = False, f"refused: slope {plane.slope_deg:.1f} deg over the footprint"
    elif plane.roughness_m > rough_limit:
        accepted, reason = False, f"refused: {plane.roughness_m:.2f} m off its plane"
    else:
        reason = f"landable: {figures}"
    return Candidate(
        position_odom=plane.position,
        normal_odom=plane.normal,
        score=_value(costmap.total, spot),
        flatness=_value(costmap.flatness, spot),
        smoothness=_value(costmap.smoothness, spot),
        distance=_value(costmap.distance, spot),
        slope_deg=plane.slope_deg,
        roughness_m=plane.roughness_m,
        clearance_m=clearance,
        accepted=accepted,
        reason=reason,
    )


def _value(layer: Float32, spot: tuple[int, int]) -> float:
    value = float(layer[spot])
    return value if np.isfinite(value) else 0.0
