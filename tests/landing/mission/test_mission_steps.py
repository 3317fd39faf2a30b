"""Single steps of a mission with known answers: looks, sweep, descent, ways, energy, frames."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from touchdown.controller.api import Setpoint
from touchdown.landing.api import LandingParams, Phase, SurveyParams
from touchdown.landing.mission import energy, phases
from touchdown.landing.mission.choice import choose_sites
from touchdown.landing.mission.descent import descend_to, final_descent
from touchdown.landing.mission.mission import Mission
from touchdown.landing.mission.rules import Action, Moment
from touchdown.landing.mission.site_recheck import best_ground
from touchdown.landing.mission.touchdown import TouchdownDetector
from touchdown.landing.mission.trajectory import HeadingTurn, vertical_move
from touchdown.landing.mission.view import MissionView
from touchdown.sim.api import GRAVITY_MPS2
from touchdown.sim.frames import Pose, rotation_from_yaw
from touchdown.sim.typing import Array

from support import landing_support
from support.lander_support import QUICK, STEP_TICKS
from support.mission_stage import COARSE, HOVER_RADPS, LEVEL, RUBBLE, SITE, STEP_S, Stage, fine


def places(setpoints: list[Setpoint]) -> Array:
    return np.array([setpoint.position_odom for setpoint in setpoints])


def test_descent_looks_at_10_m_and_sweeps_along_the_heading_at_4_m() -> None:
    yaw = 0.6
    stage = Stage(SITE + [0.0, 0.0, 15.0], yaw=yaw, sweep_m=1.4)
    setpoints = stage.run(descend_to(stage.mission))
    assert stage.result is None
    path = places(setpoints) - SITE - [0.0, 0.0, landing_support.LEG_HEIGHT]
    along, across = (path[:, :2] @ rotation_from_yaw(yaw)[:2, :2]).T
    np.testing.assert_allclose(across, 0.0, atol=1e-6)
    at_look, at_commit = (np.abs(path[:, 2] - height) < 0.03 for height in (10.0, 4.0))
    hover_s = 1.0 + LandingParams().decision_latency_s
    still = np.array([not s.velocity_odom.any() for s in setpoints])
    assert (at_look & still).sum() * STEP_S == pytest.approx(hover_s, abs=0.1)
    np.testing.assert_allclose(along[~at_commit], 0.0, atol=1e-6)
    low = along[at_commit]
    assert (low.max(), low.min()) == pytest.approx((1.4, -1.4), abs=0.01)
    assert low.argmax() < low.argmin()  # ahead first
    # home again before the look and the commitment
    np.testing.assert_allclose(low[-round(hover_s / STEP_S) :], 0.0, atol=1e-6)
    assert np.linalg.norm(np.diff(path[at_commit], axis=0), axis=1).max() <= 1.2 * STEP_S + 1e-6
    np.testing.assert_allclose(path[-1], [0.0, 0.0, 4.0], atol=0.02)
    np.testing.assert_allclose(stage.mission.state.committed_site_world, SITE, atol=0.02)


@pytest.mark.parametrize(("seen_below", "height"), [(12.0, "10 m"), (6.0, "4 m")])
def test_each_look_refuses_rubble(seen_below: float, height: str) -> None:
    stage = Stage(SITE + [0.0, 0.0, 15.0])
    stage.maps = lambda legs: (RUBBLE if legs < seen_below else LEVEL, 1)
    setpoints = stage.run(descend_to(stage.mission))
    assert stage.result is not None and stage.result.reason.startswith(f"at {height}: ")
    assert stage.mission.state.committed_site_world is None
    # patience of three seconds before it gives up
    still = np.abs(places(setpoints)[:, 2] - setpoints[-1].position_odom[2]) < 1e-6
    assert still.sum() * STEP_S > 4.0


@pytest.mark.parametrize("changes", [{}, {"site_recheck": False}])
def test_an_emergency_refuses_nothing_and_does_not_sweep(changes: dict[str, Any]) -> None:
    stage = Stage(SITE + [0.0, 0.0, 15.0], **changes)
    stage.maps = lambda legs: (RUBBLE, 1)
    if not changes:
        stage.mission.state.set_deadline(40.0)
    path = places(stage.run(descend_to(stage.mission)))
    assert stage.result is None and stage.mission.state.committed_site_world is not None
    np.testing.assert_allclose(path[:, :2], np.tile(SITE[:2], (len(path), 1)), atol=1e-6)


@pytest.mark.parametrize(("seen_below", "refused"), [(12.0, False), (6.0, True)])
def test_a_box_on_the_site_is_evaded_at_10_m_and_too_near_at_4_m(
    seen_below: float, refused: bool
) -> None:
    height = np.zeros((240, 240))
    height[114:126, 114:126] = 0.5  # 0.6 m about the site
    boxed = fine(height)
    stage = Stage(SITE + [0.0, 0.0, 15.0])
    stage.maps = lambda legs: (boxed if legs < seen_below else LEVEL, 1)
    path = places(stage.run(descend_to(stage.mission)))
    assert (stage.result is not None) == refused
    if not refused:
        site = stage.mission.state.committed_site_world
        assert 1.0 < np.linalg.norm(site[:2] - SITE[:2]) < 3.0
        np.testing.assert_allclose(path[-1, :2], site[:2], atol=1e-6)


def test_a_commanded_site_is_never_moved_by_a_look() -> None:
    height = np.zeros((240, 240))
    height[115:125, 137:147] = 0.5  # 1.1 m beside the spot
    boxed, paths = fine(height), {}
    for commanded in (None, (float(SITE[0]), float(SITE[1]))):
        stage = Stage(SITE + [0.0, 0.0, 15.0], site_xy_m=commanded, sweep_m=0.0)
        stage.maps = lambda legs: (boxed, 1)
        paths[commanded] = places(stage.run(descend_to(stage.mission)))[:, :2] - SITE[:2]
    chosen, fixed = paths.values()
    assert np.abs(chosen).max() > 0.1 and np.abs(fixed).max() < 1e-6


def test_final_descent_follows_the_ground_slowly_and_not_near_it() -> None:
    """The ground is 0.15 m above the site's height; below 1.5 m the map says nonsense."""
    ground, wrong = fine(0.15), fine(1.2)
    stage = Stage(SITE + [0.5, 0.0, 4.0 + landing_support.LEG_HEIGHT])
    stage.maps = lambda legs: (ground, 2) if legs - 0.15 > 1.4 else (wrong, 3)
    stage.carried = lambda legs: 0.5 if legs <= 0.15 + 1e-3 else 1.0
    setpoints = stage.run(final_descent(stage.mission))
    flown = [s for s in setpoints if s.thrust_limit is None and s.motors_on]
    path, speed = places(flown), np.array([s.velocity_odom[2] for s in flown])
    assert stage.mission.state.final
    assert speed.min() == pytest.approx(-LandingParams().final_speed_mps, abs=1e-3)
    added = np.diff(path[:, 2]) / STEP_S - 0.5 * (speed[1:] + speed[:-1])
    assert np.max(added) == pytest.approx(0.05, abs=2e-3) and added.min() > -1e-3
    frozen = path[1:, 2] - landing_support.LEG_HEIGHT - 0.15 < 1.3
    np.testing.assert_allclose(added[frozen], 0.0, atol=1e-3)
    low = path[:, 2] - landing_support.LEG_HEIGHT - 0.15 < 0.19
    assert low.any()
    np.testing.assert_allclose(speed[low], -LandingParams().touchdown_speed_mps, atol=2e-3)
    aside = path[:, 0] - SITE[0]
    np.testing.assert_allclose(aside, 0.5 * np.exp(-STEP_S * np.arange(len(path))), atol=1e-6)
    assert path[-1, 2] - landing_support.LEG_HEIGHT == pytest.approx(0.15, abs=0.1)


def test_a_drifting_estimate_is_brought_down_faster() -> None:
    """The variance grows below 0.15 m. Nothing changes above, nor where it grows by less than the
    limit; then the speed rises with the final acceleration to 0.3 m/s and stays there."""
    params, found = LandingParams(), {}
    for sigma in (0.02, 0.05):
        stage = Stage(SITE + [0.0, 0.0, 4.0 + landing_support.LEG_HEIGHT])
        stage.carried = lambda legs: 0.5 if legs <= 1e-3 else 1.0
        stage.spread = lambda legs, sigma=sigma: 1e-4 + (sigma**2 if legs < 0.15 else 0.0)
        setpoints = stage.run(final_descent(stage.mission))
        flown = [s for s in setpoints if s.thrust_limit is None and s.motors_on]
        found[sigma] = np.array([(s.position_odom[2], s.velocity_odom[2]) for s in flown])
    usual, hurried = found[0.02], found[0.05]
    assert usual[-1, 1] == pytest.approx(-params.touchdown_speed_mps, abs=1e-6)
    same = usual[:, 0] - landing_support.LEG_HEIGHT > 0.151
    np.testing.assert_array_equal(hurried[: same.sum()], usual[same])
    gained = np.diff(hurried[same.sum() :, 1]) / STEP_S
    assert gained.min() == pytest.approx(-params.final_accel_mps2, abs=1e-3)
    last = hurried[hurried[:, 0] - landing_support.LEG_HEIGHT < 0.02]
    np.testing.assert_allclose(last[:, 1], -params.drift_speed_mps, atol=1e-6)
    np.testing.assert_allclose(np.diff(last[:, 0]) / STEP_S, -params.drift_speed_mps, atol=1e-3)


def test_a_drift_at_the_start_of_the_final_descent_does_not_skip_its_path() -> None:
    stage = Stage(SITE + [0.0, 0.0, 4.0 + landing_support.LEG_HEIGHT])
    stage.carried = lambda legs: 0.5 if legs <= 1e-3 else 1.0
    stage.spread = lambda legs: 1e-4 + (0.05**2 if legs < 3.9999 else 0.0)
    setpoints = stage.run(final_descent(stage.mission))
    flown = [s for s in setpoints if s.thrust_limit is None and s.motors_on]
    speed = np.diff([s.position_odom[2] for s in flown]) / STEP_S
    params = LandingParams()
    assert speed.min() == pytest.approx(-params.final_speed_mps, abs=5e-3)
    assert np.abs(np.diff(speed)).max() < 1.2 * params.final_accel_mps2 * STEP_S


def test_a_missing_weight_high_above_the_ground_is_no_touchdown() -> None:
    stage = Stage(SITE + [0.0, 0.0, 4.0 + landing_support.LEG_HEIGHT])
    stage.carried = lambda legs: 0.5
    setpoints = stage.run(final_descent(stage.mission))
    legs = min(s.position_odom[2] for s in setpoints) - landing_support.LEG_HEIGHT
    assert 0.2 < legs < 0.6


def test_motors_stop_in_half_a_second_and_rest_for_one() -> None:
    stage = Stage(SITE + [0.0, 0.0, 1.0 + landing_support.LEG_HEIGHT])
    stage.carried = lambda legs: 0.5 if legs <= 1e-3 else 1.0
    setpoints = stage.run(final_descent(stage.mission))
    ramp = [s.thrust_limit for s in setpoints if s.thrust_limit is not None]
    np.testing.assert_allclose(ramp, 0.5 - STEP_S * np.arange(len(ramp)), atol=1e-9)
    assert len(ramp) * STEP_S == pytest.approx(0.5, abs=STEP_S)
    off = [s for s in setpoints if not s.motors_on]
    assert len(off) * STEP_S == pytest.approx(1.0, abs=STEP_S)
    assert setpoints[-len(off) :] == off and stage.mission.state.phase is Phase.TOUCHDOWN


@pytest.mark.parametrize(
    ("fraction", "sink", "after_s"),
    [(0.5, 0.0, 0.145), (0.5, 0.2, 0.41), (0.75, 0.0, 1.29), (0.85, 0.0, None)],
    ids=["pressed and still", "sinking", "a quarter missing", "ground effect"],
)
def test_touchdown_is_found_when_the_weight_is_missing(
    fraction: float, sink: float, after_s: float | None
) -> None:
    """Of (1 - share) weights, low-passed over 5 samples above 0.3 for 0.12 s, or over 0.8 s above
    0.2: 0.8 ln(s / (s - 0.2)) seconds with s = 0.5 or 0.25."""
    detector, speed = TouchdownDetector(landing_support.make_rig()), HOVER_RADPS * np.sqrt(fraction)
    found = None
    for tick in range(3, 1800, 3):
        obs = landing_support.make_obs(
            tick,
            imu=(landing_support.make_imu(tick, GRAVITY_MPS2),),
            rotor_speed_radps=np.full(4, speed),
        )
        estimate = landing_support.make_estimate(tick, Pose.identity(), (0.0, 0.0, -sink))
        if detector.update(obs, estimate):
            found = tick / 600.0
            break
    assert found == (None if after_s is None else pytest.approx(after_s, abs=0.011))


def test_motors_spin_up_after_the_sensors_have_settled() -> None:
    stage = Stage(np.array([0.0, 0.0, landing_support.LEG_HEIGHT]))
    setpoints = stage.run(phases.initialise(stage.mission))
    off = sum(not s.motors_on for s in setpoints)
    assert off * STEP_S == pytest.approx(1.5, abs=1.1 * STEP_S)
    assert {s.thrust_limit for s in setpoints[off:]} == {0.4}
    assert (len(setpoints) - off) * STEP_S == pytest.approx(0.8, abs=1.1 * STEP_S)


def test_an_estimate_aside_of_the_start_takes_off_straight() -> None:
    aside = np.array([0.9, -0.4, landing_support.LEG_HEIGHT + 0.5])
    stage = Stage(aside)
    for setpoint in phases.initialise(stage.mission):
        stage.tick += STEP_TICKS
        stage.feed()
        assert not setpoint.motors_on or setpoint.position_odom == pytest.approx(aside)
    climb = places(stage.run(phases.take_off(stage.mission)))
    assert setpoint.motors_on and climb[0] == pytest.approx(aside)
    assert np.ptp(climb[:, :2], axis=0).max() < 1e-9
    assert climb[-1, 2] == pytest.approx(QUICK.height_m)


def test_take_off_climbs_to_survey_height_and_turns_the_heading() -> None:
    stage = Stage(np.array([0.0, 0.0, landing_support.LEG_HEIGHT]), yaw=0.3)
    turning = dataclasses.replace(QUICK, climb_turn_deg=90.0)
    stage.mission = Mission(stage.mission.rig, stage.mission.params, turning)
    stage.feed()
    setpoints = stage.run(phases.take_off(stage.mission))
    assert setpoints[-1].position_odom == pytest.approx([0.0, 0.0, QUICK.height_m])
    assert setpoints[-1].yaw_odom == pytest.approx(0.3 + np.pi / 2)
    assert (
        stage.mission.state.takeoff_s == 0.0 and min(s.velocity_odom[2] for s in setpoints) >= 0.0
    )
    assert max(s.velocity_odom[2] for s in setpoints) == pytest.approx(3.0, abs=1e-6)


@pytest.mark.parametrize(
    ("top", "aside", "expected"),
    [(0.0, 0.0, 12.3), (12.0, 0.0, 18.3), (12.0, 2.5, 18.3), (12.0, 5.0, 12.3), (26.0, 0.0, 30.0)],
    ids=["free", "on the way", "in the corridor", "aside", "too high"],
)
def test_the_way_to_the_site_keeps_its_margin(top: float, aside: float, expected: float) -> None:
    """12.3 m: 2 m over the look; steps of 2 m from there, 6 m over what stands at the end."""
    stage = Stage(np.array([0.0, 0.0, 30.0]))
    height = np.zeros((120, 120))
    row, col = int((aside + 10.0) / 0.2), int((8.0 + 10.0) / 0.2)
    height[row : row + 2, col : col + 2] = top
    grid = landing_support.make_grid(height, origin=(-10.0, -10.0), returns=2, sigma=0.0)
    stage.show(grid)
    site = np.array([10.0, 0.0, 0.0])
    assert phases.approach_height(stage.mission, stage.position, site) == pytest.approx(expected)


def test_the_survey_lies_along_the_heading_of_the_start() -> None:
    stage = Stage(np.array([0.0, 0.0, 20.0]), yaw=0.5)
    path = places(stage.run(phases.survey(stage.mission))) @ rotation_from_yaw(0.5)
    assert path[-1] == pytest.approx([0.0, 10.0, 20.0], abs=0.05) and 20.0 < path[:, 0].max() < 30.0
    assert path[:, 1].min() > -1e-6 and path[:, 1].max() < 10.0 + 1e-6
    assert len(path) * STEP_S == pytest.approx(QUICK.duration_s, abs=2.0 * STEP_S)


def test_a_decision_takes_its_time_and_sets_the_site() -> None:
    stage = Stage(np.array([0.0, 0.0, 20.0]), decision_latency_s=0.4)
    setpoints = stage.run(phases.select(stage.mission))
    assert len(setpoints) * STEP_S == pytest.approx(0.5 + 0.4, abs=3.0 * STEP_S)
    assert np.ptp(places(setpoints), axis=0) == pytest.approx(0.0, abs=1e-9)
    (decision,) = stage.mission.state.decisions
    site = decision.candidates[0]
    assert stage.result is None and site.accepted
    np.testing.assert_array_equal(stage.mission.state.site_odom, site.position_odom)
    assert decision.time_s == pytest.approx(0.5, abs=2.0 * STEP_S)


def test_a_refused_site_is_remembered_and_its_decision_says_why() -> None:
    stage = Stage(np.array([0.0, 0.0, 20.0]), go_arounds=0)
    stage.maps = lambda legs: (RUBBLE if legs < 12.0 else None, 1)
    stage.run(phases.land_somewhere(stage.mission))
    assert stage.result.action is Action.RETURN and stage.mission.state.no_site
    refused, decision = stage.mission.state.refused_odom, stage.mission.state.decisions[-1]
    assert len(refused) == 1
    assert refused[0][:2] == pytest.approx(decision.candidates[0].position_odom[:2])
    assert decision.given_up.startswith("at 10 m: ") and stage.mission.state.site_odom is None


def test_strong_wind_makes_sites_beside_obstacles_less_probable() -> None:
    height = np.zeros((100, 100))
    height[5::20, 5::20] = 1.0
    grid = landing_support.make_grid(height, origin=(-10.0, -10.0), returns=8)
    found = []
    for wind in (0.0, 12.0):
        stage = Stage(np.array([0.0, 0.0, 20.0]), min_safe_probability=0.0, gust_drift_s=0.1)
        stage.show(grid, wind_mps=wind)
        sites = choose_sites(stage.mission).candidates[:4]
        found.append(sum(site.safe_probability for site in sites))
    assert found[1] < found[0] - 1e-3, found


def test_the_way_home_is_flown_at_survey_height() -> None:
    stage = Stage(np.array([6.0, 0.0, 9.0]))
    stage.carried = lambda legs: 0.5 if legs <= 1e-3 else 1.0
    path = places(stage.run(phases.return_home(stage.mission)))
    aside = (path[:, 0] > 1.01) & (path[:, 0] < 5.99)  # the sweep at 4 m is a metre
    assert aside.any()
    np.testing.assert_allclose(path[aside, 2], QUICK.height_m, atol=0.01)
    assert path[-1, :2] == pytest.approx([0.0, 0.0], abs=0.01)
    assert stage.mission.state.committed_site_world == pytest.approx([0.0, 0.0, 0.0], abs=0.01)
    assert stage.mission.state.phase is Phase.TOUCHDOWN


HOME = np.zeros(3)
BOX = np.zeros((240, 240))
BOX[114:126, 114:126] = 0.5  # 0.6 m about the centre
ISLAND = np.random.default_rng(5).uniform(0.0, 0.6, (240, 240))
ISLAND[:, 180:] = 0.0  # level ground from 3 m on


@pytest.mark.parametrize("changes", [{}, {"site_xy_m": (9.0, 9.0)}, {"emergency": "battery"}])
@pytest.mark.parametrize(
    ("height", "lands"), [(BOX, (1.0, 3.0)), (ISLAND, (4.0, 5.0)), (ISLAND.T, (4.0, 5.0))]
)
def test_the_way_home_ends_with_a_look(
    height: Array, lands: tuple[float, float], changes: dict[str, Any]
) -> None:
    """Beside what stands there now, within the shift of a look or on the best ground in view, even
    where another site was commanded or in an emergency."""
    stage, seen = Stage(np.array([6.0, 0.0, 20.0]), **changes), fine(height, HOME)
    stage.maps = lambda legs: (seen if legs < 12.0 else LEVEL, 1)
    stage.carried = lambda legs: 0.5 if legs <= 1e-3 else 1.0
    events = []
    for setpoint in phases.return_home(stage.mission):
        events += stage.mission.state.events
        stage.position = setpoint.position_odom.copy()
        stage.tick += STEP_TICKS
        stage.feed(setpoint.velocity_odom)
    assert lands[0] < np.linalg.norm(stage.position[:2]) < lands[1]
    assert stage.mission.state.committed_site_world[:2] == pytest.approx(stage.position[:2])
    told = [text for text in events if "home_recheck" in text]
    assert len(told) == (0 if height is BOX else 1), events
    assert stage.mission.state.phase is Phase.TOUCHDOWN


def test_home_is_landed_on_unseen() -> None:
    stage = Stage(np.array([0.0, 0.0, 20.0]))
    stage.maps = lambda legs: (None, 1)
    stage.carried = lambda legs: 0.5 if legs <= 1e-3 else 1.0
    path = places(stage.run(phases.return_home(stage.mission)))
    assert path[-1, :2] == pytest.approx([0.0, 0.0], abs=0.01)


def test_the_best_ground_is_reached_past_what_stands_in_the_way() -> None:
    """Level ground at both sides of rubble, the nearer one behind a wall: below the legs it does
    not count. Where all is rubble the least bad is taken, where nothing was seen nothing."""
    height, params = np.random.default_rng(5).uniform(0.0, 0.6, (240, 240)), LandingParams()
    height[:, :60], height[:, 176:] = 0.0, 0.0
    height[:, 166:168] = 2.5
    for legs, expected in ((4.0, 4.5), (3.0, -4.75)):
        view = landing_support.view_of(COARSE, fine(height, HOME))
        found = best_ground(view, HOME, legs, params, 0.0)
        assert found.position_odom is not None
        assert found.position_odom[0] == pytest.approx(expected, abs=0.2), found.reason
    # The fine map is of rubble alone: level by the coarse one counts beyond its edge at 6 m.
    rubble = landing_support.view_of(COARSE, fine(RUBBLE.height_m, HOME))
    beyond = best_ground(rubble, HOME, 4.0, params, 0.0).position_odom
    assert beyond is not None and np.abs(beyond[:2]).max() > 5.9
    bad = np.random.default_rng(5).uniform(0.0, 2.0, (100, 100))
    bad[52:68, 17:33] = 0.13 * (np.arange(16) % 2)
    bad = landing_support.make_grid(bad, origin=(-10.0, -10.0))
    found = best_ground(landing_support.view_of(bad, None), HOME, 4.0, params, 0.0)
    assert found.position_odom is not None
    assert found.position_odom[:2] == pytest.approx([-5.0, 2.0], abs=1.0)
    unseen = landing_support.make_grid(np.full((100, 100), np.nan), origin=(-10.0, -10.0))
    nothing = best_ground(landing_support.view_of(unseen, None), HOME, 4.0, params, 0.0)
    assert nothing.position_odom is None


def test_a_search_leg_lies_beside_the_last_one_and_begins_at_its_nearer_end() -> None:
    yaw = 0.5
    turn = rotation_from_yaw(yaw)
    for here, ends in ((0.0, (0.0, 20.0)), (20.0, (20.0, 0.0))):
        stage = Stage(turn @ [here, 10.0, 20.0], yaw=yaw)
        stage.mission.state.begin_search_leg()
        path = places(stage.run(phases.search_leg(stage.mission))) @ turn
        np.testing.assert_allclose(path[:, 2], 20.0, atol=1e-6)
        assert path[-1] == pytest.approx([ends[1], 30.0, 20.0], abs=0.01)
        passed = np.linalg.norm(path - [ends[0], 30.0, 20.0], axis=1).min()
        assert passed < 0.01 and stage.mission.state.phase is Phase.SURVEY


def test_a_go_around_climbs_to_survey_height_on_the_spot() -> None:
    stage = Stage(SITE + [0.0, 0.0, 9.0])
    path = places(stage.run(phases.climb_back(stage.mission)))
    assert path[-1] == pytest.approx([*SITE[:2], QUICK.height_m], abs=0.01)
    np.testing.assert_allclose(path[:, :2], np.tile(SITE[:2], (len(path), 1)), atol=1e-9)


def test_a_vertical_move_takes_three_seconds_to_its_speed() -> None:
    path = vertical_move(np.array([1.0, 2.0, 20.0]), 8.0, 2.0)
    assert path.duration_s == pytest.approx(3.0 + (12.0 - 6.0) / 2.0 + 3.0)
    assert path.sample(4.0)[1] == pytest.approx([0.0, 0.0, -2.0])
    assert path.sample(9.0)[0] == pytest.approx([1.0, 2.0, 8.0])


def test_a_hold_and_a_stop_end_a_leg() -> None:
    stage = Stage(np.array([0.0, 0.0, 10.0]))
    path = vertical_move(stage.position, 4.0, 2.0)
    setpoints = stage.run(stage.mission.follow(path, hold_s=1.0))
    assert len(setpoints) * STEP_S == pytest.approx(path.duration_s + 1.0, abs=STEP_S)
    assert setpoints[-1].position_odom == pytest.approx([0.0, 0.0, 4.0])
    stage = Stage(np.array([0.0, 0.0, 10.0]), slow_in_wind=True)
    stage.load_aloft = lambda: 1.1 if stage.tick > 1200 else 0.9
    stopped = stage.run(stage.mission.follow(path, until=Moment.CLIMB))
    assert stage.result.rule.name == "wind_aloft"
    assert 4.5 < stopped[-1].position_odom[2] < 9.0
    stage.mission.state.follow_clock(0.0, 5.1)
    assert stage.mission.ask(Moment.CLIMB).rule.name == "wind_no_go"
    assert np.linalg.norm(np.diff(places(stopped)[-3:], axis=0), axis=1).max() < 1e-3


def test_costs_of_segments_by_hand() -> None:
    params = LandingParams(
        cruise_speed_mps=5.0, descent_speed_mps=2.0, climb_speed_mps=3.0, final_speed_mps=0.5,
        commit_height_m=4.0,
    )  # fmt: skip
    assert energy.travel_time_s(40.0, params) == pytest.approx(15.0)
    assert energy.travel_time_s(1.0, params) == pytest.approx(2.0)
    landing = 8.0 + 6.0 + (8.0 + 6.0) + (5.0 + 8.0)
    assert energy.landing_time_s(20.0, params) == pytest.approx(landing)
    assert energy.landing_time_s(20.0, params, emergency=True) == pytest.approx(30.5)
    blind = dataclasses.replace(params, site_recheck=False)
    assert energy.landing_time_s(20.0, blind) == pytest.approx(28.0)
    assert energy.return_time_s(40.0, 20.0, params) == pytest.approx(1.2 * (15.0 + landing))
    legs = SurveyParams(leg_length_m=40.0, leg_spacing_m=16.0)
    assert energy.search_leg_time_s(legs, params) == pytest.approx(1.2 * (15.0 + 8.0))
    around = 1.2 * (20.0 / 3.0 + 3.0 + landing)
    assert energy.go_around_time_s(20.0, params) == pytest.approx(around)


def test_time_left_decides_on_search_go_around_reach_and_emergency() -> None:
    stage = Stage(np.array([30.0, 40.0, 20.0]), cruise_speed_mps=5.0)
    mission, state, params = stage.mission, stage.mission.state, stage.mission.params

    def at(battery: float) -> MissionView:
        stage.battery = battery
        stage.feed()
        return mission.view

    stage.tick = 2400
    assert at(0.9).time_left_s == np.inf  # four seconds say nothing
    stage.tick = 60_000
    view = at(0.9)
    assert view.time_left_s == pytest.approx(900.0) and view.away_m == pytest.approx(50.0)
    again = energy.go_around_time_s(QUICK.height_m, params)
    assert energy.reach_m(view, state) == pytest.approx((900.0 - 2.0 * again) * 5.0 / 1.875)
    home = energy.return_time_s(50.0, QUICK.height_m, params)
    for seconds, affords in (
        (energy.search_leg_time_s(QUICK, params), energy.affords_search_leg),
        (again, energy.affords_go_around),
    ):
        for spare in (-1.0, 1.0):
            left = seconds + home + spare
            assert affords(at(left / (100.0 + left)), state) == (spare > 0.0)
    assert not mission.view.in_emergency and not mission.view.takes_risky
    view = at(40.0 / 140.0)
    assert view.in_emergency and view.takes_risky
    reach = (40.0 - energy.landing_time_s(QUICK.height_m, params, emergency=True)) * 5.0 / 1.875
    assert energy.reach_m(view, state) == pytest.approx(reach)
    state.set_deadline(mission.now + 35.0)
    assert energy.reach_m(view, state) == pytest.approx(reach - 5.0 * 5.0 / 1.875)


def test_setpoints_in_the_world_are_turned_into_the_odometry_frame() -> None:
    """Odometry turned by 90 degrees to the left and displaced: east in the world is -y in it."""
    stage = Stage(np.array([0.0, 0.0, 10.0]), yaw=0.3)
    stage.world_from_odom = Pose(rotation_from_yaw(np.pi / 2), np.array([1.0, 0.0, 0.0]))
    stage.feed()
    mission = stage.mission
    east = np.array([1.0, 0.0, 0.0])
    setpoint = mission.setpoint(np.array([4.0, 2.0, 9.0]), east, 2.0 * east, in_world=True)
    assert setpoint.position_odom == pytest.approx([2.0, -3.0, 9.0])
    assert setpoint.velocity_odom == pytest.approx([0.0, -1.0, 0.0])
    assert setpoint.acceleration_odom == pytest.approx([0.0, -2.0, 0.0])
    assert setpoint.yaw_odom == pytest.approx(0.3 - np.pi / 2)
    assert mission.reference_world == pytest.approx([4.0, 2.0, 9.0])
    mission.setpoint(np.array([2.0, -3.0, 9.0]))
    assert mission.reference_world == pytest.approx([4.0, 2.0, 9.0])
    assert mission._wind_for(True) == pytest.approx([0.0, 0.0, 0.0])
    mission.view = dataclasses.replace(mission.view, felt_wind_odom=np.array([0.0, -5.0, 0.0]))
    assert mission._wind_for(True) == pytest.approx([5.0, 0.0, 0.0])
    assert mission._wind_for(False) == pytest.approx([0.0, -5.0, 0.0])


def test_the_heading_of_setpoints_is_that_of_the_turn() -> None:
    stage = Stage(np.array([0.0, 0.0, 10.0]), yaw=0.3)
    stage.mission.turn = HeadingTurn(1.0, 0.0, 2.0)
    for tick, angle, rate in ((0, 0.0, 0.0), (600, 0.5, 0.9375), (1800, 1.0, 0.0)):
        stage.tick = tick
        stage.feed()
        setpoint = stage.mission.setpoint(stage.position)
        assert setpoint.yaw_odom == pytest.approx(0.3 + angle)
        assert setpoint.yaw_rate == pytest.approx(rate)


def test_an_unhealthy_estimate_stops_vehicle_and_clock_but_not_the_final_descent() -> None:
    stage = Stage(SITE + [0.0, 0.0, 3.0])
    mission = stage.mission
    mission.state.enter(Phase.DESCEND)
    stage.healthy = False

    def actions(tick: int) -> Action | None:
        stage.tick = tick
        stage.feed()
        ruling = mission.ask(Moment.STEP)
        return None if ruling is None else ruling.action

    assert actions(600) is None and actions(1194) is None  # less than a second
    assert actions(1206) is Action.HOLD
    before = mission.now
    held = mission.hold()
    assert not held.velocity_odom.any()
    np.testing.assert_allclose(held.position_odom, stage.position)
    assert mission.now == pytest.approx(before - 12 / 600.0)
    assert actions(5400) is Action.LAND_BLIND and mission.state.aborted
    mission.state.descend_for_good()
    assert actions(6000) is None
