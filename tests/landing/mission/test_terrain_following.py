"""A survey rises with the ground of the map, and only then."""

import numpy as np
import pytest

from touchdown.estimator.api import MapView
from touchdown.landing.api import SurveyParams
from touchdown.landing.mission.terrain_following import Lift, LiftedTrajectory, ground_around
from touchdown.landing.mission.trajectory import survey_trajectory

from support.landing_support import make_grid, view_of

LEVEL_M = -3.0
HERE = np.zeros(2)


def map_of(height_m: float, covered: float = 0.0) -> MapView:
    """Ground of one height; ``covered``: fraction of the cells that show crowns 12 m above it."""
    heights = np.full((60, 60), height_m)
    heights[np.random.default_rng(0).random(heights.shape) < covered] += 12.0
    return view_of(make_grid(heights, 0.4, origin=(-12.0, -12.0), returns=3, sigma=0.0))


def lifted(view: MapView, seconds: float, lift: Lift | None = None) -> Lift:
    lift = lift or Lift(30.0)
    for step in range(int(100 * seconds)):
        lift.update(view, HERE, LEVEL_M, 0.01 * step)
    return lift


def test_over_level_ground_and_under_crowns_the_path_is_the_same_to_the_bit() -> None:
    path = survey_trajectory(np.array([1.0, 2.0, 30.0]), 0.3, SurveyParams())
    for height in (LEVEL_M - 20.0, LEVEL_M, LEVEL_M + 5.9):
        over = LiftedTrajectory(path, lifted(map_of(height, 0.4), 5.0))
        for t in (0.0, 3.3, 17.1, 36.0):
            for one, other in zip(path.sample(t), over.sample(t), strict=True):
                np.testing.assert_array_equal(one, other)
        np.testing.assert_array_equal(over.breaks_s, path.breaks_s)


def test_it_rises_by_what_the_ground_does_beyond_a_fifth_of_the_height() -> None:
    lift = lifted(map_of(LEVEL_M + 14.0), 25.0)
    assert lift.height_m == pytest.approx(14.0 - 6.0, abs=0.05)
    path = survey_trajectory(np.zeros(3), 0.0, SurveyParams())
    over, level = LiftedTrajectory(path, lift).sample(9.0), path.sample(9.0)
    assert over[0][2] - level[0][2] == pytest.approx(lift.height_m)
    assert over[1][2] - level[1][2] == pytest.approx(lift.rate_mps)


def test_the_lift_is_smooth() -> None:
    lift, steep, before = Lift(30.0), map_of(LEVEL_M + 26.0), [0.0, 0.0]
    lift.update(steep, HERE, LEVEL_M, 0.0)
    for step in range(1, 1500):
        lift.update(steep, HERE, LEVEL_M, 0.01 * step)
        assert abs(lift.rate_mps) <= 2.0 and abs(lift.rate_mps - before[1]) <= 0.0081
        assert lift.height_m - before[0] == pytest.approx(0.01 * lift.rate_mps, abs=1e-9)
        before = [lift.height_m, lift.rate_mps]
    assert lift.height_m < 20.05


def test_what_is_not_mapped_lifts_nothing() -> None:
    view = map_of(LEVEL_M + 20.0)
    assert np.isnan(ground_around(view, np.array([500.0, 0.0])))
    lift = Lift(30.0)
    for step in range(300):
        lift.update(view, np.array([-25.0, 500.0]), LEVEL_M, 0.01 * step)
    assert lift.height_m == 0.0
