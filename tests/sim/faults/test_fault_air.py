"""Faults of weather and light, on LIDAR and camera, against known answers."""

import math
from contextlib import closing
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from touchdown.experiments.flight.wiring import low_sun
from touchdown.scenes.api import LowSun, Scene
from touchdown.scenes.authoring.light import air_mass, lit_by, lower_sun, sun_colour
from touchdown.sim.api import CameraParams, FaultParams, LidarParams, LidarScan
from touchdown.sim.camera.degradations import (
    AIRLIGHT_LEVEL,
    CameraDegradations,
    dirt_map,
    glare_table,
)
from touchdown.sim.camera.sensor import CameraSensor
from touchdown.sim.faults.disturbances import Air, Weather, fog_extinction, rain_extinction
from touchdown.sim.lidar.patterns import HORIZON
from touchdown.sim.lidar.weather import LIDAR_RATIO_SR, Beam, Clutter, drops_larger, grid_m

from support.camera_support import CLEAN, HEIGHT_M, posed
from support.camera_support import make_scene as camera_scene
from support.fault_air_support import look_down
from support.fault_support import HZ
from support.lidar_support import BUDGET, PLANE
from support.places import scene_of
from support.worlds import load_ideal_config as load_config


def test_extinction_of_fog_and_rain() -> None:
    assert fog_extinction(200.0) == pytest.approx(3.912 / 200.0)
    assert math.exp(-fog_extinction(200.0) * 200.0) == pytest.approx(0.02, rel=1e-3)
    assert fog_extinction(200.0, 905.0) == fog_extinction(200.0)  # large droplets: no colour
    assert fog_extinction(2000.0, 905.0) == pytest.approx(1.956e-3 * (905 / 550) ** -0.66)
    # 1.076 * 25^0.67 = 9.301 dB/km; 10 lg e = 4.3429
    assert rain_extinction(25.0) == pytest.approx(9.301 / 4342.9, rel=1e-3)
    assert rain_extinction(0.0) == 0.0
    both = Air(visibility_m=200.0, rain_mmph=25.0)
    assert both.extinction() == pytest.approx(fog_extinction(200.0) + rain_extinction(25.0))


def test_weather_comes_and_goes_on_its_ticks() -> None:
    weather = Weather(FaultParams(events=("fog@1+0.5", "rain@1.2")), HZ)
    assert weather.at(599) is None
    assert weather.at(600) == Air(visibility_m=200.0)
    assert weather.at(720) == Air(visibility_m=200.0, rain_mmph=25.0)
    assert weather.at(900) == Air(rain_mmph=25.0) == weather.at(10**6)
    assert not Weather(FaultParams(events=("lidar_nan@1",)), HZ).ever


def near_axis(scan: LidarScan) -> NDArray[np.bool_]:
    return np.asarray(scan.directions[:, 2] > math.cos(math.radians(2.0)))


def test_beer_and_lambert_at_a_known_range() -> None:
    """20 m there and back at V = 100 m: exp(-2 * 0.03912 * 20) = 0.2091."""
    clear, hazy = look_down(PLANE, 20.0), look_down(PLANE, 20.0, "fog@0", fog_visibility_m=100.0)
    axis = near_axis(clear)
    assert axis.sum() > 50
    assert set(clear.intensity[axis]) == {120}  # 150 * 0.8
    through = (hazy.ranges == clear.ranges) & axis
    assert through.sum() > 0.9 * axis.sum()  # the others are false
    assert set(hazy.intensity[through]) == {25}  # 150 * 0.8 * 0.2091 = 25.1


@pytest.mark.parametrize("height", [30.0, 80.0])
def test_range_is_lost_where_the_link_budget_ends(height: float) -> None:
    """At the visibility that leaves just what is needed, half of the pulses come back."""
    needed = float(BUDGET.strength_needed(np.array([height]))[0])
    visibility = 3.912 / (math.log(0.8 / needed) / (2.0 * height))
    for factor, low, high in ((0.9, 0.0, 0.02), (1.0, 0.3, 0.7), (1.1, 0.98, 1.0)):
        scan = look_down(PLANE, height, "fog@0", fog_visibility_m=factor * visibility)
        ranges = scan.ranges[near_axis(scan)]
        true = ranges[(ranges == 0.0) | (ranges > 0.9 * height)]  # not of the fog itself
        assert true.size > 30 and low <= (true > 0.0).mean() <= high


def clutter(air: Air) -> Clutter:
    x, y = np.deg2rad(HORIZON.divergence_deg)
    return Clutter(air, Beam(BUDGET, (float(x), float(y)), 1.0, 0.5, False))


@pytest.mark.parametrize(("event", "faults", "air"), [
    ("fog@0", {"fog_visibility_m": 65.0}, Air(visibility_m=65.0)),
    ("rain@0", {"rain_mmph": 50.0}, Air(rain_mmph=50.0)),
])  # fmt: skip
def test_false_returns_are_a_poisson_process(event: str, faults: Any, air: Air) -> None:
    """Into the empty sky: the fraction of pulses that return nearer than r is 1 - exp(-H(r))."""
    scan = look_down('<geom name="plane" size="0.1" pos="0 0 -900"/>', 30.0, event, **faults)
    table, grid = clutter(air).expected, grid_m()
    table = np.maximum(table - np.interp(0.5, grid, table), 0.0)
    count = len(scan.ranges)
    assert scan.ranges[scan.ranges > 0].min() >= 0.5
    for r in (1.0, 2.0, 5.0, 60.0):
        fraction = 1.0 - math.exp(-float(np.interp(r, grid, table)))
        found = float(((scan.ranges > 0) & (scan.ranges < r)).mean())
        assert found == pytest.approx(fraction, abs=4.0 * math.sqrt(fraction / count) + 1e-3)
    assert np.median(scan.ranges[scan.ranges > 0]) < 4.0  # near the sensor


def test_rate_of_false_returns_of_fog_and_rain() -> None:
    # fog: reflectivity pi e / S over a metre reaches 1 % at e = 0.05984, V = 65.4 m
    edge = 3.912 / (0.01 * LIDAR_RATIO_SR / math.pi)
    assert edge == pytest.approx(65.4, abs=0.1)
    at_edge = clutter(Air(visibility_m=edge)).fog_per_metre()[0]
    assert at_edge == pytest.approx(0.47, abs=0.02)  # the median of a gamma lies below its mean
    assert clutter(Air(visibility_m=200.0)).expected[-1] < 1e-6
    # rain: D^2 = 2 * 0.01 S A / pi^2 = (1.73 mm)^2 at A = pi (10 mm)^2 / 4; slope 4.1 * 25^-0.21
    found = clutter(Air(rain_mmph=25.0)).rain_per_metre()[0]
    assert found == pytest.approx(7.854e-5 * float(drops_larger(np.array(1.730), 25.0)), rel=0.01)
    assert float(drops_larger(np.array(0.0), 25.0)) == pytest.approx(8000.0 / 2.0856, rel=1e-3)
    assert 0.001 < clutter(Air(rain_mmph=25.0)).expected[-1] < 0.03


def test_a_false_return_hides_what_lies_behind_it_or_is_hidden() -> None:
    dense: dict[str, Any] = {"fog_visibility_m": 60.0}
    first = look_down(PLANE, 3.0, "fog@0", **dense)
    assert (first.ranges <= look_down(PLANE, 3.0).ranges + 1e-6).all()
    assert 0.2 < (first.ranges < 2.5).mean() < 0.99
    strongest = LidarParams(
        range_sigma_m=0.0, angle_sigma_deg=0.0, divergence=False, return_mode="strongest"
    )
    seen = look_down(PLANE, 3.0, "fog@0", params=strongest, **dense)
    assert (seen.ranges > 2.9).mean() > 0.95  # a floor of 80 % at 3 m outshines it


def level_of(light: float) -> float:
    return 255.0 * min(light, 1.0) ** (1.0 / 2.2)


def photograph(scene: Scene, *events: str, **faults: Any) -> NDArray[np.uint8]:
    with closing(
        CameraSensor(scene, CLEAN, 3, faults=FaultParams(events=events, **faults), tick_hz=HZ)
    ) as camera:
        return camera.render(camera.snapshot(posed(scene)), 0)


@pytest.mark.parametrize("grey", [0.0, 1.0])
def test_contrast_falls_by_koschmieders_law(grey: float) -> None:
    """20 m below the camera, and 25.1 m on the way to a corner."""
    scene = camera_scene(floor=f"{grey} {grey} {grey} 1")
    image = photograph(scene, "fog@0", fog_visibility_m=60.0)
    k = CameraSensor(scene, CLEAN, 0).intrinsics()
    corner = math.sqrt(1.0 + (k.cx / k.fx) ** 2 + (k.cy / k.fy) ** 2)
    airlight = (AIRLIGHT_LEVEL / 255.0) ** 2.2
    for row, col, stretch in ((240, 424, 1.0), (0, 0, corner), (479, 847, corner)):
        clear = math.exp(-3.912 / 60.0 * HEIGHT_M * stretch)
        expected = level_of(grey * clear + airlight * (1.0 - clear))
        assert abs(float(image[row, col, 1]) - expected) < 1.5


def test_dirt_covers_the_configured_share() -> None:
    params = CameraParams()
    blobs = dirt_map(params, 0.1, 0.02, [0, 1])
    assert blobs.shape == (480, 848) and blobs.min() >= 0.0 and blobs.max() <= 1.0 + 1e-6
    assert blobs.mean() == pytest.approx(0.1, abs=0.003)
    assert (blobs > 0.9).mean() > 0.04 and (blobs < 0.01).mean() > 0.7  # blobs, not a veil
    np.testing.assert_array_equal(blobs, dirt_map(params, 0.1, 0.02, [0, 1]))
    other = dirt_map(params, 0.1, 0.02, [1, 1])
    assert abs(np.corrcoef(blobs.ravel(), other.ravel())[0, 1]) < 0.2


def test_dirt_dims_what_is_behind_it_and_stays_where_it_is() -> None:
    scene = camera_scene(floor="0.5 0.5 0.5 1")
    clean = photograph(scene).astype(float)
    dirty = photograph(scene, "lens_dirt@0", dirt_fraction=0.2, dirt_transmission=0.25).astype(
        float
    )
    fraction = dirty / clean
    assert fraction.max() == 1.0
    assert fraction.min() == pytest.approx(0.25 ** (1 / 2.2), abs=0.01)
    covered = (1.0 - fraction[..., 0]) / (1.0 - 0.25 ** (1 / 2.2))
    assert covered.mean() == pytest.approx(0.2, abs=0.01)
    again = photograph(scene, "lens_dirt@0", dirt_fraction=0.2, dirt_transmission=0.25)
    np.testing.assert_array_equal(again, dirty)


def test_glare_follows_the_cosine_of_the_sun_on_the_lens() -> None:
    table = glare_table(0.1)
    assert table[0] == round(level_of(0.1)) and table[255] == 255
    sun = '<light name="sun" type="directional" dir="-1 0 -0.2" diffuse="0.8 0.6 0.4"/>'
    for pitch_deg in (0.0, 30.0, 60.0):
        half = math.radians(pitch_deg) / 2.0  # nose up turns the camera towards +x
        scene = camera_scene(sun, quat_wxyz=f"{math.cos(half)} 0 {-math.sin(half)} 0")
        camera = CameraSensor(scene, CLEAN, 0)
        faults = FaultParams(events=("low_sun@0",), low_sun_deg=11.31, glare=0.05)
        degradations = CameraDegradations(
            faults, HZ, CLEAN, camera.intrinsics(), scene.model, 0, "vehicle/camera"
        )
        stray = degradations.stray_light(camera.snapshot(posed(scene)))
        cosine = math.sin(math.radians(pitch_deg) - math.atan(0.2))
        if cosine <= 0.0:
            assert stray is None
        else:
            assert stray is not None
            white = 0.05 * cosine * 0.5 / math.sin(math.radians(11.31))
            np.testing.assert_allclose(stray, white * np.array([1.0, 0.75, 0.5]), rtol=1e-5)


def test_a_low_sun_is_red_and_stands_at_the_given_azimuth() -> None:
    assert air_mass(90.0) == pytest.approx(1.0, abs=1e-3)
    assert air_mass(10.0) == pytest.approx(5.59, abs=0.02)  # table of Kasten and Young
    red, green, blue = sun_colour(10.0)
    assert red == 1.0 > green > blue and sun_colour(90.0) == pytest.approx(np.ones(3))
    spec = mujoco.MjSpec()
    light = spec.worldbody.add_light(name="sun", diffuse=[0.8, 0.8, 0.8], ambient=[0.1] * 3)
    down = np.array([0.6, 0.0, -0.8])
    way = lower_sun(light, LowSun(elevation_deg=10.0, azimuth_deg=90.0), down)
    np.testing.assert_allclose(-way, [0.0, np.cos(np.pi / 18), np.sin(np.pi / 18)], atol=1e-12)
    # of the 0.64 that level ground had, half comes from the sun and half from the sky
    np.testing.assert_allclose(light.ambient, 0.1 + 0.32)
    assert light.diffuse[0] * math.sin(math.radians(10.0)) == pytest.approx(0.32)
    kept = lower_sun(light, LowSun(elevation_deg=30.0), down)
    np.testing.assert_allclose(-kept, [-math.sqrt(0.75), 0.0, 0.5], atol=1e-12)  # as it stood


def test_the_low_sun_is_limited_to_scenes_with_the_fault() -> None:
    xml = '<mujoco><worldbody><geom type="plane" size="50 50 1"/></worldbody></mujoco>'
    plain, low = (scene_of(xml, sun=sun) for sun in (None, LowSun(elevation_deg=5.0)))
    assert low.model.light("sun").dir[2] == pytest.approx(-math.sin(math.radians(5.0)), abs=1e-6)
    assert plain.model.light("sun").dir[2] < -0.8
    with lit_by("day", LowSun(elevation_deg=5.0)):
        pass
    again = scene_of(xml)
    np.testing.assert_array_equal(again.model.light("sun").dir, plain.model.light("sun").dir)
    assert low_sun(load_config()) is None
    asked = low_sun(load_config(None, ["faults.low_sun_deg=7.5"], fault=("low_sun@0",)))
    assert asked == LowSun(elevation_deg=7.5)
