"""Scenes with ground that resembles landing sites, surveyed with the simulated sensors."""

from pathlib import Path

import numpy as np
import pytest

from touchdown.experiments.benchmarks.posed_survey import Surveyed
from touchdown.landing.api import LandingParams
from touchdown.landing.mission.site_recheck import recheck_site
from touchdown.landing.selection.selector import check_site

from support.trap_scenes import LAWN, box, ground_with_gap, hover_over, survey, write

PARAMS = LandingParams()
SHORTER = ("survey.leg_length_m=15.0", "survey.duration_s=5.0")
SLOPE = 'euler="12 0 0"'


@pytest.fixture(scope="module")
def garden(tmp_path_factory: pytest.TempPathFactory) -> Surveyed:
    """A lawn with a pond, a flat roof, a slope of 12 degrees and a silent shaft."""
    geoms = (
        ground_with_gap((20.0, 24.0, 4.0, 8.0))
        + box("water_pond", (4, 3, -0.5), (14, 13, 0.01))
        + box("building_shed", (2, -14, 0), (10, -6, 3))
        + box("lawn_bank", (18, -15, -1.0), (28, -5, 1.2), SLOPE)
    )
    return survey(write(tmp_path_factory.mktemp("traps"), "garden", geoms))


def refusal(place: Surveyed, x: float, y: float) -> str:
    site, _ = check_site(place.map_view, place.estimate, PARAMS, np.array([x, y]))
    assert not site.accepted
    return site.reason


def allowed_fraction(place: Surveyed, x0: float, x1: float, y0: float, y1: float) -> float:
    """Of the cells of a rectangle, those that the selector would land on."""
    costmap = place.selection.costmap
    low = np.floor((np.array([x0, y0]) - costmap.origin_xy_m) / costmap.cell_m).astype(int)
    high = np.ceil((np.array([x1, y1]) - costmap.origin_xy_m) / costmap.cell_m).astype(int)
    return float(place.selection.allowed[low[1] : high[1], low[0] : high[0]].mean())


def test_open_lawn_is_taken(garden: Surveyed) -> None:
    site = garden.selection.candidates[0]
    assert site.accepted and site.safe_probability > 0.99
    assert allowed_fraction(garden, 12.5, 15.5, -4.0, 1.0) > 0.95


def test_flat_pond_is_refused_by_missing_pulses(garden: Surveyed) -> None:
    """As flat as anything, and near the nadir it even gives returns."""
    assert allowed_fraction(garden, 4.0, 14.0, 3.0, 13.0) == 0.0
    assert "water" in refusal(garden, 9.0, 8.0)


def test_roof_is_taken_in_the_middle_but_not_at_its_edge(garden: Surveyed) -> None:
    assert allowed_fraction(garden, 5.0, 7.0, -11.0, -9.0) > 0.9
    for x0, x1, y0, y1 in ((2, 3, -14, -6), (9, 10, -14, -6), (2, 10, -14, -13), (2, 10, -7, -6)):
        assert allowed_fraction(garden, x0, x1, y0, y1) == 0.0
    refusal(garden, 9.5, -10.0)


def test_thin_wire_over_a_lawn_is_found_from_4_m_at_the_latest(tmp_path: Path) -> None:
    """A wire of 12 mm, half a metre above the ground: few pulses meet it, fewer from above."""
    wire = '<geom name="wire" type="capsule" fromto="12 -30 0.5 12 30 0.5" size="0.006"/>'
    place = survey(write(tmp_path, "wire", LAWN + wire), *SHORTER)
    site = np.array([12.3, 0.0, 0.0])
    look = recheck_site(hover_over(place, site, 4.0, 3.0), site, 0.0, PARAMS)
    assert look.position_odom is None, look.reason


def test_ditch_hidden_at_30_m_is_found_on_the_recheck(tmp_path: Path) -> None:
    """A slot 15 cm wide and 25 cm deep: at 30 m few pulses reach its bottom."""
    slot = ground_with_gap((12.0, 12.15, -30.0, 30.0)) + box(
        "lawn_bed", (11, -30, -1), (13, 30, -0.25)
    )
    place = survey(write(tmp_path, "ditch", slot), *SHORTER)
    site = np.array([12.4, 0.0, 0.0])
    look = recheck_site(hover_over(place, site, 10.0, 4.0), site, 3.0, PARAMS)
    assert abs(look.position_odom[0] - 12.1) > 1.0, look.reason
    assert "moved" in look.reason


def test_car_that_leaves_and_car_that_arrives(tmp_path: Path) -> None:
    """The place is mapped with a car and then without, or the other way round: where it is at the
    end of the survey nobody lands, and where it was neither before the map has forgotten it."""
    lawn = LAWN
    car = box("car", (10, 4, 0), (14.5, 6, 1.5))
    empty, parked = (write(tmp_path, name, geoms) for name, geoms in
                     (("empty", lawn), ("parked", lawn + car)))  # fmt: skip
    for first, second in ((empty, parked), (parked, empty)):
        before, after = survey(first, *SHORTER), survey(second, *SHORTER)
        after.survey.mapper = before.survey.mapper
        view = hover_over(after, np.array([12.0, 5.0]), 30.0, 3.0)
        site, _ = check_site(view, after.estimate, PARAMS, np.array([12.0, 5.0]))
        assert not site.accepted, site.reason
