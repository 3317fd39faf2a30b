"""Seeded generators of runs, campaigns and baselines: valid, old, of other tools, damaged."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from touchdown.experiments.config.loading import dump_config
from touchdown.experiments.config.schema import Config

from fuzz.fuzz_inputs import Rng, damaged, mutate_tree, pick, put
from fuzz.fuzzing import Case


@cache
def _valid_run() -> tuple[dict[str, Any], str]:
    from support.campaign_fakes import fake_result

    result = fake_result(Config(scene="flat", estimator="gps"), "COMPLETED")
    landed = {
        "safe_geometry": True,
        "slope_deg": 1.0,
        "commanded_xy_m": [1.0, 2.0],
        "class_true": "lawn",
    }
    more = {
        "landing": landed,
        "span_s": [0.9, None],
        "position_error_m": {
            "mean": 0.1,
            "rmse": 0.1,
            "max": 0.3,
            "x": 0.1,
            "y": 0.1,
            "z": 0.1,
            "yaw_deg": 1.0,
        },
        "map": {
            "duration_s": 18.0,
            "density_per_m2": 900.0,
            "levelness_error_deg": {"mean": 0.2, "max": 0.5, "places": 3},
        },
        "nees": {"median": 2.4, "mean": 3.0, "below_14_2": 0.99, "samples": 100},
        "trajectory_variance_m2": 0.1,
        "events": [{"time_s": 1.0, "text": "x"}],
    }
    rows = [f"{0.1 * n:.3f} {n} 0 {min(3 * n, 30)} 0 0 0 1" for n in range(40)]
    return {**result, **more}, "\n".join(rows) + "\n"


@cache
def _run_with_sensors(home: Path) -> Path:
    from support.replay_support import make_run

    return make_run(home / "logged", seconds=0.5)


def run_case_of(home: Path) -> Callable[[Rng, Path], Case]:
    """Cases over run directories; ``home`` keeps a log of sensors for all of them."""

    def case(rng: Rng, folder: Path) -> Case:
        runs = folder / pick(rng, ("runs", "rüns und mehr"))
        for number in range(int(pick(rng, (1, 1, 2, 3)))):
            _write_run(rng, runs / f"flat-gps-s{number}", home)
        if rng.random() < 0.35:
            _make_campaign(rng, runs)
        return Case(kind="runs", arguments=_run_command(rng, runs, folder), folder=folder)

    return case


def _write_run(rng: Rng, run: Path, home: Path) -> None:
    result, tum = _valid_run()
    result = json.loads(json.dumps(result))
    for _ in range(int(pick(rng, (0, 0, 1, 2, 4)))):
        mutate_tree(rng, result)
    run.mkdir(parents=True)
    put(rng, run / "result.json", json.dumps(result, ensure_ascii=rng.random() < 0.5), 0.12)
    config = json.loads(dump_config(Config(scene="flat", estimator="gps")))
    if rng.random() < 0.4:
        mutate_tree(rng, config)
    put(rng, run / "config.json", json.dumps(config), 0.1)
    for name in ("truth", "estimate", "reference"):
        if rng.random() < 0.9:
            put(rng, run / f"{name}.tum", tum, 0.15)
    if rng.random() < 0.3:
        source = _run_with_sensors(home)
        shutil.copy(source / "truth.tum", run / "truth.tum")
        data = (source / "sensors.mcap").read_bytes()
        (run / "sensors.mcap").write_bytes(damaged(rng, data) if rng.random() < 0.6 else data)
    if rng.random() < 0.1:
        put(rng, run / "flight.rrd", "RRF2 nothing", 0.5)
    if rng.random() < 0.05:
        (run / pick(rng, ("result.json", "truth.tum"))).unlink(missing_ok=True)
        if rng.random() < 0.5 and not (run / "result.json").exists():
            (run / "result.json").mkdir()


def _make_campaign(rng: Rng, runs: Path) -> None:
    """The same runs as a campaign's: a plan, rows, a crash."""
    from touchdown.experiments.campaign.results_table import make_row, write_table
    from touchdown.experiments.io.results import RunResult

    inner = runs / "runs"
    inner.mkdir()
    for run in [path for path in runs.iterdir() if path != inner]:
        run.rename(inner / run.name)
    plan: dict[str, Any] = {
        "name": "fuzz",
        "git_revision": None,
        "created_utc": "2026-01-01T00:00:00+00:00",
        "finished_utc": None,
        "sessions": [{"wall_s": 1.0}],
        "mode": "fly",
        "record": "none",
        "limits": {"run_timeout_s": 100.0, "memory_gb": 6.0, "retries": 1},
        "runs": [
            {
                "run_id": f"flat-gps-s{n}",
                "values": {"scene": "flat", "seed": n},
                "config_sha": "0" * 12,
            }
            for n in range(3)
        ],
    }
    for _ in range(int(pick(rng, (0, 0, 1, 2)))):
        mutate_tree(rng, plan)
    put(rng, runs / "campaign.json", json.dumps(plan), 0.1)
    for run in inner.iterdir():
        row = make_row(RunResult.model_validate(_valid_run()[0]), run.name, "fly", "0" * 12)
        if rng.random() < 0.2:
            key = pick(rng, row)
            row[key] = pick(rng, ("x", None, 1.0, [1.0], True))
        try:
            write_table([row], run / "row.parquet")
        except Exception:  # a row that no table can hold
            continue
        if rng.random() < 0.15:
            data = (run / "row.parquet").read_bytes()
            (run / "row.parquet").write_bytes(damaged(rng, data))
    if rng.random() < 0.3:
        crash = {
            "run_id": "flat-gps-s2",
            "scene": "flat",
            "estimator": "gps",
            "seed": 2,
            "wind_kmh": 12.0,
            "error": "died",
        }
        for _ in range(int(pick(rng, (0, 1, 2)))):
            mutate_tree(rng, crash)
        put(rng, runs / "failed" / "flat-gps-s2.json", json.dumps(crash), 0.2)
    if rng.random() < 0.2:
        put(rng, runs / "results.parquet", "PAR1xxxxPAR1", 0.5)


def _run_command(rng: Rng, runs: Path, folder: Path) -> tuple[str, ...]:
    found = sorted(path.parent for path in runs.rglob("config.json"))
    run = str(found[0]) if found else str(runs)
    baseline = folder / "base.json"
    if rng.random() < 0.7:
        flights = [
            {"seed": n, "error_m": 0.1, "outcome": "COMPLETED", "bad": False} for n in range(3)
        ]
        entry = {"scene": "flat", "estimator": "gps", "variant": "land", "flights": flights}
        document = {
            "format": "touchdown-baseline-1",
            "cells": [entry],
            "git_revision": None,
            "config_sha": "0" * 12,
        }
        for _ in range(int(pick(rng, (0, 1, 2)))):
            mutate_tree(rng, document)
        put(rng, baseline, json.dumps(document), 0.2)
    sql = pick(
        rng,
        (
            "select * from runs",
            "describe runs",
            'select avg("position_error_m.mean") from runs',
            "select nope from runs",
            "summarize runs",
        ),
    )
    commands: tuple[tuple[str, ...], ...] = (
        ("report", str(runs)),
        ("report", str(runs), "--json"),
        ("report", str(runs), "--out", str(folder / "rep")),
        ("regress", str(runs), "--baseline", str(baseline)),
        ("regress", str(runs), "--baseline", str(baseline), "--update"),
        ("query", str(runs), sql),
        ("query", str(runs), sql, pick(rng, ("--json", "--csv"))),
        ("campaign", "status", str(runs)),
        ("campaign", "status", str(runs), "--json"),
        ("view", run),
        ("fly", "--replay", run, "--estimator", "gps", "--out", str(folder / "out"), "--quiet"),
        ("fly", "--replay", run, "--out", str(folder / "out"), "--quiet"),
        (
            "fly",
            "--replay",
            run,
            "--estimator",
            "optical_flow",
            "--out",
            str(folder / "out"),
            "--quiet",
        ),
        ("check-estimator", "gps", "--replay", run),
        ("check-estimator", "livo", "--replay", run, "--json"),
        ("fly", "flat", "--config", str(Path(run) / "config.json"), "--out", run, "--quiet"),
    )
    return tuple(pick(rng, commands))
