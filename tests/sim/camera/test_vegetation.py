"""Plants in the picture: known heights, agreement with the LIDAR, no trace where there are none."""

import dataclasses
import functools
import math
from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np
import pytest

from touchdown.scenes.api import DETAILS, GroundRaster, Scene, Surface
from touchdown.sim import api as sim
from touchdown.sim.camera.vegetation import Vegetation
from touchdown.sim.frames import Pose, so3_exp
from touchdown.sim.lidar.surface_detail import SurfaceDetail
from touchdown.sim.moving import BodyTrack
from touchdown.sim.navigation.rangefinder import RangefinderSensor
from touchdown.sim.posed_sensors import PosedSensors
from touchdown.sim.world import MujocoWorld

from support.places import scene_of

CANOPY_M, LEAVES = 0.25, 1.7
FRACTION = 1.0 - (1.0 - math.exp(-0.5 * LEAVES)) / (0.5 * LEAVES)
"""of a plant's height from which its echoes come, on average"""
PAD_TOP_M = 0.04
GRASS = sim.LidarParams(
    range_sigma_m=0.0, angle_sigma_deg=0.0, divergence=False, vegetation=1.0, min_range_m=0.0
)
BARE = dataclasses.replace(GRASS, vegetation=0.0)
LENS = sim.CameraParams(width=96, height=72, noise_sigma=0.0)
PLACE = f"""<mujoco>
  <asset>
    <hfield name="far" nrow="3" ncol="3" size="1 1 1 1" elevation="{"0 " * 9}"/>
    <hfield name="near" nrow="161" ncol="161" size="20 20 2 1" elevation="{"0 " * 161**2}"/>
  </asset>
  <worldbody>
    <geom name="far" type="hfield" hfield="far" pos="90 90 0"/>
    <geom name="ground" type="hfield" hfield="near" pos="0 0 0.5"/>
    <geom name="pad" type="box" size="1 1 0.02" pos="-12 8 {0.5 + PAD_TOP_M - 0.02}"/>
    <geom name="car" type="box" size="1 1 1" pos="-12 -8 1.5"/>
    <site name="takeoff" pos="10 0 0.5"/>
  </worldbody>
</mujoco>"""
GROUND_M = 0.5
MEADOW, ROAD, PAD = (-10.0, 0.0), (10.0, 0.0), (-12.0, 8.0)


@functools.cache
def place() -> Scene:
    """Level ground at 0.5 m: a meadow in the west, asphalt in the east."""
    east = np.tile(np.arange(400) >= 200, (400, 1)).astype(np.uint8)
    plants = Surface(land_class="lawn", reflectivity=0.4, canopy_m=CANOPY_M, leaf_area=LEAVES)
    raster = GroundRaster(
        geom_name="ground", origin_xy_m=np.array([-20.0, -20.0]), cell_m=0.1, class_id=east,
        reflectivity=np.full((400, 400), 0.4, np.float32), material=east,
        materials=(plants, Surface(land_class="road", reflectivity=0.4)),
        detail_id=np.full((400, 400), DETAILS.index("grass"), np.uint8),
    )  # fmt: skip
    return dataclasses.replace(scene_of(PLACE), ground=raster)


def sensors_of(lidar: sim.LidarParams, **lens: object) -> PosedSensors:
    camera = dataclasses.replace(LENS, **lens)  # type: ignore[arg-type]
    return PosedSensors(place(), sim.WorldParams(camera=camera, lidar=lidar), 0)


@pytest.fixture(scope="module")
def grown() -> Iterator[PosedSensors]:
    made = sensors_of(GRASS)
    yield made
    made.close()


@pytest.fixture(scope="module")
def bare() -> Iterator[PosedSensors]:
    made = sensors_of(BARE)
    yield made
    made.close()


def above(xy: tuple[float, float], height: float) -> Pose:
    """The body so far above the bare ground."""
    return Pose(np.eye(3), np.array([*xy, GROUND_M + height]))


def plants() -> SurfaceDetail:
    found = SurfaceDetail.plants_of(GRASS, place())
    assert found is not None
    return found


def vegetation() -> Vegetation:
    found = Vegetation.of(place(), plants())
    assert found is not None
    return found


def grid(xy: tuple[float, float], half: float) -> tuple[np.ndarray, np.ndarray]:
    steps = np.arange(-half, half, 0.05)
    x, y = np.meshgrid(xy[0] + steps, xy[1] + steps)
    return x.ravel(), y.ravel()


def test_visible_height_is_the_mean_of_the_law_of_the_pulses() -> None:
    x, y = grid(MEADOW, 8.0)
    detail, mean = plants(), np.full(len(x), CANOPY_M, np.float32)
    height = detail.plant_height_m(x.astype(np.float32), y.astype(np.float32), mean)
    np.testing.assert_allclose(detail.visible_height_m(x, y), FRACTION * height, rtol=1e-5)
    assert detail.visible_height_m(x, y).mean() == pytest.approx(FRACTION * CANOPY_M, abs=0.01)
    road = grid(ROAD, 8.0)
    assert not detail.visible_height_m(*road).any()
    beyond = np.array([500.0])
    assert not detail.visible_height_m(beyond, beyond).any()
    free = 2.0 * height / LEAVES
    low = 0.05 - free * (1.0 - np.exp(-0.05 / free))
    np.testing.assert_allclose(detail.visible_height_m(x, y, 0.05), low, rtol=1e-4)


@pytest.mark.parametrize("height", [3.0, 12.0])
def test_camera_and_lidar_agree_on_the_distance(grown: PosedSensors, height: float) -> None:
    pose = above(MEADOW, height)
    scan = grown.scan(BodyTrack.at_rest(pose, grown.scan_times(0)), 0)
    points = (pose @ grown.mounts.lidar).apply(scan.points[scan.ranges > 0.0].astype(float))
    below = np.abs(points[:, :2] - MEADOW).max(axis=1) < 0.15 * height
    assert below.sum() > 500
    view = grown.view(pose, 0.0, 0)
    k, eye = grown.intrinsics, view.world_from_camera
    v, u = np.mgrid[: k.height, : k.width]
    rays = np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones(u.shape)], axis=-1)
    drawn = eye.apply((rays * view.depth_m[..., None]).reshape(-1, 3).astype(float))
    seen = np.abs(drawn[:, :2] - MEADOW).max(axis=1) < 0.15 * height
    assert seen.sum() > 50
    # the camera sees plants as a mean surface: 0.3 to 1.5 cm lower, by what grows below
    assert drawn[seen, 2].mean() == pytest.approx(points[below, 2].mean(), abs=0.02)
    assert points[below, 2].mean() > GROUND_M + 0.05


def test_a_low_object_is_not_buried(grown: PosedSensors) -> None:
    pose = above(PAD, 3.0)
    view = grown.view(pose, 0.0, 0)
    middle = (LENS.height // 2, LENS.width // 2)
    assert view.geom_id[middle] == place().model.geom("pad").id
    height = view.world_from_camera.translation[2] - view.depth_m[middle]
    assert height == pytest.approx(GROUND_M + PAD_TOP_M, abs=1e-3)
    raised, car = vegetation().raised_at, np.array([[-13.5], [-8.0]])
    assert raised(*car)[0] > 0.03  # plants stand beside what is higher
    assert raised(np.array([-12.9]), np.array([8.9]))[0] == 0.0


def test_a_camera_in_the_plants_sees_the_ground(grown: PosedSensors, bare: PosedSensors) -> None:
    """And the plants again from above, and the ground once more."""
    lever = grown.mounts.camera.translation[2]
    for clear, planted in ((0.05, False), (2.0, True), (0.05, False), (2.0, True)):
        pose = above(MEADOW, clear - lever)
        seen, plain = (s.view(pose, 0.0, 0) for s in (grown, bare))
        assert (not np.array_equal(seen.depth_m, plain.depth_m)) == planted
        assert (not np.array_equal(seen.rgb, plain.rgb)) == planted
        if not planted:
            np.testing.assert_allclose(seen.depth_m, clear, atol=1e-3)


def test_grain_lies_on_the_plants(closed: Any) -> None:
    """Grain is multiplied in where depth and the ground's height agree; plants that stand higher
    than its tolerance keep theirs."""
    tall = dataclasses.replace(GRASS, vegetation=4.0)
    with_grain, without = (closed(sensors_of(tall, detail=on)) for on in (True, False))
    pose = above(MEADOW, 2.0)
    images = [made.view(pose, 0.0, 0).rgb.astype(int) for made in (with_grain, without)]
    changed = (images[0] != images[1]).any(axis=2)
    assert changed.mean() > 0.8


def test_only_a_level_height_field_is_raised() -> None:
    scene, found = place(), plants()
    model = scene.model
    turned = dataclasses.replace(scene, model=mujoco.MjModel.from_xml_string(PLACE))
    ground = turned.model.geom("ground").id
    optics = dataclasses.replace(found.optics, ground_geom=ground)
    same = dataclasses.replace(found, optics=optics)
    assert Vegetation.of(turned, same) is not None
    turned.model.geom_quat[ground] = [math.cos(0.1), 0.0, 0.0, math.sin(0.1)]
    turned.model.geom_sameframe[ground] = 0
    assert Vegetation.of(turned, same) is None
    box = dataclasses.replace(found.optics, ground_geom=int(model.geom("pad").id))
    assert Vegetation.of(scene, dataclasses.replace(found, optics=box)) is None


@pytest.mark.parametrize("tilt", [0.0, 0.5])
def test_the_rangefinder_s_echo_comes_from_the_plants(tilt: float) -> None:
    params = sim.RangefinderParams(
        sigma_m=0.0, resolution_m=1e-6, position_body_m=(0.0, 0.0, 0.0), min_range_m=0.0
    )
    data = mujoco.MjData(place().model)
    mujoco.mj_forward(place().model, data)

    def nearer(xy: tuple[float, float], height: float) -> float:
        turned = so3_exp(np.array([0.0, tilt, 0.0]))
        pose = turned, np.array([*xy, GROUND_M + height])
        plain, seen = (
            RangefinderSensor(place(), params, 600, 1, found).sample(0, data, *pose).range_m
            for found in (None, plants())
        )
        assert plain == pytest.approx(height / math.cos(tilt), abs=1e-5)
        return plain - seen

    x = np.array([MEADOW[0] - 5.0 * math.tan(tilt)])
    visible = plants().visible_height_m(x, np.array([MEADOW[1]]))[0]
    assert nearer(MEADOW, 5.0) == pytest.approx(visible / math.cos(tilt), abs=1e-5)
    assert nearer(ROAD, 5.0) == 0.0
    assert 0.0 < nearer(MEADOW, 0.12) < 0.05  # from within the plants


def test_the_world_s_camera_and_rangefinder_see_the_plants() -> None:
    def found(lidar: sim.LidarParams) -> tuple[np.ndarray, float]:
        params = sim.WorldParams(sim=sim.SimParams(threads=1), camera=LENS, lidar=lidar)
        nav = dataclasses.replace(params.nav.rangefinder, sigma_m=0.0, resolution_m=1e-6)
        params = dataclasses.replace(params, nav=dataclasses.replace(params.nav, rangefinder=nav))
        world = MujocoWorld(place(), params, 3, sim.SensorNeeds(camera_hz=10, rangefinder=True))
        world.start_in_air(np.array([*MEADOW, GROUND_M + 4.0]), 0.0)
        images, echoes = [], []
        for _ in range(60):
            obs = world.step(sim.Command(rotor_speed_radps=np.zeros(4)))
            images += [image.rgb for image in obs.images]
            echoes += [sample.range_m for sample in obs.rangefinder]
        world.close()
        return images[0], echoes[0]

    (bare_image, bare_range), (image, reading) = found(BARE), found(GRASS)
    assert not np.array_equal(image, bare_image)
    x, y = (np.array([value]) for value in MEADOW)
    expected = plants().visible_height_m(x, y)[0]
    assert bare_range - reading == pytest.approx(expected, abs=0.005)


def test_the_model_of_physics_and_lidar_keeps_its_ground(closed: Any) -> None:
    model = place().model
    before = model.hfield_data.copy()
    made = closed(sensors_of(GRASS, samples=4))
    made.view(above(MEADOW, 4.0), 0.0, 0)
    np.testing.assert_array_equal(model.hfield_data, before)
    found = vegetation()
    assert found.terrain.field == int(model.geom_dataid[model.geom("ground").id]) != 0
    assert found.model.hfield_data.max() > 0.0


def test_asphalt_is_drawn_as_it_is(grown: PosedSensors, bare: PosedSensors) -> None:
    seen, plain = (made.view(above(ROAD, 6.0), 0.0, 0) for made in (grown, bare))
    np.testing.assert_allclose(seen.depth_m, plain.depth_m, atol=1e-4)
    assert np.abs(seen.rgb.astype(int) - plain.rgb).max() <= 2
