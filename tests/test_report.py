"""The table over finished runs."""

import json
from pathlib import Path

import pytest

from experiments.config import UsageError
from experiments.report import LANDING_COLUMNS, load_runs, lookup, markdown_table, summary


def write_run(directory: Path, seed: int, **changes: object) -> None:
    directory.mkdir(parents=True)
    row = {
        "scene": "crossroad",
        "estimator": "livo",
        "seed": seed,
        "outcome": "LANDED",
        "position_error_m": {"mean": 0.1 * seed},
        "landing": {"safe_geometry": True, "target_offset_m": 0.05},
    }
    (directory / "result.json").write_text(json.dumps(row | changes))


def test_runs_are_found_sorted_and_summed_up(tmp_path: Path) -> None:
    write_run(tmp_path / "b", 2)
    write_run(tmp_path / "a" / "deep", 1, landing={"safe_geometry": False})
    write_run(tmp_path / "c", 3, outcome="NO_SITE", landing=None)
    rows = load_runs(tmp_path)
    assert [row["seed"] for row in rows] == [1, 2, 3]
    totals = summary(rows)
    assert totals["outcomes"] == {"LANDED": 2, "NO_SITE": 1}
    assert totals["unsafe_touchdowns"] == 1
    assert totals["means"]["position_error_m.mean"] == pytest.approx(0.2)
    table = markdown_table(rows, LANDING_COLUMNS).splitlines()
    assert len(table) == 5
    assert "| crossroad | livo | 3 | NO_SITE | 0.300 | – |" in table[4]
    assert "tilt" not in table[0]


def test_lookup_of_a_missing_branch() -> None:
    assert lookup({"a": None}, "a.b") is None


def test_mistakes_are_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no directory"):
        load_runs(tmp_path / "none")
    with pytest.raises(UsageError, match="no finished run"):
        load_runs(tmp_path)
    (tmp_path / "result.json").write_text("{}")
    with pytest.raises(UsageError, match="estimator, outcome, scene, seed missing"):
        load_runs(tmp_path)
