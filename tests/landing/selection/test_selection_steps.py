"""Every limit, margin and feature of the selection, each by itself on otherwise perfect ground."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from touchdown.estimator.api import GridMap
from touchdown.landing.api import Candidate, LandingParams, Selection
from touchdown.landing.mission.site_recheck import recheck_site
from touchdown.landing.selection.clustering import Clusters
from touchdown.landing.selection.costmap import colour_edges, flatness_of
from touchdown.landing.selection.ground.elevation_raster import pooled
from touchdown.landing.selection.ground.landable import Defect, LandableMap, assess, ground_planes
from touchdown.landing.selection.ground.traffic import surface_of
from touchdown.landing.selection.probability import NAMES, RiskFeatures, probability, risk_features
from touchdown.landing.selection.selector import _best_spots, _shortlist, check_site
from touchdown.sim.typing import Array

from support.landing_support import ABOVE, make_grid, raster_of, rising, select, view_of

PARAMS = LandingParams()
SPOT = (40, 40)


def level(slope_deg: float = 0.0, **more: Any) -> GridMap:
    """16 x 16 m without noise."""
    return make_grid(rising(slope_deg), sigma=0.0, **more)


def judged(grid: GridMap, margin_m: float = 0.35) -> LandableMap:
    raster = raster_of(grid)
    planes = ground_planes(raster, PARAMS)
    return assess(raster, planes, PARAMS, margin_m=margin_m, min_returns=PARAMS.min_returns)


def changed(layer: str, value: float, spot: Any = SPOT, slope_deg: float = 0.0) -> GridMap:
    grid = level(slope_deg)
    getattr(grid, layer)[spot] = value
    return grid


@pytest.mark.parametrize(("layer", "just_good", "just_bad", "defect"), [
    ("count", 4.0, 3.0, Defect.SPARSE), ("height_std_m", 0.049, 0.051, Defect.ROUGH),
    ("height_m", 0.079, 0.081, Defect.STEP),
    ("max_height_m", 0.149, 0.151, Defect.OBSTACLE),
])  # fmt: skip
def test_each_gate_by_itself(layer: str, just_good: float, just_bad: float, defect: Defect) -> None:
    """One cell of level ground, a little within its limit and a little beyond."""
    assert judged(changed(layer, just_good)).defect[SPOT] < defect
    found = judged(changed(layer, just_bad))
    assert found.defect[SPOT] == defect
    assert not found.mask[SPOT] and not found.mask[40, 45] and found.mask[40, 50]


def test_slope_is_refused_half_a_degree_early_and_is_that_of_the_ground_not_of_its_top() -> None:
    assert judged(level(4.4)).mask[SPOT]
    steep = judged(level(4.6))
    assert (steep.defect[10:70, 10:70] == Defect.STEEP).all() and not steep.mask.any()
    # what stands out of a slope counts from the slope
    top = np.tan(np.deg2rad(4.0)) * 4.0 + 0.14
    assert judged(changed("max_height_m", top, (40, 20), 4.0)).defect[40, 20] == 0


def test_few_missing_pulses_are_no_water() -> None:
    """Of 25 cells with 40 returns each, 250 missing are a fifth; less than three are chance."""
    grid = level()
    grid.missing[38:43, 38:43] = 9.9
    assert judged(grid).defect[SPOT] == Defect.NONE
    grid.missing[38:43, 38:43] = 10.1
    assert judged(grid).defect[SPOT] == Defect.WATER
    thin = level()
    thin.count[36:45, 36:45] = 0.1
    thin.missing[SPOT] = 2.9
    assert judged(thin).defect[SPOT] != Defect.WATER
    thin.missing[SPOT] = 3.1
    assert judged(thin).defect[SPOT] == Defect.WATER


@pytest.mark.parametrize(("margin_m", "refused"), [(0.0, 5), (0.35, 6), (0.55, 7)])
def test_the_margin_widens_the_footprint_and_keeps_it_on_the_map(
    margin_m: float, refused: int
) -> None:
    found = judged(changed("max_height_m", 0.2), margin_m)
    assert not found.mask[40, 40 + refused] and found.mask[40, 41 + refused]
    border = int(np.ceil((1.0 + margin_m) / 0.2))
    assert not found.mask[border - 1].any() and found.mask[border, 50:60].all()
    # something tall keeps the clear radius of 1.5 m and the margin
    tall = judged(changed("max_height_m", 0.3), margin_m)
    reach = int((1.5 + margin_m) / 0.2)
    assert not tall.mask[40, 40 + reach] and tall.mask[40, 41 + reach]


def test_a_commanded_site_has_the_smaller_margin() -> None:
    """A post 1.2 m away: within the footprint and 0.35 m, outside of it and 0.15 m."""
    view = view_of(changed("max_height_m", 0.2, (40, 46)))
    middle = np.array([8.1, 8.1])
    assert check_site(view, ABOVE, LandingParams(selector="zou2024"), middle)[0].accepted
    assert not select(view, ABOVE, LandingParams(selector="zou2024")).allowed[SPOT]


def features(grid: GridMap, plants: bool = False, **more: float) -> RiskFeatures:
    stand = np.full(grid.count.shape, plants)
    return risk_features(raster_of(grid), judged(grid), PARAMS, stand, **({"now_s": 0.0} | more))


def at(found: RiskFeatures, name: str, spot: tuple[int, int] = SPOT) -> float:
    return float(found.values[(*spot, NAMES.index(name))])


@pytest.mark.parametrize(
    ("name", "layer", "value", "fraction"),
    [("object", "max_height_m", 0.08, 0.8), ("spread", "height_std_m", 0.025, 0.5)],
)
def test_objects_and_spread_are_the_worst_of_the_footprint(
    name: str, layer: str, value: float, fraction: float
) -> None:
    found = features(changed(layer, value))
    # the plane through 5 x 5 cells does not know of the highest return
    assert at(found, name, (40, 45)) == pytest.approx(fraction, abs=1e-3)
    assert at(found, name, (40, 46)) == pytest.approx(0.0, abs=1e-6)


def test_sparsity_and_age() -> None:
    grid = level()
    grid.count[:, :] = 9.0
    grid.count[40, 35:46] = 1.0
    found = features(grid)
    assert at(found, "sparsity") == pytest.approx((11 * 0.5 + 110 * 0.1) / 121, abs=1e-5)
    grid.last_seen_s[:] = 60.0
    assert at(features(grid, now_s=90.0), "age") == pytest.approx(0.5)
    assert at(features(grid, now_s=300.0), "age") == 2.0


@pytest.mark.parametrize("why", ["sparse", "old", "plants", "small rock", "slope beside", "uneven"])
def test_the_probability_declines_with_what_the_map_cannot_be_sure_of(why: str) -> None:
    grid = level(4.8 if why == "uneven" else 0.0)
    sure = probability(features(grid), PARAMS.risk_weights)[SPOT]
    if why == "sparse":
        grid.count[:] = 1.0
    if why == "small rock":  # 12 cm high and half as wide as its cell: below each limit
        grid.height_m[40, 42], grid.max_height_m[40, 42] = 0.03, 0.12
    if why == "slope beside":  # from 0.6 m on
        grid.height_m[:, 44:] = 0.2 * np.arange(36) * np.tan(np.deg2rad(6.0))
    if why == "uneven":
        grid.height_m[::2, ::2] += 0.03
    now_s = 90.0 if why == "old" else 0.0
    found = probability(features(grid, why == "plants", now_s=now_s), PARAMS.risk_weights)
    assert found[SPOT] < sure - 2e-6


def test_an_excess_of_slope_counts_less_on_uneven_ground() -> None:
    smooth, uneven = level(6.0), level(6.0)
    uneven.height_m[::2, ::2] += 0.03
    assert at(features(smooth), "tilt") == pytest.approx(1.2, abs=0.01)
    assert at(features(smooth), "slope around") == pytest.approx(1.2, abs=0.01)
    assert at(features(smooth), "steepness") == pytest.approx(1.0 + 0.5 * 0.2 / 0.1, abs=0.02)
    assert 1.0 < at(features(uneven), "steepness") < 1.6


def test_gusts_take_away_clearance() -> None:
    """2.4 m to the post's cell: 0.6 m too little of 3 m, 1.1 m in gusts that drift by 0.5 m."""
    grid = changed("max_height_m", 0.2)
    for drift_m, fraction in ((0.0, 0.3), (0.5, 0.55)):
        found = features(grid, drift_m=drift_m)
        assert at(found, "confinement", (40, 52)) == pytest.approx(fraction, abs=1e-3)


def test_unknown_ground_motion_water_and_the_edge_are_closed_whatever_the_weights() -> None:
    hole = features(changed("height_m", np.nan))
    assert not hole.open[40, 45] and hole.open[40, 46]
    assert not hole.open[4].any() and hole.open[5, 10:70].all()
    assert features(changed("max_height_m", 0.5)).open[SPOT]
    wet = level()
    wet.missing[38:43, 38:43] = 30.0
    assert not features(wet).open[SPOT]


def selected(grid: GridMap, seen: dict[str, Any] | None = None, **more: Any) -> Selection:
    return select(view_of(grid), ABOVE, LandingParams(**more), **(seen or {}))


def best(grid: GridMap, **more: Any) -> Candidate:
    return selected(grid, **more).candidates[0]


def test_a_site_needs_its_probability() -> None:
    p = best(level(3.0)).safe_probability
    assert 0.5 < p < 1.0
    assert best(level(3.0), min_safe_probability=p - 1e-4).accepted
    unlikely = best(level(3.0), min_safe_probability=p + 1e-4)
    assert not unlikely.accepted and unlikely.rule == "low_probability"


def test_the_plane_of_the_whole_footprint_is_checked() -> None:
    """Whatever the probability: 4.6 of 4.5 degrees, and one cell that lies 0.1 m lower."""
    assert best(level(4.4), min_safe_probability=0.0).accepted
    steep = best(level(4.6), min_safe_probability=0.0)
    assert not steep.accepted and steep.rule == "footprint_slope"
    pits = level()
    for layer in (pits.height_m, pits.max_height_m, pits.min_height_m):
        layer[::4, ::4] = -0.1
    rough = best(pits, min_safe_probability=0.0)
    assert not rough.accepted and rough.rule == "footprint_roughness"
    assert rough.roughness_m == pytest.approx(0.1, abs=0.01)


def test_wind_lowers_the_probability_beside_an_obstacle() -> None:
    grid = changed("max_height_m", 0.2)
    calm, windy = (selected(grid, {"wind_mps": v}).probability for v in (0.0, 25.0))
    assert windy[40, 52] < calm[40, 52] - 2e-5
    assert windy[40, 65] == pytest.approx(calm[40, 65], abs=1e-6)


def test_ground_without_colour_has_no_smoothness() -> None:
    grid = level()
    grid.rgb[:, :40] = np.nan
    allowed = selected(grid, selector="zou2024").allowed
    assert not allowed[:, :40].any() and allowed[20:60, 45:60].all()
    assert selected(grid).allowed[20:60, 20:35].all()


def test_refused_sites_are_avoided_within_their_radius_alone() -> None:
    there = {"avoid_odom": [np.array([8.1, 8.1, 0.0])]}
    for radius_m, cells in ((1.05, 5), (3.05, 15)):
        allowed = selected(level(), there, refused_radius_m=radius_m).allowed
        assert not allowed[40, 40 : 41 + cells].any()
        assert allowed[40, 41 + cells]


def test_traffic_stays_on_the_surface_that_it_was_seen_on() -> None:
    """Two dark lanes beside a bright one; motion on the western lane alone."""
    grid = level()
    grid.intensity[:] = np.where(np.abs(np.arange(80) - 40) < 10, 46.0, 14.0)
    moved = np.zeros((80, 80), bool)
    moved[40, 5] = True
    surface = surface_of(raster_of(grid), moved, PARAMS)
    assert surface[:, :26].all() and not surface[:, 34:].any()


def test_clearance_is_the_distance_to_what_is_not_allowed() -> None:
    grid = changed("max_height_m", 1.0, (slice(None), slice(0, 20)))
    chosen = selected(grid, selector="zou2024")
    row, col = raster_of(grid).cell_of(chosen.candidates[0].position_odom)
    rows, cols = np.nonzero(~chosen.allowed)
    nearest = 0.2 * np.hypot(rows - row, cols - col).min()
    assert chosen.candidates[0].clearance_m == pytest.approx(nearest, abs=1e-4)


def test_each_cluster_offers_its_best_allowed_cell_else_its_mode() -> None:
    label = np.repeat([[0, 1, 2]], 3, axis=0)
    merit = np.array([[1, 5, 9], [3, 5, 8], [2, 7, 7]], np.float32)
    allowed = np.array([[1, 1, 0], [1, 1, 0], [1, 0, 0]], bool)
    modes = np.array([[2, 0], [2, 1], [1, 2]])
    clusters = Clusters(label=label.astype(np.int32), modes=modes, density=merit)
    assert _best_spots(clusters, merit, allowed) == [(1, 0), (0, 1), (1, 2)]


def test_a_third_of_the_list_is_left_to_refused_sites_and_all_keep_their_distance() -> None:
    spots = [(0, 0), (0, 4), (0, 6), (0, 20), (0, 40), (0, 60), (0, 80)]
    value = np.zeros((1, 81), np.float32)
    value[0, [0, 4, 6, 20, 40, 60, 80]] = [9, 8, 7, 6, 5, np.nan, 4]
    allowed = np.zeros((1, 81), bool)
    allowed[0, [0, 4, 6, 20, 80]] = True
    for maximum, wanted in ((3, [0, 6, 40]), (4, [0, 6, 20, 40]), (6, [0, 6, 20, 80, 40, 60])):
        params = LandingParams(max_candidates=maximum, candidate_spacing_m=1.0)
        assert _shortlist(spots, value, allowed, 0.2, params) == [(0, col) for col in wanted]


def test_small_holes_in_the_colour_are_no_edges() -> None:
    rgb = np.full((40, 40, 3), 200.0, np.float32)
    rgb[10, 10] = rgb[20:22, 20:22] = np.nan
    edges, coloured = colour_edges(rgb, blur_cells=1.5, low=40.0, high=100.0, hole_cells=4)
    assert edges.sum() == 0 and coloured.sum() == 1600 - 5
    rgb[30, 28:33] = np.nan
    edges, _ = colour_edges(rgb, blur_cells=1.5, low=40.0, high=100.0, hole_cells=4)
    assert edges[30, 28:33].all()


def test_flatness_of_ground_reaches_as_far_as_the_clear_radius() -> None:
    grid = level()
    grid.height_m[:, 50:] += 2.0
    raster = raster_of(grid)
    flat = flatness_of(raster, ground_planes(raster, PARAMS), PARAMS)
    angle = np.rad2deg(ground_planes(raster, PARAMS).angle_rad[40])
    bent = int(np.flatnonzero(angle > 1.0)[0])
    reach = int(PARAMS.clear_radius_m / 0.2)
    assert flat[40, bent - reach - 1] == pytest.approx(1.0, abs=1e-6)
    assert flat[40, bent - reach] < 1.0 - 1e-4


def test_pooled_cells_keep_lowest_missing_newest_and_brightness() -> None:
    grid = make_grid(np.zeros((2, 2)), sigma=0.0)
    grid.min_height_m[:] = [[-0.1, 0.0], [np.nan, 0.2]]
    grid.missing[:] = [[1.0, 2.0], [3.0, 4.0]]
    grid.last_seen_s[:] = [[5.0, 9.0], [7.0, 1.0]]
    grid.intensity[:] = [[10.0, 20.0], [30.0, 80.0]]
    grid.count[:] = [[10.0, 10.0], [10.0, 30.0]]
    merged = pooled(raster_of(grid), 2)
    assert merged.low[0, 0] == pytest.approx(-0.1)
    assert (merged.missing[0, 0], merged.last_seen[0, 0]) == (10.0, 9.0)
    assert merged.intensity[0, 0] == pytest.approx((100 + 200 + 300 + 2400) / 60)


def fine(height: Array) -> GridMap:
    return make_grid(height, 0.05, origin=(4.0, 4.0), returns=10, sigma=0.0)


SITE = np.array([8.0, 8.0, 0.0])


def test_the_recheck_moves_no_farther_than_it_must() -> None:
    stone = np.zeros((160, 160))
    stone[78:84, 84:90] = 0.25  # 0.2 to 0.5 m east of the site
    moved = recheck_site(view_of(level(), fine(stone)), SITE, 3.0, PARAMS).position_odom
    away = float(np.linalg.norm(moved[:2] - SITE[:2]))
    # 1.15 m free around it, and up to a metre of clearance as far as it costs no more than it gives
    assert 0.9 < away < 2.4 and moved[0] < 7.4


@pytest.mark.parametrize(("slope_deg", "taken"), [(4.0, True), (6.0, False)])
def test_the_recheck_checks_the_slope(slope_deg: float, taken: bool) -> None:
    grid = fine(rising(slope_deg, 160, 0.05))
    params = dataclasses.replace(PARAMS, slope_margin_deg=-20.0)
    look = recheck_site(view_of(level(), grid), SITE, 1.0, params)
    assert (look.position_odom is not None) is taken
    assert taken or "slope 6.0 deg over the footprint" in look.reason


def test_the_recheck_needs_three_returns_a_cell() -> None:
    grid = fine(np.zeros((160, 160)))
    grid.count[:] = 0.5  # two by two cells are merged
    assert recheck_site(view_of(level(), grid), SITE, 1.0, PARAMS).position_odom is None
    grid.count[:] = 1.0
    assert recheck_site(view_of(level(), grid), SITE, 1.0, PARAMS).position_odom is not None
