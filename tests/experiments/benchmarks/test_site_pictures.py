"""Figure of the steps of a selection, on a synthetic map."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from touchdown.experiments.benchmarks.selection import figures as site_figures
from touchdown.experiments.benchmarks.selection.figures import (
    figure_files,
    steps_figure,
    write_steps,
)
from touchdown.landing.api import LandingParams, Selection
from touchdown.landing.selection.selector import NOTHING_MAPPED, select_sites
from touchdown.sim.frames import Pose

from support.landing_support import make_estimate, make_grid, view_of
from support.worlds import load_ideal_config as load_config

PARAMS = LandingParams()
ABOVE = make_estimate(0, Pose(np.eye(3), np.array([9.0, 9.0, 30.0])))
RED, BLUE = (255, 45, 45), (47, 141, 255)


def selection_of(scorer: str = "risk") -> Selection:
    """Selection on a map level in the east, rough in the west, unseen in the far north."""
    height = np.zeros((120, 90))
    height[:, :40] = np.random.default_rng(2).uniform(0.0, 0.6, (120, 40))
    height[100:] = np.nan
    params = dataclasses.replace(PARAMS, scorer=scorer)  # type: ignore[arg-type]
    return select_sites(view_of(make_grid(height)), ABOVE, params, footprint_radius_m=0.5)


@pytest.fixture(scope="module")
def selection() -> Selection:
    return selection_of()


def drawn(image: np.ndarray, colour: tuple[int, int, int]) -> np.ndarray:
    """(N, 2) row, col of the pixels that have exactly a colour."""
    return np.argwhere((image == np.array(colour, np.uint8)).all(axis=2))


def test_candidates_are_blue_and_the_site_is_red_in_the_last_panel(selection: Selection) -> None:
    image = steps_figure(selection, "a garden", "risk")
    height, width, _ = image.shape
    assert width > height
    for colour in (RED, BLUE):
        pixels = drawn(image, colour)
        assert len(pixels) > 20
        assert pixels[:, 0].min() > 0.45 * height
        assert pixels[:, 1].min() > 0.60 * width


def test_no_red_where_nothing_was_accepted(selection: Selection) -> None:
    refused = dataclasses.replace(
        selection,
        candidates=tuple(dataclasses.replace(c, accepted=False) for c in selection.candidates),
    )
    image = steps_figure(refused, "no site", "risk")
    assert len(drawn(image, RED)) == 0
    assert len(drawn(image, BLUE)) > 20


def test_file_is_written_below_its_limit(selection: Selection, tmp_path: Path) -> None:
    config = load_config(None, [], scene="turf", seed=3)
    (file,) = figure_files([config], tmp_path / "deep" / "folder")
    assert file.name == "site_turf.jpg"
    write_steps(file, config, selection)
    assert 10_000 < file.stat().st_size <= site_figures.MOST_BYTES


def test_an_empty_map_gives_no_figure() -> None:
    with pytest.raises(ValueError, match="nothing was mapped"):
        steps_figure(NOTHING_MAPPED, "", "risk")
