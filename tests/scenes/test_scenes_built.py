"""What cottage, houses, pools, the roof used as a car park and the footbridge are: safe ground,
classes, water and decks above the ground."""

import functools
from typing import Any
from zlib import crc32

import numpy as np
import pytest
from numpy.typing import NDArray

from touchdown.scenes.api import LAND_CLASSES, Scene, TruthMaps
from touchdown.scenes.authoring.plots import Plot
from touchdown.scenes.authoring.streets import STEP_M, Street, smooth_line
from touchdown.scenes.places.footbridge import bridge as bridge_layout
from touchdown.scenes.places.houses import homes
from touchdown.scenes.places.rooftop_parking import deck as roof_layout
from touchdown.scenes.truth.maps import judge_touchdown, truth_maps
from touchdown.scenes.truth.static_surface import cast_down, class_ids
from touchdown.sim.typing import Array

from support.places import cached_scene


@functools.cache
def survey_maps(name: str, seed: int) -> TruthMaps:
    """Truth within the rectangle around the standard survey, 50 m ahead and 40 m to the left."""
    scene = cached_scene(name, seed)
    yaw = scene.takeoff_yaw
    ahead = np.array([np.cos(yaw), np.sin(yaw)])
    left = np.array([-ahead[1], ahead[0]])
    corners = np.array(
        [scene.takeoff_xy_m + a * ahead + b * left for a in (0, 50) for b in (0, 40)]
    )
    return truth_maps(scene, 0.25, np.array([corners.min(axis=0), corners.max(axis=0)]))


def fraction(maps: TruthMaps, land_class: str) -> float:
    return float((maps.class_id == LAND_CLASSES.index(land_class)).mean())


def test_cottage_lane_is_level_and_the_meadow_is_not() -> None:
    maps = survey_maps("cottage", 0)
    lawn = maps.class_id == LAND_CLASSES.index("lawn")
    lane = maps.class_id == LAND_CLASSES.index("road")
    assert np.nanmedian(maps.slope_deg[lane]) < 2.0
    assert np.nanmedian(maps.slope_deg[lawn]) > 4.0
    assert (maps.safe_geometry & lane).mean() > 0.01
    assert not (maps.safe & lane).any()
    assert fraction(maps, "building") > 0.02


def test_pools_are_water_beside_a_safe_field() -> None:
    scene, maps = cached_scene("pools"), survey_maps("pools", 0)
    field = maps.class_id == LAND_CLASSES.index("field")
    assert fraction(maps, "water") > 0.05
    assert (maps.safe & field).sum() > 0.3 * field.sum()
    water = [name for name, surface in scene.surfaces.items() if surface.water]
    assert len(water) >= 3
    assert all(scene.surfaces[name].land_class == "water" for name in water)
    covers = [name for name, s in scene.surfaces.items() if s.land_class == "water" and not s.water]
    assert len(covers) == 1
    # A pool is level to the millimetre: its danger is what it is, not its shape.
    centre = scene.model.geom(covers[0]).pos[:2]
    judgement = judge_touchdown(scene, centre)
    assert judgement.slope_deg < 0.1
    assert judgement.land_class == "water"
    assert not judgement.safe_geometry


def test_lot_coordinates_invert_and_mirror() -> None:
    for mirrored in (False, True):
        plot = Plot(origin_xy_m=np.array([3.0, -2.0]), angle=0.7, mirrored=mirrored)
        uv = np.array([[0.0, 0.0], [4.0, -1.5], [2.0, 9.0]])
        np.testing.assert_allclose(plot.coordinates(plot.points(uv)), uv, atol=1e-12)
        expected = np.array([np.cos(plot.away), np.sin(plot.away)])
        np.testing.assert_allclose(plot.at(0.0, 1.0) - plot.origin_xy_m, expected, atol=1e-12)


def test_street_offsets_and_distances_agree() -> None:
    line = smooth_line(np.array([[-40.0, 0.0], [0.0, 8.0], [40.0, 0.0]]))
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
    np.testing.assert_allclose(steps, STEP_M, rtol=0.01)
    street = Street(line_m=line, width_m=6.0, pavement_m=2.0)
    for along in (5.0, 33.0, 60.0):
        for across in (-4.0, 2.5):
            distance, where = street.nearest(street.point(along, across))
            assert abs(float(distance) - abs(across)) < 0.05
            assert abs(float(where) - along) < 0.6
    assert abs(float(street.kerb_distance(street.point(20.0, 3.0)))) < 0.05


ROAD = LAND_CLASSES.index("road")


@functools.cache
def bridge_plan(seed: int) -> bridge_layout.Plan:
    return bridge_layout.draw_plan(np.random.default_rng([seed, crc32(b"scenes.footbridge")]))


@functools.cache
def roof_plan(seed: int) -> roof_layout.Plan:
    return roof_layout.draw_plan(np.random.default_rng([seed, crc32(b"scenes.rooftop_parking")]))


def sampled(scene: Scene, points: Array) -> tuple[Array, NDArray[np.uint8]]:
    """Heights and class ids at (N, 2) world points."""
    heights, classes = [], []
    for point in points:
        z, geoms = cast_down(scene, point - 0.005, 0.01, (1, 1))
        heights.append(z[0, 0])
        classes.append(class_ids(scene, point - 0.005, 0.01, z, geoms)[0, 0])
    return np.array(heights), np.array(classes)


@pytest.mark.parametrize("plan", [bridge_plan, roof_plan])
def test_surveys_of_all_seeds_stay_inside(plan: Any) -> None:
    for seed in range(25):
        drawn = plan(seed)
        c, s = np.cos(drawn.takeoff_yaw), np.sin(drawn.takeoff_yaw)
        corners = np.array([[0.0, 0.0], [66.0, 0.0], [66.0, 40.0], [-16.0, 40.0]])
        world = drawn.takeoff_xy_m + corners @ np.array([[c, s], [-s, c]])
        assert (np.abs(world) < 64.0).all(), seed


def test_roof_is_a_path_high_above_the_streets() -> None:
    scene, plan = cached_scene("rooftop_parking", 0), roof_plan(0)
    assert plan.height_m >= 5.8
    aisle = np.linspace(plan.low_xy_m[0] + 3.0, plan.high_xy_m[0] - 3.0, 12)
    heights, classes = sampled(scene, np.column_stack([aisle, np.full(12, plan.aisles()[0])]))
    assert np.abs(heights).max() < 0.1
    assert (classes == LAND_CLASSES.index("path")).all()
    street = np.array([s.point(float(a), 0.0) for s in plan.streets for a in (20.0, 100.0)])
    heights, classes = sampled(scene, street)
    np.testing.assert_allclose(heights, -plan.height_m - 0.12, atol=0.06)
    assert (classes == ROAD).all()


def test_roof_s_dangers_are_unsafe_and_its_aisles_safe() -> None:
    scene, plan = cached_scene("rooftop_parking", 0), roof_plan(0)
    ramp = plan.ramp
    middle = 0.5 * (ramp.low_y_m + ramp.high_y_m)
    half_way = np.array([ramp.top_x_m + 0.4 * (ramp.foot_x_m - ramp.top_x_m), middle])
    on_ramp = judge_touchdown(scene, half_way)
    # 3.1 m in 18 m.
    assert on_ramp.slope_deg == pytest.approx(9.8, abs=0.6) and not on_ramp.safe_geometry
    edge = np.array([plan.high_xy_m[0] - 0.6, plan.aisles()[0]])
    assert not judge_touchdown(scene, edge).safe_geometry
    assert judge_touchdown(scene, edge).obstacle_distance_m == pytest.approx(0.6, abs=0.08)
    aisle = plan.aisles()[0]
    region = np.array(
        [[plan.low_xy_m[0] + 9.0, aisle - 1.2], [plan.high_xy_m[0] - 9.0, aisle + 1.2]]
    )
    assert truth_maps(scene, 0.2, region).safe.mean() > 0.9


@pytest.mark.parametrize("seed", [0, pytest.param(3, marks=pytest.mark.slow)])
def test_bridge_is_wide_enough_to_land_on(seed: int) -> None:
    """Over a road it is an asphalt road, over water a timber path."""
    scene, plan = cached_scene("footbridge", seed), bridge_plan(seed)
    bridge, kind = plan.bridge, "road" if plan.over_road else "path"
    assert bridge.width_m >= 4.0
    for u in (0.0, 0.6 * bridge.half_length_m):
        spot = bridge.plot.at(u, 0.0)
        heights, classes = sampled(scene, spot[None])
        assert heights[0] == pytest.approx(float(bridge.top(np.array(u))), abs=0.02)
        assert classes[0] == LAND_CLASSES.index(kind)
        judged = judge_touchdown(scene, spot)
        assert judged.safe_geometry and judged.land_class == kind
        assert judged.safe is (kind == "path")
        assert judged.obstacle_distance_m == pytest.approx(0.5 * bridge.width_m - 0.1, abs=0.12)
    beside = bridge.plot.at(0.0, 0.5 * bridge.width_m - 0.7)
    assert not judge_touchdown(scene, beside).safe_geometry


@pytest.mark.parametrize("seed", [0, pytest.param(3, marks=pytest.mark.slow)])
def test_below_the_bridge_is_a_road_or_water(seed: int) -> None:
    scene, plan = cached_scene("footbridge", seed), bridge_plan(seed)
    stations = np.array([15.0, 40.0, 90.0, 115.0])
    points = np.array([plan.course.point(float(s), 0.6) for s in stations])
    heights, classes = sampled(scene, points)
    if plan.over_road:
        np.testing.assert_allclose(heights, -plan.depth_m - 0.12, atol=0.05)
        assert (classes == ROAD).all()
        clearance = float(plan.bridge.end_m) - plan.bridge.thick_m - 0.36 + plan.depth_m
        assert clearance > 4.0
    else:
        dry = classes != LAND_CLASSES.index("water")
        assert dry.sum() <= 1
        np.testing.assert_allclose(heights[~dry], plan.level_m, atol=1e-3)
    banks = np.array(
        [plan.course.point(60.0, s * (plan.floor_m + 0.5 * plan.bank_m)) for s in (-1, 1)]
    )
    assert not any(judge_touchdown(scene, bank).safe_geometry for bank in banks)


def test_house_fronts_keep_the_setback_and_the_gardens_pools() -> None:
    plot = Plot(origin_xy_m=np.array([4.0, -3.0]), angle=0.4)
    rng = np.random.default_rng(3)
    drawn = [homes.draw_home(rng, plot, 18.0, 30.0, "pool") for _ in range(40)]
    fronts = np.array([home.front_v for home in drawn])
    assert homes.SETBACK_M <= fronts.min() < fronts.max() <= homes.SETBACK_M + 1.5
    for home in drawn:
        low, high = home.pool.box_m
        assert home.back_v + 1.0 < low[1] and high[1] < home.depth_m
        assert low[0] > 0.0 and high[0] < home.width_m
