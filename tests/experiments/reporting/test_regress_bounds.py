"""`touchdown regress --bounds`: the bounds by hand, and the command."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from touchdown.experiments.errors import UsageError
from touchdown.experiments.reporting.regression import baseline, bounds

from support.command import Says

Row = dict[str, Any]
POSITION, NEES, SIGMA, SIGMA_Z, D_L, LEVEL = (figure.column for figure in baseline.FIGURES)
AGAIN = {"": 0.0, "-again_1": -0.2, "-again_2": 0.2}
"""logarithm of a figure over its level, by the end of the run's name: standard deviation 0.2"""


def landing(scene: str, seed: int, again: str = "", **changes: Any) -> Row:
    row: Row = {
        "run_id": f"{scene}-livo-s{seed}{again}", "scene": scene, "estimator": "livo", "seed": seed,
        "mode": "land", "preset": "short", "outcome": "LANDED", "landing.judged_on": "geometry",
        "landing.safe_geometry": True, "git_revision": "abc",
    }  # fmt: skip
    levels = {POSITION: 0.1, NEES: 3.0, SIGMA: 0.2, SIGMA_Z: 0.04, D_L: 0.2, LEVEL: 0.5}
    log = AGAIN[again] + 0.1 * seed
    return row | {key: level * math.exp(log) for key, level in levels.items()} | changes


def flights(**changes: float) -> list[Row]:
    """Three seeds of each of two scenes, with figures by column times ``changes``."""
    rows = [landing(scene, seed) for scene in ("a", "b") for seed in range(3)]
    return [row | {key: row[key] * factor for key, factor in changes.items()} for row in rows]


def repeated(**changes: float) -> list[Row]:
    """`flights` with two repetitions of each."""
    again = [landing(s, n, end) for end in list(AGAIN)[1:] for s in ("a", "b") for n in range(3)]
    rows = [row | {key: row[key] * factor for key, factor in changes.items()} for row in again]
    return [*rows, *flights(**changes)]


def against(rows: list[Row], old: list[Row]) -> bounds.BoundsVerdict:
    return bounds.check_bounds(rows, baseline.baseline_of(old))


def test_the_bound_follows_from_the_spread_of_repetitions() -> None:
    new = [row for row in flights() if row["seed"] < 2]
    found = against(new, repeated())
    assert not found.failed and len(found.figures) == 6 * 3
    one = next(f for f in found.figures if f.name.startswith("a,") and f.figure == "NEES")
    both = next(f for f in found.figures if f.name.startswith("all") and f.figure == "NEES")
    assert one.name == "a, livo (land short)"
    # twelve degrees of freedom: two repetitions of three seeds in each of two scenes
    quantile, power = stats.t.ppf([1.0 - 0.01 / 18, 0.8], 12)
    for figure, count in ((one, 2), (both, 4)):
        assert figure.flights == count and figure.spread == pytest.approx(0.2)
        assert figure.now == pytest.approx(figure.before) == pytest.approx(3.0 * math.exp(0.05))
        allowed = math.log(figure.maximum / figure.before)
        assert allowed == pytest.approx(quantile * 0.2 * math.sqrt(2.0 / count))
        seen = math.log(figure.sees)
        assert seen == pytest.approx((quantile + power) * 0.2 * math.sqrt(2.0 / count))


def test_a_change_is_seen_as_often_as_is_said() -> None:
    """Figures of repetitions scatter; the error of the new flights grows by what is seen."""
    rng, found = np.random.default_rng(1), 0
    for _ in range(RUNS := 200):
        old = [row | {POSITION: 0.1 * math.exp(0.03 * rng.standard_normal())} for row in repeated()]
        sees = next(
            f.sees for f in against(flights(), old).figures
            if f.name.startswith("all") and f.figure.startswith("position")
        )  # fmt: skip
        new = [
            row | {POSITION: 0.1 * sees * math.exp(0.03 * rng.standard_normal())}
            for row in flights()
        ]
        found += any(f.worse and f.name.startswith("all") for f in against(new, old).figures)
    assert 0.7 < found / RUNS < 0.9


@pytest.mark.parametrize("figure", baseline.FIGURES, ids=lambda figure: figure.title)
def test_each_figure_that_is_six_times_worse_is_named(figure: Any) -> None:
    found = against(flights(**{figure.column: 6.0}), repeated())
    assert {one.figure for one in found.figures if one.worse} == {figure.title}
    assert f"WORSE  a, livo (land short): {figure.title}" in "\n".join(bounds.bounds_lines(found))
    less = against(flights(), repeated(**{figure.column: 6.0}))
    assert less.failed == (figure.column in (SIGMA, SIGMA_Z)), (
        "less is worse for what is stated alone"
    )


def test_values_below_the_floor_do_not_decide() -> None:
    low = {D_L: 0.0001 / 0.2}
    assert not against(flights(**{D_L: 0.008 / 0.2}), repeated(**low)).failed
    with pytest.raises(UsageError, match="no spread"):
        against([landing("a", 0)], [landing("a", 0)])
    with pytest.raises(UsageError, match="its repetitions alone"):
        against(flights(), repeated()[:1])


@pytest.mark.parametrize(
    "changes",
    [{"outcome": "DIVERGED"}, {"landing.safe_geometry": False}, {D_L: None}],
    ids=["outcome", "unsafe", "figure"],
)
def test_a_flight_that_is_lost_fails(changes: Row) -> None:
    rows = flights()
    rows[0] |= changes
    found = against(rows, repeated())
    assert found.failed and len(found.lost) == 1 and found.lost[0].startswith("a, livo")


def test_flights_of_other_presets_and_seeds_are_not_compared() -> None:
    whole = [row | {"preset": "whole"} for row in flights()]
    other = [row | {"seed": 9, "run_id": "x9"} for row in flights()[:1]]
    for rows in (whole, other):
        with pytest.raises(UsageError, match="no flight of equal scene, method, preset and seed"):
            against(rows, repeated())


def test_the_command_flies_a_campaign_and_compares_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, says: Says
) -> None:
    flown: list[Row] = []
    plans = []

    def fly(plan: Any, directory: Path, *_: Any, **__: Any) -> None:
        plans.append((plan, directory))
        directory.mkdir(parents=True)

    base, file = tmp_path / "b.json", tmp_path / "c.toml"
    baseline.write_baseline(repeated(), base)
    file.write_text('name = "c"\nmode = "land"\n[axes]\nscene = ["crossroad"]\n')
    monkeypatch.setattr("touchdown.experiments.campaign.session.fly_campaign", fly)
    monkeypatch.setattr(
        "touchdown.experiments.reporting.flights.load_flights", lambda _: list(flown)
    )
    command = ["regress", file, "--baseline", base, "--bounds", "--preset", "short"]
    for factor, code in ((1.0, 0), (6.0, 1)):
        flown[:] = flights(**{NEES: factor})
        found = json.loads(says(code, *command, "--json").out)
        assert found["failed"] == bool(code)
        assert {f["figure"] for f in found["figures"] if f["worse"]} == (
            {"NEES"} if code else set()
        )
    plan, directory = plans[0]
    assert plan.runs[0].values["preset"] == "short" and not directory.exists()
    again = says(2, "regress", tmp_path, "--baseline", base, "--preset", "short")
    assert "is flown already" in again.err
