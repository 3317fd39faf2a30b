"""The picture of a choice: colours of the score, signs of the candidates, places of the ranks."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib import colormaps
from matplotlib.colors import to_rgb

from touchdown.experiments.drawing import costmap_image as drawing
from touchdown.experiments.drawing.class_image import CLASS_RGB, class_numbers, write_classes
from touchdown.experiments.drawing.costmap_image import costmap_image, fitted
from touchdown.experiments.drawing.map_images import survey_marks
from touchdown.experiments.drawing.style import pixels_of
from touchdown.experiments.io.images import read_picture
from touchdown.landing.api import (
    Candidate,
    CostmapView,
    Decision,
    Phase,
    ScoreTerm,
    SemanticView,
    SurveyParams,
)
from touchdown.scenes.api import LAND_CLASSES
from touchdown.sim.frames import Pose

from support.flight_fakes import make_view

viridis = colormaps["viridis"]


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
        position_odom=np.array([x, y, 0.0]), c_sum=0.5,
        slope_deg=1.0, roughness_m=0.0, clearance_m=2.0, accepted=accepted, reason="",
        rule="lower_value" if accepted else "water", value=0.9, step_m=0.02,
        terms=(ScoreTerm(name="clearance", value=0.9, quantity=2.0, unit="m"),),
    )  # fmt: skip


def _has(image: np.ndarray, colour: Any) -> bool:
    """True where a pixel is of ``colour``, a name or numbers from 0 to 1, but for rounding."""
    rgb = 255.0 * np.array(to_rgb(colour))
    return bool((np.abs(image - rgb).max(axis=2) <= 1.0).any())


def test_a_picture_fits_the_middle_of_another_size() -> None:
    wide = np.full((10, 40, 3), 200, np.uint8)
    wide[4:6, 10:30] = 7
    page = fitted(wide, (20, 20))
    assert page.shape == (20, 20, 3) and (page[0] == 200).all() and (page[-1] == 200).all()
    assert (page[9, 6:14] == 7).all(), "the middle stays in the middle"
    assert np.array_equal(fitted(wide, (10, 40)), wide)


def test_image_shows_score_and_winner_beside_the_other_candidates() -> None:
    sites = (_candidate(30.0, 30.0), _candidate(25.0, 10.0), _candidate(15.0, 20.0, accepted=False))
    view = make_view(Phase.SELECT, costmap=_costmap(), candidates=sites)
    image = costmap_image(view, sites[0].position_odom)
    for colour in (drawing.CHOSEN, drawing.ACCEPTED, drawing.REFUSED):
        assert _has(image, colour)
    nobody = costmap_image(view, None)
    assert not _has(nobody, drawing.CHOSEN)
    right = nobody[:, nobody.shape[1] // 2 :]
    for fraction in (0.0, 0.5, 1.0):
        assert _has(right, viridis(fraction)), "accepted ground"
    assert _has(right, "black") and _has(right, np.array(drawing.UNKNOWN_RGB) / 255.0)
    with pytest.raises(ValueError, match="no costmap"):
        costmap_image(make_view(Phase.SELECT), None)


def test_pictures_of_a_flight_have_a_table_of_the_choice(tmp_path: Path) -> None:
    sites = (_candidate(30.0, 30.0), _candidate(15.0, 20.0, accepted=False))
    decision = Decision(
        time_s=1.0, selector="risk", candidates=sites, positions_world=np.zeros((2, 3)),
        why="all is well " * 30,
    )  # fmt: skip
    view = make_view(Phase.SELECT, costmap=_costmap(), candidates=sites, decisions=(decision,))
    marks = survey_marks(np.array([20.0, 20.0]), 0.5, SurveyParams())
    drawing.write_costmap(tmp_path / "c.png", view, np.zeros(3), Pose.identity(), marks)
    assert read_picture(tmp_path / "c.png").shape[0] > costmap_image(view, np.zeros(3)).shape[0]
    figure = drawing._figure(view, np.zeros(3), Pose.identity(), marks)
    pixels_of(figure)
    lines = drawing._table(decision)
    for axes in figure.axes:  # between the table and the upper edge
        box = axes.get_position()
        assert drawing._ROW_IN * len(lines) / figure.get_figheight() < box.y0 < box.y1 < 1.0
    assert " ".join(lines[-3].split()) == "score = clearance ground slope, step, clearance rule"
    assert lines[-1].split("  ")[:3] == ["2", "0.900", "0.900 (2.0 m)"]
    assert lines[-2].endswith("1.0 deg, 0.02 m, 2.0 m  lower value")


def test_semantic_map_is_drawn_where_it_lies(tmp_path: Path) -> None:
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
    marks = survey_marks(np.array([20.0, 20.0]), 0.5, SurveyParams())
    costmap = replace(_costmap(), semantics=semantics)
    write_classes(tmp_path / "classes.png", costmap, Pose.identity(), marks)
    water = (0.5 * np.array([90, 90, 90]) + 0.5 * np.array(CLASS_RGB["water"])) / 255.0
    assert _has(read_picture(tmp_path / "classes.png"), water)
    with pytest.raises(ValueError, match="no semantic map"):
        class_numbers(_costmap())
