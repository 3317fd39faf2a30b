"""The state machine: perfect estimate, a vehicle that follows its setpoint, a made-up map."""

import dataclasses

import numpy as np
import pytest

from touchdown.estimator.api import MapView
from touchdown.landing.api import LanderView, Phase
from touchdown.landing.mission.lander import SiteLander
from touchdown.landing.mission.wind import WindEstimator
from touchdown.sim.api import GRAVITY_MPS2
from touchdown.sim.frames import Pose

from support.lander_support import (
    ORIGIN,
    PARAMS,
    QUICK,
    STEP_TICKS,
    Puppet,
    flat_map,
    fly,
    make_lander,
)
from support.landing_support import (
    LEG_HEIGHT,
    make_estimate,
    make_grid,
    make_obs,
    make_rig,
    view_of,
)


def test_phases_follow_each_other_to_a_landing_on_the_committed_site() -> None:
    puppet = Puppet(make_lander(), flat_map())
    phases, view = fly(puppet)
    assert phases == [
        Phase.INIT, Phase.TAKEOFF, Phase.SURVEY, Phase.SELECT, Phase.APPROACH, Phase.DESCEND,
        Phase.TOUCHDOWN, Phase.DONE,
    ]  # fmt: skip
    assert puppet.position[:2] == pytest.approx(view.committed_site_world[:2], abs=0.01)
    assert view.committed_site_world[2] == pytest.approx(0.0, abs=0.02) and not view.no_site
    assert not view.aborted and not puppet.setpoint.motors_on


def test_notes_say_what_the_phase_does() -> None:
    one_leg = dataclasses.replace(QUICK, legs=1)
    puppet = Puppet(SiteLander(make_rig(), PARAMS, one_leg), flat_map())
    notes: dict[Phase, str] = {}
    for view, _ in puppet.run(200.0):
        notes.setdefault(view.phase, view.note)
        if view.phase is Phase.APPROACH:
            break
    length = f"{one_leg.leg_length_m:.0f} m"
    assert notes[Phase.SURVEY] == f"surveying 1 leg of {length}"
    assert notes[Phase.SELECT] == "choosing a site"


def test_references_never_jump_and_meet_the_ground_slowly() -> None:
    puppet = Puppet(make_lander(), flat_map())
    last, fastest_near_ground, commits = None, 0.0, set()
    for view, setpoint in puppet.run(200.0):
        if last is not None and setpoint.motors_on and view.phase is not Phase.TOUCHDOWN:
            step = np.linalg.norm(setpoint.position_odom - last)
            assert step < 8.0 * STEP_TICKS / 600.0, view.phase
        if view.phase is Phase.DESCEND and puppet.position[2] < LEG_HEIGHT + 0.2:
            fastest_near_ground = max(fastest_near_ground, abs(setpoint.velocity_odom[2]))
        if view.committed_site_world is not None:
            commits.add(tuple(view.committed_site_world))
        last = setpoint.position_odom
        if view.phase is Phase.DONE:
            break
    assert 0.05 < fastest_near_ground <= 0.2 and len(commits) == 1


def test_survey_only_is_done_after_the_survey_and_keeps_flying() -> None:
    puppet = Puppet(make_lander(survey_only=True), flat_map())
    phases, _ = fly(puppet)
    assert phases == [Phase.INIT, Phase.TAKEOFF, Phase.SURVEY, Phase.DONE]
    assert puppet.setpoint.motors_on


def test_no_site_searches_another_leg_then_returns_home() -> None:
    rng = np.random.default_rng(3)
    rubble = make_grid(rng.uniform(0.0, 1.0, (280, 280)), origin=ORIGIN)
    puppet = Puppet(make_lander(), rubble)
    phases, view = fly(puppet)
    assert phases[3:] == [
        Phase.SELECT, Phase.SURVEY, Phase.SELECT, Phase.RETURN, Phase.DESCEND, Phase.TOUCHDOWN,
        Phase.DONE,
    ]  # fmt: skip
    assert view.no_site and not view.aborted
    assert puppet.position[:2] == pytest.approx([0.0, 0.0], abs=0.02)
    first, second = view.decisions
    assert first.time_s < second.time_s and second.candidates == view.candidates
    assert first.why.startswith("No site: 12 candidates refused: ") and not first.given_up


def test_unsuitable_commanded_site_is_refused_with_its_reason() -> None:
    height = np.zeros((280, 280))
    height[120:130, 132:140] = 0.8  # a box at x 6.4..8, y 4..6
    puppet = Puppet(make_lander(site_xy_m=(7.0, 5.0)), make_grid(height, origin=ORIGIN))
    phases, view = fly(puppet)
    assert view.aborted and Phase.RETURN in phases
    assert Phase.APPROACH not in phases and "refused" in view.candidates[0].reason
    (decision,) = view.decisions
    assert decision.why == f"No site: the only candidate is {view.candidates[0].reason}"
    assert decision.positions_world[0, :2] == pytest.approx([7.0, 5.0])
    assert puppet.position[:2] == pytest.approx([0.0, 0.0], abs=0.02)


def test_commanded_site_is_accepted_unchecked_without_check_site() -> None:
    height = np.zeros((280, 280))
    height[120:130, 132:140] = 0.8
    lander = make_lander(site_xy_m=(7.0, 5.0), check_site=False)
    phases, view = fly(Puppet(lander, make_grid(height, origin=ORIGIN)))
    assert not view.aborted and Phase.RETURN not in phases
    assert view.candidates[0].reason.startswith("accepted unchecked; by the map: refused")
    assert view.candidates[0].rule == "commanded_unchecked"
    assert view.committed_site_world[:2] == pytest.approx([7.0, 5.0])


def test_a_commanded_site_stays_in_the_world_when_the_odometry_frame_is_corrected() -> None:
    """0.5 m to the north in the middle of the descent: the vehicle ends 0.5 m south in odom."""
    puppet = Puppet(make_lander(site_xy_m=(7.0, 5.0)), flat_map())
    view = None
    for view, _ in puppet.run(200.0):
        low = puppet.position[2] < 8.0 and view.phase is Phase.DESCEND
        if low:
            puppet.world_from_odom = Pose(np.eye(3), np.array([0.0, 0.5, 0.0]))
        if view.phase is Phase.DONE:
            break
    assert view is not None and view.committed_site_world is not None
    assert view.committed_site_world[:2] == pytest.approx([7.0, 5.0])
    assert puppet.position[:2] == pytest.approx([7.0, 4.5], abs=0.02)


def test_site_that_fails_the_look_at_10_m_is_refused() -> None:
    """The coarse map says flat, the fine one says rubble: go around twice, then home."""
    lander = make_lander()
    puppet = Puppet(lander, flat_map())
    rough = np.random.default_rng(5).uniform(0.0, 0.6, (240, 240))
    rubble = make_grid(rough, 0.05, returns=4)

    def rubble_below() -> MapView:
        low = puppet.position[2] < 14.0
        corner = np.round((puppet.position[:2] - 6.0) / 0.05) * 0.05
        below = dataclasses.replace(rubble, origin_xy_m=corner)
        return view_of(puppet.coarse, below if low else None)

    puppet.view_map = rubble_below  # type: ignore[method-assign]
    phases, view = fly(puppet, 400.0)
    assert phases.count(Phase.APPROACH) == 3
    tried = np.array([decision.positions_world[0, :2] for decision in view.decisions])
    apart = np.linalg.norm(tried[:, None] - tried, axis=2)[~np.eye(len(tried), dtype=bool)]
    assert apart.min() > 2.5  # refused_radius_m, less the map's cells
    assert view.no_site and phases[-1] is Phase.DONE


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
