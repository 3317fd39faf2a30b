"""The ground under plants, traffic and false returns, where the answer is known."""

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from touchdown.estimator.api import HEIGHT_BIN_M, HEIGHT_BINS, GridMap
from touchdown.estimator.ground import _Heights, _own_modes, _pool
from touchdown.estimator.mapping.kernels import Grid, Pulses, accumulate_heights
from touchdown.sim.typing import Array

from support.landing_support import grid_of_returns, make_grid

ROWS, COLS, CELL_M = 24, 30, 0.2
Y, X = (np.mgrid[0:ROWS, 0:COLS] + 0.5) * CELL_M
FLAT = np.zeros((ROWS, COLS))
INNER = np.s_[3:-3, 3:-3]


def grass(height: Array | float, leaf_area: float = 1.7, returns: int = 30, seed: int = 1) -> Array:
    """Heights above the ground (returns, rows, cols) from which pulses come back that look straight
    down on plants, by the law of Beer and Lambert, with the noise of the ranges."""
    rng = np.random.default_rng(seed)
    shape = (returns, ROWS, COLS)
    depth = -np.log(rng.random(shape)) * 2.0 / leaf_area
    return np.maximum(1.0 - depth, 0.0) * height + 0.025 * rng.standard_normal(shape)


def slope_deg(height: Array) -> tuple[float, float]:
    """Rise along x and y of the plane through the cells within 1 m of the middle."""
    near = np.hypot(X - 3.0, Y - 2.4) <= 1.0
    design = np.column_stack([X[near], Y[near], np.ones(near.sum())])
    rise = np.linalg.lstsq(design, height[near], rcond=None)[0][:2]
    return float(np.degrees(np.arctan(rise[0]))), float(np.degrees(np.arctan(rise[1])))


@pytest.mark.parametrize(
    ("height", "leaf_area", "mean_m", "error_m"),
    [
        (0.25, 1.7, 0.07, 0.006),  # a meadow
        (0.10, 1.7, 0.03, 0.022),  # long grass, hardly higher than the noise of the ranges
        (0.30, 3.6, 0.14, 0.012),  # crops: a sixth of the pulses reaches the ground
    ],
)
def test_flat_ground_under_plants_is_found(
    height: float, leaf_area: float, mean_m: float, error_m: float
) -> None:
    grid = grid_of_returns(grass(height, leaf_area))
    error = grid.ground().height_m[INNER]
    assert np.median(grid.height_m) > mean_m and abs(np.median(error)) < error_m
    assert (np.abs(error - np.median(error)) < 0.02).mean() > 0.9


def test_tilt_of_a_meadow_is_recovered() -> None:
    rise_x, rise_y = np.tan(np.radians(6.0)), np.tan(np.radians(-3.0))
    ground = rise_x * X + rise_y * Y
    found = slope_deg(grid_of_returns(ground + grass(0.25)).ground().height_m)
    np.testing.assert_allclose(found, (6.0, -3.0), atol=0.25)


CARS = np.where((np.arange(30) % 5 == 0)[:, None, None] & (X > 3.0), 1.4, 0.0)
"""of 30 returns every fifth from the roof of a car"""


@pytest.mark.parametrize(
    "returns", [grass(np.where(X > 3.0, 0.25, 0.0)), CARS + grass(0.0)], ids=["meadow", "road"]
)
def test_edge_of_a_meadow_and_of_a_lane_is_level(returns: Array) -> None:
    grid = grid_of_returns(returns)
    assert slope_deg(grid.height_m)[0] > 3.0 and np.hypot(*slope_deg(grid.ground().height_m)) < 0.4


def test_bare_ground_with_its_steps_stays_to_the_bit() -> None:
    kerb = make_grid(np.where(X > 3.0, 0.12, 0.0))
    np.testing.assert_array_equal(kerb.ground().height_m, kerb.height_m)


@pytest.mark.parametrize(
    ("wide", "height_m", "over_m"), [(1, 0.2, 0.0), (2, 0.2, 0.0), (3, 0.2, 0.0), (2, 0.3, 0.2)]
)
def test_rock_in_a_meadow_keeps_its_height(wide: int, height_m: float, over_m: float) -> None:
    """The last one is overgrown."""
    rock = np.zeros((ROWS, COLS), bool)
    rock[10 : 10 + wide, 10 : 10 + wide] = True
    plants = grass(np.where(rock, over_m, 0.25))
    found = grid_of_returns(np.where(rock, height_m, 0.0) + plants).ground()
    np.testing.assert_allclose(found.height_m[rock], height_m, atol=0.04 if over_m else 0.02)
    assert np.median(np.abs(found.height_m[INNER])) < 0.01


def test_crops_on_a_steep_slope_do_not_lower_it() -> None:
    ground = 0.35 * X
    error = (grid_of_returns(ground + grass(0.3, 3.6)).ground().height_m - ground)[INNER]
    assert abs(np.median(error)) < 0.02 and (np.abs(error - np.median(error)) < 0.03).mean() > 0.9


def test_top_of_a_post_is_no_ground_and_a_roof_is() -> None:
    ground = FLAT.copy()
    ground[10, 10] = 2.0
    ground[:, 20:] = 3.0
    found = make_grid(ground).ground()
    assert np.isnan(found.height_m[10, 10]) and np.isnan(found.std_m[10, 10])
    assert np.isfinite(found.height_m[9:12, 9:12]).sum() == 8
    np.testing.assert_allclose(found.height_m[:, 20:], 3.0, atol=0.03)


def test_few_returns_far_below_the_ground_are_none_of_it() -> None:
    """Two late echoes in one cell; a pit that many returns show is ground."""
    ground = FLAT.copy()
    ground[12, 12], ground[12, 20] = -3.0, -1.0
    grid = make_grid(ground)
    grid.count[12, 12] = 2.0
    found = grid.ground().height_m
    assert np.isnan(found[12, 12]) and np.isfinite(found[11:14, 11:14]).sum() == 8
    assert found[12, 20] == pytest.approx(-1.0, abs=0.03)


def test_late_first_echo_is_no_ground() -> None:
    """The histogram of its cell begins 4 m too low and holds none of the other returns."""
    returns = 0.02 * np.random.default_rng(4).standard_normal((10, ROWS, COLS))
    returns[0, 12, 12] = -4.0
    found = grid_of_returns(returns).ground().height_m
    assert np.isnan(found[12, 12]) and np.isfinite(found).sum() == found.size - 1
    assert np.nanmax(np.abs(found)) < 0.05


def test_uncertainty_grows_as_fewer_returns_come_from_the_ground() -> None:
    open_, dense, short = (
        np.median(grid_of_returns(returns).ground().std_m[INNER])
        for returns in (grass(0.3, 1.0), grass(0.3, 3.6), grass(0.3, 1.0, returns=8))
    )
    assert open_ < 0.7 * dense and open_ < 0.7 * short and 0.001 < open_ < short < 0.03


def test_few_returns_are_judged_with_those_around_them() -> None:
    """Two returns from the tops of the grass, in a cell amid others that have many."""
    returns = grass(0.25)
    returns[:, 12, 12] = np.nan
    grid = grid_of_returns(returns)
    lone = np.full_like(returns[:2], np.nan)
    lone[:, 12, 12] = 0.24
    add(grid, lone)
    layers = (grid.count, grid.height_m, grid.min_height_m, grid.max_height_m, grid.height_std_m)
    for layer, value in zip(layers, (2.0, 0.24, 0.24, 0.24, 0.0), strict=True):
        layer[12, 12] = value
    assert abs(grid.ground().height_m[12, 12]) < 0.03


def test_water_that_swallows_most_pulses_keeps_its_mean_height() -> None:
    """Three returns a cell, one of them from 0.3 m below, of a hundred pulses."""
    rng = np.random.default_rng(4)
    returns = 0.02 * rng.standard_normal((3, ROWS, COLS))
    returns[rng.integers(0, 3, (ROWS, COLS)), *np.indices((ROWS, COLS))] -= 0.3
    grid = grid_of_returns(returns)
    assert np.median(grid.ground().height_m - grid.height_m) < -0.05
    grid.missing[:] = 97.0
    np.testing.assert_array_equal(grid.ground().height_m, grid.height_m)


def test_returns_of_a_neighbour_weigh_half_and_follow_the_slope() -> None:
    """Four returns of the cell and two of each neighbour, on ground that rises a bin a column."""
    histogram = np.zeros((3, 3, HEIGHT_BINS), np.uint8)
    histogram[:, [0, 1, 2], [9, 10, 11]] = 2
    histogram[1, 1, 10] = 4
    ends = np.tile(np.array([0, HEIGHT_BINS], np.uint8), (3, 3, 1))
    base, weights = np.zeros((3, 3), np.float32), np.zeros(48)
    _pool(_Heights(histogram, base, ends), (1, 1), 1, (HEIGHT_BIN_M, 0.0), 0.0, weights)
    assert np.flatnonzero(weights).tolist() == [10] and weights[10] == 4.0 + 8 * 2 * 0.5


def test_ground_of_a_part_is_that_of_the_whole_map() -> None:
    grid = grid_of_returns(0.1 * X + grass(0.25))
    whole = grid.ground()
    for window in (np.s_[5:15, 8:20], np.s_[0:4, 25:30], np.s_[20:40, 0:1]):
        part = grid.ground(window)
        np.testing.assert_array_equal(part.height_m, whole.height_m[window])
        np.testing.assert_array_equal(part.std_m, whole.std_m[window])
    where, window = np.zeros((12, 15), bool), np.s_[4:16, 5:20]
    where[3:9, 4:10] = True
    chosen = grid.ground(window, where).height_m
    np.testing.assert_array_equal(chosen[where], whole.height_m[window][where])
    np.testing.assert_array_equal(chosen[~where], grid.height_m[window][~where])


def test_map_without_histograms_has_its_mean_heights() -> None:
    grid = dataclasses.replace(make_grid(FLAT), histogram=None, histogram_base_m=None)
    found = grid.ground()
    np.testing.assert_array_equal(found.height_m, grid.height_m)
    np.testing.assert_allclose(found.std_m, np.maximum(grid.height_std_m, 0.02) / np.sqrt(40.0))


def add(grid: GridMap, samples: Array) -> None:
    """Adds the heights of returns (returns, rows, cols) to the histograms."""
    assert grid.histogram is not None and grid.histogram_base_m is not None
    for heights in samples:
        points = np.stack([X, Y, heights], axis=-1)[np.isfinite(heights)].astype(np.float32)
        accumulate_heights(
            Pulses(points, np.zeros_like(points), np.ones(len(points), np.float32)),
            Grid(0.0, 0.0, CELL_M), HEIGHT_BIN_M, grid.histogram, grid.histogram_base_m,
        )  # fmt: skip


def histogram_of(*heights: float) -> tuple[NDArray[np.uint8], float]:
    """Histogram and base of one cell after returns of these heights."""
    histogram, base = np.zeros((1, 1, HEIGHT_BINS), np.uint8), np.full((1, 1), np.nan, np.float32)
    points = np.array([[0.1, 0.1, height] for height in heights], np.float32)
    ranges = np.ones(len(points), np.float32)
    pulses = Pulses(points, np.zeros_like(points), ranges)
    accumulate_heights(pulses, Grid(0.0, 0.0, CELL_M), HEIGHT_BIN_M, histogram, base)
    return histogram[0, 0], float(base[0, 0])


def test_histogram_counts_by_height_and_follows_lower_returns() -> None:
    counts, base = histogram_of(1.01, 1.01, 1.07, 9.0)
    assert base == pytest.approx(1.01 - 4.5 * HEIGHT_BIN_M, abs=1e-5)
    assert (counts[4], counts[7], counts[-1], counts.sum()) == (2, 1, 1, 4)
    lower, new_base = histogram_of(1.01, 1.01, 1.07, 9.0, 0.81)
    assert new_base == pytest.approx(0.79, abs=HEIGHT_BIN_M)
    bins = np.flatnonzero(lower)
    assert lower[bins].tolist() == [1, 2, 1, 1] and bins[0] == 1 and bins[-1] == HEIGHT_BINS - 1
    assert bins[1] - bins[0] == pytest.approx(10, abs=1) and bins[2] - bins[1] == 3


def test_single_returns_from_below_the_ground_are_errors_and_three_are_the_ground() -> None:
    counts, base = histogram_of(*[5.0] * 40, -2.0, -2.0)
    assert base == pytest.approx(5.0 - 4.5 * HEIGHT_BIN_M, abs=1e-5) and counts[4] == 40
    counts, base = histogram_of(*[5.0] * 40, *[-2.0] * 6)
    assert base == pytest.approx(-2.0 - 4.5 * HEIGHT_BIN_M, abs=1e-5)
    assert counts[4] == 4 and counts[-1] == 40


def test_histogram_that_is_full_keeps_its_shares() -> None:
    counts, _ = histogram_of(*[0.0, 0.0, 0.1] * 400)
    assert 100 < counts.max() <= 255 and counts[4] / counts[9] == pytest.approx(2.0, rel=0.1)


def test_the_outer_bins_move_no_surface() -> None:
    """The last bin holds all that is higher, at no height of its own."""
    histogram = np.zeros((1, 1, HEIGHT_BINS), np.uint8)
    histogram[0, 0, -2:] = [80, 120]
    own, ends = np.full((1, 1), np.nan, np.float32), np.zeros((1, 1, 2), np.uint8)
    one = np.ones((1, 1), np.float32)
    _own_modes(histogram, 2.0 * one, one, one.astype(np.uint8), own, ends)
    assert own[0, 0] == pytest.approx(2.0 + (HEIGHT_BINS - 1.5) * HEIGHT_BIN_M, abs=1e-3)
    assert ends[0, 0].tolist() == [HEIGHT_BINS - 2, HEIGHT_BINS - 1]
