"""`forest` and `turf`: relief, safe sites, surfaces and determinism."""

import functools

import numpy as np
import pytest
from scipy import ndimage

from touchdown.scenes.api import LAND_CLASSES, Scene
from touchdown.scenes.authoring.height_field import HeightField
from touchdown.scenes.places.forest import relief
from touchdown.scenes.places.forest.layout import draw_plan
from touchdown.scenes.places.forest.stand import TREE_TOP_M
from touchdown.scenes.places.turf.airfield import fuselage_mesh
from touchdown.scenes.places.turf.generate import level_pools
from touchdown.scenes.props.tree_shapes import canopy_mesh, conifer_mesh, lathe
from touchdown.scenes.truth.maps import judge_touchdown, truth_maps

from support.places import cached_scene, check_surfaces, check_survey

SURVEY_M = (50.0, 40.0)
CELL_M = 0.25
WATER, TREES = LAND_CLASSES.index("water"), LAND_CLASSES.index("trees")


def in_survey(scene: Scene, xy: np.ndarray) -> np.ndarray:
    """(..., 2) world -> (...) True for points inside the survey's legs."""
    c, s = np.cos(scene.takeoff_yaw), np.sin(scene.takeoff_yaw)
    ahead_left = (xy - scene.takeoff_xy_m) @ np.array([[c, -s], [s, c]])
    return ((ahead_left > 0.0) & (ahead_left < SURVEY_M)).all(axis=-1)


@functools.cache
def surveyed(name: str, seed: int) -> tuple[object, np.ndarray, np.ndarray]:
    """Truth maps around the survey, the cells of the survey, and those near the take-off."""
    scene = cached_scene(name, seed)
    maps = truth_maps(scene, CELL_M, np.array([[-42.0, -42.0], [42.0, 42.0]]))
    rows, cols = np.indices(maps.safe.shape)
    xy = maps.origin_xy_m + CELL_M * (np.stack([cols, rows], axis=-1) + 0.5)
    near = np.linalg.norm(xy - scene.takeoff_xy_m, axis=-1) < 8.0
    return maps, in_survey(scene, xy), near


def shaped(seed: int) -> HeightField:
    """The forest's ground alone, from a stream of its own."""
    rng = np.random.default_rng(seed)
    return relief.shape_ground(rng, draw_plan(rng))


CASES = [
    ("forest", 1),
    ("turf", 0),
    *(pytest.param("turf", seed, marks=pytest.mark.slow) for seed in (1, 2)),
]


@pytest.mark.parametrize(("name", "seed"), CASES)
def test_survey_contains_a_safe_site_away_from_the_takeoff(name: str, seed: int) -> None:
    maps, survey, near = surveyed(name, seed)
    labels, count = ndimage.label(maps.safe & survey & ~near)  # type: ignore[attr-defined]
    areas = ndimage.sum(np.ones_like(labels), labels, range(1, count + 1)) * CELL_M**2
    assert max(areas) > 20.0
    assert judge_touchdown(cached_scene(name, seed), cached_scene(name, seed).takeoff_xy_m).safe


@pytest.mark.parametrize(("name", "seed"), CASES)
def test_survey_is_inside_and_its_height_is_free(name: str, seed: int) -> None:
    scene = cached_scene(name, seed)
    check_survey(scene, trees_m=TREE_TOP_M + 0.5 if name == "forest" else 18.0)
    check_surfaces(scene)


def test_forest_is_rugged_and_wooded() -> None:
    maps, _, _ = surveyed("forest", 1)
    scene = cached_scene("forest", 1)
    assert scene.model.hfield_size[0, 2] > 6.0
    ground = shaped(1)
    rise = np.gradient(ground.heights_m, ground.cell_m)
    steep = np.rad2deg(np.arctan(np.hypot(*rise)))
    assert np.percentile(steep, 90) > 20.0
    share = (maps.class_id == TREES).mean()  # type: ignore[attr-defined]
    assert 0.45 < share < 0.95
    assert (maps.class_id == WATER).any()  # type: ignore[attr-defined]


def test_brook_falls_all_the_way_below_the_ground() -> None:
    for seed in range(6):
        rng = np.random.default_rng(seed)
        plan = draw_plan(rng)
        ground = HeightField(heights_m=relief.hills(rng), half_m=64.0)
        bed = relief.brook_profile(plan.brook, ground)
        inside = (np.abs(plan.brook.line_m) < 62.0).all(axis=1)
        steps = np.diff(bed[inside])
        assert (steps < 1e-9).all() or (steps > -1e-9).all()
        assert abs(steps.sum()) >= 0.8 * 0.012 * inside.sum()
    assert relief.WATER_DEPTH_M < relief.BROOK_DEPTH_M


def test_clearings_have_the_slope_of_their_kind() -> None:
    """The plane fitted to the middle of a clearing: level where it is safe, steep where not."""
    for seed in range(4):
        rng = np.random.default_rng(seed)
        plan = draw_plan(rng)
        terrain = relief.shape_ground(rng, plan)
        for clearing in plan.clearings:
            grid = np.stack(np.meshgrid(*2 * [np.linspace(-3.0, 3.0, 13)]), axis=-1).reshape(-1, 2)
            z = terrain.at(clearing.centre_xy_m + grid)
            slope = np.linalg.lstsq(np.column_stack([grid, np.ones(len(grid))]), z, rcond=None)[0]
            degrees = np.rad2deg(np.arctan(np.hypot(*slope[:2])))
            if clearing.kind in ("start", "meadow", "plot"):
                assert degrees < 4.0
            elif clearing.kind == "slope":
                assert degrees > 8.0


def test_pools_are_level_and_touch_nothing_far_away() -> None:
    axis = np.linspace(-64.0, 64.0, 193)
    x, y = np.meshgrid(axis, axis)
    slope = 0.03 * x
    depth = 4.0 - np.hypot(x - 10.0, y)
    heights = level_pools(slope, depth)
    assert np.ptp(heights[depth > 0.0]) < 1e-12
    np.testing.assert_allclose(heights[depth < -3.1], slope[depth < -3.1], atol=1e-12)


def test_meshes_are_wound_outwards() -> None:
    """Face normals point away from the axis or the middle for most of the area."""
    rng = np.random.default_rng(0)
    stations = np.array([[2.0, 0.2, 0.0], [0.0, 0.6, 0.0], [-2.0, 0.2, 0.0]])
    shapes = {
        "canopy": canopy_mesh(rng, np.array([3.0, 3.0, 2.4]), 10, 2.0),
        "trunk": lathe(rng, np.array([[-1.0, 0.3], [1.0, 0.2]]), 9, 0.05),
        "fuselage": fuselage_mesh(stations),
    }
    for name, mesh in shapes.items():
        corner = mesh.vertices[mesh.faces]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        outward = (normal * corner.mean(axis=1)).sum(axis=1)
        area = np.linalg.norm(normal, axis=1)
        assert area[outward > 0.0].sum() > 0.97 * area.sum(), name
    spruce = conifer_mesh(rng, 10.0, 2.4)
    assert spruce.vertices[:, 2].max() == pytest.approx(10.0)
    assert np.hypot(*spruce.vertices[:, :2].T).max() < 1.15 * 2.4
