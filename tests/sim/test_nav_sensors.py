"""Barometer, magnetometer, rangefinder, and their delivery schedules."""

import math
from collections.abc import Callable, Iterator
from typing import Any

import mujoco
import numpy as np
import pytest

from touchdown.scenes.api import GroundRaster, Scene, Surface
from touchdown.sim import api as sim
from touchdown.sim.frames import rotation_from_yaw, so3_exp
from touchdown.sim.navigation import sensors
from touchdown.sim.navigation.rangefinder import RangefinderSensor
from touchdown.sim.typing import Array
from touchdown.sim.world import MujocoWorld

from support.places import bare_scene, scene_of

ALL_NAV = sim.SensorNeeds(gps=True, barometer=True, magnetometer=True, rangefinder=True)


def test_standard_atmosphere() -> None:
    """ISO 2533: 101325 Pa at sea level, 89 874.6 Pa at 1000 m, about 12 Pa a metre near it."""
    assert sensors.pressure_at(0.0) == sensors.SEA_LEVEL_PA
    assert sensors.pressure_at(1000.0) == pytest.approx(89_874.6, abs=1.0)
    assert sensors.pressure_at(0.0) - sensors.pressure_at(1.0) == pytest.approx(12.01, abs=0.01)
    for height in (-200.0, 0.0, 123.4, 4000.0):
        assert sensors.height_at(sensors.pressure_at(height)) == pytest.approx(height, abs=1e-6)


def test_barometer_without_errors_reads_the_height() -> None:
    params = sim.BarometerParams(white_sigma_pa=0.0, drift_sigma_pa=0.0, offset_sigma_pa=0.0)
    sample = sensors.BarometerSensor(params, 600, 0).sample(24, 31.5)
    assert (sample.tick, sample.time_s) == (24, 0.04)
    assert sample.altitude_m == pytest.approx(31.5, abs=1e-6)
    assert sample.pressure_pa == pytest.approx(sensors.pressure_at(31.5 + params.site_elevation_m))


def test_barometer_noise_drift_and_offset() -> None:
    """Differences of neighbours show the white noise; its removal leaves the drift's increments
    over a minute, sigma sqrt(2 (1 - exp(-60 / 300)))."""
    params = sim.BarometerParams()
    sensor = sensors.BarometerSensor(params, 600, 3)
    series = np.array([sensor.sample(24 * k, 0.0).pressure_pa for k in range(150_000)])
    assert np.std(np.diff(series)) / math.sqrt(2.0) == pytest.approx(1.2, rel=0.02)
    smooth = series.reshape(-1, 100).mean(axis=1)  # 4 s
    steps = np.std(smooth[15:] - smooth[:-15])
    expected = params.drift_sigma_pa * math.sqrt(2.0 * -math.expm1(-60.0 / 300.0))
    assert steps == pytest.approx(expected, rel=0.2)
    first = [sensors.BarometerSensor(params, 600, s).sample(0, 0.0).pressure_pa for s in range(500)]
    spread = math.sqrt(25.0**2 + 4.0**2 + 1.2**2)
    assert np.std(first) == pytest.approx(spread, rel=0.1)


def test_earth_field_points_down_and_along_its_declination() -> None:
    params = sim.MagnetometerParams(strength_ut=50.0, declination_deg=90.0, inclination_deg=60.0)
    np.testing.assert_allclose(
        sensors.earth_field_world(params), [25.0, 0.0, -50.0 * math.sqrt(0.75)], atol=1e-12
    )


def test_heading_from_the_field() -> None:
    """A level vehicle that heads north-west (yaw 135 degrees) recovers its yaw from the field."""
    params = sim.MagnetometerParams(noise_sigma_ut=0.0, hard_iron_sigma_ut=0.0)
    rotation = rotation_from_yaw(math.radians(135.0))
    field = sensors.MagnetometerSensor(params, 600, 0).sample(12, rotation).field_body_ut
    east, north, _ = sensors.earth_field_world(params)
    yaw = math.atan2(north, east) - math.atan2(field[1], field[0])
    assert math.degrees(yaw) == pytest.approx(135.0, abs=1e-9)


def test_hard_iron_is_constant_in_the_body_and_noise_is_white() -> None:
    sensor = sensors.MagnetometerSensor(sim.MagnetometerParams(), 600, 4)
    truth = sensors.earth_field_world(sim.MagnetometerParams())
    turns = [so3_exp(np.array([0.0, 0.3, 0.001 * k])) for k in range(20_000)]
    errors = np.array([sensor.sample(0, r).field_body_ut - r.T @ truth for r in turns])
    np.testing.assert_allclose(errors.mean(axis=0), sensor._hard_iron, atol=0.006)
    np.testing.assert_allclose(np.std(errors, axis=0), 0.2, rtol=0.03)
    devices = [
        sensors.MagnetometerSensor(sim.MagnetometerParams(), 600, s)._hard_iron for s in range(400)
    ]
    assert np.std(devices) == pytest.approx(0.7, rel=0.07)


SCENE_XML = """<mujoco><worldbody>
  <geom name="floor" type="plane" size="200 200 0.1"/>
  <geom name="roof" type="box" size="1 1 0.5" pos="20 0 2.5"/>
  <geom name="crown" type="sphere" size="2" pos="0 20 4"/>
  <geom name="pond" type="box" size="5 5 0.1" pos="-30 0 0"/>
  <geom name="soot" type="box" size="5 5 0.1" pos="0 -30 0"/>
  <geom name="hidden" type="box" size="5 5 0.1" pos="40 0 4" group="3"/>
  <body name="vehicle/quadrotor" pos="0 0 10"><freejoint/>
    <geom name="vehicle/body" type="box" size="0.3 0.3 0.3" mass="1" group="4"/></body>
</worldbody></mujoco>"""
CLEAN = sim.RangefinderParams(sigma_m=0.0, position_body_m=(0.0, 0.0, 0.0), resolution_m=1e-9)


def make_scene(ground: GroundRaster | None = None) -> tuple[Scene, mujoco.MjData]:
    model = mujoco.MjModel.from_xml_string(SCENE_XML)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    surfaces = {
        "floor": Surface(land_class="lawn", reflectivity=0.5),
        "roof": Surface(land_class="building", reflectivity=0.4),
        "crown": Surface(land_class="trees", reflectivity=0.5, porosity=0.6),
        "pond": Surface(land_class="water", reflectivity=0.02, water=True),
        "soot": Surface(land_class="road", reflectivity=0.01),
    }
    return bare_scene(model, surfaces=surfaces, ground=ground), data


def ranges(
    x: float, y: float, z: float, *, params: sim.RangefinderParams = CLEAN, tilt: float = 0.0,
    count: int = 1, ground: GroundRaster | None = None,
) -> Array:  # fmt: skip
    """(count,) readings of a vehicle at (x, y, z), pitched by ``tilt`` radians."""
    scene, data = make_scene(ground)
    sensor = RangefinderSensor(scene, params, 600, 1)
    rotation = so3_exp(np.array([0.0, tilt, 0.0]))
    pose = rotation, np.array([x, y, z])
    return np.array([sensor.sample(12, data, *pose).range_m for _ in range(count)])


def test_known_distances() -> None:
    assert ranges(0, 0, 10.0)[0] == pytest.approx(10.0, abs=1e-6)
    assert ranges(20, 0, 10.0)[0] == pytest.approx(7.0, abs=1e-6)
    assert ranges(40, 0, 10.0)[0] == pytest.approx(10.0, abs=1e-6)  # sensors do not see group 3
    assert ranges(0, 0, 10.0, tilt=0.5)[0] == pytest.approx(10.0 / math.cos(0.5), abs=1e-6)
    lowered = sim.RangefinderParams(
        sigma_m=0.0, position_body_m=(0.0, 0.0, -0.13), resolution_m=0.01
    )
    assert ranges(0, 0, 10.0, params=lowered)[0] == pytest.approx(9.87, abs=1e-9)


def test_noise_and_resolution() -> None:
    params = sim.RangefinderParams(position_body_m=(0.0, 0.0, 0.0))
    readings = ranges(0, 0, 10.0, params=params, count=4000)
    assert np.std(readings) == pytest.approx(0.03, rel=0.05)
    assert np.mean(readings) == pytest.approx(10.0, abs=0.002)
    np.testing.assert_allclose(readings * 100.0, np.round(readings * 100.0), atol=1e-6)


def test_faint_echoes_are_lost() -> None:
    """Reflectivity 0.5 is seen to 100 sqrt(5/7) = 84.5 m, 0.01 to 12.0 m; nothing is nearer than
    the least range; under 60 degrees the reach of the floor shrinks to 59.8 m."""
    assert ranges(0, 0, 84.0)[0] > 0.0
    assert ranges(0, 0, 85.0)[0] == 0.0
    assert ranges(0, -30, 11.9)[0] > 0.0
    assert ranges(0, -30, 12.3)[0] == 0.0
    assert ranges(0, 0, 0.05)[0] == 0.0
    slanted = math.radians(60.0)
    assert ranges(0, 0, 0.5 * 59.0, tilt=slanted)[0] > 0.0
    assert ranges(0, 0, 0.5 * 60.5, tilt=slanted)[0] == 0.0


def test_water_answers_near_the_vertical_only() -> None:
    assert ranges(-30, 0, 10.0)[0] == pytest.approx(9.9, abs=1e-6)
    assert ranges(-28, 0, 10.0, tilt=math.radians(15.0))[0] == 0.0


def test_crowns_let_some_pulses_through() -> None:
    readings = ranges(0, 20, 16.0, count=3000)
    top, through = np.abs(readings - 10.0) < 0.01, np.abs(readings - 16.0) < 0.01
    inner = np.abs(readings - 14.0) < 0.03  # the crown's lower skin, from inside
    assert (top | through | inner).all()
    assert top.mean() == pytest.approx(0.4, abs=0.03)


def test_the_ground_raster_overrides_the_geom() -> None:
    raster = GroundRaster(
        geom_name="floor", origin_xy_m=np.array([-1.0, -1.0]), cell_m=2.0,
        class_id=np.array([[3]], dtype=np.uint8), reflectivity=np.array([[0.01]], dtype=np.float32),
    )  # fmt: skip
    assert ranges(0, 0, 13.0, ground=raster)[0] == 0.0
    assert ranges(2, 0, 13.0, ground=raster)[0] > 0.0


MakeWorld = Callable[..., MujocoWorld]


@pytest.fixture(scope="module")
def field() -> Scene:
    return scene_of(
        '<mujoco><worldbody><geom name="lawn" type="plane" size="60 60 0.1"/></worldbody></mujoco>'
    )


@pytest.fixture
def make_world(field: Scene, closed: Any) -> MakeWorld:
    def make(needs: sim.SensorNeeds = ALL_NAV, nav: sim.NavParams | None = None) -> MujocoWorld:
        params = sim.WorldParams(
            sim=sim.SimParams(threads=1), camera=sim.CameraParams(width=32, height=24),
            nav=nav or sim.NavParams(),
        )  # fmt: skip
        return closed(MujocoWorld(field, params, 3, needs))

    return make


def rest(world: MujocoWorld, steps: int) -> Iterator[sim.Observation]:
    yield world.reset()
    for _ in range(steps):
        yield world.step(sim.Command(rotor_speed_radps=np.zeros(4)))


def test_each_sensor_has_its_own_schedule(make_world: MakeWorld) -> None:
    arrivals: dict[str, list[tuple[int, int]]] = {}
    names = ("gps", "barometer", "magnetometer", "rangefinder")
    for obs in rest(make_world(), 150):
        for name in names:
            found = arrivals.setdefault(name, [])
            found += [(obs.tick, sample.tick) for sample in getattr(obs, name)]
    schedule = {"gps": (120, 72), "barometer": (24, 12), "magnetometer": (12, 3)}
    for name, (period, latency) in (schedule | {"rangefinder": (12, 6)}).items():
        measured = range(period, 450 - latency + 1, period)
        assert arrivals[name] == [(t + latency, t) for t in measured]


def test_readings_at_rest_match_the_scene(make_world: MakeWorld) -> None:
    world = make_world()
    observations = list(rest(world, 400))
    height = float(world.truth().world_from_body.translation[2])
    antenna = world.truth().world_from_body.apply(np.array(world.rig.nav.gps.antenna_body_m))
    fixes = [fix for obs in observations for fix in obs.gps]
    assert len(fixes) == 9
    for fix in fixes:
        assert np.linalg.norm((fix.position_world - antenna) / fix.sigma_position_m) < 5.0
        assert np.linalg.norm(fix.velocity_world) < 0.3
    echoes = [s.range_m for obs in observations for s in obs.rangefinder]
    assert np.mean(echoes) == pytest.approx(height - 0.13, abs=0.01)
    heights = [s.altitude_m for obs in observations for s in obs.barometer]
    assert np.mean(heights) == pytest.approx(height, abs=3.0 * 26.0 / 12.0)


def test_sensors_do_not_disturb_one_another_and_reset_repeats(make_world: MakeWorld) -> None:
    alone = [
        s.altitude_m
        for o in rest(make_world(sim.SensorNeeds(barometer=True)), 60)
        for s in o.barometer
    ]
    world = make_world()
    together = [s.altitude_m for o in rest(world, 60) for s in o.barometer]
    again = [s.altitude_m for o in rest(world, 60) for s in o.barometer]
    assert alone == together == again


CENTRED = sim.GpsParams(antenna_body_m=(0.0, 0.0, 0.0))


def fix(sensor: sensors.GpsSensor, tick: int = 120, position: Array | None = None) -> sim.GpsFix:
    where = np.zeros(3) if position is None else position
    return sensor.sample(tick, np.eye(3), where, np.zeros(3), np.zeros(3))


def errors(params: sim.GpsParams, seed: int, count: int) -> Array:
    """(count, 3) position errors of one receiver at 5 Hz."""
    sensor = sensors.GpsSensor(params, 600, seed)
    return np.array([fix(sensor).position_world for _ in range(count)])


def test_the_receiver_wanders_like_the_process() -> None:
    """The increments of a fix over one period: sigma^2 2 (1 - exp(-T / tau)) per axis, which tests
    tau apart from sigma; across devices the first fix has the stationary spread."""
    series = errors(CENTRED, 5, 20_000)
    steps = np.std(np.diff(series, axis=0), axis=0)
    sigma = np.array([0.536, 0.536, 1.5 * 0.536])
    np.testing.assert_allclose(steps, sigma * math.sqrt(2.0 * -math.expm1(-0.2 / 60.0)), rtol=0.03)
    first = np.array([errors(CENTRED, seed, 1)[0] for seed in range(600)])
    np.testing.assert_allclose(np.std(first, axis=0), sigma, rtol=0.1)


def test_zou2024_preset_gives_the_published_mean_error() -> None:
    """36 s surveys: mean 3-D error 1.01 m with a standard deviation of 0.37 m between flights
    (the closed form of the mean of the norm of these three normals is 1.012 m)."""
    means = [
        float(np.linalg.norm(errors(CENTRED, seed, 180), axis=1).mean()) for seed in range(150)
    ]
    assert np.mean(means) == pytest.approx(1.012, abs=3.0 * 0.37 / math.sqrt(150))
    assert np.std(means) == pytest.approx(0.37, abs=0.07)


def test_velocity_is_white() -> None:
    sensor = sensors.GpsSensor(CENTRED, 600, 2)
    speeds = np.array([fix(sensor).velocity_world for _ in range(20_000)])
    np.testing.assert_allclose(np.std(speeds, axis=0), 0.05, rtol=0.03)
    lagged = np.mean(speeds[1:] * speeds[:-1], axis=0) / 0.05**2
    np.testing.assert_allclose(lagged, 0.0, atol=0.03)


def test_the_antenna_is_measured_not_the_body() -> None:
    """Antenna 1 m ahead, heading north, turning left at 2 rad/s: 1 m north of the body and moving
    west at 2 m/s beside the body's own 3 m/s upwards."""
    params = sim.GpsParams(
        antenna_body_m=(1.0, 0.0, 0.0), sigma_xy_m=0.0, sigma_z_m=0.0, velocity_sigma_mps=0.0
    )
    message = sensors.GpsSensor(params, 600, 0).sample(
        240, rotation_from_yaw(np.pi / 2), np.array([5.0, 6.0, 7.0]), np.array([0.0, 0.0, 3.0]),
        np.array([0.0, 0.0, 2.0]),
    )  # fmt: skip
    assert (message.tick, message.time_s) == (240, 0.4)
    np.testing.assert_allclose(message.position_world, [5.0, 7.0, 7.0], atol=1e-12)
    np.testing.assert_allclose(message.velocity_world, [-2.0, 0.0, 3.0], atol=1e-12)
