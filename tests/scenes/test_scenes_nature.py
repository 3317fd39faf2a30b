"""`forest` and `turf`: relief, water, meshes."""

import numpy as np
import pytest

from touchdown.scenes.api import LAND_CLASSES
from touchdown.scenes.authoring.relief import HeightField
from touchdown.scenes.places.forest import layout
from touchdown.scenes.places.forest.layout import draw_plan
from touchdown.scenes.places.turf import level_pools
from touchdown.scenes.places.turf.airfield import fuselage_mesh
from touchdown.scenes.props.woods import canopy_mesh, conifer_mesh, lathe
from touchdown.scenes.truth.maps import truth_maps

from support.places import cached_scene

WATER, TREES = LAND_CLASSES.index("water"), LAND_CLASSES.index("trees")


def test_forest_is_rugged_and_wooded() -> None:
    scene, rng = cached_scene("forest", 1), np.random.default_rng(1)
    maps = truth_maps(scene, 0.25, np.array([[-42.0, -42.0], [42.0, 42.0]]))
    assert scene.model.hfield_size[0, 2] > 6.0
    ground = layout.shape_ground(rng, draw_plan(rng))
    rise = np.gradient(ground.heights_m, ground.cell_m)
    assert np.percentile(np.rad2deg(np.arctan(np.hypot(*rise))), 90) > 20.0
    assert 0.45 < (maps.class_id == TREES).mean() < 0.95
    assert (maps.class_id == WATER).any()


def test_brook_falls_all_the_way_below_the_ground() -> None:
    for seed in range(6):
        rng = np.random.default_rng(seed)
        plan = draw_plan(rng)
        ground = HeightField(heights_m=layout.hills(rng), half_m=64.0)
        bed = layout.brook_profile(plan.brook, ground)
        inside = (np.abs(plan.brook.line_m) < 62.0).all(axis=1)
        steps = np.diff(bed[inside])
        assert (steps < 1e-9).all() or (steps > -1e-9).all()
        assert abs(steps.sum()) >= 0.8 * 0.012 * inside.sum()
    assert layout.WATER_DEPTH_M < layout.BROOK_DEPTH_M


def test_clearings_have_the_slope_of_their_kind() -> None:
    """The plane fitted to the middle of a clearing: level where it is safe, steep where not."""
    for seed in range(4):
        rng = np.random.default_rng(seed)
        plan = draw_plan(rng)
        terrain = layout.shape_ground(rng, plan)
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
