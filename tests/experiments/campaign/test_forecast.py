"""The cost of a campaign before it is flown."""

import json
from pathlib import Path
from typing import Any

import pytest

from touchdown.experiments.campaign.forecast import CORE_SECONDS, PROFILE_FACTOR, forecast
from touchdown.experiments.campaign.results_table import ROW_FILE, RUNS, write_table

from support.campaign_flights import axes, make_plan
from support.command import Says

FILE = """
name = "cost"
mode = "land"
[axes]
scene = ["crossroad", "lake"]
seeds = "0-1"
[axes.faults]
events = [[], ["fog@0"]]
[base]
survey.duration_s = %s
"""


def dry_run(file: Path, says: Says, *options: str) -> Any:
    return json.loads(says(0, "campaign", file, "--dry-run", "--json", *options).out)


def test_a_campaign_is_not_flown(tmp_path: Path, says: Says) -> None:
    """Eight landings of `livo` in `field`, at the stated cost of each."""
    file, out = tmp_path / "cost.toml", tmp_path / "out"
    file.write_text(FILE % "36.0")
    found = dry_run(file, says, "--out", str(out), "--jobs", "1")
    each = CORE_SECONDS["land", "livo"] * PROFILE_FACTOR["field"]
    assert (found["flights"], found["finished"], found["jobs"]) == (8, 0, 1)
    assert found["core_hours"] == pytest.approx(8 * each / 3600.0)
    assert found["wall_s"] == pytest.approx(8 * each)
    assert [(g["label"], g["flights"], g["measured"]) for g in found["groups"]] == [
        ("field, livo", 4, False), ("field, livo, fog@0", 4, False)
    ]  # fmt: skip
    assert found["undemanded"] == ["fog@0"] and not out.exists()
    assert dry_run(file, says, "--shard", "1/2")["flights"] < 8
    file.write_text(FILE % "117.0")  # 162 s of flight instead of 81
    assert dry_run(file, says, "--jobs", "1")["core_hours"] == pytest.approx(
        2.0 * found["core_hours"]
    )


def test_finished_rows_give_the_cost(tmp_path: Path) -> None:
    names = ["support.campaign_fakes:good", "support.campaign_fakes:is_lost"]
    plan = make_plan(tmp_path, axes(scene=["flat"], estimator=names, seeds="0-2"))
    run = tmp_path / "out" / RUNS / plan.runs[0].run_id
    run.mkdir(parents=True)
    row = {"run_id": run.name, "scene": "flat", "estimator": names[0], "seed": 0,
           "outcome": "COMPLETED", "cpu_s": 33.0}  # fmt: skip
    write_table([row], run / ROW_FILE)
    (run / "result.json").write_text("{}")
    found = forecast(plan, plan.runs, tmp_path / "out", 1)
    assert (found.flights, found.finished) == (6, 1)
    first, second = found.groups
    assert (first.measured, first.core_s, second.measured) == (True, 33.0, False)
    assert found.core_hours == pytest.approx((2 * 33.0 + 3 * second.core_s) / 3600.0)
    assert sorted(path.name for path in (tmp_path / "out").rglob("*")) == sorted(
        [RUNS, run.name, ROW_FILE, "result.json"]
    )
