"""Replays and exports of damaged runs: each ends in one line and leaves nothing half-written."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest

from touchdown.sim.api import SensorNeeds

from support.damaged_logs import KINDS, damage
from support.limited_commands import run_all
from support.replay_support import make_run

NEEDS = SensorNeeds(
    camera_hz=10, lidar=True, gps=True, barometer=True, magnetometer=True, rangefinder=True
)
CASES, QUICK = 200, 17
EXPORTS = (("tum", "--poses", "truth"), ("csv",), ("mcap",), ("ply", "--points", "scans"))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = make_run(tmp_path_factory.mktemp("runs") / "flown", seconds=1.0, needs=NEEDS)
    return run


def check(run: Path, folder: Path, cases: range) -> None:
    commands, names = [], []
    for case in cases:
        kind = KINDS[case % len(KINDS)]
        damage(run, folder / f"run{case}", kind, case)
        # Kinds repeat after 17 cases and exports after 4, so that they meet.
        estimator = ("gps", "livo", "gps", "hybrid_flow")[case % 4]
        export = EXPORTS[case % len(EXPORTS)]
        commands += [
            ["fly", "--replay", f"run{case}", "--estimator", estimator, "--quiet", "--out",
             f"replay{case}"],
            ["export", f"run{case}", "--format", *export, "--out", f"export{case}"],
        ]  # fmt: skip
        names += [f"{case} {kind}: replay {estimator}", f"{case} {kind}: export {export[0]}"]
    findings = {}
    first = [
        ["fly", "--replay", str(run), "--estimator", name, "--quiet", "--out", f"whole-{name}"]
        for name in ("gps", "livo", "hybrid_flow")
    ] + [["export", str(run), "--format", *e, "--out", f"whole-{e[0]}"] for e in EXPORTS]
    ends = run_all(commands, folder, first)
    for name, command, ended in zip(names, commands, ends, strict=True):
        print(name, ended.code, ended.err.strip())
        whole = (folder / command[-1]).exists()
        findings[name] = ended.finding() or ("" if whole == (ended.code != 2) else "half-written")
    findings["left"] = ", ".join(path.name for path in folder.glob(".*"))
    assert {name: what for name, what in findings.items() if what} == {}


def test_a_run_that_is_whole_is_replayed_and_exported(run: Path, tmp_path: Path) -> None:
    commands = [["fly", "--replay", str(run), "--estimator", "gps", "--quiet", "--out", "replay"]]
    commands += [["export", str(run), "--format", *e, "--out", e[0]] for e in EXPORTS]
    ends = run_all(commands, tmp_path)
    assert [ended.finding() for ended in ends] == [""] * 5
    assert [ended.code for ended in ends[1:]] == [0] * 4 and ends[0].code in (0, 1)


def test_damaged_runs_end_in_one_line(run: Path, tmp_path: Path) -> None:
    check(run, tmp_path, range(QUICK))


@pytest.mark.slow
def test_two_hundred_damaged_runs_end_in_one_line(run: Path, tmp_path: Path) -> None:
    for first, last in itertools.pairwise(range(0, CASES + 1, 50)):
        check(run, tmp_path, range(QUICK + first, QUICK + last))
