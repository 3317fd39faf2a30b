"""Directory of a campaign: its owner, and the rows read from it."""

import dataclasses
import os
import time
from pathlib import Path

import pytest

from touchdown.experiments.campaign.directory import locked, settle_plan
from touchdown.experiments.campaign.results_table import finished_ids, load_rows, table_of
from touchdown.experiments.campaign.session import summary
from touchdown.experiments.errors import UsageError

from support.campaign_flights import attempts, axes, fly, make_plan

TWO = axes(scene=["flat"], estimator=["fake:good"], seeds="0-1")


def test_two_campaigns_do_not_share_a_directory(tmp_path: Path) -> None:
    plan, out = make_plan(tmp_path, TWO), tmp_path / "out"
    with locked(out, None):
        with pytest.raises(UsageError, match=rf"being flown by .*process {os.getpid()} on"):
            fly(plan, out)
        with pytest.raises(UsageError, match="being flown"):
            fly(plan, out, shard=(1, 2))
    with locked(out, (1, 2)), locked(out, (2, 2)), pytest.raises(UsageError, match="being flown"):
        fly(plan, out, shard=(2, 2))
    assert fly(plan, out)["finished"] == 2


def test_a_directory_of_another_kind_is_unchanged(tmp_path: Path) -> None:
    plan = make_plan(tmp_path / "plan", TWO)
    (tmp_path / "thesis.tex").write_text("precious")
    with pytest.raises(UsageError, match="no campaign"):
        fly(plan, tmp_path)
    with pytest.raises(UsageError, match="is a file"):
        fly(plan, tmp_path / "thesis.tex")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["plan", "thesis.tex"]


def test_axes_may_grow_and_nothing_else_may_change(tmp_path: Path) -> None:
    out = tmp_path / "out"
    fly(make_plan(tmp_path, TWO), out)
    with pytest.raises(UsageError, match=r"survey.height_m of run flat-fake.good-s0 was 30.0 and"):
        fly(make_plan(tmp_path, TWO + "[base]\nsurvey.height_m = 20\n"), out)
    with pytest.raises(UsageError, match=r"its run flat-fake.good-s1 is not in this one"):
        fly(make_plan(tmp_path, TWO.replace("0-1", "0")), out)
    # A second wind lengthens the names of new runs only.
    grown = make_plan(tmp_path, TWO.replace("0-1", "0-2") + "wind_kmh = [12, 20]\n")
    assert fly(grown, out)["finished"] == 6 and attempts(out).most_common(1)[0][1] == 1
    assert finished_ids(out) == {
        "flat-fake.good-s0", "flat-fake.good-s1", "flat-fake.good-s2-w12",
        *(f"flat-fake.good-s{seed}-w20" for seed in range(3)),
    }  # fmt: skip
    # Limits and recording are not part of the identity of a run.
    fly(make_plan(tmp_path, "record = 'none'\n" + grown.text + "[limits]\nretries = 0\n"), out)


def test_a_full_disk_ends_the_campaign_in_one_line(tmp_path: Path) -> None:
    plan = make_plan(tmp_path, axes(scene=["flat"], estimator=["fake:fills_the_disk"]))
    remedy = "make room, then give the same command again"
    with pytest.raises(UsageError) as caught:
        fly(plan, tmp_path / "out")
    assert str(caught.value) == f"--out {tmp_path / 'out'}: No space left on device; {remedy}"
    assert summary(tmp_path / "out")["remaining"] == 1


def test_a_run_with_a_damaged_row_is_repeated(tmp_path: Path) -> None:
    plan, out = make_plan(tmp_path, TWO), tmp_path / "out"
    fly(plan, out)
    (out / "runs" / "flat-fake.good-s0" / "row.parquet").write_bytes(b"")
    assert fly(plan, out)["finished"] == 2
    assert attempts(out) == {"flat-fake.good-s0": 2, "flat-fake.good-s1": 1}


def test_the_session_in_progress_counts(tmp_path: Path) -> None:
    out = tmp_path / "out"
    plan = make_plan(tmp_path, TWO)
    fly(dataclasses.replace(plan, runs=plan.runs[:1]), out)
    settle_plan(plan, out, None)
    before = summary(out)
    assert (before["remaining"], before["left_s"]) == (1, None)
    row = load_rows(out)[0]
    with locked(out, None):
        os.utime(out / ".lock", (time.time() - 60.0,) * 2)
        (out / ".partial" / "flat-fake.good-s1.1").mkdir(parents=True)
        during = summary(out)
    assert 60.0 <= during["wall_s"] - before["wall_s"] < 90.0
    assert during["left_s"] == row["wall_s"]


def test_a_table_has_the_values_of_its_rows() -> None:
    row = {
        "run_id": '\u2028 "\x01\n\u00e9',
        "seed": -(2**63),
        "success": True,
        "wall_s": 0.1 + 0.2,
        "own.least": 5e-324,
        "own.most": -1.7976931348623157e308,
        "own.several": [1.0, -0.0, float("inf")],
        "own.words": ["a", {"b": None}],
    }
    made = table_of([row, {"run_id": "2", "seed": 3, "wall_s": float("inf"), "own.least": 2}])
    found = made.to_pylist()
    assert {key: found[0][key] for key in row} == row | {"own.words": '["a", {"b": null}]'}
    assert {key: v for key, v in found[1].items() if v is not None} == {
        "run_id": "2", "seed": 3, "own.least": 2.0,
    }  # fmt: skip
    assert table_of([]).to_pylist() == []
    assert table_of([]).schema == made.select(table_of([]).column_names).schema
