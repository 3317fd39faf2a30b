"""The choice of a site for the result: every candidate of the last decision, and why one won."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.io.results import (
    CandidateSite,
    Choice,
    EarlierDecision,
    MissedGround,
    SiteTerm,
)
from touchdown.landing.api import Candidate, Decision


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
