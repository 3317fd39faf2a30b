"""Campaigns of fake flights, in this process or in one that can be killed."""

import json
import subprocess
import sys
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import Any

from touchdown.experiments.campaign.executor import LocalEngine
from touchdown.experiments.campaign.plan import Plan, load_plan
from touchdown.experiments.campaign.results_table import finished_ids, load_rows
from touchdown.experiments.campaign.session import fly_campaign

ROOT = Path(__file__).parents[2]
RUNNER = "support.campaign_fakes:fly"
TIMING_COLUMNS = ("wall_s", "cpu_s", "worker_memory_mb", "started_utc", "timing.")
"""Beginnings of the names of columns that differ between two flights of one configuration."""


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
    """Rows without the values that differ between two flights of one configuration."""
    return [
        {key: value for key, value in row.items() if not key.startswith(TIMING_COLUMNS)}
        for row in load_rows(directory)
    ]


def attempts(directory: Path) -> Counter[str]:
    lines = (directory / "attempts.log").read_text().splitlines()
    return Counter(line.split()[0] for line in lines)


MANY = axes(scene=["flat", "lake"], estimator=["fake:slow", "fake:is_lost"], seeds="0-1")


def start_campaign(file: Path, out: Path) -> subprocess.Popen[bytes]:
    script = (
        "import signal, sys; "  # background jobs of a shell ignore Ctrl-C
        "signal.signal(signal.SIGINT, signal.default_int_handler); "
        "from pathlib import Path; from touchdown.experiments.campaign.plan import load_plan; "
        "from touchdown.experiments.campaign.session import fly_campaign; "
        "from touchdown.experiments.campaign.executor import LocalEngine; "
        f"fly_campaign(load_plan(Path({str(file)!r})), Path({str(out)!r}), LocalEngine(2), "
        f"runner={RUNNER!r})"
    )
    return subprocess.Popen([sys.executable, "-c", script], cwd=ROOT / "tests")


def wait_for(condition: Any, what: str) -> None:
    deadline = time.monotonic() + 600.0  # of a machine that is busy
    while not condition():
        assert time.monotonic() < deadline, what
        time.sleep(0.02)


def flying(out: Path) -> list[int]:
    """Process ids of the workers that fly."""
    pids = []
    for path in out.glob(".partial/*/pid"):
        with suppress(FileNotFoundError):  # the flight has ended since
            pids.append(path.read_text())
    return [int(pid) for pid in pids if pid and is_alive(int(pid))]


def close_gate(out: Path, count: int) -> None:
    """Of the fake flights of the campaign ``out``, all but the first ``count`` attempts wait."""
    file = out.with_name("gate.new")
    file.write_text(str(count))
    file.replace(out.with_name("gate"))


def open_gate(out: Path) -> None:
    out.with_name("gate").unlink()


def flying_after(out: Path, count: int) -> list[int]:
    """Waits until ``count`` runs are finished and others wait at the gate (`close_gate`); returns
    `flying` of then."""
    found: list[int] = []

    def in_the_air() -> bool:
        if len(finished_ids(out)) < count:
            return False
        found[:] = flying(out)
        return bool(found)

    wait_for(in_the_air, f"{count} runs")
    return found


def is_alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"
