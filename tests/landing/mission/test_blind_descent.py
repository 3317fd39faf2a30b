"""A descent whose position is not measured: by velocity, fast, and sure of the ground only where it
touches it."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from touchdown.controller.api import Setpoint
from touchdown.landing.api import Phase
from touchdown.landing.mission.blind_descent import blind_descent, runaway
from touchdown.landing.mission.view import Sight
from touchdown.sim.typing import Array

from support import landing_support
from support.lander_support import STEP_TICKS
from support.mission_stage import RUBBLE, SITE, STEP_S, Stage

LEGS = landing_support.LEG_HEIGHT


def test_sight_is_lost_where_the_spread_rises_without_a_measurement() -> None:
    sight, found = Sight(), {}
    for tick in range(3000):
        time_s = tick / 100.0
        # Dead reckoning from a given place, measurements every second, dead reckoning, nothing.
        sigma = 0.001 + 0.02 * time_s if time_s < 7.0 else 0.05 + 0.02 * (time_s % 1.0)
        if time_s >= 10.0:
            sigma = 0.05 + 0.008 * (time_s - 10.0) + 0.04 * max(time_s - 20.0, 0.0) ** 2
        sigma *= 1.0 - 0.01 * (tick % 7 == 0)  # as turns do
        found[time_s] = sight.lost_s(time_s, np.diag([1e-4, sigma**2, 9.0]))
    assert not any(seconds for time_s, seconds in found.items() if time_s < 20.0)
    assert found[24.0] == pytest.approx(3.9, abs=0.1)
    assert found[29.0] == pytest.approx(8.9, abs=0.1)
    assert sight.lost_s(30.0, 0.05**2 * np.eye(3)) == 0.0


class Flight:
    """A blind descent of a vehicle that flies the commanded velocity, and measures it with
    ``error``. The true ground lies at ``ground``; ``jump`` moves the estimated position, and a
    vehicle at a height is ``carried`` by a wind that it cannot hold against."""

    def __init__(
        self,
        stage: Stage,
        ground: float = 0.0,
        error: Callable[[float], Array] = lambda t: np.zeros(3),
        jump: Callable[[float], Array] = lambda t: np.zeros(3),
        felt: Callable[[Array], Array] | None = None,
        carried: Callable[[float], Array] = lambda height: np.zeros(3),
    ) -> None:
        self.true, time_s, before = stage.position.copy(), 0.0, np.zeros(3)
        self.setpoints: list[Setpoint] = []
        self.speeds, self.places = [], []
        stage.carried = lambda legs: 0.5 if self.true[2] <= LEGS + ground else 1.0
        steps = blind_descent(stage.mission)
        for setpoint in steps:
            self.setpoints.append(setpoint)
            off = setpoint.thrust_limit is not None or not setpoint.motors_on
            assert off or setpoint.position_odom == pytest.approx(stage.position)
            velocity = np.zeros(3) if off else setpoint.velocity_odom - error(time_s)
            velocity = velocity + carried(self.true[2] - LEGS - ground)
            self.true = self.true + velocity * STEP_S
            self.true[2] = max(self.true[2], LEGS + ground)
            self.speeds.append(velocity)
            self.places.append(self.true.copy())
            time_s += STEP_S
            stage.position = stage.position + (velocity + error(time_s)) * STEP_S
            stage.position += jump(time_s) - before
            before = jump(time_s)
            stage.tick += STEP_TICKS
            stage.feed(velocity + error(time_s))
            if felt is not None:
                stage.show(stage.coarse, felt_wind_odom=felt(velocity + error(time_s)) - velocity)
            assert time_s < 40.0
        self.flown = [s for s in self.setpoints if s.thrust_limit is None and s.motors_on]
        self.seconds = len(self.flown) * STEP_S
        assert stage.mission.state.phase is Phase.TOUCHDOWN


def stage(above: Array, **params: Any) -> Stage:
    return Stage(SITE + [*above[:2], above[2] + LEGS], **params)


def test_it_comes_down_fast_on_the_site_by_velocity_alone() -> None:
    flight = Flight(stage(np.array([4.0, -3.0, 12.0])))
    assert flight.seconds < 16.0
    assert np.linalg.norm(flight.places[-1][:2] - SITE[:2]) < 1.0
    speeds = np.array(flight.speeds[: len(flight.flown)])
    assert np.hypot(*speeds[:, :2].T).max() == pytest.approx(2.5, abs=0.1)
    across, up = np.hypot(*np.diff(speeds[:, :2], axis=0).T), np.diff(speeds[:, 2])
    assert max(across.max(), np.abs(up).max()) <= 2.5 * STEP_S + 1e-9
    path = np.array(flight.places)
    on_the_way = np.hypot(*(path[:, :2] - SITE[:2]).T) > 1.05
    np.testing.assert_allclose(path[on_the_way, 2], 12.0 + LEGS, atol=0.02)
    last = speeds[-round(2.0 / STEP_S) :]
    np.testing.assert_allclose(last, np.tile([0.0, 0.0, -0.5], (len(last), 1)), atol=0.01)


@pytest.mark.parametrize("ground", [-1.5, 1.0])
def test_it_does_not_believe_the_height_it_knows(ground: float) -> None:
    """The true ground is higher or lower: contact is found there, at the speed that legs take."""
    flight = Flight(stage(np.array([0.0, 0.0, 12.0])), ground)
    assert flight.places[-1][2] == pytest.approx(LEGS + ground)
    touch = next(i for i, place in enumerate(flight.places) if place[2] <= LEGS + ground)
    assert flight.speeds[touch][2] == pytest.approx(-0.5, abs=0.05)
    assert len(flight.flown) - touch < 2.0 / STEP_S


def test_a_position_that_jumps_moves_nothing() -> None:
    speeds = [
        Flight(stage(np.array([0.0, 0.0, 9.0])), jump=lambda t, x=x: x * float(t > 2.0)).speeds
        for x in (np.zeros(3), np.array([3.0, 0.0, 1.0]))
    ]
    np.testing.assert_allclose(*speeds, atol=1e-9)


def test_who_is_carried_away_comes_down_and_goes_back_near_the_ground() -> None:
    """Above 3 m it is carried at 4 m/s, faster than it flies: it sinks after six seconds, comes
    back within the next six, and touches down without a speed across."""
    start = np.array([2.0, 0.0, 12.0])
    flight = Flight(stage(start), carried=lambda h: np.array([4.0, 0, 0]) * (h > 3.0))
    path = np.array(flight.places)
    assert 8.0 < np.abs(path[:, 0] - SITE[0]).max() < 40.0
    touch = next(i for i, place in enumerate(path) if place[2] <= LEGS + 1e-9)
    assert np.hypot(*flight.speeds[touch][:2]) < 0.05
    low = np.flatnonzero(path[:touch, 2] < LEGS + 1.7)
    assert np.hypot(*(path[low[-1], :2] - path[low[0], :2])) > 3.0
    away = np.hypot(*(path[touch, :2] - SITE[:2]))
    assert away < 1.1 or len(low) * STEP_S > 6.0
    lost = Flight(stage(start), carried=lambda h: np.array([4.0, 0.0, 0.0]) * (h > 0.0))
    assert lost.flown[-1].velocity_odom == pytest.approx([0.0, 0.0, -0.5], abs=0.01)


def test_without_a_site_it_takes_the_best_ground_or_that_below() -> None:
    for seen, expected in ((True, SITE[:2] + [0.0, 3.0]), (False, SITE[:2])):
        here = stage(np.array([0.0, 0.0, 9.0]))
        here.mission.state.choose(None)  # type: ignore[arg-type]
        raster = RUBBLE.height_m.copy()
        raster[150:, :] = 0.0
        grid = landing_support.make_grid(raster, 0.05, origin=tuple(RUBBLE.origin_xy_m), returns=6)
        fine = grid if seen else None
        here.maps = lambda legs, fine=fine: (fine, 1)
        if not seen:
            here.coarse = landing_support.make_grid(np.full((9, 9), np.nan), origin=(-1.0, -1.0))
        here.feed()
        flight = Flight(here)
        assert np.linalg.norm(flight.places[-1][:2] - expected) < 1.6
        assert flight.places[-1][2] == pytest.approx(LEGS, abs=0.02)


def test_the_drag_bounds_an_estimate_that_runs_away() -> None:
    """The estimated velocity errs by more each second. The felt wind shows it: the vehicle is
    braked, but for what may be a gust."""
    assert runaway(np.array([1.9, 0.0, 0.0]), np.zeros(3)) == pytest.approx(np.zeros(3))
    assert runaway(np.array([0.0, 5.0, 0.0]), np.zeros(3)) == pytest.approx([0.0, 3.0, 0.0])
    assert runaway(np.array([0.0, 5.0, 0.0]), np.array([8.0, 0, 0])) == pytest.approx([0, 1.0, 0])
    error = lambda t: np.array([min(0.8 * t, 6.0), 0.0, 0.0])  # noqa: E731
    fastest = {}
    for felt in (None, lambda measured: measured):
        here = stage(np.array([0.0, 0.0, 25.0]), descent_speed_mps=2.5)
        flight = Flight(here, error=error, felt=felt)
        fastest[felt is None] = np.abs(np.array(flight.speeds)[:, 0]).max()
    assert fastest[True] > 5.5 and fastest[False] < 3.0


def test_who_sees_its_place_waits_for_others_and_sinks_on_from_rest() -> None:
    for blind_s, blind in ((0.0, False), (3.0, True)):
        here = stage(np.array([0.0, 0.0, 12.0]))
        here.show(here.coarse, blind_s=blind_s)
        steps = blind_descent(here.mission)
        next(steps)
        assert here.mission.state.final and here.mission.state.blind is blind
    sinking = np.zeros(3)
    for step in range(round(4.0 / STEP_S)):
        here.tick += STEP_TICKS
        here.feed(sinking)
        waits = step * STEP_S > 2.0
        sinking = here.mission.hold().velocity_odom if waits else next(steps).velocity_odom
        if step == round(1.9 / STEP_S):
            assert sinking[2] < -2.5
    here.tick += STEP_TICKS
    here.feed(np.zeros(3))
    assert next(steps).velocity_odom[2] == pytest.approx(0.0, abs=0.05)
