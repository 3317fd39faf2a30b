"""Sixty real flights while processes are killed at random moments, against an undisturbed campaign.

One campaign for each engine, killed ten times: what flies, what watches it, and the command itself.
"""

from __future__ import annotations

import importlib.util
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from experiments.campaign_rows import TIMING_COLUMNS, finished_ids, load_rows

ROOT = Path(__file__).parent.parent
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
survey = { legs = 1, leg_length_m = 8.0, duration_s = 6.0 }
[limits]
retries = 1
"""

pytestmark = pytest.mark.slow


def start(folder: Path, out: Path, engine: str) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "experiments", "campaign", str(folder / "plan.toml"), "--out",
               str(out), "--jobs", "2", "--engine", engine, "--quiet"]  # fmt: skip
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL)


def in_the_air(out: Path) -> list[int]:
    """Process numbers of those that fly."""
    return [int(path.name.rpartition(".")[2]) for path in out.glob(".partial/*")]


def parent_of(pid: int) -> int:
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])


def figures(directory: Path) -> list[dict[str, Any]]:
    return [
        {key: value for key, value in row.items() if not key.startswith(TIMING_COLUMNS)}
        for row in load_rows(directory)
    ]


def results(directory: Path) -> dict[str, tuple[int, bytes]]:
    """Of every finished run: its file's number on the disk, and what is in it."""
    return {
        file.parent.name: (file.stat().st_ino, file.read_bytes())
        for file in directory.glob("runs/*/result.json")
    }


def until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 300.0
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder = tmp_path_factory.mktemp("undisturbed")
    (folder / "plan.toml").write_text(PLAN, encoding="utf-8")
    assert start(folder, folder / "out", "local").wait() == 0
    yield folder / "out"


@pytest.mark.parametrize("engine", ["local", "ray"])
def test_nothing_is_lost(engine: str, undisturbed: Path, tmp_path: Path) -> None:
    if engine == "ray" and importlib.util.find_spec("ray") is None:
        pytest.skip("Ray is not installed")
    (tmp_path / "plan.toml").write_text(PLAN, encoding="utf-8")
    out, draw = tmp_path / "out", random.Random(engine)
    command = start(tmp_path, out, engine)
    victims = ["command", "worker"] if engine == "local" else ["command", "worker", "actor"]
    for number in range(KILLS):
        # one more run is over, and something flies: then at a random moment
        goal = min(len(finished_ids(out)) + 2, RUNS - 2) if out.is_dir() else 2
        until(lambda goal=goal: out.is_dir() and len(finished_ids(out)) >= goal)  # type: ignore[misc]
        until(lambda: bool(in_the_air(out)))
        time.sleep(draw.uniform(0.0, 2.0))
        flying = in_the_air(out)
        if command.poll() is not None or not flying:
            continue
        before, victim = results(out), victims[number % len(victims)]
        try:
            pid = {
                "command": lambda: command.pid,
                "worker": lambda flying=flying: draw.choice(flying),
                "actor": lambda flying=flying: parent_of(draw.choice(flying)),
            }[victim]()  # type: ignore[no-untyped-call]
            os.kill(pid, signal.SIGKILL)
        except (ProcessLookupError, FileNotFoundError):
            continue
        if victim == "command":
            command.wait()
            until(lambda: not any(Path(f"/proc/{p}").exists() for p in flying))  # noqa: B023
            assert before.items() <= results(out).items()
            command = start(tmp_path, out, engine)
    assert command.wait() == 0
    ids = [row["run_id"] for row in load_rows(out)]
    assert len(ids) == len(set(ids)) == RUNS
    assert figures(out) == figures(undisturbed)
    assert not list(out.glob(".partial/*"))
