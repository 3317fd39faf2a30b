"""Things of known size beside what a map flags."""

import numpy as np
import pytest

from touchdown.experiments.benchmarks.selection import hazards
from touchdown.experiments.benchmarks.selection.hazards import Things, compared, true_things
from touchdown.landing.api import LandingParams
from touchdown.sim.typing import Array

from support.landing_support import make_grid, raster_of

PARAMS = LandingParams()


def ground(slope_deg: float = 0.0) -> Array:
    """7 x 7 m in cells of 5 cm with a rock of 0.3 m in its middle, 0.2 m high, and a bump of 7 cm a
    metre east of it."""
    heights = np.tan(np.deg2rad(slope_deg)) * 0.05 * np.tile(np.arange(140.0), (140, 1))
    heights[67:73, 67:73] += 0.2
    heights[67:73, 87:93] += 0.07
    return heights


def rows(things: Things, *flagged: tuple[int, int]) -> list[tuple[str, bool]]:
    """What is found of a map of 0.1 m cells with such cells flagged."""
    raster = raster_of(make_grid(np.zeros((70, 70)), cell_m=0.1))
    flags = np.zeros(raster.shape, bool)
    for spot in flagged:
        flags[spot] = True
    found = compared(things, raster.origin_xy_m, raster, flags, PARAMS)
    return [(row["of"], row["hit"]) for row in found]


def test_rocks_are_found_missed_or_imagined() -> None:
    things = true_things(ground(), PARAMS)
    assert things.size_m == pytest.approx([0.34, 0.34], abs=0.01)
    assert things.rise_m == pytest.approx([0.2, 0.07], abs=0.01)
    assert rows(things) == [("recall", False)]
    assert rows(things, (35, 35)) == [("recall", True), ("precision", True)]
    assert rows(things, (35, 45)) == [("recall", False)]  # the bump is neither
    assert rows(things, (50, 35)) == [("recall", False), ("precision", False)]
    assert rows(things, (5, 35)) == [("recall", False)]  # too far to be judged


def test_a_ledge_is_a_right_find_although_nothing_stands_on_it() -> None:
    for high, hit in ((0.09, True), (0.06, False)):
        heights = np.zeros((140, 140))
        heights[70:] = high
        assert rows(true_things(heights, PARAMS), (35, 35)) == [("precision", hit)]


def test_what_stands_on_steep_ground_does_not_count() -> None:
    assert rows(true_things(ground(9.0), PARAMS), (35, 35)) == []


def test_a_curve_begins_with_its_figure_in_all(monkeypatch: pytest.MonkeyPatch) -> None:
    found = [
        {"of": "recall", "from": "10 m", "unit": f"place {n}", "size_m": size, "hit": hit}
        for n, (size, hit) in enumerate([(0.25, True), (0.25, False), (0.5, True), (0.5, True)])
    ]
    monkeypatch.setattr(hazards, "mapped", lambda *_: [found])
    levels = hazards.measure([], 4, 1, None)["levels"]
    assert [(row["size_m"], row["value"], row["count"]) for row in levels] == [
        ([0.1, 10.0], 0.75, 4), ([0.2, 0.3], 0.5, 2), ([0.45, 0.7], 1.0, 2),
    ]  # fmt: skip
