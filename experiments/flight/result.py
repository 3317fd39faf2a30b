"""The result of a flight, from the referee's judgement, the map and the clock."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.api import Outcome
from touchdown.experiments.config.schema import Config
from touchdown.experiments.config.slots import external_parts, other_parts
from touchdown.experiments.flight.choice import choice_of, missed_ground
from touchdown.experiments.flight.condition_checks import as_json, judge_conditions
from touchdown.experiments.flight.metrics import GroundMap, levelness_error_deg
from touchdown.experiments.flight.observers import StepObserver
from touchdown.experiments.flight.referee import Judgement
from touchdown.experiments.flight.stage_timer import StageClock
from touchdown.experiments.flight.truth_lookup import TruthLookup
from touchdown.experiments.flight.wiring import FlightStack
from touchdown.experiments.io.provenance import git_revision, versions
from touchdown.experiments.io.result_parts import (
    LevelnessError,
    MapFigures,
    PartNames,
    StageTimes,
    Timing,
)
from touchdown.experiments.io.results import RunResult
from touchdown.scenes.api import names_function


def make_result(
    config: Config,
    stack: FlightStack,
    judgement: Judgement,
    clock: StageClock,
    observer: StepObserver,
) -> RunResult:
    """Returns the result of a finished flight."""
    origin = stack.scene.origin_m
    place: dict[str, Any] = {"origin_m": (*origin.tolist(),)} if origin.any() else {}
    record = stack.record()
    measured = observer.conditions.measured(record, stack.world.rig, stack.nominal_rig)
    conditions = judge_conditions(config, measured, record.faults, judgement.sim_s)
    no_site = judgement.outcome == Outcome.NO_SITE
    missed = missed_ground(stack.scene, observer.decisions, observer.judged_map, no_site=no_site)
    return RunResult(
        outcome=str(judgement.outcome),
        reason=judgement.reason,
        scene=config.scene,
        seed=config.seed,
        estimator=config.estimator,
        **_parts(config),
        profile=config.profile,
        preset=config.preset,
        wind_kmh=config.wind.mean_kmh,
        **place,
        position_error_m=judgement.position_error,
        span_s=judgement.span_s,
        trajectory_error_m=judgement.deviation.mean_m,
        trajectory_error_max_m=judgement.deviation.max_m,
        trajectory_variance_m2=judgement.deviation.variance_m2,
        slowed_s=observer.slowed_s,
        nees=judgement.nees,
        landing=judgement.landing,
        choice=choice_of(observer.decisions, missed),
        classifier=stack.network or "off",
        map=_map_figures(stack, judgement, observer.judged_map, config.seed),
        timing=_timing(clock, judgement.sim_s),
        versions=versions(),
        git_revision=git_revision(),
        events=observer.events.kept,
        event_count=observer.events.count,
        phases=observer.phases.kept,
        faults=record.faults,
        measured=measured,
        conditions=as_json(conditions),
    )


def _parts(config: Config) -> dict[str, Any]:
    """The parts beside the estimator that are not those by default, and the code of all that is
    from outside."""
    others, external = other_parts(config), dict(external_parts(config))
    told: dict[str, Any] = {"parts": PartNames(**others)} if others else {}
    own_place = names_function(config.scene)
    if not (external or own_place):
        return told
    from touchdown.experiments.external.loading import flown_code, imported_code

    told |= flown_code(config.estimator)
    if own_place:
        told["scene_sha"] = imported_code(config.scene)
    code = {kind: imported_code(name) for kind, name in external.items() if kind in others}
    return told | ({"parts_sha": PartNames(**code)} if code else {})


def _timing(clock: StageClock, sim_s: float) -> Timing:
    wall_s = clock.wall_s()
    return Timing(
        wall_s=wall_s,
        sim_s=sim_s,
        real_time_factor=sim_s / wall_s,
        stage_ms=StageTimes(**clock.stage_ms(sim_s)),
    )


def _map_figures(
    stack: FlightStack, judgement: Judgement, grid: GroundMap, seed: int
) -> MapFigures:
    """``density_per_m2``: returns per square metre of the mapped area at the end of the survey."""
    seen = grid.count > 0
    area = float(seen.sum()) * grid.cell_m**2
    errors: NDArray[np.float64] = levelness_error_deg(
        grid, TruthLookup(stack.scene).surface_points, seed
    )
    return MapFigures(
        duration_s=judgement.survey_s,
        density_per_m2=float(grid.count[seen].sum()) / area if area > 0 else 0.0,
        levelness_error_deg=LevelnessError(
            mean=float(errors.mean()) if errors.size else None,
            max=float(errors.max()) if errors.size else None,
            places=int(errors.size),
        ),
    )
