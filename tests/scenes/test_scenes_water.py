"""`lake`, `open_water`, `flat`: level and unsafe water, take-off spots and textures."""

import numpy as np
import pytest

from touchdown.scenes.api import LAND_CLASSES, Scene
from touchdown.scenes.authoring.water import WaterLook, lay_water, upsample
from touchdown.scenes.truth.maps import truth_maps
from touchdown.scenes.truth.static_surface import cast_down, class_ids

from support.places import cached_scene

WATER = LAND_CLASSES.index("water")
RAFT_AND_ISLET = (0, 5)
"""Seeds of `open_water`"""
CAMERA_HALF_DIAGONAL_M = 27.0
"""Of the ground seen by the camera from 30 m (69 x 42 degrees), with a margin of 4 m."""


def around_takeoff(scene: Scene, half_m: float) -> np.ndarray:
    return np.stack([scene.takeoff_xy_m - half_m, scene.takeoff_xy_m + half_m])


def below(scene: Scene, cell_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Heights, geoms and classes of the whole scene, seen from above."""
    low, high = scene.bounds_xy_m
    shape = tuple(np.round((high - low)[::-1] / cell_m).astype(int))
    heights, geoms = cast_down(scene, low, cell_m, (shape[0], shape[1]))
    return heights, geoms, class_ids(scene, low, cell_m, geoms)


def test_lake_water_is_level_and_never_safe() -> None:
    scene = cached_scene("lake", 0)
    heights, geoms, classes = below(scene, 0.5)
    wet = (classes == WATER) & (geoms == scene.model.geom("terrain").id)
    level = float(np.median(heights[wet]))
    # Where a bank is steep, the triangle that holds the waterline rises out of the water.
    assert (np.abs(heights[wet] - level) < 1e-3).mean() > 0.97
    assert np.abs(heights[wet] - level).max() < 0.25
    ground = (classes != WATER) & (geoms == scene.model.geom("terrain").id)
    assert heights[ground].min() > level - 1e-3
    assert 0.08 < wet.mean() < 0.35
    maps = truth_maps(scene, 0.25)
    water = maps.class_id == WATER
    assert not (maps.safe_geometry & water).any()
    assert 0.1 < maps.safe.mean() < 0.7


@pytest.mark.parametrize("seed", RAFT_AND_ISLET)
def test_open_water_is_safe_at_the_takeoff_spot_only(seed: int) -> None:
    scene = cached_scene("open_water", seed)
    maps = truth_maps(scene, 0.2, around_takeoff(scene, 40.0))
    rows, cols = np.nonzero(maps.safe)
    assert 5.0 < len(rows) * 0.04 < 150.0
    points = maps.origin_xy_m + (np.stack([cols, rows], axis=-1) + 0.5) * maps.cell_m
    assert np.linalg.norm(points - scene.takeoff_xy_m, axis=1).max() < 8.0
    assert not (maps.safe_geometry & (maps.class_id == WATER)).any()
    assert (maps.class_id == WATER).mean() > 0.9


@pytest.mark.parametrize("seed", RAFT_AND_ISLET)
def test_open_water_has_no_shore_in_view_for_most_of_a_survey_leg(seed: int) -> None:
    """A leg of 50 m flown in 10 s: at least its last half shows water and nothing else."""
    scene = cached_scene("open_water", seed)
    assert (np.ptp(scene.bounds_xy_m, axis=0) >= 200.0).all()
    heights, _, classes = below(scene, 1.0)
    rows, cols = np.nonzero(classes != WATER)
    points = scene.bounds_xy_m[0] + np.stack([cols, rows], axis=-1) + 0.5
    away = np.linalg.norm(points - scene.takeoff_xy_m, axis=1)
    # What is not water lies on the take-off spot, or farther than the survey can see.
    assert not ((away > 12.5) & (away < 70.0)).any()
    level = np.median(heights)
    # Cells of the islet's strand count as water up to a finger's breadth over it.
    np.testing.assert_allclose(heights[classes == WATER], level, atol=0.03)
    forward = np.array([np.cos(scene.takeoff_yaw), np.sin(scene.takeoff_yaw)])
    blind = [
        along
        for along in np.arange(0.0, 50.0, 1.0)
        if (
            np.linalg.norm(points - scene.takeoff_xy_m - along * forward, axis=1)
            > CAMERA_HALF_DIAGONAL_M
        ).all()
    ]
    assert len(blind) >= 10


def test_flat_is_level_to_the_bit_and_safe_everywhere() -> None:
    scene = cached_scene("flat", 0)
    assert np.ptp(scene.model.hfield_data) == 0.0
    maps = truth_maps(scene, 0.25)
    assert maps.safe.all()
    assert np.ptp(maps.height_m) < 1e-4
    visible = [name for name in scene.surfaces if not name.startswith("vehicle")]
    assert visible == ["terrain"]
    image = scene.model.tex_data[-3 * 4_000_000 :]
    assert image.std() > 15.0


def test_water_hides_the_bottom_with_depth() -> None:
    """Red light is dimmed first: a bright bottom turns from its own colour to the body's."""
    size = 512
    depth = np.repeat(np.linspace(-1.0, 8.0, size, dtype=np.float32)[None], size, axis=0)
    image = np.full((size, size, 3), 200, np.uint8)
    look = WaterLook(body=(20.0, 60.0, 80.0), clarity_m=(0.5, 1.0, 1.2), ripple=0.2)
    sun = np.array([0.5, 0.0, -np.sqrt(0.75)])
    lay_water(np.random.default_rng(1), image, depth, 12.0, look, sun)
    columns = image.mean(axis=0)
    dry, shallow, deep = columns[:40], columns[75:80], columns[-60:]
    assert (dry == 200.0).all()
    assert (shallow[:, 0].mean() < shallow[:, 2].mean() < 200.0) and shallow[:, 0].mean() > 60.0
    np.testing.assert_allclose(deep.mean(axis=0), look.body, atol=14.0)


def test_upsample_is_the_terrain_s_linear_interpolation() -> None:
    x, y = np.meshgrid(np.linspace(-4.0, 4.0, 9), np.linspace(-4.0, 4.0, 9))
    raster = upsample(2.0 * x - 0.5 * y, 64)
    axis = (np.arange(64) + 0.5) / 8.0 - 4.0
    col, row = np.meshgrid(axis, axis)
    np.testing.assert_allclose(raster, 2.0 * col - 0.5 * row, atol=0.03)
