"""`touchdown regress`: the verdict on made-up campaigns, and the command."""

import json
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from touchdown.experiments.errors import UsageError
from touchdown.experiments.reporting.regression.baseline import (
    baseline_of,
    cells_of,
    write_baseline,
)
from touchdown.experiments.reporting.regression.compare import (
    Comparison,
    compare,
    comparison_lines,
    verdict_sentences,
)

from support.command import Says

SCENES = ("crossroad", "lake", "houses", "forest")
METHODS = ("gps", "optical_flow", "hybrid_flow", "stereo", "zou2024", "livo")
Row = dict[str, Any]


def flight(scene: str, method: str, seed: int, error: float | None, **changes: Any) -> Row:
    row: Row = {
        "run_id": f"{scene}-{method}-s{seed}", "scene": scene, "estimator": method, "seed": seed,
        "wind_kmh": 12.0, "mode": "fly", "outcome": "COMPLETED",
        "config_sha": f"{scene}{method}{seed}", "git_revision": "abc",
        "position_error_m.mean": error,
    }  # fmt: skip
    return row | changes


def campaign(rng: np.random.Generator, seeds: range, spread: float = 0.35) -> list[Row]:
    """24 cells whose errors scatter by ``spread`` (of their logarithm) around their own level."""
    rows = []
    for level, (scene, method) in enumerate(product(SCENES, METHODS), start=1):
        errors = 0.02 * level * np.exp(rng.normal(0.0, spread, len(seeds)))
        rows += [flight(scene, method, s, float(e)) for s, e in zip(seeds, errors, strict=True)]
    return rows


def scaled(rows: list[Row], factor: Callable[[Row], float]) -> list[Row]:
    key = "position_error_m.mean"
    return [row | {key: row[key] * factor(row)} for row in rows]


def against(new: list[Row], old: list[Row], margin: float = 0.0) -> Comparison:
    return compare(new, baseline_of(old), margin)


def test_cells_are_of_one_variant() -> None:
    rows = [
        flight("lake", "livo", 1, 0.1, mode="land"),
        flight("lake", "livo", 1, 0.1, mode="land", preset="short"),
        flight("lake", "livo", 2, 0.1, preset="short", run_id="lake-livo-s2-short-w6"),
        flight("lake", "livo", 2, 0.1, preset="whole", run_id="lake-livo-s2-whole"),
        flight("lake", "livo", 1, 0.1, run_id="lake-livo-s1-w20"),
        flight("lake", "livo", 1, 0.3, run_id="a/x", mode="land", **{"parts.selector": "risk"}),
    ]
    variants = ["land", "land short", "short w6", "", "w20", "land risk"]
    assert [variant for *_, variant in cells_of(rows)] == variants
    with pytest.raises(UsageError, match="flown twice with seed 1"):
        cells_of([*rows, rows[0]])


def test_the_same_flights_are_no_regression() -> None:
    rows = campaign(np.random.default_rng(0), range(10))
    found = against(rows, rows)
    assert not found.regressed and len(found.cells) == 30
    assert {cell.ratio for cell in found.cells} == {1.0}
    assert {cell.p_adjusted for cell in found.cells} == {1.0}
    assert found.missing == found.added == found.newly_bad == found.warnings == []
    assert all(cell.at_most for cell in found.cells)
    assert verdict_sentences(found)[0] == "Nothing got worse beyond chance in 30 comparisons."
    exact = against(nothing := [flight("flat", "oracle", s, 0.0) for s in range(6)], nothing)
    assert not exact.regressed and exact.cells[0].ratio == 1.0, "no logarithm of zero"


def test_thirty_percent_on_equal_seeds_are_found_and_named() -> None:
    rows = campaign(np.random.default_rng(0), range(10))
    where = {"scene": "lake", "estimator": "livo"}
    worse = scaled(rows, lambda r: 1.3 if where.items() <= r.items() else 1.0)
    found = against(worse, rows)
    named = [cell for cell in found.cells if cell.worse]
    assert found.regressed
    assert [c.name for c in named] == ["lake, livo", "all scenes, livo"]
    assert named[0].ratio == pytest.approx(1.3) and named[0].p == 1 / 1024
    assert 24 / 1024 <= named[0].p_adjusted <= 30 / 1024
    assert verdict_sentences(found)[0].startswith("WORSE  lake, livo: position error ")
    assert "1.3 times" in verdict_sentences(found)[0]
    assert {line.split(" | ")[0] for line in comparison_lines(found)[2:4]} == {
        "| lake, livo",
        "| all scenes, livo",
    }
    assert not against(rows, worse).regressed, "better is not worse"


def test_thirty_percent_with_noise_in_every_scene_are_found_over_all_scenes() -> None:
    """Scatter of 0.3 between equal seeds hides 30 % in ten pairs, not in forty."""
    rng = np.random.default_rng(4)
    rows = campaign(rng, range(10))
    worse = scaled(
        rows, lambda r: (1.3 if r["estimator"] == "livo" else 1.0) * rng.lognormal(0, 0.3)
    )
    found = against(worse, rows)
    named = {tuple(cell.name.split(", ")) for cell in found.cells if cell.worse}
    assert ("all scenes", "livo") in named and {method for _, method in named} == {"livo"}
    assert len(named) < 5, "ten pairs do not show it everywhere"


@pytest.mark.parametrize(("seeds", "stream"), [(range(10, 20), 2), (range(10), 8)])
def test_chance_alone_passes_at_least_95_of_100_times(seeds: range, stream: int) -> None:
    """100 campaigns against 100 baselines: other seeds, and equal ones whose errors scatter anew,
    as after a change that changes nothing."""
    rng = np.random.default_rng(stream)
    pairs = ((campaign(rng, seeds), campaign(rng, range(10))) for _ in range(100))
    assert sum(against(*pair).regressed for pair in pairs) <= 5


def test_other_seeds_find_a_doubled_error() -> None:
    rng = np.random.default_rng(5)
    old, new = campaign(rng, range(10), 0.2), campaign(rng, range(10, 20), 0.2)
    worse = scaled(new, lambda r: 2.0 if r["scene"] == "forest" else 1.0)
    found = against(worse, old)
    named = {tuple(cell.name.split(", ")) for cell in found.cells if cell.worse}
    assert {cell.test for cell in found.cells} == {"unpaired"}
    assert named == {("forest", method) for method in METHODS}


def test_a_margin_asks_for_more() -> None:
    rows = campaign(np.random.default_rng(0), range(10))
    worse = scaled(rows, lambda r: 1.3)
    assert against(worse, rows, margin=0.25).regressed
    assert not against(worse, rows, margin=0.35).regressed
    assert not against(worse, rows, margin=0.3).regressed


def test_lost_flights_count() -> None:
    rows = campaign(np.random.default_rng(0), range(10))
    lost = [
        row | {"outcome": "DIVERGED"} if row["estimator"] == "gps" and row["seed"] < 5 else row
        for row in rows
    ]
    found = against(lost, rows)
    assert found.regressed and [o.name for o in found.outcomes if o.worse] == ["all scenes, gps"]
    assert len(found.newly_bad) == 20
    assert found.newly_bad[0] == "crossroad, gps, seed 0: COMPLETED before, DIVERGED now"
    one = [row | {"outcome": "DIVERGED"} if row is rows[7] else row for row in rows]
    again = against(one, rows)
    assert not again.regressed and len(again.newly_bad) == 1


@pytest.mark.parametrize("seeds", [range(1), range(2), range(5)])
def test_flights_that_never_took_off_are_worse_whatever_their_number(seeds: range) -> None:
    rows = [flight("lake", "livo", seed, 0.02) for seed in seeds]
    grounded = [row | {"outcome": "CRASHED", "position_error_m.mean": None} for row in rows]
    found = against(grounded, rows)
    assert found.regressed and found.failed() and found.warnings == []
    words = verdict_sentences(found)
    assert words[0].startswith("WORSE  lake, livo: no flight comes to a position error")
    assert words[-1].startswith("Nothing was compared: ")
    assert not any(line.startswith("Nothing got worse") for line in words)


def test_cells_that_lose_their_flights_are_worse_without_a_test() -> None:
    """3 of 5 is beyond half, 2 of 5 is for Fisher's test to judge."""
    rows = [flight("lake", m, seed, 0.02) for m in ("gps", "livo") for seed in range(5)]

    def lost(count: int) -> list[Row]:
        return [
            row | {"outcome": "GROUNDED", "position_error_m.mean": None}
            if row["estimator"] == "gps" and row["seed"] < count
            else row
            for row in rows
        ]

    assert against(lost(3), rows).vanished == [
        "lake, gps: 2 of 5 flights end as they should, 5 of 5 did in the baseline"
    ]
    assert not against(lost(2), rows).regressed
    others = [flight("lake", "livo", seed, None, outcome="GROUNDED") for seed in (7, 8)]
    assert against(others, rows).vanished == [
        "lake, livo: no flight comes to a position error, 5 of 5 did in the baseline"
    ]
    assert against(rows[:3], rows).vanished == [], "fewer seeds are no loss"


def test_one_estimator_in_one_scene_needs_five_equal_seeds() -> None:
    rows = [flight("lake", "livo", seed, 0.02 + 0.001 * seed) for seed in range(5)]
    four, five = against(rows[:4], rows[:4]), against(rows, rows)
    assert (four.blind, five.blind) == (["lake, livo"], [])
    assert (four.failed(), four.failed(require_power=True)) == (False, True)
    assert not five.failed(require_power=True)
    assert verdict_sentences(four)[-1] == (
        "No change could have been found in 1 of 1 comparison (lake, livo): one needs 5 equal "
        "seeds."
    )
    assert against(scaled(rows, lambda r: 3.0), rows).regressed
    assert not against(scaled(rows[:4], lambda r: 3.0), rows[:4]).regressed


def test_what_is_missing_is_named() -> None:
    rows = campaign(np.random.default_rng(0), range(10))
    some = [
        row
        for row in rows
        if row["scene"] != "lake" and not (row["estimator"] == "gps" and row["seed"] in (2, 7))
    ]
    found = against(some, rows)
    assert not found.regressed
    assert "lake, livo" in found.missing and "crossroad, gps: seed 2, 7" in found.missing
    assert against(rows, some).added == found.missing
    assert "missing: lake, livo" in verdict_sentences(found)
    assert any("configurations or the set of runs differ" in note for note in found.warnings)


def test_the_keys_of_another_configuration_are_named_with_both_values(tmp_path: Path) -> None:
    def flown(name: str, **values: Any) -> list[Row]:
        rows = [flight("lake", "livo", seed, 0.1, config_sha=name) for seed in range(3)]
        for row in rows:
            row["run_dir"] = str(tmp_path / name / str(row["seed"]))
            Path(row["run_dir"]).mkdir(parents=True)
            tree = {"seed": row["seed"], "record": name == "old", "wind": {"mean_kmh": 12}} | values
            (Path(row["run_dir"]) / "config.json").write_text(json.dumps(tree))
        return rows

    old = flown("old", light="day", preset="short")
    assert baseline_of(old).config == {"wind.mean_kmh": 12, "light": "day", "preset": "short"}
    (note,) = against(flown("new", light="night", preset="whole"), old).warnings
    assert note.startswith("configurations (light (day, now night), preset (short, now whole)) d")
    (note,) = against([row | {"config_sha": "x"} for row in old], old).warnings
    assert note.startswith("configurations or the set of runs differ")


def write_runs(directory: Path, factor: float = 1.0, seeds: range = range(10)) -> None:
    rng = np.random.default_rng(7)
    for seed in seeds:
        run = directory / f"lake-livo-{seed}"
        run.mkdir(parents=True)
        result = {
            "scene": "lake", "estimator": "livo", "seed": seed, "outcome": "COMPLETED",
            "wind_kmh": 12.0, "git_revision": "abc",
            "position_error_m": {"mean": factor * float(rng.lognormal(-4.0, 0.3))},
        }  # fmt: skip
        (run / "result.json").write_text(json.dumps(result))


def test_exit_codes(tmp_path: Path, says: Says) -> None:
    write_runs(tmp_path / "old")
    write_runs(tmp_path / "new", 1.3)
    base, old, new = (tmp_path / name for name in ("sub/base.json", "old", "new"))
    says(0, "regress", old, "--baseline", base, "--update")
    written = base.read_bytes()
    says(0, "regress", old, "--baseline", base)
    assert "WORSE  lake, livo" in says(1, "regress", new, "--baseline", base).out
    tree = json.loads(says(1, "regress", new, "--baseline", base, "--json").out)
    assert tree["regressed"] and tree["cells"][0]["ratio"] == pytest.approx(1.3)
    assert tree["cells"][0]["detectable"] > 1.0
    says(0, "regress", old, "--baseline", base, "--update")
    assert base.read_bytes() == written, "the same flights, the same file"
    assert [p.name for p in base.parent.iterdir()] == ["base.json"]


def test_exit_codes_where_nothing_could_be_found(tmp_path: Path, says: Says) -> None:
    for name, seeds, code, words in (
        ("one", range(1), 1, "Nothing was compared: "),
        ("four", range(4), 0, "No change could have been found in 1 of 1 "),
    ):
        write_runs(tmp_path / name, seeds=seeds)
        command = ["regress", tmp_path / name, "--baseline", tmp_path / "base.json"]
        says(0, *command, "--update")
        assert says(code, *command).out.splitlines()[-1].startswith(words)
        says(1, *command, "--require-power")


def one_flight(values: str, bad: str = "false") -> str:
    """A baseline of one flight."""
    cell = '"scene": "flat", "estimator": "gps", "variant": ""'
    return (
        '{"format": "touchdown-baseline-1", "git_revision": null, "config_sha": "", "cells": '
        f'[{{{cell}, "flights": [{{{values}, "outcome": "LANDED", "bad": {bad}}}]}}]}}'
    )


@pytest.mark.parametrize("margin", ["nan", "inf", "-0.1", "1e9"])
def test_a_margin_is_a_share(tmp_path: Path, says: Says, margin: str) -> None:
    arguments = ["regress", str(tmp_path), "--baseline", "b.json", "--margin", margin]
    assert "invalid value for '--margin'" in says(2, *arguments).err.lower()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "does not exist; write it with --update"),
        ("{", "is no baseline"),
        ("[]", "is no baseline"),
        ('{"format": "other"}', "format: Input should be 'touchdown-baseline-1'"),
        (
            '{"format": "touchdown-baseline-1", "git_revision": null, "config_sha": ""}',
            "cells: Field required",
        ),
        (one_flight('"seed": 0'), "0.figures: Field required"),
        (one_flight('"seed": 0, "figures": {"nees.mean": "0"}'), "nees.mean: Input should be a v"),
        (one_flight('"seed": 0, "figures": {"nees.mean": true}'), "nees.mean: Input should be a v"),
        (one_flight('"seed": 0, "figures": {"nees.mean": NaN}'), "nees.mean: Input should be"),
        (one_flight('"seed": "0", "figures": {}'), "0.seed: Input should be a valid integer"),
        (one_flight('"seed": 0, "figures": {}', bad="0"), "0.bad: Input should be a valid boolean"),
    ],
)
def test_bad_baselines_are_one_line(
    tmp_path: Path, says: Says, text: str | None, message: str
) -> None:
    write_runs(tmp_path / "old")
    base = tmp_path / "base.json"
    if text is not None:
        base.write_text(text)
        says(2, "regress", tmp_path / "old", "--baseline", base, "--update")
        assert base.read_text() == text, "a file that is no baseline is left alone"
    said = says(2, "regress", tmp_path / "old", "--baseline", base)
    assert said.out == "" and said.err.count("\n") == 1 and message in said.err


def test_nothing_in_common_is_an_error(tmp_path: Path, says: Says) -> None:
    write_runs(tmp_path / "old")
    write_baseline([flight("flat", "gps", 0, 1.0)], tmp_path / "base.json")
    command = ["regress", str(tmp_path / "old"), "--baseline", str(tmp_path / "base.json")]
    assert "no cell of these flights; it has flat, gps" in says(2, *command).err
