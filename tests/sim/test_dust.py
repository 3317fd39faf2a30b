"""Dust rises below 3 m over bare soil alone, and shows in scans and images."""

import dataclasses

import mujoco
import numpy as np
import pytest

from touchdown.scenes.api import GroundRaster, Scene, Surface
from touchdown.sim.airframe.vehicle import rotor_geometry, vehicle_body_id, vehicle_model
from touchdown.sim.api import DustParams
from touchdown.sim.dust import (
    CLEAR,
    FULL_EXTINCTION_PER_M,
    DustAir,
    DustCloud,
    dust_strength,
    ground_speed_mps,
)
from touchdown.sim.lidar.sensor import LidarSensor

from support.lidar_support import BRIGHT, DOWN, PERFECT, PLANE, TICK_HZ, make_scene, track
from support.places import scene_of

XML = """<mujoco><worldbody>
  <geom name="field_soil" type="plane" size="60 60 0.1" rgba="0.4 0.3 0.2 1"/>
  <light pos="0 0 20" dir="0 0 -1"/><site name="takeoff" pos="0 0 0"/>
</worldbody></mujoco>"""
WEIGHT, RADIUS = 41.2, 0.1905


@pytest.fixture(scope="module")
def soil() -> Scene:
    scene = scene_of(XML)
    bare = Surface(land_class="field", reflectivity=0.25, dust=1.0)
    return dataclasses.replace(scene, surfaces={**scene.surfaces, "field_soil": bare})


def _air(scene: Scene, height: float, *, thrust: float = 1.0, density: float = 1.0) -> DustAir:
    """The dust under a vehicle whose rotors give ``thrust`` times its weight."""
    cloud = DustCloud(scene, DustParams(density=density))
    data = mujoco.MjData(scene.model)
    mujoco.mj_kinematics(scene.model, data)
    data.xfrc_applied[vehicle_body_id(scene.model), 2] = (
        thrust * vehicle_model(scene.model).mass_kg * 9.81
    )
    cloud.observe(600, data, np.array([0.3, 0.2, height]))
    assert cloud.at(590) is CLEAR
    return cloud.at(607)


def test_speed_on_the_ground_by_hand() -> None:
    """Momentum theory: 10.3 N on 0.114 m^2 induce 6.07 m/s; twice that in the far wake."""
    assert ground_speed_mps(0.5, WEIGHT, RADIUS) == pytest.approx(12.14, abs=0.02)
    core = 6.2 * np.sqrt(2.0) * RADIUS
    assert ground_speed_mps(2.0 * core, WEIGHT, RADIUS) == pytest.approx(6.07, abs=0.01)
    assert ground_speed_mps(0.5, 4.0 * WEIGHT, RADIUS) == pytest.approx(24.29, abs=0.04)


def test_strength_falls_to_nothing_just_below_three_metres(soil: Scene) -> None:
    mass, radius = vehicle_model(soil.model).mass_kg, rotor_geometry(soil.model).radius_m
    weight = 9.81 * mass
    heights = np.arange(0.3, 4.0, 0.05)
    strengths = np.array([dust_strength(h, weight, weight, radius) for h in heights])
    assert strengths[0] == pytest.approx(1.0)
    assert (np.diff(strengths) <= 0.0).all()
    highest = heights[strengths > 0.0].max()
    assert 2.5 < highest < 3.0
    assert dust_strength(0.5, 0.2 * weight, weight, radius) == 0.0  # idling rotors


@pytest.mark.parametrize(
    ("height", "dusty"), [(0.5, True), (2.0, True), (3.0, False), (9.0, False)]
)
def test_only_a_low_hover_over_soil_raises_dust(soil: Scene, height: float, dusty: bool) -> None:
    air = _air(soil, height)
    assert (air.extinction > 0.0) == dusty
    if dusty:
        assert air.depth_m == pytest.approx(height)
    lawn = Surface(land_class="lawn", reflectivity=0.45)
    grassy = dataclasses.replace(soil, surfaces={**soil.surfaces, "field_soil": lawn})
    assert _air(grassy, height) is CLEAR
    assert _air(soil, height, thrust=0.1) is CLEAR


def test_extinction_follows_density_and_the_share_of_soil(soil: Scene) -> None:
    assert _air(soil, 0.5).extinction == pytest.approx(FULL_EXTINCTION_PER_M)
    assert _air(soil, 0.5, density=0.3).extinction == pytest.approx(0.3 * FULL_EXTINCTION_PER_M)
    half = dataclasses.replace(soil.surfaces["field_soil"], dust=0.5)
    less = dataclasses.replace(soil, surfaces={"field_soil": half})
    assert _air(less, 0.5).extinction == pytest.approx(0.5 * FULL_EXTINCTION_PER_M)
    # of the raster around the place: a quarter is soil, and half of that is under water
    kinds = np.zeros((80, 80), np.uint8)
    kinds[:, 40:41], kinds[:, 38:39] = 1, 1
    classes = np.ones((80, 80), np.uint8)
    classes[:, 38:39] = 5
    raster = GroundRaster(
        geom_name="field_soil", origin_xy_m=np.array([-20.0, -20.0]), cell_m=0.5,
        class_id=classes, reflectivity=np.full((80, 80), 0.3, np.float32), material=kinds,
        materials=(Surface(land_class="lawn", reflectivity=0.4), soil.surfaces["field_soil"]),
    )  # fmt: skip
    painted = dataclasses.replace(soil, ground=raster)
    assert _air(painted, 0.5).extinction == pytest.approx(0.2 * FULL_EXTINCTION_PER_M)


class _Constant(DustCloud):
    def __init__(self, extinction: float, depth_m: float) -> None:
        self._air = DustAir(extinction, depth_m)

    def at(self, tick: int) -> DustAir:
        return self._air


def _scan(height: float, dust: DustCloud | None) -> tuple[np.ndarray, np.ndarray]:
    sensor = LidarSensor(make_scene(PLANE, {"plane": BRIGHT}), PERFECT, 1, None, dust=dust)
    scan = sensor.scan(0, 60, TICK_HZ, track((0, 60), height), DOWN, {})
    return scan.ranges, scan.intensity


def test_the_cloud_weakens_echoes_and_answers_itself_above_the_ground() -> None:
    clear_range, clear_level = _scan(2.0, None)
    ranges, level = _scan(2.0, _Constant(0.4, 2.0))
    early = (clear_range > 0) & (ranges > 0) & (ranges < clear_range - 0.05)
    assert 0.05 < early.mean() < 0.9
    assert np.median(level[early]) < 10 < np.median(clear_level)
    assert ranges[early].min() >= 0.5
    ground = (ranges > 0) & ~early
    expected = clear_level[ground] * np.exp(-0.8 * clear_range[ground])
    np.testing.assert_allclose(level[ground], expected, atol=1.0)
    none, same = _scan(2.0, _Constant(0.0, 0.0))
    np.testing.assert_array_equal(none, clear_range)
    np.testing.assert_array_equal(same, clear_level)
    thin, _ = _scan(2.0, _Constant(0.05, 2.0))
    assert (thin < clear_range - 0.05).mean() < 0.01
