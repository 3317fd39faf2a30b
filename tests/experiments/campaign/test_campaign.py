"""A campaign gives the same rows if killed, in shards or in parallel."""

import json
import os
import shutil
import signal
from pathlib import Path

import psutil
import pytest

from touchdown.experiments.campaign.directory import read_plan_file, write_plan_file
from touchdown.experiments.campaign.executor import LocalEngine
from touchdown.experiments.campaign.merging import merge
from touchdown.experiments.campaign.results_table import finished_ids, load_rows
from touchdown.experiments.campaign.session import fly_campaign, summary
from touchdown.experiments.errors import UsageError
from touchdown.experiments.reporting.sql import connect

from support.campaign_command import start
from support.campaign_flights import (
    MANY,
    attempts,
    axes,
    close_gate,
    figures,
    fly,
    flying_after,
    is_alive,
    make_plan,
    open_gate,
    start_campaign,
    wait_for,
)
from support.command import RunCli


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("undisturbed")
    fly(make_plan(folder, MANY), folder / "out", jobs=2)
    return folder / "out"


def test_a_killed_and_resumed_campaign_gives_the_same_rows(
    tmp_path: Path, undisturbed: Path
) -> None:
    plan, out = make_plan(tmp_path, MANY), tmp_path / "out"
    close_gate(out, 3)
    parent = start_campaign(tmp_path / "campaign.toml", out)
    workers = flying_after(out, 3)
    parent.kill()
    parent.wait()
    wait_for(lambda: not any(map(is_alive, workers)), "workers outlive their parent")
    open_gate(out)
    finished = finished_ids(out)
    before = attempts(out)
    assert 3 <= len(finished) < 8
    totals = fly(plan, out)
    again = attempts(out) - before
    # Finished flights are not repeated, except to record unsuccessful ones.
    assert all("is_lost" in run_id for run_id in again.keys() & finished)
    assert totals["remaining"] == 0 and not list(out.glob(".partial/*"))
    assert figures(out) == figures(undisturbed)
    recorded = {path.parent.name for path in out.glob("runs/*/flight.rrd")}
    assert recorded == {run.run_id for run in plan.runs if "is_lost" in run.run_id}
    before = attempts(out)
    fly(plan, out)
    assert attempts(out) == before


def test_a_worker_is_replaced_whether_it_or_its_guard_is_killed(
    tmp_path: Path, undisturbed: Path
) -> None:
    make_plan(tmp_path, MANY)
    out = tmp_path / "out"
    close_gate(out, 2)
    parent = start_campaign(tmp_path / "campaign.toml", out)
    os.kill(flying_after(out, 2)[0], signal.SIGKILL)
    close_gate(out, 5)  # the third was killed
    os.kill(psutil.Process(flying_after(out, 4)[0]).ppid(), signal.SIGKILL)
    open_gate(out)
    assert parent.wait() == 0 and figures(out) == figures(undisturbed)
    assert summary(out)["crashed"] == 0


def test_any_number_of_jobs_and_shards_gives_the_same_rows(
    tmp_path: Path, undisturbed: Path
) -> None:
    plan = make_plan(tmp_path, MANY)
    first = fly(plan, tmp_path / "out", shard=(1, 2))
    assert 0 < first["finished"] < 8 and fly(plan, tmp_path / "out", shard=(2, 2))["remaining"] == 0
    assert figures(tmp_path / "out") == figures(undisturbed)
    for path in (tmp_path / "out" / "runs").iterdir():
        other = undisturbed / "runs" / path.name
        assert (path / "result.json").read_bytes() == (other / "result.json").read_bytes()


def test_shards_that_were_flown_apart_are_merged(
    tmp_path: Path, undisturbed: Path, run_cli: RunCli
) -> None:
    plan, parts = make_plan(tmp_path, MANY), [tmp_path / "a", tmp_path / "b"]
    for index, part in enumerate(parts, start=1):
        fly(plan, part, shard=(index, 2))
    out = tmp_path / "out"
    status, text, _ = run_cli("merge", out, parts[0], "--json")
    assert status == 1 and json.loads(text)["remaining"] == len(finished_ids(parts[1])) > 0
    (marked := out / "runs" / min(finished_ids(out)) / "kept").touch()
    merged = merge(out, parts)
    assert merged["remaining"] == 0 and marked.exists(), "what is there is not copied again"
    assert figures(out) == figures(undisturbed) and finished_ids(parts[0]) < finished_ids(out)
    assert len(read_plan_file(out)["sessions"]) == 2 and fly(plan, out)["missing"] == []
    document = read_plan_file(parts[1])
    write_plan_file(parts[1], document | {"git_revision": "another"})
    assert run_cli("merge", out, *parts)[0] == 2
    with pytest.raises(UsageError, match="git_revision differ"):
        merge(tmp_path / "new", parts)
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_costs_no_finished_flight(number: int, tmp_path: Path, undisturbed: Path) -> None:
    plan, out = make_plan(tmp_path, MANY), tmp_path / "out"
    close_gate(out, 2)
    command = start("campaign", tmp_path / "campaign.toml", "--out", out, "--jobs", "2", "--quiet")
    workers = flying_after(out, 2)
    command.send_signal(number)
    _, err = command.communicate(timeout=600.0)
    assert command.returncode == 128 + number
    assert err.startswith("touchdown: stopped; ") and err.count("\n") == 1
    assert "the same command resumes" in err
    open_gate(out)
    assert not any(map(is_alive, workers)) and not list(out.glob(".partial/*"))
    document = json.loads((out / "campaign.json").read_text())
    assert document["finished_utc"] is None
    assert [session["jobs"] for session in document["sessions"]] == [2]
    kept = {file: file.stat().st_ino for file in out.glob("runs/*slow*/result.json")}
    assert fly(plan, out)["remaining"] == 0 and kept == {file: file.stat().st_ino for file in kept}
    assert figures(out) == figures(undisturbed)


def test_rows_with_missing_values_have_the_same_columns_and_types(undisturbed: Path) -> None:
    columns = dict(connect(undisturbed).execute("select column_name, column_type from "
                                                "(describe runs)").fetchall())  # fmt: skip
    assert columns["position_error_m.mean"] == "DOUBLE" and columns["landing.slope_deg"] == "DOUBLE"
    assert columns["landing.site_xy_m"] == "DOUBLE[]" and columns["landing.safe"] == "BOOLEAN"
    assert columns["seed"] == "BIGINT" and columns["versions.touchdown"] == "VARCHAR"
    row = load_rows(undisturbed)[0]
    assert row["run_id"] == "flat-fake.is_lost-s0"
    assert (row["mode"], row["wind_kmh"], row["git_revision"]) == ("fly", 12.0, "abc")
    # 0.1 + 0.001 * 12 km/h + 0.1 * 4 letters
    assert row["position_error_m.mean"] == pytest.approx(0.512)


def test_runs_flown_one_by_one_give_rows_too(undisturbed: Path, tmp_path: Path) -> None:
    shutil.copytree(undisturbed / "runs", tmp_path / "runs")
    rows = {row["run_id"]: row for row in load_rows(tmp_path)}
    assert len(rows) == 8
    for row in load_rows(undisturbed):
        other = rows[f"runs/{row['run_id']}"]
        for key in ("mode", "seed", "config_sha", "position_error_m.mean", "outcome"):
            assert other[key] == row[key]
    (tmp_path / "empty").mkdir()
    with pytest.raises(UsageError, match="no finished run"):
        load_rows(tmp_path / "empty")


@pytest.mark.slow
def test_real_flights_are_the_same_in_any_number_of_workers(tmp_path: Path) -> None:
    """One worker flies both methods in sequence, two fly them in parallel."""
    text = axes(scene=["crossroad"], estimator=["livo", "gps"], seeds="11")
    text += "[base.survey]\nheight_m = 12.0\nlegs = 1\nleg_length_m = 8.0\nduration_s = 5.0\n"
    plan = make_plan(tmp_path, text)
    for jobs in (1, 2):
        totals = fly_campaign(plan, tmp_path / f"out{jobs}", LocalEngine(jobs))
        assert totals["outcomes"] == {"COMPLETED": 2}
    assert figures(tmp_path / "out1") == figures(tmp_path / "out2")
    for run in plan.runs:
        one, two = (tmp_path / f"out{jobs}" / "runs" / run.run_id for jobs in (1, 2))
        for name in ("truth.tum", "estimate.tum", "reference.tum", "map.ply"):
            assert (one / name).read_bytes() == (two / name).read_bytes(), name
        results = [json.loads((path / "result.json").read_text()) for path in (one, two)]
        for result in results:
            del result["timing"]
        assert results[0] == results[1]
