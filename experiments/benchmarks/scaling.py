"""What a second worker is worth: the same flights by one worker and by several."""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from touchdown.experiments.benchmarks.loop import SHORT_SURVEY
from touchdown.experiments.campaign.executor import LocalEngine
from touchdown.experiments.campaign.plan import Plan, load_plan
from touchdown.experiments.campaign.session import fly_campaign
from touchdown.experiments.errors import UsageError

_PLAN = """
name = "workers"
mode = "land"
record = "none"
[axes]
scene = ["{scene}"]
estimator = ["{estimator}"]
seeds = "0-{last}"
"""


def workers_plan(folder: Path, *, scene: str, estimator: str, runs: int) -> Plan:
    """Landings after a short survey, seeds from 0; its file is written to ``folder``. Raises
    UsageError."""
    lines = [_PLAN.format(scene=scene, estimator=estimator, last=runs - 1), "[base]\n"]
    lines += [f"{setting}\n" for setting in SHORT_SURVEY]
    file = folder / "workers.toml"
    file.write_text("".join(lines), encoding="utf-8")
    return load_plan(file)


def measure_workers(
    *,
    scene: str,
    estimator: str,
    workers: int,
    runs: int,
    rounds: int,
    report: Callable[[str], None] = lambda line: None,
) -> dict[str, Any]:
    """Flies ``runs`` flights with one single-threaded worker, then with ``workers``, ``rounds``
    times over.

    ``wall_s`` lists the campaigns' wall seconds, loading of the workers included; ``ratio.one`` is
    the median over the rounds of how many times as many flights the workers end in a second.
    Raises UsageError: bad names, runs that do not share out evenly, a campaign with crashes.
    """
    if runs % workers:
        raise UsageError(f"--runs {runs} do not share out among {workers} workers")
    wall: dict[str, list[float]] = {"one": [], "workers": []}
    with tempfile.TemporaryDirectory(prefix="touchdown-bench-") as folder:
        plan = workers_plan(Path(folder), scene=scene, estimator=estimator, runs=runs)
        # The first flight on a machine compiles kernels: one that does not count comes before.
        _flown(replace(plan, runs=plan.runs[:1]), Path(folder) / "first", 1)
        for number in range(rounds):
            for name, jobs in (("one", 1), ("workers", workers)):
                spent = _flown(plan, Path(folder) / f"{name}-{number}", jobs)
                wall[name].append(spent)
                report(f"round {number + 1}: {jobs} at work, {runs} flights in {spent:.1f} s")
    ratios = [one / more for one, more in zip(wall["one"], wall["workers"], strict=True)]
    return {
        "scene": scene,
        "estimator": estimator,
        "runs": runs,
        "workers": workers,
        "wall_s": wall,
        "ratio": {"one": statistics.median(ratios)},
    }


def _flown(plan: Plan, out: Path, jobs: int) -> float:
    started = time.perf_counter()
    found = fly_campaign(plan, out, LocalEngine(jobs))
    spent = time.perf_counter() - started
    if found["crashed"]:
        first, error = next(iter(found["errors"].items()))
        raise UsageError(f"{found['crashed']} of {found['runs']} runs crashed; {first}: {error}")
    return spent
