"""Faults that begin at a phase or at a height over the site."""

import math

import numpy as np
import pytest

from touchdown.experiments.config.schema import Config
from touchdown.experiments.errors import UsageError
from touchdown.experiments.flight.conditions import judge_fault
from touchdown.experiments.flight.replay import replay_faults
from touchdown.sim.api import FaultParams
from touchdown.sim.faults.disturbances import Disturbances
from touchdown.sim.faults.injector import FaultInjector
from touchdown.sim.faults.marks import Marks
from touchdown.sim.faults.types import parse_fault

from support.fault_support import HZ, world


def marks(*events: str) -> tuple[FaultParams, Marks]:
    params = FaultParams(events=events)
    return params, Marks(params.schedule(), HZ)


def test_messages_are_lost_from_the_phase_on() -> None:
    params, reached = marks("lidar_dropout@approach+0.5")
    injector = FaultInjector(params, HZ, reached)
    came = []
    for obs in world():
        came += [obs.tick] * len(injector.apply(obs).scans)
        phase = "SURVEY" if obs.tick < 600 else "APPROACH"
        reached.follow(obs.tick, phase, math.inf)
    assert [t for t in range(96, 1500, 60) if t not in came] == [636, 696, 756, 816, 876]
    (record,) = injector.summary()
    assert record["began_s"] == 1.0
    verdict = judge_fault(parse_fault("lidar_dropout@approach+0.5"), record, 2.5, Config())
    assert verdict.happened and "from 1.0 to 1.5 s" in verdict.text


def test_a_height_counts_on_the_way_down_alone() -> None:
    (fault,), (params, reached) = [parse_fault("motor_loss@6m")], marks("motor_loss@6m")
    motors = Disturbances(params, HZ, 12.0, 0, reached)
    for tick, phase, height in ((0, "TAKEOFF", 2.0), (3, "DESCEND", 6.5), (6, "DESCEND", math.inf)):
        reached.follow(tick, phase, height)
        assert motors.rotor_speed_fraction(tick) is None
    reached.follow(9, "DESCEND", 5.9)
    assert np.sum(motors.rotor_speed_fraction(9) < 1.0) == 1
    reached.follow(12, "DESCEND", 7.0)  # once reached it stays
    assert reached.span(fault) == (9, math.inf)


def test_a_flight_that_ends_before_says_so() -> None:
    _, reached = marks("camera_black@3m")
    fault = parse_fault("camera_black@3m")
    assert fault.text == "camera_black@3m" and reached.began_s(fault) is None
    verdict = judge_fault(fault, {"began_s": None}, 60.0, Config())
    assert not verdict.happened and "never got there" in verdict.text


@pytest.mark.parametrize(("text", "said"), [
    ("fog@approach", "begins at a time"),
    ("lidar_dropout@landing", "phases: takeoff"),
    ("lidar_dropout@1.2.3m", "no height"),
])  # fmt: skip
def test_other_marks_are_refused(text: str, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        parse_fault(text)


def test_a_replay_has_no_phases() -> None:
    with pytest.raises(UsageError, match="a replay knows no phases"):
        replay_faults(Config(), ("lidar_dropout@approach",), HZ)
