"""Surveys along waypoints: limits, corners, spirals."""

import dataclasses

import numpy as np
import pytest

from touchdown.landing.api import LandingParams, SurveyParams
from touchdown.landing.mission.rules import another_leg
from touchdown.landing.mission.state import MissionState
from touchdown.landing.mission.trajectory import peaks, survey_trajectory
from touchdown.landing.mission.waypoints import survey_path, survey_waypoints, waypoint_trajectory
from touchdown.sim.frames import rotation_from_yaw
from touchdown.sim.typing import Array

from support.mission_stage import Stage

LIMITS = LandingParams(cruise_speed_mps=7.0, climb_speed_mps=3.0, accel_mps2=1.5)


def _sampled(places: Array) -> tuple[Array, Array]:
    path = waypoint_trajectory(places, 7.0, 3.0, 1.5)
    samples = [path.sample(t) for t in np.linspace(0.0, path.duration_s, 4000)]
    return np.array([one[0] for one in samples]), np.array([one[1] for one in samples])


def _random_places(seed: int) -> Array:
    rng = np.random.default_rng(seed)
    steps = rng.uniform(-1.0, 1.0, (12, 3)) * rng.choice([2.0, 15.0, 80.0], (12, 1))
    return np.cumsum(steps * [1.0, 1.0, 0.2], axis=0) + [0.0, 0.0, 60.0]


@pytest.mark.parametrize("seed", range(12))
def test_limits_hold_and_nothing_jumps(seed: int) -> None:
    """Speed and acceleration up to their limits, the vertical speed to that of a climb; in a turn
    the speed changes its direction alone."""
    places = _random_places(seed)
    path = waypoint_trajectory(places, 7.0, 3.0, 1.5)
    speed, acceleration = peaks(path, 200)
    assert speed <= 7.0 * (1.0 + 1e-6) and acceleration <= 1.5 * (1.0 + 1e-6)
    assert speed > 4.0 and acceleration > 1.49
    where, velocity = _sampled(places)
    assert np.abs(velocity[:, 2]).max() <= 3.0 * (1.0 + 1e-6)
    for t in path.breaks_s[1:-1]:
        for before, after in zip(path.sample(t - 1e-7), path.sample(t + 1e-7), strict=True):
            np.testing.assert_allclose(before, after, atol=1e-4)
    for end, place in ((where[0], places[0]), (where[-1], places[-1])):
        np.testing.assert_allclose(end, place, atol=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_corners_are_passed_within_half_of_where_their_turn_begins(seed: int) -> None:
    places = _random_places(seed)
    lengths = np.linalg.norm(np.diff(places, axis=0), axis=1)
    where, _ = _sampled(places)
    for k in range(1, len(places) - 1):
        begins = min(0.4 * min(lengths[k - 1], lengths[k]), 5.0)
        assert np.linalg.norm(where - places[k], axis=1).min() < 0.55 * begins + 0.05


def test_a_long_way_is_flown_at_cruising_speed() -> None:
    """60 m at up to 7 m/s and 1.5 m/s^2: a change of 7 m/s takes 7 s and 24.5 m."""
    path = waypoint_trajectory(np.array([[0.0, 0, 30], [60.0, 0, 30]]), 7.0, 3.0, 1.5)
    assert path.duration_s == pytest.approx(7.0 + 11.0 / 7.0 + 7.0)
    assert path.sample(0.5 * path.duration_s)[1] == pytest.approx([7.0, 0.0, 0.0])


def test_a_waypoint_on_a_straight_way_is_passed_at_speed() -> None:
    one = waypoint_trajectory(np.array([[0.0, 0, 30], [90.0, 0, 30]]), 7.0, 3.0, 1.5)
    two = waypoint_trajectory(np.array([[0.0, 0, 30], [30, 0, 30], [90, 0, 30]]), 7.0, 3.0, 1.5)
    assert two.duration_s == pytest.approx(one.duration_s, rel=0.02)


def test_a_spiral_goes_outward_by_its_spacing() -> None:
    spiral = SurveyParams(path="spiral", legs=3, leg_spacing_m=20.0, height_m=25.0)
    ways = survey_waypoints(0.3, spiral)
    radius = np.linalg.norm(ways[:, :2], axis=1)
    assert radius[-1] == pytest.approx(60.0) and (ways[:, 2] == 25.0).all()
    np.testing.assert_allclose(radius[12:] - radius[:-12], 20.0)
    start = np.array([4.0, -2.0, 25.3])
    path = survey_path(start, 0.3, spiral, LIMITS)
    np.testing.assert_allclose(path.sample(0.0)[0], start)
    np.testing.assert_allclose(path.sample(path.duration_s)[0], start + ways[-1] - [0, 0, 25.0])


def test_the_serpentine_is_what_it_was() -> None:
    start, survey = np.array([1.0, 2.0, 30.0]), SurveyParams()
    path, before = survey_path(start, 0.4, survey, LIMITS), survey_trajectory(start, 0.4, survey)
    np.testing.assert_array_equal(path.coefficients, before.coefficients)
    corners = survey_waypoints(0.4, survey) @ rotation_from_yaw(0.4)
    expected = [[0, 0], [50, 0], [50, 20], [0, 20], [0, 40], [50, 40]]
    np.testing.assert_allclose(corners[:, :2], expected, atol=1e-9)


def test_waypoints_without_a_way_are_refused() -> None:
    still = SurveyParams(path="a.plan", waypoints_m=((0.0, 0.0, 30.0),))
    with pytest.raises(ValueError, match="read in flights"):
        survey_waypoints(0.0, SurveyParams(path="a.plan"))
    with pytest.raises(ValueError, match="goes nowhere"):
        survey_path(np.array([0.0, 0.0, 30.0]), 0.0, still, LIMITS)


def test_a_strong_wind_lowers_the_waypoints() -> None:
    ways = ((0.0, 5.0, 30.0), (9.0, 5.0, 12.0))
    state = MissionState(SurveyParams(path="a.plan", waypoints_m=ways, min_height_m=20.0))
    state.lower_survey()
    assert state.survey.waypoints_m == ((0.0, 5.0, 20.0), (9.0, 5.0, 12.0))


def test_another_leg_is_one_of_a_serpentine() -> None:
    stage = Stage(np.array([0.0, 0.0, 30.0]), search_legs=2)
    state = stage.mission.state
    assert another_leg(stage.mission.view, state)
    state.survey = dataclasses.replace(state.survey, path="spiral")
    assert another_leg(stage.mission.view, state) is None
