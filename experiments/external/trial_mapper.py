"""The examination of a mapper: synthetic scans of rolling ground from true poses."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from touchdown.estimator.api import Estimate, MapperRig, MapView
from touchdown.experiments.external.conformance_report import Findings
from touchdown.experiments.external.loading import Build
from touchdown.experiments.external.part_checks import wrong_map, wrong_mapper
from touchdown.experiments.external.synthetic_stream import SyntheticStream, ground_height
from touchdown.experiments.external.trial import COMMON_RULES, Trial
from touchdown.sim.api import Observation, SensorNeeds
from touchdown.sim.frames import Pose

OFF_M, LEAST_M2 = 0.1, 3.0
"""largest median error of the heights, and least area mapped, after three seconds"""
RULES: Mapping[str, str] = {
    **COMMON_RULES,
    "heights": f"the median height of the map's cells is within {OFF_M:g} m of the ground, over "
    f"{LEAST_M2:g} square metres or more",
    "version": "version does not fall, and rises with the scans",
}

_SECONDS = 3.0


def examine_mapper(build: Build, rig: MapperRig, params: Mapping[str, Any]) -> Findings:
    """The broken rules of a mapper, its latency, and the error of its heights."""
    trial = Trial("mapper", build, params, rig, lambda part: wrong_mapper(part, rig.sensors))
    trial.sessions(lambda part: _session(trial, part))
    return trial.findings


def true_estimate(stream: SyntheticStream, obs: Observation, tick_hz: int) -> Estimate:
    """The true pose of a synthetic flight as an estimate."""
    before, now = (stream.true_pose(max(tick, 0)) for tick in (obs.tick - 3, obs.tick))
    return Estimate(
        tick=obs.tick,
        time_s=obs.time_s,
        odom_from_body=now,
        world_from_odom=Pose.identity(),
        velocity_odom=(now.translation - before.translation) * tick_hz / 3.0,
        angular_velocity_body=np.zeros(3),
        acceleration_odom=np.zeros(3),
        position_covariance=1e-4 * np.eye(3),
        rotation_covariance=1e-6 * np.eye(3),
    )


def _session(trial: Trial, part: Any) -> Iterator[Any]:
    sensors = trial.rig.sensors
    stream = SyntheticStream(sensors, part.needs | SensorNeeds(lidar=True), _SECONDS)
    last: MapView | None = None
    version = -1
    for obs in stream:
        when, rule = f"at {obs.time_s:.3f} s", "answers" if version > 0 else "missing data"
        estimate = true_estimate(stream, obs, sensors.tick_hz)
        view = trial.ask(part, "update", obs, estimate, when=when, rule=rule)
        if view is None and trial.findings.violations:
            return  # it raised
        if view is not last:
            wrong = wrong_map(view)
            trial.judge(wrong, f"{when} update returned")
            if wrong is not None:
                return
            if view.version < version:
                trial.note("version", f"{when} version fell from {version} to {view.version}")
            last, version = view, view.version
            yield (view.version, view.coarse.height_m, view.coarse.count)
    if last is not None:
        _judge_heights(trial, last)
    if version <= 0:
        trial.note("version", f"version is {version} after {_SECONDS:g} s of scans")


def _judge_heights(trial: Trial, view: MapView) -> None:
    grid = view.coarse
    rows, cols = np.nonzero((grid.count > 0.0) & np.isfinite(grid.height_m))
    centres = grid.origin_xy_m + (np.column_stack([cols, rows]) + 0.5) * grid.cell_m
    area = len(rows) * grid.cell_m**2
    if area < LEAST_M2:
        trial.note("heights", f"{area:.1f} square metres are mapped after {_SECONDS:g} s")
        return
    errors = grid.height_m[rows, cols] - ground_height(centres)
    off = float(np.median(abs(errors)))
    trial.findings.figures["heights"] = f"{off:.3f} m off (median) over {area:.0f} square metres"
    if off > OFF_M:
        trial.note("heights", f"heights are {off:.2f} m off (median of {len(rows)} cells)")
