"""Positioning error on equal logs: ``livo`` and ``zou2024`` beside odometry of others.

One survey per scene is flown with ``livo`` in the loop and its sensors are logged. The estimators
replay that log as in a flight, causally and from lift-off to the end of the survey. The reference
implementations get its scans (`odometry_baselines`), or scans and IMU samples (`inertial`), each
with the best setting of its grid. Errors are those of evo: APE of the translation, not aligned.
"""

from __future__ import annotations

import math
import os
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.benchmarks.inertial import comparison as inertial
from touchdown.experiments.benchmarks.inertial.logfile import write_log
from touchdown.experiments.benchmarks.inertial.methods import METHODS
from touchdown.experiments.benchmarks.odometry_baselines import (
    GRIDS,
    OdometryTrack,
    ScanPoints,
    require_references,
    run_reference,
    settings,
)
from touchdown.experiments.benchmarks.revisits import RevisitFigures, Revisits
from touchdown.experiments.config.loading import load_config
from touchdown.experiments.config.schema import Config
from touchdown.experiments.errors import UsageError
from touchdown.experiments.flight.metrics import PositioningError
from touchdown.experiments.flight.replay import (
    CpuClock,
    LoggedRun,
    check_needs,
    open_run,
    replay_config,
    run_estimator,
    seen_by,
)
from touchdown.scenes.api import short_name
from touchdown.sim.frames import Pose, interpolate_pose

Array = NDArray[np.float64]
Report = Callable[[str], None]

SCENES = ("crossroad", "lake", "houses", "forest")
LIO_PYTHON = "TOUCHDOWN_LIO_PYTHON"
"""Environment variable with the interpreter of the environment of the methods in `inertial`."""
WITHOUT_CAMERA = "livo_no_camera"
ESTIMATORS: dict[str, tuple[str, tuple[str, ...]]] = {
    "livo": ("livo", ()),
    WITHOUT_CAMERA: ("livo", ("livo.use_vision=false",)),
    "zou2024": ("zou2024", ()),
}
"""Estimator and changed parameters by name. References are compared with `WITHOUT_CAMERA`, which
like them sees no image."""
_SURVEY_BELOW_M = 0.5
"""The survey begins where the vehicle first is this near to its greatest height."""


@dataclass(frozen=True, slots=True)
class Measured:
    """Result of one estimator on one log."""

    error_m: float
    """by evo"""
    own_error_m: float
    """by `experiments.flight.metrics.PositioningError` on the same rows"""
    cpu_ms: float
    """of one core per 0.1 s of data"""
    lost_s: float | None
    """time at which its error exceeded the limit of a flight; the error is that until then"""
    revisits: RevisitFigures
    """of estimators that tell in their diagnostics what they looked up"""


def flight_config(scene: str, seed: int) -> Config:
    """Configuration of the logged survey, in the default profile. Raises UsageError."""
    return load_config(
        None, scene=scene, seed=seed, estimator="livo", record=False, survey_only=True,
        log_sensors=True,
    )  # fmt: skip


def bench_scene(
    logged: LoggedRun, seconds: float | None, report: Report, methods: Sequence[str] = ()
) -> dict[str, Any]:
    """Errors and costs of all methods over one log, of its first ``seconds`` after lift-off where
    these are given: ``error_m``, ``cpu_ms``, ``own_difference_m``, ``lost_s`` by method, and
    ``settings`` with every setting of the reference implementations and its error; ``missing`` has
    a line for each method that is not installed. ``methods``: some of them, or all. Raises
    UsageError."""
    chosen = set(chosen_methods(methods))
    end_s = math.inf if seconds is None else logged.from_s + seconds
    found: dict[str, Any] = {
        "error_m": {}, "cpu_ms": {}, "own_difference_m": {}, "lost_s": {}, "best": {},
        "settings": {}, "missing": {},
    }  # fmt: skip
    for name, (estimator, changes) in ESTIMATORS.items():
        if name not in chosen:
            continue
        report(f"{name}")
        config = replay_config(logged.path, estimator, changes, fresh=True)
        measured = measure(logged, config, end_s)
        found["error_m"][name] = measured.error_m
        found["own_difference_m"][name] = abs(measured.error_m - measured.own_error_m)
        found["cpu_ms"][name] = measured.cpu_ms
        found["lost_s"][name] = measured.lost_s
    truth, alone = TruePath(logged), [method for method in GRIDS if method in chosen]
    scans = logged_scans(logged, end_s) if alone else []
    for method in alone:
        rows = []
        for setting in settings(method):
            report(f"{method} {setting}")
            track = run_reference(
                method,
                setting,
                scans,
                truth.at,
                logged.sensors.rig.body_from_lidar,
                truth.survey_s(),
            )
            rows.append(_reference_row(track, truth))
        _add_best(found, method, rows)
    _bench_inertial(found, logged, end_s, report, chosen)
    return found


def _bench_inertial(
    found: dict[str, Any], logged: LoggedRun, end_s: float, report: Report, chosen: set[str]
) -> None:
    if chosen.isdisjoint(METHODS):
        return
    python = os.environ.get(LIO_PYTHON, sys.executable)
    truth, there = TruePath(logged), inertial.installed(python)
    span = (logged.from_s, truth.survey_s(), min(end_s, logged.to_s))
    with tempfile.TemporaryDirectory(prefix="touchdown-lio-") as folder:
        log = Path(folder) / "log.npz"
        for method, facts in METHODS.items():
            if method not in chosen:
                continue
            if facts.package not in there:
                found["missing"][method] = inertial.missing_line(method)
                continue
            if not log.is_file():
                write_log(logged, end_s, log)
            rows = []
            for setting in inertial.settings(method):
                report(f"{method} {setting}")
                track = inertial.run_setting(method, setting, log, truth.at, span, python)
                rows.append(_reference_row(track, truth) | {"failure": track.failure})
            _add_best(found, method, rows)


def _add_best(found: dict[str, Any], method: str, rows: list[dict[str, Any]]) -> None:
    best = min(rows, key=_badness)
    for name in ("error_m", "cpu_ms", "lost_s"):
        found[name][method] = best[name]
    found["best"][method] = best["setting"]
    found["settings"][method] = rows


def measure(logged: LoggedRun, config: Config, end_s: float = math.inf) -> Measured:
    """Replays a log into the estimator of ``config`` until ``end_s``. Raises UsageError when the
    log lacks what it needs."""
    from touchdown.experiments.flight.wiring import build_estimator

    estimator = build_estimator(config, logged.sensors.rig)
    check_needs(config.estimator, estimator, logged.sensors)
    clock, own = CpuClock(), PositioningError()
    revisits = Revisits(logged.sensors.rig, TruePath(logged).at)
    times: list[float] = []
    estimated: list[Array] = []
    true: list[Array] = []
    lost_s, data_s = None, 0.0
    for obs, estimate in run_estimator(estimator, seen_by(estimator.needs, logged.sensors), clock):
        data_s = obs.time_s
        if obs.time_s >= end_s:
            break
        revisits.add(estimate.diagnostics)
        pose = logged.truth.get(obs.tick)
        if pose is None or not logged.judged(obs.tick):
            continue
        position = estimate.world_from_body.translation
        distance = float(np.linalg.norm(position - pose.translation))
        if not distance <= config.referee.divergence_m:
            lost_s = obs.time_s
            break
        own.add(estimate.world_from_body, pose)
        times.append(obs.time_s)
        estimated.append(position)
        true.append(pose.translation)
    cpu_ms = 1e3 * clock.seconds() / max(data_s / 0.1, 1e-9)
    error_m = evo_error(times, true, estimated)
    return Measured(error_m, own.summary().mean or math.nan, cpu_ms, lost_s, revisits.figures())


# ------------------------------------------------------------------------------------- evo


def evo_error(times_s: Sequence[float], true: Sequence[Array], estimated: Sequence[Array]) -> float:
    """evo's mean APE of positions (N, 3) at times (N,), translation part, not aligned."""
    from evo.core import metrics
    from evo.core.trajectory import PoseTrajectory3D
    from evo.main_ape import ape

    if len(times_s) < 2:
        return math.nan
    upright = np.tile([1.0, 0.0, 0.0, 0.0], (len(times_s), 1))  # wxyz; rotations play no part
    reference, estimate = (
        PoseTrajectory3D(np.asarray(rows), upright, np.asarray(times_s))
        for rows in (true, estimated)
    )
    relation = metrics.PoseRelation.translation_part
    return float(ape(reference, estimate, relation, align=False).stats["mean"])


def evo_of_run(run: Path) -> float:
    """Mean error, metres, of ``evo_ape tum truth.tum estimate.tum`` for a run directory between
    lift-off and the end of the survey."""
    from evo.core import metrics, sync
    from evo.main_ape import ape
    from evo.tools import file_interface

    logged = span_of(run)
    paths = [
        file_interface.read_tum_trajectory_file(str(run / f"{name}.tum"))
        for name in ("truth", "estimate")
    ]
    reference, estimate = sync.associate_trajectories(*paths, max_diff=1e-3)
    for path in (reference, estimate):
        path.reduce_to_time_range(*logged)
    relation = metrics.PoseRelation.translation_part
    return float(ape(reference, estimate, relation, align=False).stats["mean"])


def span_of(run: Path) -> tuple[float, float]:
    """Lift-off and end of the survey of a run directory, s."""
    import json

    begin, end = json.loads((run / "result.json").read_text(encoding="utf-8"))["span_s"]
    return float(begin), math.inf if end is None else float(end)


# ------------------------------------------------------------------------------------- the log


class TruePath:
    """True poses of a run at any time, between its logged ones."""

    def __init__(self, logged: LoggedRun) -> None:
        self._hz = logged.sensors.rig.tick_hz
        self._ticks = np.array(sorted(logged.truth))
        self._poses = [logged.truth[tick] for tick in self._ticks.tolist()]
        self._end_s = logged.to_s

    def at(self, time_s: float) -> Pose:
        tick = time_s * self._hz
        last = len(self._ticks) - 2
        row = int(np.clip(np.searchsorted(self._ticks, tick, side="right") - 1, 0, last))
        before, after = self._ticks[row : row + 2]
        share = float((tick - before) / (after - before))
        return interpolate_pose(self._poses[row], self._poses[row + 1], share)

    def survey_s(self) -> float:
        """Time at which the vehicle first reaches the height of the survey."""
        heights = np.array([pose.translation[2] for pose in self._poses])
        there = heights > heights.max() - _SURVEY_BELOW_M
        return float(self._ticks[np.argmax(there)] / self._hz)


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


def _reference_row(
    track: OdometryTrack | inertial.InertialTrack, truth: TruePath
) -> dict[str, Any]:
    true = [truth.at(time_s).translation for time_s in track.times_s]
    return {
        "setting": track.setting,
        "error_m": evo_error(track.times_s, true, track.positions),
        "cpu_ms": 1e3 * track.cpu_s / max(track.data_s / 0.1, 1e-9),
        "lost_s": track.lost_s,
    }


# ------------------------------------------------------------------------------------- together


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
    `summary` does, ``evo_difference_m.SCENE`` (evo on the flight's files less its own figure) and
    the details by scene. Raises UsageError.
    """
    chosen_methods(methods)
    require_references()
    found: dict[str, dict[str, Any]] = {}
    difference: dict[str, float] = {}
    seed_of = seeds_by_scene(scenes, seeds)
    for scene, seed in seed_of.items():
        report_scene = partial(_report_scene, report, scene)
        run = logged_survey(scene, seed, runs, report_scene)
        logged = open_run(run)
        flown_error_m = float(logged.result.value("position_error_m.mean"))
        difference[scene] = evo_of_run(run) - flown_error_m
        found[scene] = bench_scene(logged, seconds, report_scene, methods)
    return {
        "seed": seed_of,
        "seconds": seconds,
        **summary(found),
        "evo_difference_m": difference,
        "scenes": found,
    }


def summary(found: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Figures over all scenes from those of each, as `bench_scene` returns them:
    ``error_m.SCENE.METHOD``, ``ms_per_0.1s.METHOD`` (mean over scenes) and, each with its
    ``geometric_mean``, ``ratio.scans.SCENE`` and ``ratio.inertial.SCENE``: the best reference that
    sees the scans alone, or scans and IMU, over ``livo`` without camera."""
    methods = [
        name
        for name in (*ESTIMATORS, *GRIDS, *METHODS)
        if all(name in figures["error_m"] for figures in found.values())
    ]
    with_imu = [name for name, facts in METHODS.items() if facts.imu]
    alone = [name for name in methods if name not in (*ESTIMATORS, *with_imu)]
    return {
        "error_m": {scene: figures["error_m"] for scene, figures in found.items()},
        "ratio": {
            "scans": _ratios(found, alone),
            "inertial": _ratios(found, [name for name in methods if name in with_imu]),
        },
        "ms_per_0.1s": {
            name: float(np.mean([figures["cpu_ms"][name] for figures in found.values()]))
            for name in methods
        },
        "remarks": {name: METHODS[name].remarks for name in methods if name in METHODS},
    }


def _ratios(found: dict[str, dict[str, Any]], methods: Sequence[str]) -> dict[str, float]:
    """Of the best of these, one that is not lost where there is one; empty where none ran."""
    ratios = {}
    for scene, figures in found.items():
        errors, lost = figures["error_m"], figures["lost_s"]
        known = [method for method in methods if not math.isnan(errors[method])]
        kept = [method for method in known if lost[method] is None] or known
        if kept and WITHOUT_CAMERA in errors:
            ratios[scene] = min(errors[method] for method in kept) / errors[WITHOUT_CAMERA]
    if not ratios:
        return {}
    mean = math.exp(float(np.mean([math.log(ratio) for ratio in ratios.values()])))
    return {**ratios, "geometric_mean": mean}


def chosen_methods(methods: Sequence[str]) -> Sequence[str]:
    """These rows of the table, or all where none is named. Raises UsageError for an unknown one."""
    every = (*ESTIMATORS, *GRIDS, *METHODS)
    if unknown := [name for name in methods if name not in every]:
        raise UsageError(f"'{unknown[0]}' is no method; known ones: {', '.join(every)}")
    return methods or every


def seeds_of(scenes: Sequence[str], seeds: Sequence[int]) -> list[tuple[str, int]]:
    """Scenes, each with its seed, of one for all or one each. Raises UsageError for another number
    of them."""
    if len(seeds) not in (1, len(scenes)):
        raise UsageError(f"{len(seeds)} seeds for {len(scenes)} scenes; give one, or one each")
    every = seeds if len(seeds) == len(scenes) else (*seeds,) * len(scenes)
    return list(zip(scenes, every, strict=True))


def seeds_by_scene(scenes: Sequence[str], seeds: Sequence[int]) -> Mapping[str, int]:
    """Seed by scene, see `seeds_of`."""
    return dict(seeds_of(scenes, seeds))


def _report_scene(report: Report, scene: str, text: str) -> None:
    report(f"{scene}: {text}")


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
