"""A campaign gives the same rows if killed, in shards, on Ray or in parallel."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from touchdown.experiments.campaign.results_table import finished_ids
from touchdown.experiments.campaign.session import fly_campaign, make_engine, summary
from touchdown.experiments.errors import UsageError

from support.campaign_flights import (
    MANY,
    RUNNER,
    attempts,
    axes,
    figures,
    fly,
    flying_after,
    is_alive,
    make_plan,
    start_campaign,
    wait_for,
)
from support.ray_fake import FakeRay


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("undisturbed")
    fly(make_plan(folder, MANY), folder / "out", jobs=2)
    return folder / "out"


def test_a_killed_and_resumed_campaign_gives_the_same_rows(
    tmp_path: Path, undisturbed: Path
) -> None:
    plan, out = make_plan(tmp_path, MANY), tmp_path / "out"
    parent = start_campaign(tmp_path / "campaign.toml", out)
    workers = flying_after(out, 4)
    parent.kill()
    parent.wait()
    wait_for(lambda: not any(map(is_alive, workers)), "workers outlive their parent")
    finished = finished_ids(out)
    before = attempts(out)
    assert 4 <= len(finished) < 12
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
    parent = start_campaign(tmp_path / "campaign.toml", out)
    os.kill(flying_after(out, 2)[0], signal.SIGKILL)
    os.kill(psutil.Process(flying_after(out, 6)[0]).ppid(), signal.SIGKILL)
    assert parent.wait() == 0
    assert figures(out) == figures(undisturbed)
    assert summary(out)["crashed"] == 0


def test_any_number_of_jobs_and_shards_gives_the_same_rows(
    tmp_path: Path, undisturbed: Path
) -> None:
    plan = make_plan(tmp_path, MANY)
    first = fly(plan, tmp_path / "out", shard=(1, 2))
    assert 0 < first["finished"] < 12
    assert fly(plan, tmp_path / "out", shard=(2, 2))["remaining"] == 0
    assert figures(tmp_path / "out") == figures(undisturbed)
    for path in (tmp_path / "out" / "runs").iterdir():
        other = undisturbed / "runs" / path.name
        assert (path / "result.json").read_bytes() == (other / "result.json").read_bytes()


def test_missing_ray_is_reported_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(UsageError, match=r"pip install 'touchdown\[ray\]'"):
        make_engine("ray", None)
    with pytest.raises(UsageError, match="--engine ray"):
        make_engine("local", None, "auto")


def test_ray_gives_the_same_rows_and_outlives_its_workers(
    tmp_path: Path, undisturbed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ray = FakeRay()
    monkeypatch.setitem(sys.modules, "ray", ray)
    plan = make_plan(tmp_path, MANY)
    engine = make_engine("ray", None)
    assert engine.jobs == 2
    totals = fly_campaign(plan, tmp_path / "out", engine, runner=RUNNER)
    assert totals["remaining"] == totals["crashed"] == 0
    assert figures(tmp_path / "out") == figures(undisturbed)
    assert len(ray.actors) == 3 and len(ray.killed) == 2
    full = make_plan(tmp_path / "full", axes(scene=["flat"], estimator=["fake:fills_the_disk"]))
    with pytest.raises(UsageError, match="No space left"):
        fly_campaign(full, tmp_path / "full" / "out", engine, runner=RUNNER)


def test_a_flight_by_itself_adds_up_as_one_of_a_campaign() -> None:
    """Linear algebra uses one thread unless more are configured."""
    script = "import touchdown, os; print(os.environ['OPENBLAS_NUM_THREADS'])"
    other = {key: value for key, value in os.environ.items() if key != "OPENBLAS_NUM_THREADS"}
    for environment, threads in ((other, "1"), (other | {"OPENBLAS_NUM_THREADS": "3"}, "3")):
        found = subprocess.run(
            [sys.executable, "-c", script], cwd=Path(__file__).parents[3], env=environment,
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        assert found.stdout.strip() == threads


def test_a_campaign_of_a_version_before_profiles_is_resumed(tmp_path: Path) -> None:
    text, out = axes(scene=["flat"], estimator=["fake:good"], seeds="0"), tmp_path / "out"
    ideal = text + '[base]\nprofile = "ideal"\n'
    fly(make_plan(tmp_path, ideal), out)

    def flown() -> set[str]:
        files = out.glob("runs/*/config.json")
        return {json.loads(file.read_text())["profile"] for file in files}

    file = out / "campaign.json"
    document = json.loads(file.read_text())
    for run in document["runs"]:
        del run["values"]["profile"]  # as that version wrote it
    file.write_text(json.dumps(document))
    more = text.replace('"0"', '"0-1"')
    fly(make_plan(tmp_path, more), out)
    assert set(attempts(out).values()) == {1} and len(attempts(out)) == 2
    assert flown() == {"ideal"}
    fly(make_plan(tmp_path, more.replace("0-1", "0-2")), out)
    assert flown() == {"ideal"}
    with pytest.raises(UsageError, match=r'profile of run .* was "ideal" and is now "harsh"'):
        fly(make_plan(tmp_path, ideal.replace("ideal", "harsh")), out)
