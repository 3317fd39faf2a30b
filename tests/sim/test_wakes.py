"""Wakes of obstacles at points whose wind is known from the formulas."""

import numpy as np
import pytest

from touchdown.sim.api import Command, WindParams, WorldParams
from touchdown.sim.wakes import Obstacles, Wakes, _table, mean_in_wake, obstacles
from touchdown.sim.wind import Wind
from touchdown.sim.world import MujocoWorld

from support.places import cached_scene

EAST = np.array([1.0, 0.0, 0.0])
FRICTION, ROUGHNESS = 2.0, 0.1
CAVITY = 8.0 * 1.8 * 1.25 / (1.25**0.3 * (1.0 + 0.24 * 1.25))
"""of a cube-like house of 10 m by 10 m and 8 m of height"""


def _house(solidity: float = 1.0, x: float = 0.0) -> Obstacles:
    return Obstacles(
        np.array([[x, 0.0]]), np.array([[[5.0, 0.0], [0.0, 5.0]]]), np.array([8.0]),
        np.array([solidity]),
    )  # fmt: skip


def _speed(found: Obstacles, point: tuple[float, float, float]) -> float:
    table = _table(found, EAST, 0.0)
    return mean_in_wake(table, *point, FRICTION, ROUGHNESS)[0]


def _free(height: float) -> float:
    return float(FRICTION * np.log(height / ROUGHNESS))


def test_far_wake_falls_off_with_the_power_of_three_halves() -> None:
    for x, z in ((1.5, 2.0), (2.5, 1.0)):
        reach = CAVITY * np.sqrt(1.0 - (z / 8.0) ** 2)
        expected = _free(z) * (1.0 - x**-1.5)
        assert _speed(_house(), (5.0 + x * reach, 0.0, z)) == pytest.approx(expected)


def test_flow_turns_back_in_the_cavity() -> None:
    reach = CAVITY * np.sqrt(1.0 - 0.25**2)
    expected = -_free(8.0) * 0.75**2
    assert _speed(_house(), (5.0 + 0.25 * reach, 0.0, 2.0)) == pytest.approx(expected)


def test_wake_narrows_towards_its_edges() -> None:
    centre, edge = (_speed(_house(), (25.0, y, 2.0)) for y in (0.0, 4.0))
    assert centre < edge < _free(2.0)


@pytest.mark.parametrize(
    "point",
    [(-6.0, 0.0, 2.0), (3.0, 0.0, 2.0), (20.0, 5.1, 2.0), (20.0, 0.0, 8.1), (70.0, 0.0, 2.0)],
    ids=["upwind", "beside the roof", "aside", "above", "far downwind"],
)
def test_air_elsewhere_is_free(point: tuple[float, float, float]) -> None:
    assert _speed(_house(), point) == _free(point[2])


def test_crown_lets_half_of_the_flow_through_and_none_turns_back() -> None:
    reach = CAVITY * np.sqrt(1.0 - 0.25**2)
    near, far = 5.0 + 0.25 * reach, 5.0 + 2.0 * reach
    assert _speed(_house(0.5), (near, 0.0, 2.0)) == pytest.approx(0.5 * _free(2.0))
    expected = _free(2.0) * (1.0 - 0.5 * 2.0**-1.5)
    assert _speed(_house(0.5), (far, 0.0, 2.0)) == pytest.approx(expected)


def test_slowest_of_two_wakes_holds() -> None:
    one, other = _house(), _house(x=30.0)
    both = Obstacles(*(np.concatenate(pair) for pair in zip(one, other, strict=True)))
    point = (50.0, 0.0, 2.0)
    assert _speed(both, point) == min(_speed(one, point), _speed(other, point))


def test_wake_turns_with_the_wind() -> None:
    north = np.array([0.0, 1.0, 0.0])
    house = _house()._replace(axes_xy=np.array([[[5.0, 0.0], [0.0, 2.0]]]))
    long, wide = _table(house, EAST, 0.0)[0], _table(house, north, 0.0)[0]
    assert (long[2], long[3]) == (2.0, 5.0)
    assert (wide[2], wide[3]) == (5.0, 2.0)
    assert wide[5] > long[5]


def test_mean_and_turbulence_in_the_wake() -> None:
    wakes = Wakes(_house(), EAST, 0.0, seed=3)
    position = np.array([30.0, 0.0, 2.0])
    series = []
    for _ in range(60_000):
        wind = np.array([_free(2.0), 0.0, 0.0])
        wakes.add(wind, position, 0.05, FRICTION, ROUGHNESS)
        series.append(wind)
    deficit = _free(2.0) - _speed(_house(), (30.0, 0.0, 2.0))
    gusts = np.array(series)
    np.testing.assert_allclose(gusts.mean(axis=0), [_free(2.0) - deficit, 0, 0], atol=0.06)
    np.testing.assert_allclose(gusts.std(axis=0), deficit / 3.0, rtol=0.06)


def test_scene_has_walls_and_crowns_as_obstacles_and_no_wires_or_fences() -> None:
    houses = obstacles(cached_scene("houses"))
    assert {0.5, 1.0} == set(houses.solidity)
    assert houses.tops_m.max() == pytest.approx(8.7, abs=0.5)
    spans = 2.0 * np.linalg.norm(houses.axes_xy, axis=2)
    assert spans.min() >= 1.0
    kept = len(Wakes(houses, EAST, 0.0, seed=0))
    assert 20 <= kept <= 200


def test_wakes_are_a_switch_and_slow_the_air_of_the_world() -> None:
    scene = cached_scene("houses")
    found = obstacles(scene)
    wall = int(np.argmax(found.tops_m * found.solidity))
    speeds = {}
    for on in (False, True):
        params = WorldParams(
            wind=WindParams(mean_kmh=36.0, direction_deg=0.0, turbulence=False, wakes=on)
        )
        world = MujocoWorld(scene, params, 0)
        lee = found.centres_xy_m[wall] + [np.abs(found.axes_xy[wall, :, 0]).sum() + 6.0, 0.0]
        obs = world.start_in_air(np.array([*lee, 3.5]), 0.0)
        world.step(Command(rotor_speed_radps=np.full(4, 398.0)))
        speeds[on] = float(world.truth().wind_world[0])
        assert obs.tick == 0
        world.close()
    free = Wind(WindParams(mean_kmh=36.0, direction_deg=0.0, turbulence=False), 0)
    assert speeds[False] == pytest.approx(free.mean_speed(3.5), abs=0.6)
    assert speeds[True] < 0.6 * speeds[False]


def test_rotational_gusts_turn_the_vehicle() -> None:
    rates = {}
    for on in (False, True):
        params = WorldParams(wind=WindParams(mean_kmh=36.0, direction_deg=0.0, rotational=on))
        world = MujocoWorld(cached_scene("flat"), params, 0)
        world.start_in_air(np.array([0.0, 0.0, 25.0]), 0.0)
        spins = []
        for _ in range(100):
            world.step(Command(rotor_speed_radps=np.full(4, 398.0)))
            spins.append(world.truth().angular_velocity_body)
        rates[on] = np.array(spins)
        world.close()
    assert not np.array_equal(rates[True], rates[False])
    assert np.abs(rates[True] - rates[False]).max() > 0.01
