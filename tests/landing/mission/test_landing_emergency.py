"""Emergencies, energy and unhealthy estimates, with a vehicle that follows its setpoint."""

import dataclasses

import numpy as np
import pytest

from touchdown.landing.api import LanderView, Phase
from touchdown.landing.mission.wind import WindEstimator
from touchdown.sim.api import GRAVITY_MPS2
from touchdown.sim.frames import Pose

from support.lander_support import ORIGIN, PARAMS, Puppet, flat_map, fly, make_lander
from support.landing_support import make_estimate, make_grid, make_obs, make_rig


def fly_timed(puppet: Puppet, seconds: float = 200.0) -> tuple[dict[Phase, float], LanderView]:
    """When each phase began for the first time."""
    began: dict[Phase, float] = {}
    for view, _ in puppet.run(seconds):
        began.setdefault(view.phase, puppet.tick / 600.0)
        if view.phase is Phase.DONE:
            break
    return began, view


def test_emergency_lands_in_time_on_the_least_bad_site() -> None:
    """A slope of 7 degrees everywhere is refused, in an emergency accepted within the limit."""
    _, x = np.mgrid[0:280, 0:280] * 0.2
    steep = make_grid(np.tan(np.deg2rad(7.0)) * (x - 20.0), origin=ORIGIN)
    lander = make_lander(emergency="battery")
    began, view = fly_timed(Puppet(lander, steep, ground=-3.0))
    assert began[Phase.DONE] - began[Phase.SELECT] <= PARAMS.emergency_s
    assert "the least bad" in view.candidates[0].reason and Phase.RETURN not in began
    assert not view.no_site


def test_emergency_without_a_map_descends_in_place() -> None:
    void = make_grid(np.full((280, 280), np.nan), origin=ORIGIN)
    began, view = fly_timed(Puppet(make_lander(emergency="battery"), void))
    assert Phase.RETURN not in began and view.no_site
    assert began[Phase.DONE] - began[Phase.SELECT] <= PARAMS.emergency_s


@pytest.mark.parametrize(("battery", "legs"), [(0.9, 2), (0.35, 1)])
def test_search_leg_only_where_the_battery_suffices_for_it_and_the_way_home(
    battery: float, legs: int
) -> None:
    """Rubble; the flight so far took what is missing of the battery."""
    rng = np.random.default_rng(3)
    rubble = make_grid(rng.uniform(0.0, 1.0, (280, 280)), origin=ORIGIN)
    puppet = Puppet(make_lander(emergency_s=5.0), rubble)
    puppet.battery = battery
    phases, view = fly(puppet)
    assert phases.count(Phase.SURVEY) == legs and view.no_site


class Lost(Puppet):
    """Its estimator says that it is unhealthy between two times."""

    def __init__(self, start_s: float, end_s: float, **changes: object) -> None:
        super().__init__(make_lander(**changes), flat_map())
        healthy = self.lander.update

        def update(obs, estimate, view):  # type: ignore[no-untyped-def]
            bad = start_s <= obs.time_s < end_s
            return healthy(obs, dataclasses.replace(estimate, healthy=not bad), view)

        self.lander.update = update  # type: ignore[method-assign]


def test_short_unhealthy_period_holds_and_resumes() -> None:
    puppet = Lost(12.0, 16.0)
    held, jumps, last = [], [], None
    for view, setpoint in puppet.run(200.0):
        if 13.5 < puppet.tick / 600.0 < 15.9:
            held.append(setpoint.position_odom)
        if last is not None:
            jumps.append(float(np.linalg.norm(setpoint.position_odom - last)))
        last = setpoint.position_odom.copy()
        if view.phase is Phase.DONE:
            break
    assert np.ptp(np.array(held), axis=0) == pytest.approx(0.0, abs=1e-9)
    assert max(jumps) < 0.3  # the fastest leg covers 0.2 m in a step
    assert not view.aborted and view.committed_site_world is not None


def test_long_unhealthy_period_aborts_and_descends_in_place() -> None:
    puppet = Lost(12.0, 1e9)
    phases, view = fly(puppet)
    assert view.aborted
    assert "unhealthy" in view.note or phases[-1] is Phase.DONE
    assert phases[-1] is Phase.DONE and Phase.SELECT not in phases
    assert puppet.position[:2] == pytest.approx(view.committed_site_world[:2], abs=0.01)


def test_wind_follows_from_tilt_and_thrust() -> None:
    """Hovering against 5 m/s: drag of 0.3 N per m/s is balanced by the tilt of the thrust."""
    vehicle = make_rig().vehicle
    weight = vehicle.mass_kg * GRAVITY_MPS2
    tilt = np.arctan2(0.3 * 5.0, weight)
    up = np.array([-np.sin(tilt), 0.0, np.cos(tilt)])
    ahead = np.array([np.cos(tilt), 0.0, np.sin(tilt)])
    attitude = np.column_stack([ahead, [0.0, 1.0, 0.0], up])
    speed = np.full(4, np.sqrt(weight / np.cos(tilt) / 4.0 / vehicle.thrust_coefficient))
    guess = WindEstimator(vehicle)
    for tick in range(0, 12000, 12):
        obs = make_obs(tick, rotor_speed_radps=speed)
        guess.update(obs, make_estimate(tick, Pose(attitude, np.zeros(3))))
    assert guess.wind_odom == pytest.approx([5.0, 0.0], abs=0.05)
