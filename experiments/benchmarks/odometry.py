"""Positioning error on equal logs: ``livo`` and ``zou2024`` beside odometry of others.

One survey per scene is flown with ``livo`` in the loop and its sensors are logged. The estimators
replay that log as in a flight, causally and from lift-off to the end of the survey. The reference
implementations get its scans (`odometry_baselines`), each with the best setting of its grid. Errors
are means of the distance from the true position, not aligned.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.benchmarks.odometry_baselines import (
    GRIDS,
    OdometryTrack,
    ScanPoints,
    require_references,
    run_reference,
    settings,
)
from touchdown.experiments.config.loading import load_config
from touchdown.experiments.config.schema import Config
from touchdown.experiments.errors import UsageError
from touchdown.experiments.flight.replay import LoggedRun, open_run, replay, replay_config
from touchdown.experiments.io.tum import Trajectory
from touchdown.scenes.api import short_name

Array = NDArray[np.float64]
Report = Callable[[str], None]

SCENES = ("crossroad", "lake", "houses", "forest")
_SURVEY_BELOW_M = 0.5
"""The survey begins where the vehicle first is this near to its greatest height."""
WITHOUT_CAMERA = "livo_no_camera"
ESTIMATORS: dict[str, tuple[str, tuple[str, ...]]] = {
    "livo": ("livo", ()),
    WITHOUT_CAMERA: ("livo", ("livo.use_vision=false",)),
    "zou2024": ("zou2024", ()),
}
"""Estimator and changed parameters by name. References are compared with `WITHOUT_CAMERA`, which
like them sees no image."""


def flight_config(scene: str, seed: int) -> Config:
    """Configuration of the logged survey, in the default profile. Raises UsageError."""
    return load_config(
        None, scene=scene, seed=seed, estimator="livo", record=False, survey_only=True,
        log_sensors=True,
    )  # fmt: skip


def bench_log(
    logged: LoggedRun, seconds: float | None, report: Report, methods: Sequence[str] = ()
) -> dict[str, Any]:
    """Errors and costs of all methods over one log, of its first ``seconds`` after lift-off where
    these are given: ``error_m``, ``cpu_ms``, ``lost_s`` by method, ``best`` setting of the
    reference implementations, and ``settings`` with every setting and its error. ``methods``: some
    of them, or all. Raises UsageError."""
    chosen = set(chosen_methods(methods))
    end_s = math.inf if seconds is None else logged.from_s + seconds
    found: dict[str, Any] = {"error_m": {}, "cpu_ms": {}, "lost_s": {}, "best": {}, "settings": {}}
    for name in (name for name in ESTIMATORS if name in chosen):
        report(name)
        estimator, changes = ESTIMATORS[name]
        for figure, value in replayed(logged, estimator, changes, end_s).items():
            found[figure][name] = value
    truth, references = (
        Trajectory(logged.path / "truth.tum"),
        [method for method in GRIDS if method in chosen],
    )
    scans = logged_scans(logged, end_s) if references else []
    lidar, survey_s = logged.sensors.rig.body_from_lidar, _survey_s(truth)
    for method in references:
        rows = []
        for setting in settings(method):
            report(f"{method} {setting}")
            track = run_reference(method, setting, scans, truth.pose, lidar, survey_s)
            rows.append(_reference_row(track, truth))
        _add_best(found, method, rows)
    return found


def _survey_s(truth: Trajectory) -> float:
    """Time at which the vehicle first reaches the height of the survey."""
    heights = truth.positions[:, 2]
    return float(truth.times_s[np.argmax(heights > heights.max() - _SURVEY_BELOW_M)])


def _add_best(found: dict[str, Any], method: str, rows: list[dict[str, Any]]) -> None:
    best = min(rows, key=_badness)
    for name in ("error_m", "cpu_ms", "lost_s"):
        found[name][method] = best[name]
    found["best"][method] = best["setting"]
    found["settings"][method] = rows


def replayed(
    logged: LoggedRun, estimator: str, changes: tuple[str, ...], end_s: float = math.inf
) -> dict[str, Any]:
    """Result of an estimator with ``KEY=VALUE`` ``changes`` on one log until ``end_s``:
    ``error_m``, ``cpu_ms`` of one core per 0.1 s of data, and ``lost_s``, the time at which its
    error exceeded the limit of a flight, or None; the error is that until then. Raises UsageError
    when the log lacks what it needs."""
    config = replay_config(logged.path, estimator, changes, fresh=True)
    result = replay(logged.path, config, until_s=end_s)
    error, timing = result.position_error_m, result.plain()["timing"]
    return {
        "error_m": math.nan if error is None or error.mean is None else error.mean,
        "cpu_ms": timing["stage_ms"]["estimator"],
        "lost_s": timing["sim_s"] if result.outcome == "DIVERGED" else None,
    }


def mean_error_m(true: Sequence[Array], estimated: Sequence[Array]) -> float:
    """Mean distance of N positions (3,), not aligned: the APE of the translation."""
    if len(true) < 2:
        return math.nan
    return float(np.linalg.norm(np.array(estimated) - np.array(true), axis=1).mean())


def logged_scans(logged: LoggedRun, end_s: float) -> list[ScanPoints]:
    """The returns of the scans between lift-off and ``end_s`` or the end of the survey."""
    scans: list[ScanPoints] = []
    for obs in logged.sensors.observations(images=False):
        for scan in obs.scans:
            if scan.start_time_s < logged.from_s or scan.end_time_s >= min(end_s, logged.to_s):
                continue
            back = scan.ranges > 0.0
            span_s = scan.end_time_s - scan.start_time_s
            shares = (scan.time_offsets[back] / span_s).astype(np.float32)
            points = scan.points[back]
            scans.append(ScanPoints(points, shares, scan.start_time_s, scan.end_time_s))
        if obs.time_s > end_s + 1.0:
            break
    return scans


def _badness(row: dict[str, Any]) -> tuple[float, float]:
    """Sort key: lost settings are the worst, the sooner lost the worse."""
    lost_s, error_m = row["lost_s"], row["error_m"]
    return (
        -math.inf if lost_s is None else -lost_s,
        math.inf if math.isnan(error_m) else error_m,
    )


def _reference_row(track: OdometryTrack, truth: Trajectory) -> dict[str, Any]:
    true = [truth.pose(time_s).translation for time_s in track.times_s]
    return {
        "setting": track.setting,
        "error_m": mean_error_m(true, track.positions),
        "cpu_ms": 1e3 * track.cpu_s / max(track.data_s / 0.1, 1e-9),
        "lost_s": track.lost_s,
    }


def bench_estimator(
    scenes: Sequence[str],
    *,
    seeds: Sequence[int],
    runs: Path,
    seconds: float | None = None,
    report: Report = lambda _text: None,
    methods: Sequence[str] = (),
) -> dict[str, Any]:
    """Flies the surveys that ``runs`` lacks, one directory ``SCENE-SEED`` each, and compares.

    ``seeds``: one for all scenes, or one each. ``methods``: some of the rows, or all. Returns what
    `summary` does and the details by log. Raises UsageError.
    """
    chosen_methods(methods)
    require_references()
    logs, found = logs_of(scenes, seeds), {}
    for name, (scene, seed) in logs.items():
        report_log = partial(_report_log, report, name)
        logged = open_run(logged_survey(scene, seed, runs, report_log))
        found[name] = bench_log(logged, seconds, report_log, methods)
    seed_of = {name: seed for name, (_, seed) in logs.items()}
    return {"seed": seed_of, "seconds": seconds, **summary(found), "scenes": found}


def summary(found: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Figures over all logs from those of `bench_log` of each: ``error_m.LOG.METHOD``,
    ``ms_per_0.1s.METHOD`` (mean over logs) and ``ratio.LOG`` with its ``geometric_mean``: the best
    reference over ``livo`` without camera."""
    methods = [
        name
        for name in (*ESTIMATORS, *GRIDS)
        if all(name in figures["error_m"] for figures in found.values())
    ]
    return {
        "error_m": {log: figures["error_m"] for log, figures in found.items()},
        "ratio": _ratios(found, [name for name in methods if name in GRIDS]),
        "ms_per_0.1s": {
            name: float(np.mean([figures["cpu_ms"][name] for figures in found.values()]))
            for name in methods
        },
    }


def _ratios(found: dict[str, dict[str, Any]], methods: Sequence[str]) -> dict[str, float]:
    """Of the best of these, one that is not lost where there is one; empty where none ran."""
    ratios = {}
    for log, figures in found.items():
        errors, lost = figures["error_m"], figures["lost_s"]
        known = [method for method in methods if not math.isnan(errors[method])]
        kept = [method for method in known if lost[method] is None] or known
        if kept and WITHOUT_CAMERA in errors:
            ratios[log] = min(errors[method] for method in kept) / errors[WITHOUT_CAMERA]
    if not ratios:
        return {}
    mean = math.exp(float(np.mean([math.log(ratio) for ratio in ratios.values()])))
    return {**ratios, "geometric_mean": mean}


def chosen_methods(methods: Sequence[str]) -> Sequence[str]:
    """These rows of the table, or all where none is named. Raises UsageError for an unknown one."""
    every = (*ESTIMATORS, *GRIDS)
    if unknown := [name for name in methods if name not in every]:
        raise UsageError(f"'{unknown[0]}' is no method; known ones: {', '.join(every)}")
    return methods or every


def logs_of(scenes: Sequence[str], seeds: Sequence[int]) -> dict[str, tuple[str, int]]:
    """Scene and seed by the name of a log: its scene, with the seed where the scene is given more
    than once. ``seeds``: one for all scenes, or one each. Raises UsageError for another number of
    them."""
    if len(seeds) not in (1, len(scenes)):
        raise UsageError(f"{len(seeds)} seeds for {len(scenes)} scenes; give one, or one each")
    every = seeds if len(seeds) == len(scenes) else (*seeds,) * len(scenes)
    return {
        scene if scenes.count(scene) == 1 else f"{scene} {seed}": (scene, seed)
        for scene, seed in zip(scenes, every, strict=True)
    }


def _report_log(report: Report, log: str, text: str) -> None:
    report(f"{log}: {text}")


def logged_survey(scene: str, seed: int, runs: Path, report: Report) -> Path:
    """The run directory of a survey with sensor log below ``runs``, flown unless it exists."""
    from touchdown.experiments.flight.platform import limit_threads
    from touchdown.experiments.flight.run import fly
    from touchdown.experiments.io.sensor_log import FILE_NAME

    limit_threads()
    run = runs / f"{short_name(scene)}-{seed}"
    if not (run / FILE_NAME).is_file():
        config = flight_config(scene, seed)
        fly(config, run, lambda time_s, phase, _note: report(f"flying, {time_s:.0f} s, {phase}"))
    return run
