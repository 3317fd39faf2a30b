"""Where a vehicle takes off over ground of a given size, with something in its middle."""

import numpy as np
import pytest

from touchdown.scenes.importers.top_view import CELL_M, TopView, takeoff_spot
from touchdown.sim.typing import Array


def level(east_m: float, north_m: float, holes: float = 0.0) -> TopView:
    """Level ground about the origin, where a box of 2 m stands, with a fraction of ``holes``."""
    shape = round(north_m / CELL_M), round(east_m / CELL_M)
    height = np.zeros(shape)
    height[np.random.default_rng(0).random(shape) < holes] = np.nan
    row, col = shape[0] // 2, shape[1] // 2
    height[row - 2 : row + 2, col - 2 : col + 2] = 2.0
    geom = np.where(np.isnan(height), -1, 0).astype(np.int32)
    return TopView(np.array([-east_m / 2, -north_m / 2]), CELL_M, height, geom)


def spot(east_m: float, north_m: float, holes: float = 0.0) -> Array:
    return takeoff_spot(level(east_m, north_m, holes), np.zeros(2))


def test_wide_ground_is_left_at_the_wish_or_beside_what_stands_there() -> None:
    wide = level(200.0, 200.0)
    assert (takeoff_spot(wide, np.array([10.0, 5.0])) == [10.0, 5.0]).all()
    assert 2.0 < np.hypot(*takeoff_spot(wide, np.zeros(2))) < 4.0


def test_the_wish_stays_where_a_small_survey_sees_all_from_there() -> None:
    free = level(24.0, 24.0)
    free.height_m[:] = 0.0
    wish = np.array([-0.1, 0.1])
    assert (takeoff_spot(free, wish) == wish).all()


def test_a_roof_beside_wider_ground_is_left() -> None:
    roof = level(200.0, 200.0)
    roof.height_m[190:210, 190:210] = 3.0
    assert np.abs(takeoff_spot(roof, np.zeros(2))).max() > 5.0


def test_the_legs_of_the_standard_survey_fit_where_they_can() -> None:
    x, y = spot(64.0, 64.0)
    assert x + 52.0 <= 32.0 + 52.0 * 0.05 and y + 42.0 <= 32.0 + 42.0 * 0.05


def test_from_the_spot_a_small_survey_sees_the_whole_of_a_small_place() -> None:
    """Of a plane of 40 m: 12 m behind the nearest spot to the middle lies its edge, and 20 m
    to either side."""
    x, y = spot(40.0, 40.0)
    assert x == pytest.approx(-8.0, abs=0.5) and abs(y) <= 1.0


def test_the_shortest_leg_ends_on_the_ground() -> None:
    x, y = spot(10.0, 10.0)
    assert -3.6 < x <= -3.0 and abs(y) <= 1.0


def test_legs_side_by_side_see_more_of_a_deep_place() -> None:
    """45 m by 100 m: legs of 16 m leave 13 m for turns, three of them see 80 m of the depth."""
    x, y = spot(45.0, 100.0)
    assert -9.8 <= x <= -5.2 and y == pytest.approx(-10.0, abs=0.8)


def test_ground_with_holes_has_room_too() -> None:
    """A fiftieth is missing: nowhere is there ground below all of three legs."""
    x, y = spot(45.0, 100.0, holes=0.02)
    assert -10.5 <= x <= -5.2 and y == pytest.approx(-10.0, abs=2.0)
