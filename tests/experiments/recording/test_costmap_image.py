"""The picture of a choice: colours of the score, signs of the candidates, places of the ranks."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from touchdown.experiments.drawing import candidate_signs as signs
from touchdown.experiments.drawing.class_image import class_numbers
from touchdown.experiments.drawing.costmap_image import costmap_image, score_colours
from touchdown.landing.api import Candidate, CostmapView, Phase, ScoreTerm, SemanticView
from touchdown.scenes.api import LAND_CLASSES

from support.flight_fakes import make_view


def _costmap() -> CostmapView:
    """40 x 40 cells of 1 m: unknown west of 10, refused to 20, then accepted and rising."""
    value = np.tile(np.linspace(0.0, 1.0, 40, dtype=np.float32), (40, 1))
    value[:, :10] = np.nan
    return CostmapView(
        origin_xy_m=np.zeros(2), cell_m=1.0, total=value, flatness=value, smoothness=value,
        distance=value, rgb=np.full((40, 40, 3), 90, np.uint8), value=value,
        allowed=np.arange(40)[None].repeat(40, axis=0) >= 20,
    )  # fmt: skip


def _candidate(x: float, y: float, *, accepted: bool = True) -> Candidate:
    return Candidate(
        position_odom=np.array([x, y, 0.0]), normal_odom=np.array([0.0, 0.0, 1.0]), c_sum=0.5,
        slope_deg=1.0, roughness_m=0.0, clearance_m=2.0, accepted=accepted, reason="",
        rule="lower_value" if accepted else "water", value=0.9, step_m=0.02,
        terms=(ScoreTerm(name="room", value=0.9, quantity=2.0, unit="m"),),
    )  # fmt: skip


def test_colours_span_accepted_ground_and_refused_ground_is_grey() -> None:
    colours = score_colours(_costmap()).astype(int)
    best = cv2.applyColorMap(np.array([[255]], np.uint8), cv2.COLORMAP_VIRIDIS)[0, 0, ::-1]
    worst = cv2.applyColorMap(np.array([[0]], np.uint8), cv2.COLORMAP_VIRIDIS)[0, 0, ::-1]
    assert colours[5, 39].tolist() == best.tolist() and colours[5, 20].tolist() == worst.tolist()
    refused = colours[5, 10:20]
    assert (refused.max(axis=1) == refused.min(axis=1)).all() and (np.diff(refused[:, 0]) > 0).all()
    assert colours[5, 5].tolist() == [30, 32, 38]


@pytest.mark.parametrize("accepted", [True, False])
def test_a_ring_marks_accepted_sites_and_a_cross_refused_ones(accepted: bool) -> None:
    image = np.zeros((60, 60, 3), np.uint8)
    signs.draw_sign(image, (30, 30), _candidate(0.0, 0.0, accepted=accepted), 10)
    colour = signs.ACCEPTED_RGB if accepted else signs.REFUSED_RGB
    middle, side = image[30, 30].tolist(), image[30, 40].tolist()
    assert (middle == list(colour)) is not accepted  # a ring is open in the middle
    assert (side == list(colour)) is accepted


def test_image_shows_the_winner_beside_the_other_candidates() -> None:
    sites = (_candidate(30.0, 30.0), _candidate(25.0, 10.0), _candidate(15.0, 20.0, accepted=False))
    view = make_view(Phase.SELECT, costmap=_costmap(), candidates=sites)
    image = costmap_image(view, sites[0].position_odom)
    for rgb in (signs.CHOSEN_RGB, signs.ACCEPTED_RGB, signs.REFUSED_RGB):
        assert (image == rgb).all(axis=2).any()
    nobody = costmap_image(view, None)
    assert not (nobody == signs.CHOSEN_RGB).all(axis=2).any()
    with pytest.raises(ValueError, match="no costmap"):
        costmap_image(make_view(Phase.SELECT), None)


def test_semantic_map_is_drawn_where_it_lies() -> None:
    chance = np.full((5, 4, 7), 0.1 / 6, np.float32)
    chance[:, :2, LAND_CLASSES.index("water")] = 0.9  # nodes at x = 12 and 18
    chance[:, 2:, LAND_CLASSES.index("lawn")] = 0.9  # at 24 and 30
    chance[4] = 1 / 7  # at y = 29
    weight = np.ones((5, 4), np.float32)
    weight[0] = 0.0  # at y = 5
    semantics = SemanticView(
        origin_xy_m=np.array([12.0, 5.0]), spacing_m=6.0, probabilities=chance, weight=weight
    )
    # the seen part of the map begins at x = 2: what is unknown but for a margin of 8 m is left out
    found = class_numbers(replace(_costmap(), semantics=semantics))
    assert found.shape == (40, 38)
    unsure, unseen = len(LAND_CLASSES), len(LAND_CLASSES) + 1
    at = {(15, 13): "water", (15, 20): "water", (15, 21): "lawn", (15, 32): "lawn"}
    for (y, x), name in at.items():
        assert found[y, x - 2] == LAND_CLASSES.index(name), (y, x)
    assert found[29, 18] == unsure and found[5, 18] == unseen
    assert found[15, 6] == found[15, 36] == unseen, "unknown ground, and ground beyond the nodes"
    with pytest.raises(ValueError, match="no semantic map"):
        class_numbers(_costmap())
