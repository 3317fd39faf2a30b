"""Crowns sway at the frequency of their height, the farther the stronger the wind."""

import dataclasses

import numpy as np
import pytest

from touchdown.scenes.api import Scene, Surface
from touchdown.sim.api import LidarScan
from touchdown.sim.lidar.raycast_scene import LidarScene
from touchdown.sim.lidar.sensor import LidarSensor
from touchdown.sim.lidar.sway import Sway, _displacement, sway_frequency_hz, sway_sigma_m

from support.lidar_support import DOWN, PERFECT, PLANE, TICK_HZ, make_scene, track

SWAYING = dataclasses.replace(PERFECT, sway=1.0)
EAST = np.array([10.0, 0.0])
CROWN = Surface(land_class="trees", reflectivity=0.45, porosity=0.02)
WORLD = PLANE + '<geom name="crown" type="ellipsoid" size="6 6 4" pos="0 0 11"/>'


def _scene() -> Scene:
    return make_scene(WORLD, {"crown": CROWN})


def _sway(wind: np.ndarray = EAST, seed: int = 5) -> Sway:
    sway = Sway.of(SWAYING, LidarScene(_scene()), wind, seed)
    assert sway is not None
    return sway


def _moved(sway: Sway, crown: int, times: np.ndarray) -> np.ndarray:
    """(N, 2) displacements at instants (N,)."""
    return np.array([_displacement(t, sway.along, sway._swing[crown]) for t in times])


def _scan(sway: float, wind: np.ndarray = EAST, start: int = 0) -> LidarScan:
    params = dataclasses.replace(PERFECT, sway=sway)
    ticks = (start, start + 60)
    sensor = LidarSensor(_scene(), params, 5, None, wind)
    return sensor.scan(*ticks, TICK_HZ, track(ticks, 30.0), DOWN, {})


def test_frequency_and_spread_by_hand() -> None:
    """20 m high, 33 cm thick: 0.0948 + 3.4317 * 33.3 / 400; 10 m/s on 0.025 m^2/kg."""
    frequency = sway_frequency_hz(np.array([10.0, 15.0, 20.0]))
    np.testing.assert_allclose(frequency, [0.667, 0.476, 0.381], atol=0.001)
    drag = 0.5 * 1.225 * 0.025 * 100.0
    expected = 0.4 * drag / (2 * np.pi * frequency) ** 2
    np.testing.assert_allclose(sway_sigma_m(frequency, 10.0), expected)
    np.testing.assert_allclose(sway_sigma_m(frequency, 20.0), 4.0 * sway_sigma_m(frequency, 10.0))


def test_the_crowns_height_is_measured_from_the_ground_below() -> None:
    """The top is at 15 m."""
    sway = _sway()
    (crown,) = np.flatnonzero(sway.porous)
    assert sway.frequency_hz[crown] == pytest.approx(0.476, abs=0.002)


def test_displacement_has_the_known_spread_frequency_and_direction() -> None:
    sway = _sway(10.0 * np.array([0.6, 0.8]))
    (crown,) = np.flatnonzero(sway.porous)
    times = np.arange(0.0, 600.0, 0.02)
    moved = _moved(sway, crown, times)
    along = moved @ [0.6, 0.8]
    across = moved @ [-0.8, 0.6]
    known = float(sway_sigma_m(sway.frequency_hz[[crown]], 10.0)[0])
    assert along.std() == pytest.approx(known, rel=0.03)
    assert across.std() == pytest.approx(0.5 * known, rel=0.03)
    assert abs(along.mean()) < 0.1 * known
    power = np.abs(np.fft.rfft(along)) ** 2
    peak = np.fft.rfftfreq(len(times), 0.02)[power.argmax()]
    assert peak == pytest.approx(sway.frequency_hz[crown], abs=0.01)
    twice = _sway(20.0 * np.array([0.6, 0.8]))
    np.testing.assert_allclose(_moved(twice, crown, times[:9]), 4.0 * moved[:9], atol=1e-9)


def test_ranges_to_a_crown_are_those_of_the_moved_ellipsoid() -> None:
    """Where a ray meets the ellipsoid displaced by what the sway says, to a millimetre or two."""
    sway = _sway()
    (crown,) = np.flatnonzero(sway.porous)
    for start in (0, 600, 1200):
        swayed, still = _scan(1.0, start=start), _scan(0.0, start=start)
        rays = swayed.directions.astype(float) @ DOWN.rotation.T
        times = start / TICK_HZ + swayed.time_offsets
        moved = _moved(sway, crown, times)
        size = np.array([6.0, 6.0, 4.0])
        center = np.column_stack([moved, np.full(len(times), 11.0)])
        origin = (np.array([0.0, 0.0, 30.0]) - center) / size
        slope = rays / size
        a, b = (slope**2).sum(1), (origin * slope).sum(1)
        c = (origin**2).sum(1) - 1.0
        inside = b * b - a * c > 0.3 * a  # well within the outline
        exact = (-b[inside] - np.sqrt((b * b - a * c)[inside])) / a[inside]
        hit = np.abs(still.ranges[inside] - exact) < 1.0  # not passed through
        assert hit.sum() > 2000
        error = (swayed.ranges[inside] - exact)[hit]
        assert np.abs(error).max() < 0.004
        change = (swayed.ranges - still.ranges)[inside][hit]
        assert np.abs(change).max() > 0.02


def test_ground_and_calm_air_do_not_sway() -> None:
    swayed, still = _scan(1.0), _scan(0.0)
    ground = np.abs(still.ranges * still.directions[:, 2] - 30.0) < 1e-3
    np.testing.assert_array_equal(swayed.ranges[ground], still.ranges[ground])
    np.testing.assert_array_equal(_scan(1.0, np.zeros(2)).ranges, still.ranges)
    bare = LidarScene(make_scene(PLANE))
    assert Sway.of(SWAYING, bare, EAST, 1) is None
    assert Sway.of(PERFECT, LidarScene(_scene()), EAST, 1) is None
