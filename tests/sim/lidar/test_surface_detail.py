"""Texture: a function of the place with known spread and scales. Plants: an exponential law."""

import dataclasses
import math

import numpy as np
import pytest

from touchdown.scenes.api import GroundRaster, Scene, Surface
from touchdown.sim.api import LidarParams, LidarScan
from touchdown.sim.frames import Pose, so3_exp
from touchdown.sim.lidar import surface_detail
from touchdown.sim.lidar.sensor import LidarSensor
from touchdown.sim.moving import BodyTrack

from support.lidar_support import DOWN, PERFECT, PLANE, TICK_HZ, make_scene, track

TICKS = (0, 60)
TEXTURED = dataclasses.replace(PERFECT, texture=1.0)
GRASS = dataclasses.replace(PERFECT, vegetation=1.0)


def _surface(**changes: float) -> Surface:
    return Surface(land_class="field", reflectivity=0.4, **changes)  # type: ignore[arg-type]


def _scan(params: LidarParams, scene: Scene, height: float = 20.0, mount: Pose = DOWN) -> LidarScan:
    return LidarSensor(scene, params, 5).scan(*TICKS, TICK_HZ, track(TICKS, height), mount, {})


def _plane(seed: int = 0, **changes: float) -> Scene:
    scene = make_scene(PLANE, {"plane": _surface(**changes)})
    return dataclasses.replace(scene, seed=seed)


def _field(places: np.ndarray, salt: int) -> np.ndarray:
    """Noise (N,) over unit cells at (N, 2 or 3) places."""
    noise, ones = np.zeros(len(places), np.float32), np.ones(len(places), np.float32)
    axes = [np.ascontiguousarray(axis, dtype=np.float32) for axis in places.T]
    add = surface_detail.add_plane_noise if len(axes) == 2 else surface_detail.add_space_noise
    add(*axes, 1.0, np.uint32(salt), ones, noise)
    return noise


@pytest.mark.parametrize("axes", [2, 3])
def test_noise_has_unit_variance_everywhere_and_the_correlation_of_its_cells(axes: int) -> None:
    places = np.random.default_rng(0).uniform(-500.0, 500.0, (200_000, axes))
    noise = _field(places, 7)
    assert abs(noise.mean()) < 0.02
    assert noise.var() == pytest.approx(1.0, abs=0.02)
    for corner in (0.0, 0.5):  # at the nodes, and amid them
        assert _field(np.floor(places) + corner, 7).var() == pytest.approx(1.0, abs=0.02)

    def correlation(shift: float) -> float:
        return float((noise * _field(places + shift * np.eye(axes)[0], 7)).mean())

    assert correlation(0.1) > 0.93
    assert 0.1 < correlation(1.0) < 0.3
    assert abs(correlation(2.0)) < 0.02
    assert abs((noise * _field(places, 8)).mean()) < 0.01


def _log_gain(params: LidarParams, scene: Scene, height: float) -> np.ndarray:
    """Logarithm of the intensity over that without texture; strong returns."""
    plain = dataclasses.replace(params, texture=0.0)
    varied = _scan(params, scene, height).intensity.astype(float)
    same = _scan(plain, scene, height).intensity.astype(float)
    used = same > 40
    return np.log(varied[used] / same[used])


@pytest.mark.parametrize("spread", [0.1, 0.2])
def test_spread_is_that_of_the_surface_less_what_the_footprint_averages(spread: float) -> None:
    def left(height: float) -> float:
        widths = 0.01 + height * np.deg2rad([0.03, 0.28])
        cells = surface_detail.FINEST_M * 4.0 ** np.arange(len(surface_detail.FRACTIONS))
        fade = np.prod(cells[:, None] / (cells[:, None] + widths), axis=1)
        return float(math.sqrt(np.array(surface_detail.FRACTIONS) @ fade))

    for height in (3.0, 20.0):
        found = _log_gain(TEXTURED, _plane(spread=spread), height).std()
        assert found == pytest.approx(spread * left(height), rel=0.15 if height < 5 else 0.07)
    assert sum(surface_detail.FRACTIONS) == pytest.approx(1.0)


def test_texture_keeps_ranges_and_the_mean_and_costs_nothing_where_off() -> None:
    scene = _plane(spread=0.15)
    varied, same = _scan(TEXTURED, scene), _scan(PERFECT, scene)
    np.testing.assert_array_equal(varied.ranges, same.ranges)
    assert varied.intensity.mean() == pytest.approx(same.intensity.mean(), rel=0.03)
    np.testing.assert_array_equal(_scan(TEXTURED, _plane(spread=0.0)).intensity, same.intensity)
    twice = dataclasses.replace(TEXTURED, texture=2.0)
    assert _log_gain(twice, scene, 20.0).std() == pytest.approx(
        2.0 * _log_gain(TEXTURED, scene, 20.0).std(), rel=0.05
    )


def _reflectance(
    scan: LidarScan, position: np.ndarray, rotation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Places (N, 3) in the world of the returns of a resting LIDAR, and intensity over cosine."""
    back = scan.ranges > 0
    rays = scan.directions[back] @ (rotation @ DOWN.rotation).T
    places = position + scan.ranges[back, None] * rays
    return places, scan.intensity[back] / np.abs(rays[:, 2])


def test_the_same_place_is_as_bright_from_another_viewpoint() -> None:
    """A second view, moved, turned and rolled: neighbours within 3 cm on the ground agree far
    better than strangers do."""
    sensor = LidarSensor(_plane(spread=0.25), TEXTURED, 5)
    views = []
    for position, turn in (([0.0, 0.0, 8.0], [0, 0, 0]), ([1.5, 0.7, 9.0], [0.2, 0.1, 1.2])):
        rotation = so3_exp(np.array(turn, dtype=float))
        times = np.arange(TICKS[0], TICKS[1] + 1) / TICK_HZ
        body = BodyTrack.at_rest(Pose(rotation, np.array(position)), times)
        scan = sensor.scan(*TICKS, TICK_HZ, body, DOWN, {})
        views.append(_reflectance(scan, np.array(position), rotation))
    cells = [{}, {}]
    for view, (places, level) in zip(cells, views, strict=True):
        for place, value in zip(np.round(places[:, :2] / 0.03).astype(int), level, strict=True):
            view[tuple(place)] = value
    shared = sorted(set(cells[0]) & set(cells[1]))
    assert len(shared) > 500
    one, two = (np.log([view[k] for k in shared]) for view in cells)
    assert np.corrcoef(one, two)[0, 1] > 0.85


def test_texture_differs_between_scenes_and_not_between_flights() -> None:
    scene = _plane(spread=0.2)
    first = LidarSensor(scene, TEXTURED, 5).scan(*TICKS, TICK_HZ, track(TICKS, 20), DOWN, {})
    other = LidarSensor(scene, TEXTURED, 6).scan(*TICKS, TICK_HZ, track(TICKS, 20), DOWN, {})
    np.testing.assert_array_equal(first.intensity, other.intensity)
    elsewhere = _scan(TEXTURED, _plane(seed=1, spread=0.2))
    assert (first.intensity != elsewhere.intensity).mean() > 0.5


def test_texture_moves_with_a_moving_body() -> None:
    """The body drives from one place to another, turned: from above it looks the same."""
    world = (
        '<body name="cart" mocap="true"><geom name="cart" type="box" size="9 9 0.1"/></body>'
        + '<geom name="far" type="plane" size="0 0 1" pos="0 0 -50"/>'
    )
    scene = make_scene(world, {"cart": _surface(spread=0.25), "far": _surface(spread=0.0)})
    sensor = LidarSensor(scene, TEXTURED, 5)
    times = np.arange(TICKS[0], TICKS[1] + 1) / TICK_HZ
    levels = []
    for pose in (
        Pose(np.eye(3), np.zeros(3)),
        Pose(so3_exp(np.array([0.0, 0.0, 0.8])), np.array([31.3, -12.7, 4.1])),
    ):
        above = pose @ Pose(np.eye(3), np.array([0.0, 0.0, 6.0]))
        body = BodyTrack.at_rest(above, times)
        scan = sensor.scan(
            *TICKS, TICK_HZ, body, DOWN, {"cart": BodyTrack.at_rest(pose, times[:1])}
        )
        levels.append(scan.intensity.astype(float))
    assert levels[0].std() > 3.0
    assert np.abs(levels[0] - levels[1]).max() <= 1.0


def test_materials_of_the_ground_have_spreads_of_their_own() -> None:
    hfield = '<hfield name="h" nrow="2" ncol="2" size="40 40 1 1" elevation="0 0 0 0"/>'
    rows, cols = 80, 80
    material = np.zeros((rows, cols), np.uint8)
    material[:, cols // 2 :] = 1
    raster = GroundRaster(
        geom_name="g", origin_xy_m=np.array([-40.0, -40.0]), cell_m=1.0,
        class_id=np.ones((rows, cols), np.uint8),
        reflectivity=np.full((rows, cols), 0.4, np.float32),
        material=material, materials=(_surface(spread=0.0), _surface(spread=0.2)),
    )  # fmt: skip
    scene = make_scene('<geom name="g" type="hfield" hfield="h"/>', {}, raster, hfield)
    scan, plain = _scan(TEXTURED, scene), _scan(PERFECT, scene)
    places = scan.points @ DOWN.rotation.T
    same = scan.intensity == plain.intensity
    left, right = places[:, 0] < -0.1, places[:, 0] > 0.1
    assert same[left].all()
    assert same[right].mean() < 0.3


def _depths(scene: Scene, params: LidarParams, height: float = 15.0) -> tuple[np.ndarray, ...]:
    """Slant distances above the ground of all returns, and cosines of incidence."""
    scan, bare = _scan(params, scene, height), _scan(PERFECT, scene, height)
    back = bare.ranges > 0
    return (bare.ranges - scan.ranges)[back], scan.directions[back, 2].astype(float)


def _heights(
    detail: surface_detail.SurfaceDetail, x: np.ndarray, y: np.ndarray, mean: float
) -> np.ndarray:
    places = [np.ascontiguousarray(axis, dtype=np.float32) for axis in (x, y)]
    return detail.plant_height_m(*places, np.full(len(x), mean, np.float32))


@pytest.mark.parametrize(("canopy", "leaves"), [(0.25, 1.7), (0.05, 3.6)])
def test_returns_of_plants_follow_beer_and_lambert(canopy: float, leaves: float) -> None:
    """Optical depth from the canopy's top, over 1 - exp(-total), is evenly distributed for what
    meets a leaf; the ground answers with the fraction exp(-L / (2 cosine))."""
    scene = _plane(canopy_m=canopy, leaf_area=leaves)
    above, cosine = _depths(scene, GRASS)
    total = 0.5 * leaves / cosine
    ground = above < 1e-4
    assert ground.mean() == pytest.approx(np.exp(-total).mean(), abs=0.01)
    detail = LidarSensor(scene, GRASS, 5)._detail
    assert detail is not None
    scan = _scan(PERFECT, scene, 15.0)
    places = (scan.points @ DOWN.rotation.T)[scan.ranges > 0]
    heights = _heights(detail, places[:, 0], places[:, 1], canopy)
    depth = total * (1.0 - above * cosine / heights)  # optical, from the top
    fraction = ((1.0 - np.exp(-depth)) / (1.0 - np.exp(-total)))[~ground]
    assert fraction.min() > -1e-3 and fraction.max() < 1.0 + 1e-3
    quantiles = np.quantile(fraction, [0.1, 0.25, 0.5, 0.75, 0.9])
    np.testing.assert_allclose(quantiles, [0.1, 0.25, 0.5, 0.75, 0.9], atol=0.02)


def test_plants_on_a_slope_that_falls_along_the_ray_do_not_reach_to_the_lidar() -> None:
    """Over level ground the path through them is h / sin(elevation)."""
    tilted = '<geom name="g" type="box" size="40 40 0.1" euler="0 50 0" pos="0 0 0"/>'
    scene = make_scene(tilted, {"g": _surface(canopy_m=0.2, leaf_area=1.7)})
    scan, bare = _scan(GRASS, scene, 15.0), _scan(PERFECT, scene, 15.0)
    back = bare.ranges > 0
    shorter, down = (bare.ranges - scan.ranges)[back], scan.directions[back, 2]
    assert shorter.max() > 0.4 and (shorter <= 2.0 * 0.3 / down + 1e-4).all()


def test_height_of_plants_varies_smoothly_about_its_mean() -> None:
    detail = LidarSensor(_plane(), GRASS, 5)._detail
    assert detail is not None
    grid = np.arange(0.0, 200.0, 0.9)
    x, y = (axis.ravel() for axis in np.meshgrid(grid, grid))
    heights = _heights(detail, x, y, 0.2)
    assert heights.mean() == pytest.approx(0.2, rel=0.02)
    assert heights.std() == pytest.approx(0.3 * 0.2, rel=0.15)
    assert heights.min() >= 0.1 - 1e-9 and heights.max() <= 0.3 + 1e-9
    line = _heights(detail, 0.01 * np.arange(500), np.full(500, 3.0), 0.2)
    assert np.abs(np.diff(line)).max() < 0.005


def test_vegetation_scales_the_height_and_bare_ground_keeps_every_range() -> None:
    grassy = _plane(canopy_m=0.2, leaf_area=1.7)
    tall = dataclasses.replace(GRASS, vegetation=2.0)
    once, twice = _depths(grassy, GRASS)[0], _depths(grassy, tall)[0]
    np.testing.assert_allclose(twice, 2.0 * once, atol=1e-4)
    bare = _plane()
    np.testing.assert_array_equal(_scan(GRASS, bare).ranges, _scan(PERFECT, bare).ranges)


def test_water_has_neither_plants_nor_texture() -> None:
    hfield = '<hfield name="h" nrow="2" ncol="2" size="40 40 1 1" elevation="0 0 0 0"/>'
    raster = GroundRaster(
        geom_name="g", origin_xy_m=np.array([-40.0, -40.0]), cell_m=1.0,
        class_id=np.full((80, 80), 5, np.uint8),
        reflectivity=np.full((80, 80), 0.05, np.float32), material=np.zeros((80, 80), np.uint8),
        materials=(_surface(spread=0.3, canopy_m=0.3, leaf_area=3.0),),
    )  # fmt: skip
    scene = make_scene('<geom name="g" type="hfield" hfield="h"/>', {}, raster, hfield)
    both = dataclasses.replace(GRASS, texture=1.0)
    scan, plain = _scan(both, scene), _scan(PERFECT, scene)
    np.testing.assert_array_equal(scan.ranges, plain.ranges)
    np.testing.assert_array_equal(scan.intensity, plain.intensity)
