"""What a network is given, which image a patch is taken from, and how evidence is weighed."""

from typing import Any

import numpy as np
import pytest

from touchdown.landing.api import GroundPrediction, LandingParams, SemanticMapParams
from touchdown.landing.classification import engine, site_check
from touchdown.landing.classification.labels import D_LAND
from touchdown.landing.classification.scores import probabilities
from touchdown.landing.classification.survey_images import SurveyImages
from touchdown.sim.frames import Pose

from support.ground_class_support import COLOURS, ByColour, photograph, plain, site_at, small_rig
from support.landing_support import make_estimate, make_grid, make_obs, select, view_of


def test_the_input_of_a_network_is_light_by_channel() -> None:
    images = np.zeros((2, 4, 4, 3), np.uint8)
    images[1, 2, 3] = (255, 51, 0)
    given = engine.as_input(images, 4)
    assert given.shape == (2, 3, 4, 4) and given.dtype == np.float32
    np.testing.assert_allclose(given[1, :, 2, 3], [1.0, 0.2, 0.0], rtol=1e-6)
    assert given.sum() == pytest.approx(1.2)


def test_softmax_by_hand_and_of_large_scores() -> None:
    scores = np.array([[0.0, np.log(3.0)], [1000.0, 1000.0 + np.log(4.0)]], np.float32)
    np.testing.assert_allclose(probabilities(scores), [[0.25, 0.75], [0.2, 0.8]], rtol=1e-4)


def pose_at(y: float, height: float) -> Pose:
    """Along the long side of the image."""
    return Pose(np.eye(3), np.array([0.0, y, height]))


def images_of(*views: tuple[float, float, str]) -> SurveyImages:
    """One image a second of plain ground: y, height, kind."""
    rig = small_rig()
    images = SurveyImages(rig, 8)
    for number, (y, height, name) in enumerate(views):
        tick = 600 * (number + 1)
        image = photograph(rig, pose_at(y, height), plain(name), number + 1.0)
        images.update(make_obs(tick, images=(image,)), make_estimate(tick, pose_at(y, height)))
    return images


def kind_of(patch: Any) -> str:
    mean = patch.mean(axis=(0, 1))
    return min(COLOURS, key=lambda name: float(np.abs(mean - COLOURS[name]).sum()))


@pytest.mark.parametrize(("views", "wanted"), [
    (((-6.0, 20.0, "road"), (0.5, 20.0, "lawn"), (7.0, 20.0, "water")), "lawn"),  # steepest
    (((0.0, 30.0, "road"), (0.0, 15.0, "lawn"), (0.0, 40.0, "water")), "lawn"),  # nearest
])  # fmt: skip
def test_a_patch_is_taken_from_the_steepest_and_nearest_view(views: Any, wanted: str) -> None:
    patch = images_of(*views).patch(np.zeros(3), 4.0, 16)
    assert patch is not None and kind_of(patch) == wanted


def test_newer_images_alone_where_they_are_asked_for() -> None:
    images = images_of((0.0, 15.0, "lawn"), (4.0, 15.0, "road"), (8.0, 15.0, "water"))
    for since_s, wanted in ((-np.inf, "lawn"), (1.5, "road"), (3.0, "water")):
        patch = images.patch(np.zeros(3), 4.0, 16, since_s)
        assert patch is not None and kind_of(patch) == wanted
    assert images.patch(np.zeros(3), 4.0, 16, 3.5) is None


def test_images_are_kept_a_fifth_of_their_height_apart_and_not_from_near_the_ground() -> None:
    views = (0.0, 2.6, "lawn"), (0.0, 20.0, "lawn"), (3.9, 20.0, "lawn"), (4.1, 20.0, "lawn")
    assert len(images_of(*views)) == 2


def test_pulses_count_in_the_square_around_the_site_alone() -> None:
    grid = make_grid(np.zeros((50, 50)), origin=(-5.0, -5.0))
    grid.missing[:] = 1.0
    grid.missing[25:27, 30:34] = 5.0
    site = np.array([1.4, 0.2, 0.0])
    missing, hits = site_check.pulses_around(view_of(grid), site, 0.3)
    assert (missing, hits) == (16.0 + 8 * 4.0, 16 * 40.0)
    corner = site_check.pulses_around(view_of(grid), np.array([-4.85, -4.85, 0.0]), 0.3)
    assert corner == (9.0, 9 * 40.0)


def test_evidence_keeps_a_distribution_and_counts_twenty_pulses_at_most() -> None:
    image = np.full(7, 1.0 / 7.0)
    for missing, hits, traffic in ((5.0, 5.0, False), (0.0, 9.0, True), (400.0, 600.0, True)):
        assert site_check.fuse_lidar_evidence(image, missing, hits, traffic).sum() == pytest.approx(
            1.0
        )
    few, many = (site_check.fuse_lidar_evidence(image, n, 9.0 * n, False) for n in (2.0, 2000.0))
    np.testing.assert_allclose(few, many)
    less = site_check.fuse_lidar_evidence(image, 1.0, 9.0, False)
    water = D_LAND.index("water")
    ratio = 15.0 * (0.85 / 0.99) ** 9
    assert less[water] == pytest.approx(ratio / (ratio + 6.0))


def test_zones_of_traffic_have_borders() -> None:
    view = view_of(make_grid(np.zeros((40, 60)), origin=(-4.0, -2.0)))
    chosen = select(view, make_estimate(0, pose_at(0, 9)), LandingParams())
    assert chosen.traffic_zone.shape == (40, 60)
    chosen.traffic_zone[:] = False
    chosen.traffic_zone[15, 40] = True
    for xy, inside in (((4.1, 1.1), True), ((1.1, 4.1), False), ((4.3, 1.1), False)):
        assert site_check.in_traffic_zone(chosen, np.array([*xy, 0.0])) is inside
    assert not site_check.in_traffic_zone(chosen, np.array([99.0, 1.0, 0.0]))


class Lawn(ByColour):
    """Sees lawn with 0.97, whatever it is shown."""

    def classify(self, images: Any) -> GroundPrediction:
        chance = np.full((len(images), 7), 0.005)
        chance[:, D_LAND.index("lawn")] = 0.97
        every = np.ones(len(images), np.bool_)
        return GroundPrediction(probabilities=chance, in_distribution=every)


def check_with(classifier: ByColour, *views: tuple[float, float, str]) -> site_check.SiteClassCheck:
    check = site_check.SiteClassCheck(
        classifier, small_rig(), LandingParams(semantics=SemanticMapParams(squares=0))
    )
    check.images = images_of(*views)
    return check


FLAT = view_of(make_grid(np.zeros((200, 200)), origin=(-20.0, -20.0)))


def test_the_second_look_prefers_images_of_the_last_four_seconds() -> None:
    """The old one is steeper; only the newest is recent."""
    check = check_with(ByColour(), (0.0, 20.0, "water"), (4.5, 20.0, "lawn"))
    near = check.reclassify(None, np.zeros(3), FLAT, 5.5)
    assert near is not None and near.name == "lawn"
    late = check.reclassify(None, np.zeros(3), FLAT, 60.0)  # none is recent: the steepest
    assert late is not None and late.name == "water"


def test_a_class_needs_the_known_ground_and_a_name_that_is_allowed() -> None:
    check = check_with(Lawn(), (0.0, 20.0, "lawn"))
    chance = np.full(7, 0.01)
    chance[D_LAND.index("lawn")] = 0.94
    assert check.refusal(site_check.SiteClass(chance, True), False) is None
    strange = check.refusal(site_check.SiteClass(chance, False), False)
    assert strange is not None and strange.rule == "unfamiliar_ground"
    chance[[D_LAND.index("lawn"), D_LAND.index("road")]] = (0.01, 0.94)
    unsafe = check.refusal(site_check.SiteClass(chance, True), False)
    assert unsafe is not None and unsafe.rule == "unsafe_ground"
    assert check.refusal(site_check.SiteClass(chance, True), True) is None
    (judged,) = check.judge([site_at(0.0, 0.0)], FLAT)
    assert judged.accepted and check.class_of(judged) is not None
