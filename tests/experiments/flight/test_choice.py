import json

import numpy as np

from touchdown.experiments.flight.choice import choice_of
from touchdown.experiments.io.results import RunResult
from touchdown.landing.api import Candidate, Decision, ScoreTerm, SiteRule


def _candidate(rule: SiteRule, value: float, accepted: bool) -> Candidate:
    return Candidate(
        position_odom=np.array([1.0, 2.0, 0.0]), normal_odom=np.array([0.0, 0.0, 1.0]), c_sum=0.6,
        slope_deg=0.4, roughness_m=0.02, clearance_m=2.5, accepted=accepted, reason="level",
        rule=rule, value=value, step_m=0.03, cluster_bonus=0.1, safe_probability=0.99,
        terms=(ScoreTerm(name="room", value=0.08, quantity=2.5, unit="m"),),
        class_predicted="lawn", class_probability=0.9,
    )  # fmt: skip


def _decision(time_s: float, *candidates: Candidate, z: float = 5.0, **changes: str) -> Decision:
    positions = np.array([[10.0 + n, 20.0, z] for n in range(len(candidates))]).reshape(-1, 3)
    return Decision(
        time_s=time_s, selector="risk", candidates=candidates, positions_world=positions,
        why=changes.get("why", "Site 1 won"), given_up=changes.get("given_up", ""),
    )  # fmt: skip


def test_last_decision_is_listed_in_full_and_earlier_ones_by_rule() -> None:
    good = _candidate("highest_value", 1.05, True)
    step, water = _candidate("step", float("nan"), False), _candidate("water", 0.2, False)
    first = _decision(50.0, good, step, water, step, given_up="a wire")
    choice = choice_of((first, _decision(80.0, good, step)))
    assert (choice.time_s, choice.selector, choice.why) == (80.0, "risk", "Site 1 won")
    won, refused = choice.candidates
    assert (won.rank, won.position_m, won.rule, won.value) == (
        1, (10.0, 20.0, 5.0), "highest_value", 1.05,
    )  # fmt: skip
    assert (won.terms[0].name, won.terms[0].value, won.terms[0].quantity, won.terms[0].unit) == (
        "room", 0.08, 2.5, "m",
    )  # fmt: skip
    figures = (won.c_sum, won.slope_deg, won.roughness_m, won.step_m, won.clearance_m)
    assert figures == (0.6, 0.4, 0.02, 0.03, 2.5)
    chances = (won.safe_probability, won.class_predicted, won.class_probability)
    assert chances == (0.99, "lawn", 0.9) and won.cluster_bonus == 0.1
    assert (refused.rank, refused.rule, refused.value, refused.accepted) == (2, "step", None, False)
    (earlier,) = choice.earlier
    assert (earlier.time_s, earlier.candidates, earlier.given_up) == (50.0, 4, "a wire")
    assert earlier.rules == {"step": 2, "water": 1}


def test_choice_survives_the_file() -> None:
    unmapped = _decision(50.0, _candidate("not_seen", float("nan"), False), z=float("nan"))
    choice = choice_of((unmapped,))
    assert choice is not None and choice.candidates[0].position_m is None
    result = RunResult(outcome="NO_SITE", scene="crossroad", seed=1, estimator="gps", choice=choice)
    assert RunResult.model_validate(json.loads(result.to_json())) == result
