"""The choice of a site for the result: every candidate of the last decision, why one won, and what
a flight that found no site, or gave one up, refused of the true ground."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.flight.metrics import GroundMap
from touchdown.experiments.io.result_parts import (
    CandidateSite,
    Choice,
    EarlierDecision,
    GivenUpSite,
    MissedGround,
    RefusingRule,
    SiteTerm,
)
from touchdown.landing.api import RULE_KEYS, Candidate, Decision
from touchdown.scenes.api import Scene

Array = NDArray[np.float64]

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
        accepted=candidate.accepted,
        rule=candidate.rule,
        reason=candidate.reason,
        value=candidate.value,
        terms=[
            SiteTerm(name=term.name, value=term.value, quantity=term.quantity, unit=term.unit)
            for term in candidate.terms
        ],
        cluster_bonus=candidate.cluster_bonus,
        c_sum=candidate.c_sum,
        slope_deg=candidate.slope_deg,
        roughness_m=candidate.roughness_m,
        step_m=candidate.step_m,
        clearance_m=candidate.clearance_m,
        safe_probability=candidate.safe_probability,
        class_predicted=candidate.class_predicted,
        class_probability=candidate.class_probability,
    )


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
