"""Directories of campaigns that other people made: nothing outside of them is touched."""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from touchdown.experiments.campaign import session
from touchdown.experiments.campaign.plan import Plan, load_plan
from touchdown.experiments.campaign.results_table import load_rows, write_table
from touchdown.experiments.cli import main as cli
from touchdown.experiments.errors import UsageError

from support.campaign_flights import attempts, axes, fly, make_plan
from support.command import Says

NAME = "flat-fake.good-s0"
TEXT = axes(scene=["flat"], estimator=["fake:good"], seeds="0-1")


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flown")
    fly(make_plan(folder, TEXT), folder / "out")
    return folder / "out"


@pytest.fixture
def out(flown: Path, tmp_path: Path) -> Path:
    """A campaign, and what else the user has: all of it in ``tmp_path/home``."""
    home = tmp_path / "home" / "work"
    home.mkdir(parents=True)
    shutil.copytree(flown, home / "out")
    for victim in (home / "victim", home / "out" / "victim"):
        victim.mkdir()
        (victim / "thesis.txt").write_text("years of work")
        (victim / "result.json").write_text("{}")
    return home / "out"


@pytest.fixture
def plan(out: Path) -> Plan:
    return load_plan(out / "campaign.toml", allow_code=True)


def edit(out: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    document = json.loads((out / "campaign.json").read_text())
    change(document)
    (out / "campaign.json").write_text(json.dumps(document))


def listing(folder: Path) -> dict[str, bytes | str | None]:
    """All below a folder, with contents; links by their targets."""
    return {
        str(path.relative_to(folder)): str(path.readlink())
        if path.is_symlink()
        else path.read_bytes()
        if path.is_file()
        else None
        for path in sorted(folder.rglob("*"))
        if path.suffix != ".fifo"
    }


def refused(plan: Plan, out: Path, reason: str) -> None:
    """Fails unless flying into ``out`` is refused in one line and changes nothing at all."""
    before = listing(out.parents[1])
    with pytest.raises(UsageError, match=reason) as caught:
        fly(plan, out)
    assert "\n" not in str(caught.value) and str(caught.value).isprintable()
    after = listing(out.parents[1])
    for kept in (before, after):
        kept.pop("work/out/.lock")  # names the process
    assert after == before


STRANGE = ("../../victim", "../victim", "..", ".", "", "/etc/victim", "a/b", "x\n", "\x1b[31mx",
           "\ud800", "x" * 300)  # fmt: skip


@pytest.mark.parametrize("name", STRANGE)
def test_a_run_cannot_be_called_by_a_path(name: str, out: Path, plan: Plan, says: Says) -> None:
    edit(out, lambda document: document["runs"][0].update(run_id=name))
    shutil.rmtree(out / "runs" / NAME)
    refused(plan, out, r"calls a run .* which no campaign does|has half a character")
    says(2, "campaign", "status", out)
    says(2, "campaign", out / "campaign.toml", "--out", out, "--allow-code")


def _replaced_by_link(path: Path, target: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
    path.symlink_to(target)


@pytest.mark.parametrize(
    "name",
    [".lock", ".lock-sessions", ".lock-1-of-2", "campaign.json", "campaign.toml", "runs", "failed",
     ".partial", "results.parquet", f"runs/{NAME}", f"failed/{NAME}.json", ".campaign.json.1",
     f".partial/{NAME}.1"],
)  # fmt: skip
@pytest.mark.parametrize("target", ["victim", "victim/thesis.txt", "nothing"])
def test_links_in_the_directory_are_refused(name: str, target: str, out: Path, plan: Plan) -> None:
    (out / name).parent.mkdir(exist_ok=True)
    if name.startswith("campaign"):
        (out.parent / "victim" / "result.json").write_bytes((out / name).read_bytes())
    _replaced_by_link(out / name, out.parent / target)
    before = listing(out.parents[1])
    with pytest.raises(UsageError, match=r"is a link; a campaign uses none|holds something"):
        fly(plan, out)
    after = listing(out.parents[1])
    assert before == after


def test_a_file_in_the_place_of_a_folder_is_named(out: Path, plan: Plan) -> None:
    shutil.rmtree(out / "runs")
    (out / "runs").write_text("")
    refused(plan, out, "runs' is a file where a campaign has a folder")


def test_the_directory_itself_may_be_a_link(out: Path, plan: Plan) -> None:
    link = out.parent / "link"
    link.symlink_to(out)
    assert fly(plan, link)["finished"] == 2
    assert attempts(out)[NAME] == 1, "nothing is flown twice"


def test_rows_that_name_another_run_are_damaged(out: Path) -> None:
    run = out / "runs" / NAME
    (row,) = [row for row in load_rows(out) if row["run_id"] == NAME]
    write_table([row | {"run_id": "../../victim"}], run / "row.parquet")
    (out / "results.parquet").unlink()
    with pytest.raises(UsageError, match=r"row\.parquet' is damaged; remove the directory"):
        load_rows(out)


def test_missing_rows_are_no_success(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, says: Says
) -> None:
    """As after a worker that did not report what became of its runs."""
    make_plan(tmp_path, TEXT)
    monkeypatch.setattr(session.LocalEngine, "run", lambda *_arguments: None)
    monkeypatch.setattr(session, "check_external", print)
    monkeypatch.setattr(session, "check_external_code", lambda *_arguments: None)
    command = ["campaign", str(tmp_path / "campaign.toml"), "--out", str(tmp_path / "out")]
    captured = says(1, *command, "--quiet", "--json")
    assert captured.err.count("\n") == 1
    assert f"2 runs have no row, such as {NAME}; give the same command again" in captured.err


def test_a_run_that_vanishes_is_not_counted(tmp_path: Path) -> None:
    plan = make_plan(tmp_path, TEXT)
    out, seen = tmp_path / "out", list[dict[str, Any]]()

    class Thief(session.Watcher):
        def see(self, event: dict[str, Any]) -> None:
            seen.append(event)
            if event["event"] == "finished":
                shutil.rmtree(out / "runs" / event["run_id"])

    totals = fly(plan, out, watcher=Thief())
    assert totals["finished"] == 0 and len(totals["missing"]) == 2
    assert [event["event"] for event in seen].count("finished") == 2


@pytest.mark.parametrize("wall_s", [float("nan"), "1"])
def test_times_that_are_no_numbers(wall_s: object, out: Path, plan: Plan) -> None:
    edit(out, lambda document: document["sessions"][0].update(wall_s=wall_s))
    assert cli.main(["campaign", "status", str(out)]) == 2
    refused(plan, out, r"campaign\.json' is damaged")


def test_a_table_that_is_a_pipe_is_made_anew(out: Path) -> None:
    (out / "results.parquet").unlink()
    os.mkfifo(out / "results.parquet")
    assert len(load_rows(out)) == 2


def test_files_of_others_in_the_place_of_a_run_stay(out: Path, plan: Plan) -> None:
    (out / "runs" / NAME / "row.parquet").unlink()
    thesis = out / "runs" / NAME / "thesis.txt"
    thesis.write_text("years of work")
    refused(plan, out, "holds 'thesis.txt', which no run writes, where a run of the campaign")
    thesis.rename(out / "thesis.txt")
    assert fly(plan, out)["finished"] == 2 and (out / "runs" / NAME / "row.parquet").is_file()


def test_files_of_others_that_come_while_a_run_is_flown_stay(out: Path, plan: Plan) -> None:
    shutil.rmtree(out / "runs" / NAME)
    thesis = out / "runs" / NAME / "thesis.txt"

    class Writer(session.Watcher):
        def start(self, *_arguments: Any) -> None:
            thesis.parent.mkdir()
            thesis.write_text("years of work")

    totals = fly(plan, out, watcher=Writer())
    assert totals["crashed"] == 0 and totals["missing"] == []
    assert (
        "holds 'thesis.txt'" in json.loads((out / "failed" / f"{NAME}.json").read_text())["error"]
    )
    assert thesis.read_text() == "years of work"


def test_leavings_of_killed_campaigns_go(out: Path, plan: Plan) -> None:
    shutil.rmtree(out / "runs" / NAME)
    left = [out / ".partial" / "other-run.1" / "x", out / "failed" / f".{NAME}.json.partial-1"]
    for path in left:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("")
    assert fly(plan, out)["finished"] == 2 and not any(path.exists() for path in left)


def test_a_name_that_is_too_long_is_refused_before_the_first_flight(tmp_path: Path) -> None:
    events = json.dumps([[f"gps_bias {n} {n + 1}" for n in range(40)], []])
    text = TEXT + f"[axes.faults]\nevents = {events}\n"
    (tmp_path / "campaign.toml").write_text(text)
    with pytest.raises(UsageError, match=r"longer than 200 bytes|faults"):
        load_plan(tmp_path / "campaign.toml")
