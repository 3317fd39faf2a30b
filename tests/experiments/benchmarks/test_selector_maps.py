"""Kept maps of surveys, and selectors judged on them: known answers on maps made by hand."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from touchdown.estimator.api import GridMap, MapView
from touchdown.experiments.benchmarks.posed_survey import true_estimate
from touchdown.experiments.benchmarks.selection import maps, sites
from touchdown.experiments.benchmarks.selection.curves import selector_curves
from touchdown.experiments.benchmarks.selection.maps import (
    KeptMap,
    SafeGround,
    map_files,
    read_map,
    write_map,
)
from touchdown.experiments.errors import UsageError
from touchdown.sim.frames import Pose

from support.command import Says
from support.landing_support import make_rig

CELL = 0.2
PICKS = """
import numpy as np
from touchdown.landing import api

class Picks:
    def __init__(self, params):
        self.x, self.states = params["x"], params.get("states", False)
    def select(self, seen):
        grid = seen.map_view.coarse
        east = grid.origin_xy_m[0] + (np.arange(grid.count.shape[1]) + 0.5) * grid.cell_m
        value = np.where(grid.count > 0, 0.0, np.nan) - np.abs(east - self.x)
        layers = [api.TermLayer(name="near", value=value, quantity=value)]
        if self.states:
            chance = np.where(east < self.x, 0.9, 0.2) + 0.0 * value
            layers.append(api.TermLayer(name="probability", value=chance, quantity=chance))
        terms = tuple(api.ScoreTerm(name=layer.name, value=0.0) for layer in layers)
        site = api.Site(position_odom=np.array([self.x, 0.1]), terms=terms)
        return api.RankedSites(sites=(site,), layers=tuple(layers))

def build(params, rig):
    return Picks(params)
"""


@pytest.fixture
def kept() -> KeptMap:
    """20 m x 20 m of level ground, all of it seen but for one column; by the truth it is
    safe up to 4 m east."""
    shape = (100, 100)
    zeros = np.zeros(shape, dtype=np.float32)
    grid = GridMap(
        origin_xy_m=np.array([-10.0, -10.0]), cell_m=CELL, count=zeros + 5.0, height_m=zeros + 0.25,
        height_std_m=zeros + 0.012, min_height_m=zeros - 0.5, max_height_m=zeros + 0.5,
        rgb=np.full((*shape, 3), 90.0, dtype=np.float32), intensity=zeros + 30.0,
        missing=zeros, last_seen_s=zeros + 7.5,
    )  # fmt: skip
    for layer in (grid.height_m, grid.height_std_m, grid.rgb):
        layer[:, 20] = np.nan
    grid.count[:, 20] = 0.0
    safe = np.zeros((200, 200), dtype=bool)
    safe[:, :140] = True
    return KeptMap(
        scene="crossroad", seed=4, profile="field", revision="abc",
        map_view=MapView(version=1, coarse=grid, fine=None),
        estimate=true_estimate(960, 1.0, Pose(np.eye(3), np.array([0.0, 0.0, 30.0]))),
        vehicle=make_rig().vehicle,
        truth=SafeGround(origin_xy_m=np.array([-10.0, -10.0]), cell_m=0.1, safe=safe),
    )  # fmt: skip


def test_a_map_is_read_as_it_was_written(kept: KeptMap, tmp_path: Path) -> None:
    file = write_map(kept, tmp_path)
    assert file.name == "crossroad-4.map.npz" and map_files(tmp_path) == [file]
    again = read_map(file)
    for field in dataclasses.fields(GridMap):
        ours, theirs = (getattr(m.map_view.coarse, field.name) for m in (kept, again))
        if ours is not None:
            np.testing.assert_allclose(theirs, ours, atol=5e-4)
    np.testing.assert_array_equal(again.truth.safe, kept.truth.safe)
    np.testing.assert_array_equal(again.vehicle.rotor_xy_m, kept.vehicle.rotor_xy_m)
    assert again.vehicle.mass_kg == kept.vehicle.mass_kg
    assert (again.scene, again.seed, again.profile, again.revision) == (
        "crossroad", 4, "field", "abc",
    )  # fmt: skip
    assert again.estimate.odom_from_body.translation.tolist() == [0.0, 0.0, 30.0]


def test_maps_are_made_at_each_value_of_a_dial(
    kept: KeptMap, tmp_path: Path, says: Says, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = []

    def make(config: Any, dials: dict[str, float]) -> KeptMap:
        made.append((config.seed, config.wind.mean_kmh))
        return dataclasses.replace(kept, seed=config.seed, dials=dials)

    monkeypatch.setattr(sites, "make_map", make)
    dial = ("--dial", "wind.mean_kmh=0:20:3", "--out", tmp_path, "--json")
    files = json.loads(says(0, "maps", "make", "crossroad", "--seeds", "9000-9001", *dial).out)
    assert made == [(seed, wind) for seed in (9000, 9001) for wind in (0.0, 10.0, 20.0)]
    assert files["maps"][1].endswith("crossroad-9000-wind.mean_kmh=10.map.npz")
    assert read_map(Path(files["maps"][1])).dials == {"wind.mean_kmh": 10.0}
    for wrong in ("wind.mean_kmh", "wind.mean_kmh=0:20", "wind.mean_kmh=0:20:1"):
        err = says(2, "maps", "make", "crossroad", "--dial", wrong, "--out", tmp_path).err
        assert "is no KEY=FROM:TO:STEPS" in err


def test_a_selector_that_is_worse_ends_earlier_along_the_dial() -> None:
    rng = np.random.default_rng(5)

    def choices(half_at: float) -> list[dict[str, Any]]:
        return [
            {"scene": "rugged", "seed": seed, "dials": {"rugged.slope_deg": slope},
             "chosen_safe": safe if safe or seed % 2 else None,
             "cells": {"safe": 100 * (seed > 9), "allowed": 50, "both": 40 - slope}}
            for seed in range(40) for slope in (0.0, 5.0, 10.0, 15.0, 20.0)
            for safe in [bool(rng.random() < 1.0 / (1.0 + np.exp(0.6 * (slope - half_at))))]
        ]  # fmt: skip

    told, picture = selector_curves({"good": choices(14.0), "bad": choices(6.0)})[
        "rugged.slope_deg"
    ]
    assert told["good"]["safe_0.5"]["value"] == pytest.approx(14.0, abs=1.5)
    assert any("`good` falls to 50 % safe later than `bad`" in line for line in told["words"])
    steep = told["bad"]["levels"]["20"]
    assert steep["missed"]["value"] == pytest.approx(15 / 40, abs=0.03)
    assert steep["precision"]["value"] == pytest.approx(0.4)
    assert steep["recall"]["value"] == pytest.approx(0.2)
    assert picture.name == "curve_rugged_slope_deg" and "<svg" in picture.svg


@pytest.mark.parametrize(("x", "safe", "clearance"), [(0.1, True, 3.0), (2.5, True, 1.5),
                                                      (6.0, False, 0.0)])  # fmt: skip
def test_a_choice_is_judged_by_the_true_ground(
    x: float, safe: bool, clearance: float, kept: KeptMap, tmp_path: Path, says: Says,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    (tmp_path / "picks.py").write_text(PICKS)
    monkeypatch.syspath_prepend(tmp_path)
    write_map(kept, tmp_path)
    found = _json(says, "bench", "selector", "--maps", tmp_path, "--selector", "picks:build",
                  "--set", f"external.selector.x={x}", "--pictures", tmp_path / "worst",
                  "--worst", "1")  # fmt: skip
    (place,), total = found["places"], found["summary"]
    assert place["chosen_safe"] is safe and place["clearance_m"] == pytest.approx(
        clearance, abs=0.11
    )
    assert total["precision"] == float(safe) and place["best_clearance_m"] == 3.0
    assert total["regret_m"] == pytest.approx(3.0 - clearance, abs=0.11)
    assert place["cells"]["safe"] == 69 * 100
    assert total["calibration_error"] is None and total["ms"] > 0.0
    assert found["beside"].keys() == {"risk", "zou2024"}
    assert [file.name for file in (tmp_path / "worst").iterdir()] == ["site_crossroad.jpg"]


def test_stated_probabilities_are_drawn_beside_the_truth(
    kept: KeptMap, tmp_path: Path, says: Says, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A selector that states 0.9 up to 4 m east, where ground is safe, and 0.2 beyond."""
    (tmp_path / "picks.py").write_text(PICKS)
    monkeypatch.syspath_prepend(tmp_path)
    write_map(kept, tmp_path)
    sets = ("--set", "external.selector.x=4.0", "--set", "external.selector.states=true")
    found = _json(says, "bench", "selector", "--maps", tmp_path, "--selector", "picks:build",
                  "--curves", tmp_path, *sets)  # fmt: skip
    (low, unsafe, _), (high, safe, _) = found["summary"]["reliability"]
    assert (low, unsafe, high, safe) == pytest.approx((0.2, 0.0, 0.9, 1.0))
    assert 0.1 < found["summary"]["calibration_error"] < 0.2
    shipped = found["beside"]
    assert shipped["zou2024"]["reliability"] == shipped["risk"]["reliability"]
    assert shipped["risk"]["calibration_error_allowed"] < 0.5
    drawn = (tmp_path / "reliability.svg").read_text()
    assert all(name in drawn for name in ("picks:build", "risk", "stated probability"))


def test_no_site_is_right_where_no_ground_is_safe() -> None:
    cells = {"safe": 0, "allowed": 5, "both": 0}
    places = [
        {"chosen_safe": False if accepted else None, "accepted": accepted, "accepted_safe": 0,
         "cells": cells, "clearance_m": 0.0, "best_clearance_m": best, "seconds": 0.0,
         "barren_accepted": barren, "sample": None}
        for accepted, best, barren in (
            (2, 0.0, 2), (0, 0.0, 0), (0, 1.0, 0), (1, 2.0, 0), (1, 2.0, None),
        )
    ]  # fmt: skip
    total = sites.summary(places)
    assert (total["refused"], total["barren"]) == (0.75, 4)
    assert (total["found"], total["regret_m"]) == (2 / 3, pytest.approx(5 / 3))
    figures = {"selector": "risk", "summary": total}
    head, row = sites.text(figures).splitlines()[:2]
    assert row[: head.index("  regret m")].endswith("75.0%")


def test_the_largest_square_without_safe_ground_is_a_map_without_a_site(kept: KeptMap) -> None:
    """Safe are a strip in the west, 2 m wide, and one cell 7 m east of it."""
    kept.truth.safe[:] = False
    kept.truth.safe[:, :20] = True
    kept.truth.safe[100, 90] = True
    part = maps.without_safe_ground(kept)
    assert part is not None
    coarse = part.map_view.coarse
    low, high = coarse.origin_xy_m, coarse.origin_xy_m + CELL * np.array(coarse.count.shape[::-1])
    assert low[0] >= -0.9 - 1e-9 and (high <= 10.0 + 1e-9).all()
    assert (high - low) == pytest.approx([10.8, 10.8], abs=0.41)
    (place,) = [sites.check_map(kept, sites.config_of("field", "risk", (), "crossroad", 4))]
    assert place["accepted_safe"] < place["accepted"] and place["barren_accepted"] > 0
    kept.map_view.coarse.count[:, 55:65] = 0.0
    assert maps.without_safe_ground(kept) is None
    kept.truth.safe[::90] = True
    assert maps.without_safe_ground(kept) is None


def test_sites_beyond_the_judged_ground_do_not_count(kept: KeptMap) -> None:
    small = dataclasses.replace(kept.truth, safe=kept.truth.safe[:50, :50])
    config = sites.config_of("field", "risk", (), "crossroad", 4)
    found = sites.check_map(dataclasses.replace(kept, truth=small), config)
    assert found["accepted"] == found["accepted_safe"] < 6


def _json(says: Says, *arguments: Any) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(says(0, *arguments, "--json").out)
    return found


def test_wrong_maps_are_one_line(kept: KeptMap, tmp_path: Path, says: Says) -> None:
    err = says(2, "bench", "selector", "--maps", tmp_path).err
    assert "holds no map; make some by `touchdown maps make" in err
    file = write_map(kept, tmp_path)
    whole = file.read_bytes()
    for content in (b"", b"PK", whole[: len(whole) // 2]):
        file.write_bytes(content)
        with pytest.raises(UsageError, match="is no map of `touchdown maps make`"):
            read_map(file)
    np.savez(file.with_suffix(""), about=np.array('{"version": 9}'))
    with pytest.raises(UsageError, match="no map"):
        read_map(file)
    assert "exclude each other" in says(2, "bench", "selector", "flat", "--maps", tmp_path).err


def test_each_survey_is_judged_as_soon_as_it_is_made(
    kept: KeptMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two places of one name: all of the first is safe, nothing of the second."""
    grounds, events = iter((True, False)), []

    def make(_config: Any) -> KeptMap:
        events.append("made")
        safe = np.full_like(kept.truth.safe, next(grounds))
        return dataclasses.replace(kept, truth=dataclasses.replace(kept.truth, safe=safe))

    monkeypatch.setattr(sites, "make_map", make)
    found = sites.run(sites.Posed(("crossroad", "crossroad"), "4"), ["risk"],
                      report=lambda _place: events.append("judged"))  # fmt: skip
    assert [place["cells"]["safe"] > 0 for place in found["places"]] == [True, False]
    assert events == ["made", "judged"] * 2


def test_a_survey_is_kept_with_its_true_ground(tmp_path: Path, says: Says) -> None:
    short = ("survey.legs=1", "survey.leg_length_m=8", "survey.duration_s=5", "survey.height_m=12")
    sets = [part for one in short for part in ("--set", one)]
    says(0, "maps", "make", "crossroad", "--seeds", "0", "--out", tmp_path, *sets)
    kept = read_map(tmp_path / "crossroad-0.map.npz")
    grid = kept.map_view.coarse
    assert 0.2 < (grid.count > 0).mean() < 1.0 and grid.histogram is not None
    assert 0.2 < kept.truth.safe.mean() < 1.0
    found = _json(says, "bench", "selector", "--maps", tmp_path, *sets)
    assert found["summary"]["precision"] == 1.0 and found["selector"] == "risk"
