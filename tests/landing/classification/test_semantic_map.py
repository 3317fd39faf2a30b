"""The semantic map: fusion by hand, reliability of views, what reads it."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from touchdown.landing.api import LandingParams, SemanticMapParams
from touchdown.landing.classification import semantic_map
from touchdown.landing.classification.labels import D_LAND
from touchdown.landing.classification.site_check import SiteClassCheck
from touchdown.sim.frames import Pose

from support.ground_class_support import (
    ByColour,
    chances,
    photograph,
    plain,
    site_at,
    small_rig,
    west_is_water,
)
from support.landing_support import make_estimate, make_grid, make_obs, select, view_of

FLAT = view_of(make_grid(np.zeros((200, 200)), origin=(-20.0, -20.0)))
LAWN, WATER = D_LAND.index("lawn"), D_LAND.index("water")
MAPPED = LandingParams(semantics=SemanticMapParams(squares=2))


def _fly(check: SiteClassCheck, paint: Any, *places: tuple[float, float, float]) -> None:
    """Two seconds of images over each place (x, y, z)."""
    rig, tick = small_rig(), 0
    for place in places:
        pose = Pose(np.eye(3), np.array(place))
        for _ in range(20):
            tick += 60
            image = photograph(rig, pose, paint, tick / 600.0)
            check.update(make_obs(tick, images=(image,)), make_estimate(tick, pose), FLAT)


def test_views_add_up_in_log_odds() -> None:
    """0.8 for lawn is 24 times 0.2 / 6; half a view more makes 24^1.5, and more than one and a half
    count no more. Views that contradict one another leave both classes."""
    lawn = semantic_map.log_odds(chances(lawn=0.8))
    for views in (1.0, 1.5, 4.0):
        odds = 24.0 ** min(views, 1.5)
        (found,) = semantic_map.fused(views * lawn[None], np.array([views]), 1.5)
        assert found[LAWN] == pytest.approx(odds / (odds + 6.0))
    water = semantic_map.log_odds(chances(water=0.8))
    (both,) = semantic_map.fused((lawn + water)[None], np.array([2.0]), 1.5)
    assert both[LAWN] == pytest.approx(both[WATER]) and both[LAWN] > 0.3
    nothing = semantic_map.fused(np.zeros((1, 7)), np.zeros(1), 1.5)
    np.testing.assert_allclose(nothing, 1.0 / 7.0)


def test_reliability_falls_with_pixel_slant_and_darkness() -> None:
    check = SiteClassCheck(ByColour(), small_rig(), MAPPED)
    _fly(check, plain("lawn"), (0.0, 0.0, 15.0))
    seen = check.images.newest_view()
    assert seen is not None and seen.height_m == pytest.approx(15.0, abs=1.0)
    below, aside = seen.position - [0, 0, 10.0], seen.position - [5.0, 0, 10.0]
    far = seen.position - [0, 0, 2.0 * 0.12 / seen.pixel_rad]
    found = semantic_map.reliability(seen, np.array([below, aside, far]), SemanticMapParams())
    np.testing.assert_allclose(found, [1.0, 0.5, 0.5], rtol=1e-6)
    dim = dataclasses.replace(seen, dim=True)
    assert semantic_map.reliability(dim, below[None], SemanticMapParams()) == pytest.approx(0.5)
    before = np.array([seen.position, seen.position + [0.15 * seen.height_m, 0, 0], [np.nan] * 3])
    np.testing.assert_allclose(
        semantic_map.novelty(seen, before, 0.15), [0.0, 1.0 - np.exp(-1.0), 1.0], atol=1e-6
    )


def test_a_flight_maps_what_it_sees_and_sites_prefer_it() -> None:
    classifier = ByColour()
    check = SiteClassCheck(classifier, small_rig(), MAPPED)
    assert check.semantic_view() is None
    _fly(check, west_is_water, (0.0, 0.0, 30.0), (0.0, 6.0, 20.0))
    assert max(classifier.batches) == 2
    seen = check.semantic_view()
    assert seen is not None
    x = seen.origin_xy_m[0] + seen.spacing_m * np.arange(seen.weight.shape[1])
    chance, known = seen.probabilities, seen.weight > 0.1
    west, east = known & (x < -3.0), known & (x > 3.0)
    assert west.sum() > 10 and east.sum() > 10
    assert (chance[west].argmax(axis=1) == WATER).all()
    assert (chance[east].argmax(axis=1) == LAWN).all()
    assert chance[west, WATER].max() > 0.9 and chance[east, LAWN].max() > 0.9
    np.testing.assert_allclose(chance[seen.weight == 0.0], 1.0 / 7.0)
    estimate = make_estimate(0, Pose(np.eye(3), np.array([0.0, 0.0, 30.0])))
    chosen = select(FLAT, estimate, LandingParams(), semantics=seen)
    assert chosen.candidates[0].position_odom[0] > 3.0
    assert chosen.costmap is not None
    (layer,) = [term for term in chosen.costmap.terms if term.name == "ground"]
    row, col = 100, (200 * np.array([-5.0, 5.0]) / 40.0 + 100).astype(int)
    assert layer.quantity[row, col] == pytest.approx([0.0, 1.0], abs=0.2)
    np.testing.assert_allclose(layer.value, 0.3 * (layer.quantity - 1.0), atol=1e-6)


def test_a_site_is_judged_by_all_that_was_seen_of_it() -> None:
    """Views of 0.8 each are surer together than one; one of lawn does not undo several of water."""
    check = SiteClassCheck(ByColour(sure=0.8), small_rig(), MAPPED)
    _fly(check, plain("water"), (0.0, 0.0, 20.0), (0.0, 4.0, 20.0), (0.0, -4.0, 20.0))
    found = check.reclassify(None, np.zeros(3), FLAT, 6.0)
    assert found is not None and found.name == "water" and found.probability > 0.94
    (site,) = check.judge([site_at(0.0, 0.0)], FLAT)
    assert site.class_predicted == "water" and site.class_probability > 0.94
    assert check._semantics is not None
    chance = check._semantics.with_view(np.zeros(2), chances(lawn=0.8))
    assert chance[WATER] > chance[LAWN] > 0.05


def test_without_the_term_there_is_no_map() -> None:
    """As in the selector of Zou, Sun and Kong, and where no squares are classified."""
    for selector, squares in (("zou2024", 2), ("risk", 0)):
        params = LandingParams(selector=selector, semantics=SemanticMapParams(squares=squares))
        classifier = ByColour()
        check = SiteClassCheck(classifier, small_rig(), params)
        _fly(check, plain("lawn"), (0.0, 0.0, 30.0))
        assert check.semantic_view() is None and classifier.batches == []
