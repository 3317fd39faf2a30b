"""Scaling of a campaign: throughput of several workers over that of one, on the same flights."""

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
name = "scaling"
mode = "land"
record = "none"
[axes]
scene = ["{scene}"]
estimator = ["{estimator}"]
seeds = "0-{last}"
"""


def scaling_plan(folder: Path, *, scene: str, estimator: str, runs: int) -> Plan:
    """Plan of landings after a short survey, seeds from 0, whose file is written to ``folder``.
    Raises UsageError."""
    lines = [_PLAN.format(scene=scene, estimator=estimator, last=runs - 1), "[base]\n"]
    lines += ['profile = "ideal"\n']
    lines += [f"{setting}\n" for setting in SHORT_SURVEY]
    file = folder / "scaling.toml"
    file.write_text("".join(lines), encoding="utf-8")
    return load_plan(file)


def measure_scaling(
    *,
    scene: str,
    estimator: str,
    workers: int,
    runs: int,
    rounds: int,
    report: Callable[[str], None] = lambda line: None,
) -> dict[str, Any]:
    """Flies ``runs`` flights with one single-threaded worker, then with ``workers`` of them,
    ``rounds`` times.

    ``wall_s`` lists the wall time of the campaigns in seconds, start of the workers included;
    ``ratio.one`` is the throughput of ``workers`` over that of one, the median over the rounds.
    Raises UsageError for bad names, ``runs`` that ``workers`` does not divide, and crashes.
    """
    if runs % workers:
        raise UsageError(f"--runs {runs} is no multiple of --workers {workers}")
    wall: dict[str, list[float]] = {"one": [], "workers": []}
    with tempfile.TemporaryDirectory(prefix="touchdown-bench-") as folder:
        plan = scaling_plan(Path(folder), scene=scene, estimator=estimator, runs=runs)
        # The first flight on a machine compiles kernels and is not counted.
        _flown(replace(plan, runs=plan.runs[:1]), Path(folder) / "first", 1)
        for number in range(rounds):
            for name, jobs in (("one", 1), ("workers", workers)):
                spent = _flown(plan, Path(folder) / f"{name}-{number}", jobs)
                wall[name].append(spent)
                report(f"round {number + 1}: {jobs} workers, {runs} flights in {spent:.1f} s")
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
