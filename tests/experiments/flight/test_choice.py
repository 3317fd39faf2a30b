import json

import numpy as np

from touchdown.experiments.flight.metrics import GroundMap
from touchdown.experiments.flight.result import choice_of, missed_ground
from touchdown.experiments.io.results import RunResult
from touchdown.experiments.reporting.report_tables import missed_lines
from touchdown.landing.api import Candidate, Decision, ScoreTerm, SiteRule

from support.places import scene_of


def _candidate(rule: SiteRule, value: float, accepted: bool) -> Candidate:
    return Candidate(
        position_odom=np.array([1.0, 2.0, 0.0]), c_sum=0.6,
        slope_deg=0.4, roughness_m=0.02, clearance_m=2.5, accepted=accepted, reason="level",
        rule=rule, value=value, step_m=0.03, cluster_bonus=0.1, safe_probability=0.99,
        terms=(ScoreTerm(name="clearance", value=0.08, quantity=2.5, unit="m"),),
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
        "clearance", 0.08, 2.5, "m",
    )  # fmt: skip
    figures = (won.c_sum, won.slope_deg, won.roughness_m, won.step_m, won.clearance_m)
    assert figures == (0.6, 0.4, 0.02, 0.03, 2.5)
    chances = (won.safe_probability, won.class_predicted, won.class_probability)
    assert chances == (0.99, "lawn", 0.9) and won.cluster_bonus == 0.1
    assert (refused.rank, refused.rule, refused.value, refused.accepted) == (2, "step", None, False)
    (earlier,) = choice.earlier
    assert (earlier.time_s, earlier.candidates, earlier.given_up) == (50.0, 4, "a wire")
    assert earlier.rules == {"step": 2, "water": 1}


def test_what_a_flight_missed_is_told_by_the_truth() -> None:
    """A slab 0.4 m high from x = 20 m on, of a class that is refused rightly, makes the lawn unsafe
    from 18.5 m on; the map holds 10 x 10 m elsewhere."""
    scene = scene_of(
        '<mujoco><worldbody><geom name="lawn" type="box" size="30 30 1" pos="10 20 -1"/>'
        '<geom name="road" type="box" size="2 20 .2" pos="22 20 .2"/></worldbody></mujoco>'
    )
    grid = GroundMap(
        np.array([-2.0, 18.0]), 1.0, np.zeros((20, 20), np.float32), np.zeros((20, 20))
    )
    grid.count[:10, :10] = 5.0
    unsure = _candidate("uncertain_ground", 0.5, False)
    good = _candidate("highest_value", 1.0, True)
    refusals = [unsure] * 11 + [_candidate("unsafe_ground", 0.4, False)]  # x from 10 to 21 m
    none = _decision(80.0, *refusals)
    assert missed_ground(scene, (_decision(50.0, good),), grid, no_site=False) is None
    first = _decision(50.0, good, given_up="at 10 m: unsure")
    missed = missed_ground(scene, (first, none), grid, no_site=True)
    assert missed is not None and missed.safe_m2 == 100.0
    rules = [(one.rule, one.candidates, one.safe, one.key) for one in missed.rules]
    assert rules == [
        ("uncertain_ground", 11, 9, "landing.unknown_ground"),
        ("unsafe_ground", 1, 0, "landing.allowed_classes"),
    ]
    assert [(look.safe, look.reason) for look in missed.given_up] == [(True, "at 10 m: unsure")]
    assert missed.sentence() == (
        "100 m2 of mapped ground were safe; refused: 11 uncertain ground (9 safe, "
        "landing.unknown_ground), 1 unsafe ground (0 safe, landing.allowed_classes); "
        "given up: a safe site, at 10 m: unsure"
    )
    result = RunResult(
        outcome="NO_SITE", scene="x", seed=1, estimator="gps", choice=choice_of((none,), missed)
    )
    assert missed_lines({"run": result}) == [f"run: NO_SITE: {missed.sentence()}"]


def test_choice_survives_the_file() -> None:
    unmapped = _decision(50.0, _candidate("not_seen", float("nan"), False), z=float("nan"))
    choice = choice_of((unmapped,))
    assert choice is not None and choice.candidates[0].position_m is None
    result = RunResult(outcome="NO_SITE", scene="crossroad", seed=1, estimator="gps", choice=choice)
    assert RunResult.model_validate(json.loads(result.to_json())) == result
