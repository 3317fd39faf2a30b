"""Ground under low plants: taken where plants are wide and let pulses through, nowhere else."""

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from touchdown.estimator.api import GridMap
from touchdown.landing.api import LandingParams
from touchdown.landing.mission.site_recheck import ground_under, recheck_site
from touchdown.landing.selection.ground.plants import standing_plants, without_plants
from touchdown.sim.typing import Array

from support.landing_support import (
    ABOVE,
    grid_of_returns,
    make_grid,
    raster_of,
    rising,
    select,
    view_of,
)

PARAMS = LandingParams()
GROUND = PARAMS.ground
RETURNS = 40


def _map(ground: Array, cover: Array, through: float = 0.5, cell_m: float = 0.2) -> GridMap:
    """A map of ``ground`` (rows, cols) under plants as high as ``cover``, of whose pulses the
    fraction ``through`` reaches the ground and the rest comes from anywhere in them; noise of 2
    cm."""
    rng = np.random.default_rng(5)
    shape = (RETURNS, *ground.shape)
    up = np.where(rng.random(shape) < through, 0.0, rng.random(shape)) * cover
    up[:2] = 0.0  # of so many pulses some reach the ground
    samples = ground + up + 0.02 * rng.standard_normal(shape)
    return grid_of_returns(samples, cell_m)


def _flat(value: float = 0.0) -> Array:
    """16 x 16 m."""
    return np.full((80, 80), value)


def _allowed(grid: GridMap) -> NDArray[np.bool_]:
    chosen = select(view_of(grid), ABOVE, PARAMS)
    return chosen.allowed


def test_meadow_is_landed_in_and_its_ground_is_known_to_two_centimetres() -> None:
    slope = rising(2.0)
    grid = _map(slope, _flat(0.25))
    raster = raster_of(grid)
    assert np.median(grid.height_m - slope) > 0.05
    bare = without_plants(raster, standing_plants(raster, GROUND), GROUND)
    error = bare.height - slope
    assert abs(np.median(error)) < 0.02
    assert (np.abs(error) < 0.03).mean() > 0.98
    assert _allowed(grid)[15:65, 15:65].mean() > 0.95


def test_bare_ground_stays_to_the_bit() -> None:
    raster = raster_of(make_grid(_flat()))
    assert without_plants(raster, standing_plants(raster, GROUND), GROUND) is raster


@pytest.mark.parametrize(
    ("height", "through"),
    [
        (0.6, 0.5),  # tall grass: what stands in it is hidden
        (0.36, 0.05),  # a hedge that is nearly closed
    ],
)
def test_tall_or_closed_plants_stay_objects(height: float, through: float) -> None:
    assert not _allowed(_map(_flat(), _flat(height), through)).any()


@pytest.mark.parametrize("wide", [1, 2, 3])
def test_solid_things_in_a_meadow_stay(wide: int) -> None:
    """A rock of 20 cm lets no pulse through: the lowest returns show it, and it keeps its metre."""
    ground, cover = _flat(), _flat(0.25)
    rock = np.s_[40 : 40 + wide, 40 : 40 + wide]
    ground[rock], cover[rock] = 0.2, 0.0
    allowed = _allowed(_map(ground, cover))
    assert allowed[20:30, 20:30].any()
    assert not allowed[36 : 44 + wide, 36 : 44 + wide].any()


@pytest.mark.parametrize("width", [1, 2])
def test_narrow_things_on_bare_ground_stay(width: int) -> None:
    """A row of stakes or a low fence of 25 cm: as permeable as grass, but narrow."""
    cover = _flat()
    cover[:, 40 : 40 + width] = 0.25
    allowed = _allowed(_map(_flat(), cover))
    assert allowed[20:60, 20:28].any()
    assert not allowed[:, 36 : 44 + width].any()


def test_low_wall_is_no_clump_although_its_edges_spread() -> None:
    """20 cm high, 60 cm wide: mixed cells on both sides, and a solid top between them."""
    ground, cover = _flat(), _flat()
    ground[:, 41] = 0.2
    cover[:, 40], cover[:, 42] = 0.2, 0.2
    assert not _allowed(_map(ground, cover))[:, 37:46].any()
    raster = raster_of(_map(ground, cover))
    for fill in (False, True):
        assert not standing_plants(raster, GROUND, fill_gaps=fill)[:, 41].any()


def test_look_from_ten_metres_lands_between_and_on_clumps_of_grass() -> None:
    """Clumps of 40 cm with gaps between them, 20 cm high, in fine cells of 5 cm."""
    cover = np.zeros((320, 320))
    for row in range(4, 316, 14):
        for col in range(4, 316, 14):
            cover[row : row + 8, col : col + 8] = 0.18
    grid = _map(np.zeros((320, 320)), cover, 0.67, cell_m=0.05)
    view = view_of(make_grid(_flat()), grid)
    look = recheck_site(view, np.array([8.0, 8.0, 0.0]), 3.0, PARAMS)
    assert look.position_odom is not None, look.reason
    assert look.position_odom[2] == pytest.approx(0.0, abs=0.03)
    grid.max_height_m[160, 160] = 0.5  # a stake
    moved = recheck_site(view, np.array([8.0, 8.0, 0.0]), 3.0, PARAMS)
    assert np.hypot(*(moved.position_odom[:2] - 8.0)) > 1.0


@pytest.mark.parametrize("row", [159, 160, 161, 162])
def test_stake_in_a_wide_stand_is_seen_wherever_the_cells_lie(row: int) -> None:
    grid = _map(np.zeros((320, 320)), np.full((320, 320), 0.18), 0.67, cell_m=0.05)
    grid.max_height_m[row, 160] = 0.5
    look = recheck_site(view_of(make_grid(_flat()), grid), np.array([8.0, 8.0, 0.0]), 0.0, PARAMS)
    assert look.position_odom is None and "an object" in look.reason


def test_plants_without_sure_ground_stay_objects() -> None:
    raster = raster_of(_map(_flat(), _flat(0.25)))
    plants = standing_plants(raster, GROUND)
    assert without_plants(raster, plants, GROUND).high[40, 40] < 0.1 < raster.high[40, 40]
    unsure = dataclasses.replace(
        raster, ground=lambda where: raster.ground(where)._replace(std_m=np.full(where.shape, 0.04))
    )
    np.testing.assert_array_equal(without_plants(unsure, plants, GROUND).high, raster.high)


def test_height_to_descend_to_is_that_of_the_ground_at_the_edge_of_a_meadow() -> None:
    cover = _flat()
    cover[:, 40:] = 0.3
    grid = _map(_flat(), cover, 0.3)
    assert grid.height_m[40, 50] > 0.08
    for x in (7.5, 8.0, 8.5, 10.0):
        assert ground_under(view_of(grid), np.array([x, 8.0])) == pytest.approx(0.0, abs=0.015)
