"""Cases over run directories, campaigns, baselines, reproductions, calibrations and queries."""

import copy
import json
import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from touchdown.experiments.config.loading import dump_config
from touchdown.experiments.config.schema import Config

from fuzz.cases import Case
from fuzz.config_kinds import FLOOR, config_document
from fuzz.mutations import (
    MARKED,
    NUMBERS,
    Rng,
    chance,
    flipped,
    json_text,
    misspelt,
    mutate_tree,
    pick,
    put,
)

POSES = ("truth", "estimate", "reference")


@cache
def _valid_result() -> dict[str, Any]:
    from support.campaign_fakes import fake_result

    errors = ("mean", "rmse", "max", "x", "y", "z")
    landed = {
        "safe_geometry": True, "slope_deg": 1.0, "commanded_xy_m": [1.0, 2.0], "class_true": "lawn",
    }  # fmt: skip
    return {
        **fake_result(Config(scene="flat", estimator="gps"), "COMPLETED"),
        "landing": landed,
        "span_s": [0.9, None],
        "position_error_m": {**dict.fromkeys(errors, 0.1), "yaw_deg": 1.0},
        "map": {
            "duration_s": 18.0,
            "density_per_m2": 900.0,
            "levelness_error_deg": {"mean": 0.2, "max": 0.5, "places": 3},
        },
        "nees": {"median": 2.4, "mean": 3.0, "below_14_2": 0.99, "samples": 100},
        "trajectory_variance_m2": 0.1,
        "phases": [{"time_s": 0.0, "phase": "INIT"}, {"time_s": 0.7, "phase": "TAKEOFF"}],
        "events": [{"time_s": 1.0, "text": "x"}],
    }


def _tum_rows() -> list[str]:
    return [f"{0.1 * n:.3f} {n} 0 {min(3 * n, 30)} 0 0 0 1" for n in range(40)]


def write_run(
    rng: Rng, run: Path, *, changes: int = 0, tum: Callable[[str], str | bytes] | None = None
) -> None:
    """A run directory; ``changes``: of its result and its configuration; ``tum`` makes what stands
    in one of the trajectories."""
    run.mkdir(parents=True)
    result = copy.deepcopy(_valid_result())
    for _ in range(changes):
        mutate_tree(rng, result)
    put(rng, run / "result.json", json_text(rng, result) if changes else json.dumps(result),
        0.12 if changes else 0.0)  # fmt: skip
    plain = json.loads(dump_config(Config(scene="flat", estimator="gps")))
    config = config_document(rng) if changes and chance(rng, 0.5) else plain
    put(rng, run / "config.json", json.dumps(config), 0.1 if changes else 0.0)
    text = "\n".join(_tum_rows()) + "\n"
    changed = pick(rng, POSES) if tum else ""
    for name in POSES:
        data = tum(text) if tum and (name == changed or chance(rng, 0.3)) else text
        put(rng, run / f"{name}.tum", data, 0.1 if tum and name == changed else 0.0)


def _read_commands(runs: str, run: str) -> tuple[tuple[str, ...], ...]:
    """Commands that read finished runs."""
    return (
        ("report", runs),
        ("report", runs, "--json"),
        ("report", runs, "--out", "rep"),
        ("query", runs, "select * from runs"),
        ("query", runs, "describe runs", "--json"),
        (
            "query",
            runs,
            'select avg("position_error_m.mean"), scene from runs group by all',
            "--csv",
        ),
        ("regress", runs, "--baseline", "base.json"),
        ("regress", runs, "--baseline", "new.json", "--update"),
        ("view", run),
        ("export", run, "--format", "tum", "--out", "rep"),
        ("export", run, "--format", "csv", "--out", "rep"),
        ("fly", "--replay", run, "--out", "out", "--quiet"),
    )


_READ_WRITES = ("rep", "new.json", "out", "runs/report", "[x]/report")


def run_case(rng: Rng, folder: Path, _shared: Path) -> Case:
    """``result.json`` and ``config.json`` of up to three runs."""
    runs = pick(rng, ("runs", "runs", "[x]"))
    scene = pick(rng, ("flat", "flat", *(text for text in MARKED if "/" not in text)))
    scene = "".join(c for c in scene if c > "\0" and not "\ud800" <= c <= "\udfff")
    count = int(pick(rng, (1, 1, 2, 3)))
    for number in range(count):
        changes = int(pick(rng, (0, 1, 2, 4)))
        write_run(rng, folder / runs / f"{scene}-gps-s{number}", changes=changes)
    if chance(rng, 0.5):
        put(rng, folder / "base.json", json.dumps(_baseline()), 0.0)
    commands = _read_commands(runs, f"{runs}/{scene}-gps-s0")
    return Case(arguments=pick(rng, commands), writes=_READ_WRITES)


_PLAN_TOML = """name = "fuzz"
mode = "fly"
record = "none"
[axes]
scene = ["flat"]
estimator = ["gps"]
seeds = "0-2"
"""


def _made_plan(folder: Path) -> dict[str, Any]:
    """What ``touchdown campaign`` writes for `_PLAN_TOML`."""
    from touchdown.experiments.campaign.directory import settle_plan
    from touchdown.experiments.campaign.plan import load_plan

    (folder / "c.toml").write_text(_PLAN_TOML)
    (folder / "made").mkdir()
    settle_plan(load_plan(folder / "c.toml"), folder / "made", "abc")
    tree: dict[str, Any] = json.loads((folder / "made" / "campaign.json").read_text())
    shutil.rmtree(folder / "made")
    return tree


def plan_case(rng: Rng, folder: Path, _shared: Path) -> Case:
    """``campaign.json`` and the crashes of a campaign that is resumed, looked at, reported on."""
    plan = _made_plan(folder)
    if chance(rng, 0.5):
        _aim_elsewhere(rng, plan)
    for _ in range(int(pick(rng, (0, 0, 1, 2)))):
        mutate_tree(rng, plan)
    put(rng, folder / "out" / "campaign.json", json_text(rng, plan), 0.1)
    if chance(rng, 0.6):
        shutil.copy(folder / "c.toml", folder / "out" / "campaign.toml")
    for number in range(int(pick(rng, (0, 0, 1, 3)))):
        _finished_run(rng, folder / "out" / "runs" / f"flat-gps-s{number}")
    if chance(rng, 0.4):
        crash = {
            "run_id": "flat-gps-s2", "scene": "flat", "estimator": "gps", "seed": 2,
            "wind_kmh": 12.0, "error": "died",
        }  # fmt: skip
        for _ in range(int(pick(rng, (0, 1, 2)))):
            mutate_tree(rng, crash)
        name = pick(rng, ("flat-gps-s2.json", "other.json", "[x].json"))
        put(rng, folder / "out" / "failed" / name, json_text(rng, crash), 0.2)
    if chance(rng, 0.15):
        _put_strangers(rng, folder / "out")
    commands: tuple[tuple[str, ...], ...] = (
        *[("campaign", "c.toml", "--out", "out", "--quiet")] * 4,
        ("campaign", "c.toml", "--out", "out", "--quiet", "--shard", "1/2"),
        ("campaign", "status", "out"),
        ("campaign", "status", "out", "--json"),
        ("report", "out"),
        ("query", "out", "select * from runs"),
    )
    return Case(arguments=pick(rng, commands), writes=("out",))


def _aim_elsewhere(rng: Rng, plan: dict[str, Any]) -> None:
    """Names in the plan lead out of the campaign's directory."""
    run = pick(rng, plan["runs"])
    key = pick(rng, ("run_id", "run_id", "run_id", "values"))
    aim = pick(rng, ("../../x", "../x", "/nonexistent/x", "..", "", ".", "a/b", *MARKED))
    if key == "run_id":
        run["run_id"] = aim
    elif isinstance(run.get("values"), dict):
        run["values"][pick(rng, ("scene", "estimator", "seed", "calibration"))] = aim


def _finished_run(rng: Rng, run: Path) -> None:
    from touchdown.experiments.campaign.results_table import make_row, write_table
    from touchdown.experiments.io.results import RunResult

    write_run(rng, run, changes=int(pick(rng, (0, 0, 1))))
    row = make_row(RunResult.model_validate(_valid_result()), run.name, "fly", "0" * 12)
    write_table([row], run / "row.parquet")


def _put_strangers(rng: Rng, out: Path) -> None:
    target = pick(rng, ("runs", "failed", ".partial", "runs/flat-gps-s9", "results.parquet"))
    (out / target).parent.mkdir(parents=True, exist_ok=True)
    if not (out / target).exists():
        (out / target).symlink_to(pick(rng, ("../x", "/dev/zero", "gone", target)))


def parquet_case(rng: Rng, folder: Path, _shared: Path) -> Case:
    """``row.parquet`` and ``results.parquet``: other types, other columns, damaged."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    plan = _made_plan(folder)
    put(rng, folder / "out" / "campaign.json", json.dumps(plan), 0.0)
    for number in range(int(pick(rng, (1, 2, 3)))):
        run = folder / "out" / "runs" / f"flat-gps-s{number}"
        _finished_run(rng, run)
        file = run / "row.parquet"
        table = pq.read_table(file)
        for _ in range(int(pick(rng, (0, 1, 1, 3)))):
            table = _other_table(rng, table, pa)
        pq.write_table(table, file, compression=pick(rng, ("snappy", "zstd", "none", "gzip")))
        if chance(rng, 0.3):
            data = file.read_bytes()
            file.unlink()
            put(rng, file, flipped(rng, data) if chance(rng, 0.4) else data, 0.6)
    if chance(rng, 0.2):
        put(rng, folder / "out" / "results.parquet", "PAR1xxxxPAR1", 0.5)
    commands: tuple[tuple[str, ...], ...] = (
        ("campaign", "status", "out"),
        ("report", "out"),
        ("query", "out", "select * from runs"),
        ("query", "out", "select * from runs", "--json"),
        ("regress", "out", "--baseline", "base.json", "--update"),
    )
    return Case(arguments=pick(rng, commands), writes=("out", "base.json"))


def _other_table(rng: Rng, table: Any, pa: Any) -> Any:
    names = table.column_names
    at = int(rng.integers(len(names)))
    count = len(table)
    new = pick(rng, (
        [float(pick(rng, (np.nan, np.inf, -1.0, 1e300)))], [pick(rng, ("", "[/x]", "\x1b[31m"))],
        [[1.0]], [b"\xff\xfe"], [2**63 - 1], [None], [{"a": 1}], [True],
    ))  # fmt: skip
    column = pa.array(new * count)
    title = str(pick(rng, (names[at], misspelt(rng, names[at]), *MARKED[:7], "x")))
    return pick(rng, (
        lambda: table.remove_column(at), lambda: table.append_column(title, column),
        lambda: table.set_column(at, title, column),
        lambda: table.set_column(at, names[at], column),
        lambda: pa.concat_tables([table[: int(rng.integers(2))]] * int(pick(rng, (1, 2, 50)))),
    ))()  # fmt: skip


def _baseline() -> dict[str, Any]:
    flights = [
        {"seed": n, "outcome": "COMPLETED", "bad": False, "figures": {"position_error_m.mean": 0.1}}
        for n in range(3)
    ]
    cell = {"scene": "flat", "estimator": "gps", "variant": "land", "flights": flights}
    return {
        "format": "touchdown-baseline-1", "cells": [cell], "git_revision": "abc",
        "config_sha": "0" * 12,
    }  # fmt: skip


def baseline_case(rng: Rng, folder: Path, _shared: Path) -> Case:
    """``regress --baseline``."""
    for number in range(int(pick(rng, (1, 2, 3)))):
        write_run(rng, folder / "runs" / f"flat-gps-s{number}")
        file = folder / "runs" / f"flat-gps-s{number}" / "result.json"
        result = json.loads(file.read_text())
        file.write_text(json.dumps({**result, "seed": number}))
    document = _baseline()
    for _ in range(int(pick(rng, (0, 1, 1, 2, 4)))):
        mutate_tree(rng, document)
    put(rng, folder / "base.json", json_text(rng, document), 0.15)
    more: tuple[str, ...] = pick(
        rng, ((), (), ("--json",), ("--update",), ("--margin", str(pick(rng, NUMBERS))),
              ("--require-power",)),
    )  # fmt: skip
    arguments = ("regress", "runs", "--baseline", "base.json", *more)
    return Case(arguments=arguments, writes=("base.json",) if "--update" in more else ())


_CALIBRATION: dict[str, Any] = {
    "camera": {
        "width": 848, "height": 480, "fx": 617.0, "fy": 625.0, "cx": 423.5, "cy": 239.5,
        "distortion": [0.0, 0.0, 0.0, 0.0, 0.0],
    },
    "camera_from_lidar": {
        "rotation_quat_wxyz": [0.5, -0.5, 0.5, -0.5],
        "translation_m": [0.0, 0.0, 0.1],
    },
    "residuals": {"reprojection_rms_px": 0.1, "plane_rms_m": 0.01},
    "views_used": 12,
}  # fmt: skip


def calibration_case(rng: Rng, folder: Path, _shared: Path) -> Case:
    """``--calibration FILE``, and ``--set zou2024.edge_model=FILE``."""
    (folder / "floor.xml").write_text(FLOOR)
    start = ("fly", "floor.xml", "--quiet", "--no-record", "--estimator")
    if chance(rng, 0.15):
        from fuzz.kinds import ROOT

        shipped = next((ROOT / "estimator" / "zou2024").rglob("*.yml.gz")).read_bytes()
        name = pick(rng, ("edges.yml.gz", "edges.yml", "edges"))
        put(rng, folder / name, pick(rng, (shipped, b"%YAML:1.0\n---\nntrees: 1\n")), 0.8)
        return Case(arguments=(*start, "zou2024", "--set", f"zou2024.edge_model={name}"))
    tree = copy.deepcopy(_CALIBRATION)
    for _ in range(int(pick(rng, (0, 1, 1, 2)))):
        mutate_tree(rng, tree)
    put(rng, folder / "cal.json", json_text(rng, tree), 0.15)
    target = "cal.json" if chance(rng, 0.95) else pick(rng, (".", "/dev/zero", "gone", ""))
    return Case(arguments=(*start, "gps", "--calibration", target))


def reproduction_case(rng: Rng, folder: Path, _shared: Path) -> Case:
    """``part.json`` and ``reproduction.json``: the state of a reproduction that is continued."""
    from touchdown.experiments.reproduce.parts import PARTS, Extent

    extent = Extent(quick=True, photographs=())
    out = folder / "out"
    put(rng, out / "reproduction.json", '{"edition": "quick"}\n', 0.1)
    for part in PARTS:
        if chance(rng, 0.2):
            continue
        state: dict[str, Any] = {
            "part": part.name,
            "edition": "quick",
            "settings": json.loads(json.dumps(part.settings(extent))),
            "figures": {"pictures": ["a.jpg"], "crashed": 0, "remaining": 0, "runs": 3},
            "why": pick(rng, ("", "", "its errors are too large", *MARKED)),
            "error": pick(rng, ("", "", "", *MARKED)),
            "wall_s": 3.0,
            "finished_utc": "2026-01-01T00:00:00+00:00",
            "git_revision": "abc",
        }
        for _ in range(int(pick(rng, (0, 0, 1, 2)))):
            mutate_tree(rng, state)
        put(rng, out / part.name / "part.json", json_text(rng, state), 0.1)
    if chance(rng, 0.2):
        put(rng, out / pick(rng, PARTS).name / pick(rng, ("campaign.json", "runs")), "{}", 0.5)
    skip = [name for part in PARTS if chance(rng, 0.3) for name in ("--skip", part.name)]
    more = pick(rng, ((), ("--json",)))
    command = ("reproduce", "--out", "out", "--jobs", "1", "--quiet")
    quick = ("--quick",) if chance(rng, 0.9) else ()
    return Case(arguments=(*command, *quick, *skip, *more), writes=("out",))
