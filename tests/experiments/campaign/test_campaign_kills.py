"""Sixty real flights while processes are killed at random moments, against an undisturbed campaign.

One campaign for each engine, killed ten times: what flies, what watches it, and the command itself.
"""

import importlib.util
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from touchdown.experiments.campaign.results_table import finished_ids, load_rows

from support.campaign_flights import ROOT, figures, flying, is_alive, wait_for

RUNS, KILLS = 60, 10
PLAN = """
name = "short"
mode = "fly"
record = "none"
[axes]
scene = ["crossroad", "lake", "houses", "forest"]
estimator = ["gps", "optical_flow", "livo"]
seeds = "0-4"
[base]
survey = { legs = 1, leg_length_m = 6.0, duration_s = 5.0, height_m = 8.0 }
mapper = { enabled = false }
[limits]
retries = 1
"""

pytestmark = pytest.mark.slow


def start(folder: Path, out: Path, engine: str) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "touchdown", "campaign", str(folder / "plan.toml"), "--out",
               str(out), "--jobs", "2", "--engine", engine, "--quiet"]  # fmt: skip
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL)


def parent_of(pid: int) -> int:
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])


def results(directory: Path) -> dict[str, tuple[int, bytes]]:
    """Returns the inode and the content of the file of every finished run."""
    return {
        file.parent.name: (file.stat().st_ino, file.read_bytes())
        for file in directory.glob("runs/*/result.json")
    }


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("undisturbed")
    (folder / "plan.toml").write_text(PLAN, encoding="utf-8")
    assert start(folder, folder / "out", "local").wait() == 0
    return folder / "out"


def strike(victim: str, command: subprocess.Popen[bytes], flier: int) -> bool:
    """True if a process was killed."""
    try:
        guard = parent_of(flier)
        pids = {"command": command.pid, "worker": flier, "guard": guard}
        pid = pids.get(victim) or parent_of(guard)  # the actor watches the guard
        os.kill(pid, signal.SIGKILL)
    except (ProcessLookupError, FileNotFoundError):
        return False
    return True


@pytest.mark.parametrize(
    ("engine", "victims"),
    [("local", ["command", "worker", "guard"]), ("ray", ["command", "worker", "actor"])],
)
def test_nothing_is_lost(
    engine: str, victims: list[str], undisturbed: Path, tmp_path: Path
) -> None:
    if engine == "ray" and importlib.util.find_spec("ray") is None:
        pytest.skip("Ray is not installed")
    (tmp_path / "plan.toml").write_text(PLAN, encoding="utf-8")
    out, draw = tmp_path / "out", random.Random(engine)
    command = start(tmp_path, out, engine)
    kills = 0
    while kills < KILLS:
        goal = (kills + 1) * RUNS // (KILLS + 2)
        wait_for(lambda: len(finished_ids(out)) >= goal and flying(out), "runs")  # noqa: B023
        time.sleep(draw.uniform(0.0, 2.0))
        before, fliers, victim = results(out), flying(out), victims[kills % len(victims)]
        if not fliers or not strike(victim, command, draw.choice(fliers)):
            continue
        kills += 1
        if victim == "command":
            command.wait()
            wait_for(lambda: not any(map(is_alive, fliers)), "fliers outlive it")  # noqa: B023
            assert before.items() <= results(out).items()
            command = start(tmp_path, out, engine)
    assert command.wait() == 0
    ids = [row["run_id"] for row in load_rows(out)]
    assert len(ids) == len(set(ids)) == RUNS
    assert figures(out) == figures(undisturbed)
    assert not list(out.glob(".partial/*"))
