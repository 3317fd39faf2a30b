"""Positioning error on equal logs: ``livo`` and ``zou2024`` beside odometry of others.

One survey per scene is flown with ``livo`` in the loop and its sensors are logged. The estimators
replay that log as in a flight, causally and from lift-off to the end of the survey. The reference
implementations get its scans (`odometry_baselines`), each with the best setting of its grid. Errors
are means of the distance from the true position, not aligned. An ablation replays the same logs
through an estimator with one part left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
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
from touchdown.experiments.errors import UsageError
from touchdown.experiments.flight.platform import limit_threads
from touchdown.experiments.flight.replay import LoggedRun, open_run, replay, replay_config
from touchdown.experiments.flight.run import fly
from touchdown.experiments.io.run_directory import SENSORS_FILE
from touchdown.experiments.io.tum import Trajectory
from touchdown.experiments.reporting.statistics import mean_interval
from touchdown.scenes.api import short_name

Array = NDArray[np.float64]
Report = Callable[[str], None]
Rows = dict[str, dict[str, Any]]
"""``error_m``, ``cpu_ms`` and ``lost_s`` by row of a table, see `replayed`"""

SCENES = ("crossroad", "lake", "houses", "forest")
_SURVEY_BELOW_M = 0.5
"""The survey begins where the vehicle first is this near to its maximum height."""
WITHOUT_CAMERA = "livo_no_camera"
VARIANTS: dict[str, tuple[str, dict[str, bool]]] = {
    "livo: tight, all on": ("livo", {}),
    "livo: LIDAR only": ("livo", {"use_vision": False}),
    "livo: vision only": ("livo", {"use_lidar": False}),
    "livo: loose": ("livo", {"loose": True}),
    "livo: no degeneracy handling": ("livo", {"use_degeneracy": False}),
    "livo: no closures": ("livo", {"use_closures": False}),
    "zou2024: all on": ("zou2024", {}),
    "zou2024: LIDAR only": ("zou2024", {"use_camera_pose": False}),
    "zou2024: camera only": ("zou2024", {"use_lidar_pose": False}),
    "zou2024: no f_c": ("zou2024", {"use_colour_smoothness": False}),
    "zou2024: no Eq. 12": ("zou2024", {"use_geodesic_depth": False}),
    "zou2024: no bundle": ("zou2024", {"use_bundle": False}),
    "zou2024: no closures": ("zou2024", {"use_closures": False}),
}
"""Estimator and changed parameters by name of the variant."""

_MIN_LOGS = 3
"""of an interval"""

ESTIMATORS = {
    "livo": "livo: tight, all on",
    WITHOUT_CAMERA: "livo: LIDAR only",
    "zou2024": "zou2024: all on",
}
"""Variants beside the references, which are compared with `WITHOUT_CAMERA`: like them it sees no
image."""


def bench_log(
    logged: LoggedRun, seconds: float | None, report: Report, methods: Sequence[str] = ()
) -> dict[str, Any]:
    """Errors and costs of all methods over one log, of its first ``seconds`` after lift-off where
    these are given: ``error_m``, ``cpu_ms``, ``lost_s`` by method, ``best`` setting of the
    reference implementations, and ``settings`` with every setting and its error. ``methods``: some
    of them, or all. Raises UsageError."""
    chosen = chosen_methods(methods)
    end_s = _end_s(logged, seconds)
    rows: Rows = {}
    for name in (name for name in ESTIMATORS if name in chosen):
        report(name)
        rows[name] = replayed(logged, ESTIMATORS[name], end_s)
    truth, references = Trajectory(logged.path / "truth.tum"), [m for m in GRIDS if m in chosen]
    scans = logged_scans(logged, end_s) if references else []
    lidar, survey_s = logged.sensors.rig.body_from_lidar, _survey_s(truth)
    tried: dict[str, list[dict[str, Any]]] = {method: [] for method in references}
    for method in references:
        for setting in settings(method):
            report(f"{method} {setting}")
            track = run_reference(method, setting, scans, truth.pose, lidar, survey_s)
            tried[method].append(_reference_row(track, truth))
        rows[method] = min(tried[method], key=_badness)
    figures = {
        figure: {name: row[figure] for name, row in rows.items()}
        for figure in ("error_m", "cpu_ms", "lost_s")
    }
    best = {method: rows[method]["setting"] for method in references}
    return {**figures, "best": best, "settings": tried}


def ablate_log(
    logged: LoggedRun, seconds: float | None, report: Report, methods: Sequence[str] = ()
) -> Rows:
    """`replayed` by variant of ``methods`` (`variants`)."""
    rows: Rows = {}
    for variant in variants(methods):
        report(variant)
        rows[variant] = replayed(logged, variant, _end_s(logged, seconds))
    return rows


def _end_s(logged: LoggedRun, seconds: float | None) -> float:
    return math.inf if seconds is None else logged.from_s + seconds


def _survey_s(truth: Trajectory) -> float:
    """Time at which the vehicle first reaches the height of the survey."""
    heights = truth.positions[:, 2]
    return float(truth.times_s[np.argmax(heights > heights.max() - _SURVEY_BELOW_M)])


def replayed(logged: LoggedRun, variant: str, end_s: float = math.inf) -> dict[str, Any]:
    """Result of one of `VARIANTS` on one log until ``end_s``: ``error_m``, ``cpu_ms`` of one core
    per 0.1 s of data, and ``lost_s``, the time at which its error exceeded the limit of a flight,
    or None; the error is that until then. Raises UsageError when the log lacks what it needs."""
    estimator, values = VARIANTS[variant]
    changes = tuple(f"{estimator}.{name}={str(value).lower()}" for name, value in values.items())
    config = replay_config(logged.path, estimator, changes, fresh=True)
    result = replay(logged.path, config, until_s=end_s)
    error, timing = result.position_error_m, result.plain()["timing"]
    return {
        "error_m": math.nan if error is None or error.mean is None else error.mean,
        "cpu_ms": timing["stage_ms"]["estimator"],
        "lost_s": timing["sim_s"] if result.outcome == "DIVERGED" else None,
    }


def logged_scans(logged: LoggedRun, end_s: float) -> list[ScanPoints]:
    """The returns of the scans between lift-off and ``end_s`` or the end of the survey."""
    scans: list[ScanPoints] = []
    for obs in logged.sensors.observations(images=False):
        for scan in obs.scans:
            if scan.start_time_s < logged.from_s or scan.end_time_s >= min(end_s, logged.to_s):
                continue
            back = scan.ranges > 0.0
            span_s = scan.end_time_s - scan.start_time_s
            fractions = (scan.time_offsets[back] / span_s).astype(np.float32)
            points = scan.points[back]
            scans.append(ScanPoints(points, fractions, scan.start_time_s, scan.end_time_s))
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
    off = np.reshape(track.positions, (-1, 3)) - truth.at(np.array(track.times_s))[0]
    return {
        "setting": track.setting,
        "error_m": float(np.linalg.norm(off, axis=1).mean()) if len(off) > 1 else math.nan,
        "cpu_ms": 1e3 * track.cpu_s / max(track.data_s / 0.1, 1e-9),
        "lost_s": track.lost_s,
    }


def bench_estimator(
    scenes: Sequence[str],
    *,
    seeds: Sequence[int],
    runs: Path,
    ablate: bool = False,
    seconds: float | None = None,
    report: Report = lambda _text: None,
    methods: Sequence[str] = (),
) -> dict[str, Any]:
    """Flies the surveys that ``runs`` lacks, one directory ``SCENE-SEED`` each, and compares.

    ``seeds``: one for all scenes, or one each. ``methods``: some of the rows, or all. Returns what
    `summary` does and the details by log; with ``ablate`` what `ablate_log` returns, by log. All of
    it is open loop: the path of the vehicle does not depend on the row. Raises UsageError.
    """
    if ablate:
        variants(methods)
    else:
        chosen_methods(methods)
        require_references()
    logs, found = logs_of(scenes, seeds), {}
    for name, (scene, seed) in logs.items():

        def report_log(text: str, log: str = name) -> None:
            report(f"{log}: {text}")

        logged = open_run(logged_survey(scene, seed, runs, report_log))
        measure = ablate_log if ablate else bench_log
        found[name] = measure(logged, seconds, report_log, methods)
    if ablate:
        return {"seed": list(seeds), "seconds": seconds, "ablation": found}
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


def logged_survey(scene: str, seed: int, runs: Path, report: Report) -> Path:
    """The run directory of a survey with sensor log below ``runs``, flown unless it exists."""
    limit_threads()
    run = runs / f"{short_name(scene)}-{seed}"
    if not (run / SENSORS_FILE).is_file():
        config = load_config(
            None, scene=scene, seed=seed, estimator="livo", record=False, survey_only=True,
            log_sensors=True,
        )  # fmt: skip
        fly(config, run, lambda time_s, phase, _note: report(f"flying, {time_s:.0f} s, {phase}"))
    return run


# -------------------------------------------------------------------------------------- ablation


def whole(variant: str) -> str:
    """The variant with everything on that ``variant`` is compared with."""
    return next(name for name, made in VARIANTS.items() if made == (VARIANTS[variant][0], {}))


def variants(methods: Sequence[str]) -> list[str]:
    """Those of the estimators or with the names in ``methods``; all for none. Raises UsageError."""
    estimators = {estimator for estimator, _ in VARIANTS.values()}
    for name in methods:
        if name not in VARIANTS and name not in estimators:
            one_of = ", ".join([*sorted(estimators), *VARIANTS])
            raise UsageError(f"--ablate has no '{name}'; name one of: {one_of}")
    chosen = [v for v in VARIANTS if v in methods or VARIANTS[v][0] in methods]
    compared = {*chosen, *map(whole, chosen)}
    return [v for v in VARIANTS if v in compared] if methods else list(VARIANTS)


def ablation_table(found: Mapping[str, Rows]) -> str:
    """Markdown table, one column per log: mean error in metres, or the time of the loss; of three
    logs and more what leaving the part out adds to the error, with its interval."""
    logs = list(found)
    rows = [variant for variant in VARIANTS if variant in found[logs[0]]]
    heads = ["variant", *logs] + ["more error, 95 %"] * (len(logs) >= _MIN_LOGS)
    lines = ["| " + " | ".join(heads) + " |", "|---|" + "---|" * (len(heads) - 1)]
    for variant in rows:
        cells = [_cell(found[log][variant]) for log in logs]
        if len(logs) >= _MIN_LOGS:
            cells.append(_more(found, variant))
        lines.append(f"| {variant} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _more(found: Mapping[str, Rows], variant: str) -> str:
    """By how much the error over all logs exceeds that of the whole estimator."""
    pairs = [(rows[variant], rows[whole(variant)]) for rows in found.values()]
    if whole(variant) == variant or any(
        row["lost_s"] is not None for pair in pairs for row in pair
    ):
        return "–"
    errors = np.array([[row["error_m"] for row in pair] for pair in pairs])
    more = mean_interval(errors[:, 0] - errors[:, 1])
    assert more is not None
    return f"{more.value:+.3f} [{more.low:+.3f}, {more.high:+.3f}]"


def _cell(row: Mapping[str, Any]) -> str:
    lost = row["lost_s"]
    return f"{row['error_m']:.3f}" if lost is None else f"lost at {lost:.0f} s"
