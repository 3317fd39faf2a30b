"""The geometric check on synthetic ground, and touchdown detection."""

import numpy as np
import pytest

from touchdown.estimator.api import GridMap
from touchdown.landing.api import LandingParams
from touchdown.landing.mission.site_recheck import ground_under
from touchdown.landing.selection.ground.elevation_raster import ElevationRaster
from touchdown.landing.selection.ground.landable import (
    Defect,
    LandableMap,
    assess,
    explain,
    fit_footprint,
    ground_planes,
)
from touchdown.sim.typing import Array

from support.landing_support import ABOVE, make_grid, raster_of, rising, select, view_of

PARAMS = LandingParams()
MIDDLE = (40, 40)


def judged(grid: GridMap) -> tuple[ElevationRaster, LandableMap]:
    raster = raster_of(grid)
    return raster, assess(
        raster, ground_planes(raster, PARAMS), PARAMS, margin_m=PARAMS.map_margin_m,
        min_returns=PARAMS.min_returns,
    )  # fmt: skip


def test_traffic_is_detected_by_changing_heights() -> None:
    """A lane 2 m wide on which cars passed, against a static edge one cell wide."""
    lane = make_grid(rising())
    lane.height_std_m[30:50, 58:68] = 0.5
    lane.height_m[30:50, 58:68] = 0.2
    lane.max_height_m[30:50, 58:68] = 1.5
    _, result = judged(lane)
    assert result.defect[40, 45] == Defect.MOVING  # 2.6 m from the lane
    edge = make_grid(rising())
    edge.height_std_m[:, 62] = 0.5
    edge.max_height_m[:, 62] = 1.5
    _, result = judged(edge)
    assert result.defect[40, 58] == Defect.NONE
    crown = make_grid(rising())
    crown.height_std_m[36:46, 60:70] = 1.5
    crown.height_m[36:46, 60:70] = 4.0
    crown.max_height_m[36:46, 60:70] = 6.0
    _, result = judged(crown)
    assert result.defect[40, 50] == Defect.NONE


def test_footprint_plane_of_a_known_slope() -> None:
    raster, _ = judged(make_grid(rising(4.0), sigma=0.0))
    plane = fit_footprint(raster, np.array([8.0, 8.0]), 1.0)
    assert plane.slope_deg == pytest.approx(4.0, abs=1e-3)
    assert plane.roughness_m == pytest.approx(0.0, abs=1e-5)
    assert plane.position[2] == pytest.approx(np.tan(np.deg2rad(4.0)) * 7.9, abs=1e-4)


def test_empty_map_gives_no_candidate() -> None:
    empty = make_grid(np.full((20, 20), np.nan))
    nothing = select(view_of(empty), ABOVE, PARAMS)
    assert nothing.candidates == ()
    assert nothing.costmap is None


def fine(height: Array, corner: tuple[float, float] = (4.0, 4.0)) -> GridMap:
    return make_grid(height, 0.05, origin=corner, returns=10)


def test_ground_height_prefers_the_fine_map() -> None:
    coarse, close = make_grid(rising()), fine(np.full((160, 160), 0.25))
    assert ground_under(view_of(coarse, close), np.array([8.0, 8.0])) == pytest.approx(
        0.25, abs=0.01
    )
    assert ground_under(view_of(coarse), np.array([8.0, 8.0])) == pytest.approx(0.0, abs=0.01)
    slope = make_grid(rising(5.0), sigma=0.0)
    expected = np.tan(np.deg2rad(5.0)) * (8.03 - 0.1)
    assert ground_under(view_of(slope), np.array([8.03, 8.0])) == pytest.approx(expected, abs=1e-4)
    assert np.isnan(ground_under(view_of(coarse), np.array([99.0, 8.0])))


def test_something_tall_beyond_the_footprint_is_told() -> None:
    grid = make_grid(rising())
    grid.max_height_m[:, 48] = 1.0  # a wire fence 1.6 m from the middle cell's centre
    found = explain(*judged(grid), *MIDDLE, PARAMS, 0.35)
    assert found.rule == "tall_neighbour" and "m high within 1.9 m (limit 0.25 m)" in found.text


@pytest.mark.parametrize(("slope_deg", "edge_m", "top_m", "told"), [
    (6.0, 0.0, 0.0, "too steep (6.0 deg, limit 4.5)"),
    (0.0, 0.09, 0.0, "a step (0.09 m, limit 0.08)"),
    (0.0, 0.0, 0.2, "an object (0.20 m, limit 0.15)"),
])  # fmt: skip
def test_a_refusal_tells_the_limit_that_it_was_judged_by(
    slope_deg: float, edge_m: float, top_m: float, told: str
) -> None:
    grid = make_grid(rising(slope_deg), sigma=0.0)
    grid.height_m[:, 40:] += edge_m
    grid.max_height_m[40, 40] += top_m
    assert told in explain(*judged(grid), *MIDDLE, PARAMS, 0.35).text
