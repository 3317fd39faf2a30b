"""The turn of the heading in the climb: its angle, its rate, and where it begins."""

import math

import numpy as np
import pytest

from touchdown.landing.mission.trajectory import (
    BEGIN_ABOVE_M,
    HeadingTurn,
    PiecewiseTrajectory,
    State,
    through,
    turn_in_climb,
)

LIMIT = math.radians(40.0)


def climb(height_m: float, duration_s: float, floor_m: float = 2.0) -> PiecewiseTrajectory:
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
    path, now = climb(height, duration), 5.0
    turn = turn_in_climb(path, now, angle_deg)
    times = np.linspace(0.0, turn.duration_s + duration + 1.0, 2001)
    samples = np.array([turn.sample(now + float(t)) for t in times])
    heights = np.array([path.sample(float(t))[0][2] for t in times]) - 2.0
    assert np.abs(samples[:, 1]).max() <= LIMIT * (1.0 + 1e-9)
    assert samples[-1, 0] == pytest.approx(math.radians(angle_deg))
    moving = samples[:, 1] != 0.0
    assert moving.any()
    if height > BEGIN_ABOVE_M:
        first = heights[moving][0]
        assert BEGIN_ABOVE_M <= first < BEGIN_ABOVE_M + 1.0
    else:
        assert times[moving][0] >= duration  # too low a climb: after it


def test_a_slow_climb_is_used_to_its_end() -> None:
    path = climb(30.0, 40.0)
    turn = turn_in_climb(path, 0.0, 90.0)
    assert turn.begin_s + turn.duration_s == pytest.approx(40.0)
    assert turn_in_climb(path, 0.0, 0.0) is None
