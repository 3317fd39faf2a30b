"""Campaigns of flights that take no time: plans, resuming, faults of workers, rows."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from experiments import cli
from experiments.campaign import Limits, Plan, in_shard, load_plan
from experiments.campaign_dir import locked
from experiments.campaign_progress import TimeLeft
from experiments.campaign_rows import TIMING_COLUMNS, connect, finished_ids, load_rows
from experiments.campaign_run import Task
from experiments.campaign_session import fly_campaign, make_engine, summary
from experiments.config import UsageError
from experiments.engines import LocalEngine
from tests.ray_fake import FakeRay

ROOT = Path(__file__).parent.parent
RUNNER = "tests.campaign_fakes:fly"


def make_plan(folder: Path, text: str) -> Plan:
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "campaign.toml"
    file.write_text(text, encoding="utf-8")
    return load_plan(file)


def axes(**values: Any) -> str:
    lists = "".join(f"{name} = {json.dumps(value)}\n" for name, value in values.items())
    return f'name = "test"\n[axes]\n{lists}'


def fly(plan: Plan, out: Path, jobs: int = 1, **options: Any) -> dict[str, Any]:
    return fly_campaign(plan, out, LocalEngine(jobs), runner=RUNNER, **options)


def figures(directory: Path) -> list[dict[str, Any]]:
    """Rows without what differs between two flights of one configuration."""
    return [
        {key: value for key, value in row.items() if not key.startswith(TIMING_COLUMNS)}
        for row in load_rows(directory)
    ]


def attempts(directory: Path) -> Counter[str]:
    lines = (directory / "attempts.log").read_text().splitlines()
    return Counter(line.split()[0] for line in lines)


# ------------------------------------------------------------------------------------------- plan


def test_plan_is_the_product_of_the_axes_seed_by_seed(tmp_path: Path) -> None:
    text = axes(scene=["flat", "lake"], estimator=["livo", "oracle"], seeds="3, 7-8")
    text += "wind_kmh = [0, 20.5]\n[axes.survey]\nlegs = [1]\n"
    plan = make_plan(tmp_path, text)
    names = [run.run_id for run in plan.runs]
    assert len(set(names)) == 2 * 2 * 3 * 2
    assert names[:3] == ["flat-livo-s3-w0", "flat-livo-s3-w20.5", "flat-oracle-s3-w0"]
    assert names[-1] == "lake-oracle-s8-w20.5"
    assert plan.runs[1].values == {
        "sim.threads": 1,
        "scene": "flat",
        "estimator": "livo",
        "seed": 3,
        "wind.mean_kmh": 20.5,
        "survey.legs": 1,
        "record": False,
        "landing.survey_only": True,
    }
    assert len({run.config_sha for run in plan.runs}) == len(names)


def test_overrides_apply_where_their_axes_match(tmp_path: Path) -> None:
    text = axes(scene=["flat", "lake"], estimator=["livo", "oracle"])
    text += """
[base]
survey.height_m = 25.0
log = { camera_hz = 1.0 }
[[override]]
when = { estimator = ["oracle"], scene = "lake" }
set = { survey.height_m = 12.0, "log.scan_hz" = 1.0 }
"""
    by_name = {run.run_id: run.values for run in make_plan(tmp_path, text).runs}
    assert by_name["lake-oracle-s0"]["survey.height_m"] == 12.0
    assert by_name["lake-oracle-s0"]["log.scan_hz"] == 1.0
    for other in ("lake-livo-s0", "flat-oracle-s0"):
        assert by_name[other]["survey.height_m"] == 25.0
        assert "log.scan_hz" not in by_name[other]
        assert by_name[other]["log.camera_hz"] == 1.0


def test_shipped_campaign_compares_six_methods_on_equal_terms() -> None:
    plan = load_plan(ROOT / "configs" / "positioning.toml")
    assert len(plan.runs) == 4 * 6 * 10
    methods: dict[str, dict[str, Any]] = {}
    for run in plan.runs:
        values = dict(run.values)
        name = values.pop("estimator")
        # Methods without a LIDAR go without a map; nothing else tells them apart.
        assert values.pop("mapper.enabled", True) == (name in ("paper", "livo"))
        methods.setdefault(name, {})[f"{values.pop('scene')} {values.pop('seed')}"] = values
    assert list(methods) == ["gps", "optical_flow", "hybrid_flow", "stereo", "paper", "livo"]
    assert all(runs == methods["livo"] for runs in methods.values())


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("axes = 3\n", ["lacks 'name'"]),
        ('name = "x"\n', ["lacks 'axes'"]),
        (axes(estimator=["livo"]), ["lacks scene"]),
        (axes(scene=["crossrod"]), ["unknown scene 'crossrod'", "did you mean 'crossroad'"]),
        (axes(scene=["no/such.xml"]), ["no/such.xml", "does not exist"]),
        (axes(scene=["flat"], estimator=["lvio"]), ["lvio", "did you mean 'livo'"]),
        (axes(scene=["flat"], estimater=["livo"]), ["estimater", "did you mean 'estimator'"]),
        (axes(scene="flat"), ["'scene'", "list"]),
        (axes(scene=[]), ["'scene'", "list"]),
        (axes(scene=["flat", "flat"]), ["flat twice"]),
        (axes(scene=["flat"], seed=[-1]), ["seed -1", "from 0 up"]),
        (axes(scene=["flat"], seeds="9-0"), ["counts down"]),
        (axes(scene=["flat"], seeds="a"), ["'0-9'"]),
        (axes(scene=["flat"], seeds="1", seed=[1]), ["both seed and seeds"]),
        (axes(scene=["flat"], wind_kmh=["strong"]), ["wind.mean_kmh", "number"]),
        (axes(scene=["flat"], wind_kmh=[-3]), ["wind.mean_kmh = -3", "not be negative"]),
        (axes(scene=["flat"]) + "[base]\nwind.mean_kph = 3\n", ["did you mean 'wind.mean_kmh'"]),
        (axes(scene=["flat"]) + "[base]\nseed = 3\n", ["'seed'", "[axes] seeds"]),
        (axes(scene=["flat"]) + "[base]\nrecord = true\n", ["'record'", "whole campaign"]),
        (axes(scene=["flat"], wind_kmh=[3]) + "[base]\nwind.mean_kmh = 3\n", ["axis already"]),
        (axes(scene=["flat"]) + "[limits]\nmemory_gib = 3\n", ["did you mean 'memory_gb'"]),
        (axes(scene=["flat"]) + "[limits]\nretries = -1\n", ["limits.retries"]),
        ("recrod = 'all'\n" + axes(scene=["flat"]), ["did you mean 'record'"]),
        ("record = 'some'\n" + axes(scene=["flat"]), ["record", "'failures'"]),
        (
            axes(scene=["flat"]) + "[[override]]\nwhen = {scene = 'flat'}\nset = {a = 1}\nif = 1\n",
            ["unknown key 'override.0.if'", "known: when, set"],
        ),
        (
            axes(scene=["flat"]) + "[[override]]\nwhen = {scenes = 'flat'}\nset = {}\n",
            ["did you mean 'scene'"],
        ),
        (axes(scene=["flat"]) + "[axes", ["not valid TOML", "line"]),
    ],
)
def test_mistakes_are_one_line_and_nothing_is_written(
    text: str, words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "bad.toml"
    file.write_text(text, encoding="utf-8")
    code = cli.main(["campaign", str(file), "--out", str(tmp_path / "out")])
    captured = capsys.readouterr()
    assert code == 2, captured.err
    assert captured.out == "" and captured.err.count("\n") == 1
    for word in words:
        assert word in captured.err
    assert not (tmp_path / "out").exists()


def test_shards_share_the_runs_among_them() -> None:
    names = [f"lake-livo-s{seed}" for seed in range(200)]
    parts = [{name for name in names if in_shard(name, (part, 3))} for part in (1, 2, 3)]
    assert set.union(*parts) == set(names)
    assert sum(map(len, parts)) == len(names)
    assert min(map(len, parts)) > 40


# ----------------------------------------------------------------------- one campaign, many faults

BEHAVIOURS = (
    "good",
    "prints",
    "is_lost",
    "raises",
    "raises_once",
    "segfaults",
    "is_killed_once",
    "grows",
)


@pytest.fixture(scope="module")
def faulty(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    folder = tmp_path_factory.mktemp("faulty")
    text = axes(scene=["flat"], estimator=[f"fake:{name}" for name in BEHAVIOURS])
    plan = make_plan(folder, text + "[limits]\nrun_timeout_s = 100\nmemory_gb = 0.3\n")
    return folder / "out", fly(plan, folder / "out", jobs=2)


def row_of(directory: Path, behaviour: str) -> dict[str, Any]:
    return next(row for row in load_rows(directory) if row["estimator"] == f"fake:{behaviour}")


@pytest.mark.parametrize(
    ("behaviour", "outcome", "flown", "reason"),
    [
        ("good", "COMPLETED", 1, ""),
        ("prints", "COMPLETED", 1, ""),
        ("is_lost", "DIVERGED", 2, ""),  # the second time for its recording
        ("raises", "CRASHED", 2, "RuntimeError: a wing came off"),
        ("raises_once", "COMPLETED", 2, ""),
        ("segfaults", "CRASHED", 2, "SIGSEGV"),
        ("is_killed_once", "COMPLETED", 2, ""),
        ("grows", "CRASHED", 1, "0.3 GB"),
    ],
)
def test_every_run_has_its_row_whatever_befell_it(
    faulty: tuple[Path, dict[str, Any]], behaviour: str, outcome: str, flown: int, reason: str
) -> None:
    row = row_of(faulty[0], behaviour)
    assert row["outcome"] == outcome
    assert reason in row["reason"]
    assert attempts(faulty[0])[row["run_id"]] == flown
    assert (faulty[0] / "runs" / row["run_id"]).exists() == (outcome != "CRASHED")


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


def test_only_bad_outcomes_are_recorded(faulty: tuple[Path, dict[str, Any]]) -> None:
    recorded = {path.parent.name for path in (faulty[0] / "runs").glob("*/flight.rrd")}
    assert recorded == {"flat-fake.is_lost-s0"}


def test_nothing_is_left_over(faulty: tuple[Path, dict[str, Any]]) -> None:
    assert not (faulty[0] / ".partial").exists()
    totals = faulty[1]
    assert (totals["finished"], totals["crashed"], totals["remaining"]) == (5, 3, 0)
    assert totals["flying"] == []
    shares = totals["estimators"]["fake:good"]["stage_share"]
    assert sum(shares.values()) == pytest.approx(1.0)
    # 1 ms of the world and 0.5 ms of the estimator in a loop of 2 ms.
    assert shares["world"] == pytest.approx(2 * shares["estimator"])
    assert shares["rest"] == pytest.approx(shares["estimator"])


def test_a_second_call_tries_the_crashed_alone(
    faulty: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    out = tmp_path / "copy"
    shutil.copytree(faulty[0], out)
    (out / "attempts.log").write_text("")
    plan = load_plan(out / "campaign.toml")
    keep = [run for run in plan.runs if "raises" in run.run_id or "good" in run.run_id]
    document = json.loads((out / "campaign.json").read_text())
    document["runs"] = [r for r in document["runs"] if r["run_id"] in {k.run_id for k in keep}]
    (out / "campaign.json").write_text(json.dumps(document))
    totals = fly(dataclasses.replace(plan, runs=tuple(keep)), out)
    assert attempts(out) == {"flat-fake.raises-s0": 2}
    assert totals["crashed"] == 1


# --------------------------------------------------------------------------------------- resuming

MANY = axes(scene=["flat", "lake"], estimator=["fake:slow", "fake:is_lost"], seeds="0-2")


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("undisturbed")
    fly(make_plan(folder, MANY), folder / "out", jobs=2)
    return folder / "out"


def start_campaign(file: Path, out: Path) -> subprocess.Popen[bytes]:
    script = (
        "import signal, sys; "  # what runs in a shell's background is born deaf to Ctrl-C
        "signal.signal(signal.SIGINT, signal.default_int_handler); "
        "from pathlib import Path; from experiments.campaign import load_plan; "
        "from experiments.campaign_session import fly_campaign; "
        "from experiments.engines import LocalEngine; "
        f"fly_campaign(load_plan(Path({str(file)!r})), Path({str(out)!r}), LocalEngine(2), "
        f"runner={RUNNER!r})"
    )
    return subprocess.Popen([sys.executable, "-c", script], cwd=ROOT)


def wait_for(condition: Any, what: str) -> None:
    deadline = time.monotonic() + 120.0
    while not condition():
        assert time.monotonic() < deadline, what
        time.sleep(0.02)


def flying(out: Path) -> list[int]:
    """Process numbers of the workers that are in the air."""
    return [int(path.name.rpartition(".")[2]) for path in out.glob(".partial/*")]


def is_alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


def test_killed_and_called_again_it_gives_the_same_rows(tmp_path: Path, undisturbed: Path) -> None:
    plan, out = make_plan(tmp_path, MANY), tmp_path / "out"
    parent = start_campaign(tmp_path / "campaign.toml", out)
    wait_for(lambda: len(finished_ids(out)) >= 4 and flying(out), "four runs")
    workers = flying(out)
    parent.kill()
    parent.wait()
    wait_for(lambda: not any(map(is_alive, workers)), "workers outlive their parent")
    finished = finished_ids(out)
    before = attempts(out)
    assert 4 <= len(finished) < 12
    totals = fly(plan, out)
    again = attempts(out) - before
    # What was finished is not flown again, but for the recordings of bad outcomes.
    assert all("is_lost" in run_id for run_id in again.keys() & finished)
    assert totals["remaining"] == 0 and not list(out.glob(".partial/*"))
    assert figures(out) == figures(undisturbed)
    recorded = {path.parent.name for path in out.glob("runs/*/flight.rrd")}
    assert recorded == {run.run_id for run in plan.runs if "is_lost" in run.run_id}
    before = attempts(out)
    fly(plan, out)
    assert attempts(out) == before


def test_a_worker_that_is_killed_is_replaced(tmp_path: Path, undisturbed: Path) -> None:
    make_plan(tmp_path, MANY)
    out = tmp_path / "out"
    parent = start_campaign(tmp_path / "campaign.toml", out)
    for count in (2, 6):
        wait_for(lambda n=count: len(finished_ids(out)) >= n and flying(out), "runs")  # type: ignore[misc]
        os.kill(flying(out)[0], signal.SIGKILL)
    assert parent.wait() == 0
    assert figures(out) == figures(undisturbed)
    assert summary(out)["crashed"] == 0


def test_a_survey_that_cannot_be_flown_is_told_before_the_first_flight(tmp_path: Path) -> None:
    text = axes(scene=["flat"], estimator=["gps"]) + "[axes.survey]\nduration_s = [36.0, 3.0]\n"
    with pytest.raises(UsageError, match=r"a survey of 3 legs of 50 m does not fit into 3 s"):
        make_plan(tmp_path, text)


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


def test_interrupt_stops_and_keeps_what_is_finished(tmp_path: Path) -> None:
    make_plan(tmp_path, MANY)
    out = tmp_path / "out"
    parent = start_campaign(tmp_path / "campaign.toml", out)
    wait_for(lambda: len(finished_ids(out)) >= 2 and flying(out), "runs")
    workers = flying(out)
    parent.send_signal(signal.SIGINT)
    assert parent.wait() != 0
    assert not any(map(is_alive, workers)) and not list(out.glob(".partial/*"))
    document = json.loads((out / "campaign.json").read_text())
    assert document["finished_utc"] is None
    assert [session["jobs"] for session in document["sessions"]] == [2]


# --------------------------------------------------------------------------------- the directory

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


def test_a_directory_of_something_else_is_left_alone(tmp_path: Path) -> None:
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
    # A second wind lengthens names, not those of the runs that are there.
    grown = make_plan(tmp_path, TWO.replace("0-1", "0-2") + "wind_kmh = [12, 20]\n")
    assert fly(grown, out)["finished"] == 6
    assert attempts(out).most_common(1)[0][1] == 1
    assert finished_ids(out) == {
        "flat-fake.good-s0",
        "flat-fake.good-s1",
        "flat-fake.good-s2-w12",
        *(f"flat-fake.good-s{seed}-w20" for seed in range(3)),
    }
    # Neither limits nor recording change what a run is.
    fly(make_plan(tmp_path, "record = 'none'\n" + grown.text + "[limits]\nretries = 0\n"), out)


def test_a_full_disk_ends_the_campaign_in_one_line(tmp_path: Path) -> None:
    plan = make_plan(tmp_path, axes(scene=["flat"], estimator=["fake:fills_the_disk"]))
    with pytest.raises(UsageError, match="No space left on device; make room"):
        fly(plan, tmp_path / "out")
    assert summary(tmp_path / "out")["remaining"] == 1


def test_a_run_that_the_machine_lost_is_flown_again(tmp_path: Path) -> None:
    plan, out = make_plan(tmp_path, TWO), tmp_path / "out"
    fly(plan, out)
    (out / "runs" / "flat-fake.good-s0" / "row.parquet").write_bytes(b"")
    assert fly(plan, out)["finished"] == 2
    assert attempts(out) == {"flat-fake.good-s0": 2, "flat-fake.good-s1": 1}


# ------------------------------------------------------------------------------------------- rows


def test_rows_have_the_same_columns_and_types_whatever_is_missing(undisturbed: Path) -> None:
    columns = dict(connect(undisturbed).execute("select column_name, column_type from "
                                                "(describe runs)").fetchall())  # fmt: skip
    assert columns["position_error_m.mean"] == "DOUBLE"
    assert columns["landing.slope_deg"] == "DOUBLE"
    assert columns["landing.site_xy_m"] == "DOUBLE[]"
    assert columns["landing.safe"] == "BOOLEAN"
    assert columns["seed"] == "BIGINT"
    assert columns["versions.touchdown"] == "VARCHAR"
    row = load_rows(undisturbed)[0]
    assert row["run_id"] == "flat-fake.is_lost-s0"
    assert (row["mode"], row["wind_kmh"], row["git_revision"]) == ("fly", 12.0, "abc")
    # 0.1 + 0.001 * 12 km/h + 0.1 * 4 letters
    assert row["position_error_m.mean"] == pytest.approx(0.512)


def test_runs_flown_one_by_one_give_rows_too(undisturbed: Path, tmp_path: Path) -> None:
    shutil.copytree(undisturbed / "runs", tmp_path / "runs")
    rows = {row["run_id"]: row for row in load_rows(tmp_path)}
    assert len(rows) == 12
    for row in load_rows(undisturbed):
        other = rows[f"runs/{row['run_id']}"]
        for key in ("mode", "seed", "config_sha", "position_error_m.mean", "outcome"):
            assert other[key] == row[key]
    (tmp_path / "empty").mkdir()
    with pytest.raises(UsageError, match="no finished run"):
        load_rows(tmp_path / "empty")


def test_query(undisturbed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sql = 'select estimator, max("position_error_m.mean") as worst from runs group by 1 order by 1'
    assert cli.main(["query", str(undisturbed), sql, "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [row["estimator"] for row in rows] == ["fake:is_lost", "fake:slow"]
    assert rows[0]["worst"] == pytest.approx(0.532)
    assert cli.main(["query", str(undisturbed), sql, "--csv"]) == 0
    assert capsys.readouterr().out.splitlines()[0] == "estimator,worst"
    assert cli.main(["query", str(undisturbed), sql]) == 0
    assert "fake:slow" in capsys.readouterr().out
    assert cli.main(["query", str(undisturbed), "select nonsense from runs"]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1 and "nonsense" in captured.err


def test_status(undisturbed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["campaign", "status", str(undisturbed), "--json"]) == 0
    totals = json.loads(capsys.readouterr().out)
    assert totals["outcomes"] == {"COMPLETED": 6, "DIVERGED": 6}
    assert cli.main(["campaign", "status", str(undisturbed)]) == 0
    assert "12 of 12 runs finished" in capsys.readouterr().out
    assert cli.main(["campaign", "status", str(undisturbed.parent)]) == 2


def test_options_may_stand_before_the_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = str(tmp_path / "out")
    for arguments in (["--out", out, "gone.toml"], ["gone.toml", "--out", out, "--jobs", "2"]):
        assert cli.main(["campaign", *arguments]) == 2
        assert "'gone.toml' does not exist" in capsys.readouterr().err


# --------------------------------------------------------------------------------- time, and Ray


def test_time_left_knows_that_methods_differ() -> None:
    todo = [
        Task(run_id=f"{name}{seed}", values={"estimator": name}, directory="")
        for seed in range(3)
        for name in ("quick", "slow")
    ]
    left = TimeLeft(todo, jobs=2)
    assert left.left_s(0.0) is None
    left.start("quick0", 0.0)
    left.start("slow0", 0.0)
    assert left.end("quick0", 10.0) == 10.0
    # quick: 2 of 10 s to go; slow: 2 of as much as is known, 10 s, and slow0 is over that.
    assert left.left_s(10.0) == pytest.approx((20.0 + 20.0 + 0.0) / 2)
    left.end("slow0", 40.0)
    assert left.left_s(40.0) == pytest.approx((20.0 + 80.0) / 2)


def test_ray_is_asked_for_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_limits_have_sane_defaults() -> None:
    limits = Limits()
    assert limits.retries == 1 and limits.run_timeout_s > 600 and limits.memory_gb > 2


@pytest.mark.slow
def test_real_flights_are_the_same_in_any_number_of_workers(tmp_path: Path) -> None:
    """One worker flies both methods one after the other, two fly them side by side."""
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
