"""Workers of a campaign: a row for every run after any failure, and what it holds."""

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from touchdown.experiments.campaign.plan import load_plan
from touchdown.experiments.campaign.progress import Display
from touchdown.experiments.campaign.results_table import load_rows

from support.campaign_flights import attempts, axes, fly, make_plan

BEHAVIOURS = (
    "good", "prints", "is_lost", "raises", "raises_once", "segfaults", "is_killed_once", "grows",
    "maps", "litters",
)  # fmt: skip


@pytest.fixture(scope="module")
def faulty(tmp_path_factory: pytest.TempPathFactory, base_gb: float) -> tuple[Path, dict[str, Any]]:
    folder = tmp_path_factory.mktemp("faulty")
    text = axes(scene=["flat"], estimator=[f"fake:{name}" for name in BEHAVIOURS])
    limits = f"[limits]\nrun_timeout_s = 900\nmemory_gb = {base_gb + 0.25:.3f}\n"
    plan = make_plan(folder, text + limits)
    return folder / "out", fly(plan, folder / "out", jobs=2)


def row_of(directory: Path, behaviour: str) -> dict[str, Any]:
    return next(row for row in load_rows(directory) if row["estimator"] == f"fake:{behaviour}")


@pytest.mark.parametrize(("behaviour", "outcome", "flown", "reason"), [
    ("good", "COMPLETED", 1, ""), ("prints", "COMPLETED", 1, ""),
    ("is_lost", "DIVERGED", 2, ""),  # the second time for its recording
    ("raises", "CRASHED", 2, "RuntimeError: a wing came off"), ("raises_once", "COMPLETED", 2, ""),
    ("segfaults", "CRASHED", 2, "SIGSEGV"), ("is_killed_once", "COMPLETED", 2, ""),
    ("grows", "CRASHED", 1, "GB of memory"), ("maps", "COMPLETED", 1, ""),
    ("litters", "COMPLETED", 1, ""),
])  # fmt: skip
def test_every_run_has_a_row_after_any_failure(
    faulty: tuple[Path, dict[str, Any]], behaviour: str, outcome: str, flown: int, reason: str
) -> None:
    row = row_of(faulty[0], behaviour)
    assert row["outcome"] == outcome and reason in row["reason"]
    assert attempts(faulty[0])[row["run_id"]] == flown
    assert (faulty[0] / "runs" / row["run_id"]).exists() == (outcome != "CRASHED")


def test_a_worker_gives_back_what_a_run_took(
    faulty: tuple[Path, dict[str, Any]], base_gb: float
) -> None:
    after_mb = row_of(faulty[0], "litters")["worker_memory_mb"]
    assert after_mb == pytest.approx(1e3 * base_gb, abs=50.0)


def test_a_run_that_hangs_is_ended_at_its_limit(tmp_path: Path) -> None:
    text = axes(scene=["flat"], estimator=["fake:hangs"]) + "[limits]\nrun_timeout_s = 0.5\n"
    assert fly(make_plan(tmp_path, text), tmp_path / "out")["crashed"] == 1
    row = row_of(tmp_path / "out", "hangs")
    assert (row["outcome"], row["reason"]) == ("CRASHED", "took longer than 0.5 s")


def test_a_crash_keeps_its_traceback(faulty: tuple[Path, dict[str, Any]]) -> None:
    record = json.loads((faulty[0] / "failed" / "flat-fake.raises-s0.json").read_text())
    assert "in fly" in record["traceback"] and record["attempts"] == 2
    died = json.loads((faulty[0] / "failed" / "flat-fake.segfaults-s0.json").read_text())
    assert "campaign_fakes.py" in died["traceback"]


def test_only_unsuccessful_flights_are_recorded(faulty: tuple[Path, dict[str, Any]]) -> None:
    recorded = {path.parent.name for path in (faulty[0] / "runs").glob("*/flight.rrd")}
    assert recorded == {"flat-fake.is_lost-s0"}


def test_a_second_flight_for_a_recording_is_announced(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plan = make_plan(tmp_path, axes(scene=["flat"], estimator=["fake:good", "fake:is_lost"]))
    fly(plan, tmp_path / "out", watcher=Display())
    assert "to record what was unsuccessful: 1" in capsys.readouterr().err
    fly(plan, tmp_path / "out", watcher=Display())
    assert "once more" not in capsys.readouterr().err


def test_no_partial_files_remain(faulty: tuple[Path, dict[str, Any]]) -> None:
    assert not (faulty[0] / ".partial").exists()
    totals = faulty[1]
    assert (totals["finished"], totals["crashed"], totals["remaining"]) == (7, 3, 0)
    assert totals["flying"] == []
    fractions = totals["estimators"]["fake:good"]["stage_fraction"]
    assert sum(fractions.values()) == pytest.approx(1.0)
    # 1 ms of the world and 0.5 ms of the estimator in a loop of 2 ms.
    assert fractions["world"] == pytest.approx(2 * fractions["estimator"])
    assert fractions["rest"] == pytest.approx(fractions["estimator"])


def test_a_second_call_repeats_only_crashed_runs(
    faulty: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    out = tmp_path / "copy"
    shutil.copytree(faulty[0], out)
    (out / "attempts.log").write_text("")
    plan = load_plan(out / "campaign.toml", allow_code=True)
    keep = [run for run in plan.runs if "raises" in run.run_id or "good" in run.run_id]
    document = json.loads((out / "campaign.json").read_text())
    document["runs"] = [r for r in document["runs"] if r["run_id"] in {k.run_id for k in keep}]
    (out / "campaign.json").write_text(json.dumps(document))
    totals = fly(dataclasses.replace(plan, runs=tuple(keep)), out)
    assert attempts(out) == {"flat-fake.raises-s0": 2} and totals["crashed"] == 1
