"""The result of a flight, from the referee's judgement, the map and the clock: figures, the choice
of a site, and what a flight that found none, or gave one up, refused of the true ground."""

import math
from collections import Counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.api import Outcome
from touchdown.experiments.config.schema import Config
from touchdown.experiments.config.slots import external_parts, other_parts
from touchdown.experiments.flight.conditions import as_json, judge_conditions
from touchdown.experiments.flight.metrics import GroundMap, levelness_error_deg
from touchdown.experiments.flight.observers import StageClock, StepObserver
from touchdown.experiments.flight.referee import Judgement, TruthLookup
from touchdown.experiments.flight.wiring import FlightStack
from touchdown.experiments.io.provenance import git_revision, versions
from touchdown.experiments.io.result_parts import (
    CandidateSite,
    Choice,
    EarlierDecision,
    GivenUpSite,
    LevelnessError,
    MapFigures,
    MissedGround,
    PartNames,
    RefusingRule,
    SiteTerm,
)
from touchdown.experiments.io.results import RunResult
from touchdown.landing.api import RULE_KEYS, Candidate, Decision
from touchdown.scenes.api import Scene, names_function
from touchdown.sim.typing import Array


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
    if stack.scene.facts:
        place["ground"] = dict(stack.scene.facts)
    record, deviation = stack.record(), judgement.deviation
    measured = observer.conditions.measured(record, stack.world.rig, stack.nominal_rig)
    conditions = judge_conditions(config, measured, record.faults, judgement.sim_s)
    no_site = judgement.outcome == Outcome.NO_SITE
    missed = missed_ground(stack.scene, observer.decisions, observer.judged_map, no_site=no_site)
    return RunResult(
        outcome=str(judgement.outcome),
        reason=judgement.reason,
        scene=config.scene,
        seed=config.seed,
        unit=config.unit,
        estimator=config.estimator,
        **_parts(config),
        profile=config.profile,
        preset=config.preset,
        wind_kmh=config.wind.mean_kmh,
        **place,
        position_error_m=judgement.position_error,
        span_s=judgement.span_s,
        trajectory_error_m=deviation.mean if deviation.count else None,
        trajectory_error_max_m=deviation.largest if deviation.count else None,
        trajectory_variance_m2=deviation.variance if deviation.count else None,
        slowed_s=observer.slowed_s,
        nees=judgement.nees,
        landing=judgement.landing,
        intrusion=observer.intrusion.summary(),
        choice=choice_of(observer.decisions, missed),
        classifier=stack.network or "off",
        map=_map_figures(stack, judgement, observer.judged_map, config.seed),
        timing=clock.timing(judgement.sim_s),
        versions=versions(),
        renderer=record.renderer,
        git_revision=git_revision(),
        events=observer.events.kept,
        event_count=observer.events.count,
        phases=observer.phases,
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


TRUTH_CELL_M = 0.2


def choice_of(decisions: tuple[Decision, ...], missed: MissedGround | None = None) -> Choice | None:
    """Returns the choice of a flight with these decisions, and what it missed; None without one."""
    if not decisions:
        return None
    *earlier, last = decisions
    return Choice(
        time_s=last.time_s,
        selector=last.selector,
        why=last.why,
        given_up=last.given_up,
        candidates=[
            _site(rank, candidate, position)
            for rank, (candidate, position) in enumerate(
                zip(last.candidates, last.positions_world, strict=True), start=1
            )
        ],
        earlier=[
            EarlierDecision(
                time_s=decision.time_s,
                candidates=len(decision.candidates),
                rules=dict(Counter(c.rule for c in decision.candidates if not c.accepted)),
                why=decision.why,
                given_up=decision.given_up,
            )
            for decision in earlier
        ],
        missed=missed,
    )


def _site(rank: int, candidate: Candidate, position: NDArray[np.float64]) -> CandidateSite:
    x, y, z = position.tolist()
    return CandidateSite(
        rank=rank,
        position_m=(x, y, z) if math.isfinite(z) else None,
        terms=[
            SiteTerm(name=term.name, value=term.value, quantity=term.quantity, unit=term.unit)
            for term in candidate.terms
        ],
        **{name: getattr(candidate, name) for name in _SITE_FIGURES},
    )


_SITE_FIGURES = (
    "accepted", "rule", "reason", "value", "cluster_bonus", "c_sum", "slope_deg", "roughness_m",
    "step_m", "clearance_m", "safe_probability", "class_predicted", "class_probability",
)  # fmt: skip
"""Fields of a `Candidate` that stand in the result as they are."""


def missed_ground(
    scene: Scene, decisions: tuple[Decision, ...], grid: GroundMap, *, no_site: bool
) -> MissedGround | None:
    """Judges by the truth what the decisions of a flight refused; None for a flight that landed on
    its first site. ``grid``: the ground mapped at the end of the survey."""
    given_up = [decision for decision in decisions if decision.given_up]
    if not decisions or not (given_up or no_site):
        return None
    candidates = Counter[str]()
    safe = Counter[str]()
    judged: dict[tuple[float, float], bool] = {}
    for decision in decisions:
        for site, position in zip(decision.candidates, decision.positions_world, strict=True):
            if not site.accepted:
                candidates[site.rule] += 1
                safe[site.rule] += _safe(scene, position, judged)
    return MissedGround(
        safe_m2=_safe_m2(scene, grid),
        rules=[
            RefusingRule(rule=rule, candidates=count, safe=safe[rule], key=RULE_KEYS.get(rule))
            for rule, count in candidates.most_common()
        ],
        given_up=[
            GivenUpSite(
                time_s=decision.time_s, reason=decision.given_up,
                safe=_safe(scene, decision.positions_world[0], judged),
            )
            for decision in given_up
        ],
    )  # fmt: skip


def _safe(scene: Scene, position: Array, judged: dict[tuple[float, float], bool]) -> bool:
    from touchdown.scenes.truth.maps import judge_touchdown

    place = (float(position[0]), float(position[1]))
    if place not in judged:
        judged[place] = bool(judge_touchdown(scene, position[:2]).safe)
    return judged[place]


def _safe_m2(scene: Scene, grid: GroundMap) -> float:
    """Area of the mapped cells that are safe by the truth."""
    from touchdown.scenes.truth.maps import truth_maps

    rows, cols = np.nonzero(grid.count > 0)
    if rows.size == 0:
        return 0.0
    first, last = np.array([cols.min(), rows.min()]), np.array([cols.max(), rows.max()]) + 1
    region = grid.origin_xy_m + np.stack([first, last]) * grid.cell_m
    truth = truth_maps(scene, TRUTH_CELL_M, region)
    centres = grid.origin_xy_m + (np.stack([cols, rows], axis=1) + 0.5) * grid.cell_m
    cell = np.floor((centres - truth.origin_xy_m) / truth.cell_m).astype(int)
    inside = ((cell >= 0) & (cell < np.array(truth.safe.shape)[::-1])).all(axis=1)
    col, row = cell[inside].T
    return float(truth.safe[row, col].sum()) * grid.cell_m**2
