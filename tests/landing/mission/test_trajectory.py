import math

import numpy as np
import pytest

from touchdown.landing.api import SurveyParams
from touchdown.landing.mission.trajectory import (
    BEGIN_ABOVE_M,
    HeadingTurn,
    PiecewiseTrajectory,
    State,
    descent_trajectory,
    peaks,
    straight_trajectory,
    survey_trajectory,
    through,
    turn_in_climb,
)
from touchdown.sim.frames import rotation_from_yaw
from touchdown.sim.typing import Array

START = np.array([3.0, -2.0, 30.0])
YAW = 0.7


def sampled(trajectory: PiecewiseTrajectory, step: float = 1e-3) -> tuple[Array, ...]:
    times = np.arange(0.0, trajectory.duration_s, step)
    return (times, *(np.array(part) for part in zip(*map(trajectory.sample, times), strict=True)))


def assert_smooth(trajectory: PiecewiseTrajectory, max_jerk: float) -> None:
    """Acceleration moves no faster than ``max_jerk``, and each derivative is the one it claims."""
    times, position, velocity, acceleration = sampled(trajectory)
    step = times[1] - times[0]
    assert np.linalg.norm(np.diff(acceleration, axis=0), axis=1).max() <= max_jerk * step
    middle_velocity = 0.5 * (velocity[1:] + velocity[:-1])
    np.testing.assert_allclose(np.diff(position, axis=0) / step, middle_velocity, atol=1e-5)
    middle_acceleration = 0.5 * (acceleration[1:] + acceleration[:-1])
    np.testing.assert_allclose(
        np.diff(velocity, axis=0) / step, middle_acceleration, atol=0.25 * max_jerk * step
    )


def test_rest_to_rest_is_the_minimum_jerk_polynomial() -> None:
    path = through([State(np.zeros(3)), State(np.array([2.0, 0.0, -4.0]))], [3.0])
    for s in (0.0, 0.2, 0.5, 0.9, 1.0):
        fraction = 10 * s**3 - 15 * s**4 + 6 * s**5
        np.testing.assert_allclose(
            path.sample(3.0 * s)[0], [2 * fraction, 0, -4 * fraction], atol=1e-12
        )
    assert path.sample(1.5)[1][0] == pytest.approx(1.875 * 2.0 / 3.0)


def test_segment_meets_all_its_boundary_states() -> None:
    rng = np.random.default_rng(2)
    states = [State(*rng.normal(size=(3, 3))) for _ in range(4)]
    path = through(states, [0.8, 1.7, 0.4])
    for time, state in zip(path.breaks_s, states, strict=True):
        got = path.sample(float(time))
        np.testing.assert_allclose(got[0], state.position, atol=1e-9)
        np.testing.assert_allclose(got[1], state.velocity, atol=1e-9)
        np.testing.assert_allclose(got[2], state.acceleration, atol=1e-8)


def test_before_its_start_it_waits_and_after_its_end_it_coasts() -> None:
    end = State(np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, -0.5]))
    path = through([State(np.zeros(3), np.array([1.0, 0.0, 0.0])), end], [2.0])
    np.testing.assert_array_equal(path.sample(-1.0), np.zeros((3, 3)))
    position, velocity, acceleration = path.sample(4.0)
    np.testing.assert_allclose(position, [1.0, 0.0, -1.0], atol=1e-12)
    np.testing.assert_allclose(velocity, [0.0, 0.0, -0.5], atol=1e-12)
    np.testing.assert_array_equal(acceleration, np.zeros(3))


def test_a_duration_of_zero_is_refused() -> None:
    with pytest.raises(ValueError, match="above 0 s"):
        through([State(np.zeros(3)), State(np.ones(3))], [0.0])


def in_leg_axes(positions: Array) -> Array:
    return (positions - START) @ rotation_from_yaw(YAW)


def test_survey_takes_its_time_and_rests_at_both_ends() -> None:
    path = survey_trajectory(START, YAW, SurveyParams())
    assert path.duration_s == pytest.approx(36.0, abs=1e-9)
    position, velocity, acceleration = path.sample(0.0)
    np.testing.assert_allclose(position, START)
    np.testing.assert_allclose([velocity, acceleration], 0.0, atol=1e-9)
    position, velocity, acceleration = path.sample(36.0)
    np.testing.assert_allclose(in_leg_axes(position), [50.0, 40.0, 0.0], atol=1e-9)
    np.testing.assert_allclose([velocity, acceleration], 0.0, atol=1e-9)


def test_survey_legs_are_straight_parallel_and_of_one_speed() -> None:
    path = survey_trajectory(START, YAW, SurveyParams())
    _, position, velocity, acceleration = sampled(path)
    local, local_velocity = in_leg_axes(position), velocity @ rotation_from_yaw(YAW)
    np.testing.assert_allclose(local[:, 2], 0.0, atol=1e-9)
    speeds = []
    for leg, sign in enumerate([1.0, -1.0, 1.0]):
        on_leg = (np.abs(local[:, 1] - 20.0 * leg) < 1e-6) & (
            np.linalg.norm(acceleration, axis=1) < 1e-9
        )
        along = local[on_leg, 0]
        inside = (along > 17.0) & (along < 33.0)  # clear of the ramps at both ends
        assert along[inside].min() < 17.1
        assert along[inside].max() > 32.9
        speeds.append(sign * local_velocity[on_leg, 0][inside])
        np.testing.assert_allclose(local_velocity[on_leg, 1], 0.0, atol=1e-9)
    np.testing.assert_allclose(np.concatenate(speeds), speeds[0][0], rtol=1e-9)
    middle = np.abs(local[:, 1] - 20.0) < 1e-6
    assert local[middle, 0].min() < 0.1
    assert local[middle, 0].max() > 49.9


def test_survey_is_smooth_and_moderate() -> None:
    path = survey_trajectory(START, YAW, SurveyParams())
    assert_smooth(path, max_jerk=8.0)
    speed, acceleration = peaks(path)
    assert speed < 8.0
    assert acceleration < 4.0


@pytest.mark.parametrize(("legs", "duration"), [(1, 14.0), (2, 24.0), (5, 60.0)])
def test_survey_of_other_sizes(legs: int, duration: float) -> None:
    params = SurveyParams(legs=legs, duration_s=duration)
    path = survey_trajectory(START, YAW, params)
    end = in_leg_axes(path.sample(duration)[0])
    np.testing.assert_allclose(end, [50.0 if legs % 2 else 0.0, 20.0 * (legs - 1), 0.0], atol=1e-9)
    assert path.duration_s == pytest.approx(duration)
    assert_smooth(path, max_jerk=15.0)


@pytest.mark.parametrize("params", [
    SurveyParams(duration_s=12.0), SurveyParams(legs=0), SurveyParams(legs=10**9, duration_s=1e12),
    SurveyParams(leg_length_m=-1.0),
])  # fmt: skip
def test_impossible_surveys_are_refused(params: SurveyParams) -> None:
    with pytest.raises(ValueError, match="survey"):
        survey_trajectory(START, YAW, params)


def test_straight_from_rest_uses_up_one_of_its_limits() -> None:
    far = straight_trajectory(np.zeros(3), np.zeros(3), np.array([60.0, 0, 0]), 5.0, 2.0)
    speed, acceleration = peaks(far, per_segment=1001)
    assert speed == pytest.approx(5.0, rel=1e-5)
    assert acceleration < 2.0
    near = straight_trajectory(np.zeros(3), np.zeros(3), np.array([0, 2.0, 1.0]), 5.0, 2.0)
    speed, acceleration = peaks(near, per_segment=1001)
    assert acceleration == pytest.approx(2.0, rel=1e-4)
    assert speed < 5.0
    _, position, _, _ = sampled(near)
    np.testing.assert_allclose(position[:, 1], 2.0 * position[:, 2], atol=1e-12)


@pytest.mark.parametrize("velocity", [[1.0, 0.0, 0.0], [-2.0, 1.0, 0.5], [0.0, 4.0, 0.0]])
def test_straight_takes_over_a_velocity_within_its_limits(velocity: list[float]) -> None:
    first = np.array(velocity)
    path = straight_trajectory(START, first, START + np.array([8.0, 0.0, -3.0]), 3.0, 1.5)
    np.testing.assert_allclose(path.sample(0.0)[1], first)
    np.testing.assert_allclose(path.sample(path.duration_s)[0], [11.0, -2.0, 27.0])
    np.testing.assert_allclose(path.sample(path.duration_s)[1:], 0.0, atol=1e-9)
    speed, acceleration = peaks(path)
    assert speed <= max(3.0, float(np.linalg.norm(first))) * 1.001
    assert acceleration <= 1.5 * 1.01


def test_straight_to_where_it_is_stays_there() -> None:
    path = straight_trajectory(START, np.zeros(3), START, 3.0, 1.5)
    np.testing.assert_allclose(path.sample(0.05)[0], START)


def test_straight_ends_even_if_an_acceleration_makes_the_limits_unreachable() -> None:
    path = straight_trajectory(
        START, np.array([1.0, 0, 0]), START, 0.5, 0.2, acceleration_start=np.array([3.0, 0, 0])
    )
    np.testing.assert_allclose(path.sample(path.duration_s)[0], START, atol=1e-9)


def test_descent_cruises_slows_down_and_goes_on_at_touchdown_speed() -> None:
    path = descent_trajectory(START, 1.0, cruise_speed=2.0, touchdown_speed=0.15, max_accel=0.8)
    _, position, velocity, acceleration = sampled(path)
    assert velocity[:, 2].min() == pytest.approx(-2.0)
    assert np.all(velocity[:, 2] <= 1e-12)
    assert np.abs(acceleration).max() == pytest.approx(0.8, rel=1e-4)
    np.testing.assert_allclose(position[:, :2], np.tile(START[:2], (len(position), 1)))
    end = path.sample(path.duration_s)
    np.testing.assert_allclose(end[0], [3.0, -2.0, 1.0], atol=1e-9)
    np.testing.assert_allclose(end[1], [0.0, 0.0, -0.15], atol=1e-9)
    assert path.sample(path.duration_s + 2.0)[0][2] == pytest.approx(0.7)
    assert_smooth(path, max_jerk=2.0)


def test_a_short_descent_is_a_slower_one() -> None:
    path = descent_trajectory(START, 29.0, cruise_speed=2.0, touchdown_speed=0.1, max_accel=0.5)
    speed, acceleration = peaks(path)
    assert 0.1 < speed < 1.0
    assert acceleration <= 0.5 * 1.001
    np.testing.assert_allclose(path.sample(path.duration_s)[0][2], 29.0)


def test_a_descent_takes_over_the_sinking_speed() -> None:
    path = descent_trajectory(START, 0.0, vertical_speed_start=-1.0)
    assert path.sample(0.0)[1][2] == pytest.approx(-1.0)
    assert_smooth(path, max_jerk=4.0)
    with pytest.raises(ValueError, match="too short"):
        descent_trajectory(START, 29.9, vertical_speed_start=-3.0)


TURN_LIMIT = math.radians(40.0)


def climb_path(height_m: float, duration_s: float, floor_m: float = 2.0) -> PiecewiseTrajectory:
    low, high = np.array([1.0, 2.0, floor_m]), np.array([1.0, 2.0, floor_m + height_m])
    return through([State(low), State(high)], [duration_s])


@pytest.mark.parametrize("angle", [math.pi, -1.2])
def test_a_turn_starts_and_ends_at_rest_and_its_rate_is_the_derivative(angle: float) -> None:
    turn = HeadingTurn(angle, 3.0, 8.0)
    assert turn.sample(0.0) == turn.sample(3.0) == (0.0, 0.0)
    assert turn.sample(7.0)[0] == pytest.approx(0.5 * angle)
    for late in (11.0, 60.0):
        assert turn.sample(late) == pytest.approx((angle, 0.0))
    for t in np.linspace(2.5, 11.5, 37):
        rate = (turn.sample(t + 1e-4)[0] - turn.sample(t - 1e-4)[0]) / 2e-4
        assert turn.sample(float(t))[1] == pytest.approx(rate, abs=1e-6)
    rates = [turn.sample(float(t))[1] for t in np.linspace(3.0, 11.0, 801)]
    assert max(np.abs(rates)) == pytest.approx(1.875 * abs(angle) / 8.0)


@pytest.mark.parametrize(("height", "duration"), [(20.0, 12.0), (20.0, 3.0), (3.0, 4.0)])
@pytest.mark.parametrize("angle_deg", [180.0, -90.0, 360.0])
def test_it_begins_four_metres_up_and_is_never_fast(
    height: float, duration: float, angle_deg: float
) -> None:
    path, now = climb_path(height, duration), 5.0
    turn = turn_in_climb(path, now, angle_deg)
    times = np.linspace(0.0, turn.duration_s + duration + 1.0, 2001)
    samples = np.array([turn.sample(now + float(t)) for t in times])
    heights = np.array([path.sample(float(t))[0][2] for t in times]) - 2.0
    assert np.abs(samples[:, 1]).max() <= TURN_LIMIT * (1.0 + 1e-9)
    assert samples[-1, 0] == pytest.approx(math.radians(angle_deg))
    moving = samples[:, 1] != 0.0
    assert moving.any()
    if height > BEGIN_ABOVE_M:
        first = heights[moving][0]
        assert BEGIN_ABOVE_M <= first < BEGIN_ABOVE_M + 1.0
    else:
        assert times[moving][0] >= duration  # too low a climb: after it


def test_a_slow_climb_is_used_to_its_end() -> None:
    path = climb_path(30.0, 40.0)
    turn = turn_in_climb(path, 0.0, 90.0)
    assert turn.begin_s + turn.duration_s == pytest.approx(40.0)
    assert turn_in_climb(path, 0.0, 0.0) is None
