"""Shipped campaigns: every condition that they name is demanded, and every fault happens."""

import functools
from pathlib import Path

import pytest

from touchdown.experiments.campaign.forecast import forecast
from touchdown.experiments.campaign.plan import Plan, load_plan
from touchdown.experiments.flight.conditions import judge_fault
from touchdown.sim.api import FAULT_KINDS, FaultParams
from touchdown.sim.faults.injector import FaultInjector
from touchdown.sim.faults.marks import Marks
from touchdown.sim.faults.types import WORLD_KINDS

from support.fault_support import HZ, world
from support.worlds import load_ideal_config as load_config


def scheduled() -> list[tuple[str, ...]]:
    """Schedules of the shipped campaigns that act on messages."""
    found = {
        tuple(run.values.get("faults.events", ()))
        for file in CAMPAIGNS
        for run in plan_of(file).runs
    }
    in_world = {s for s in found if any(text.split("@")[0] in WORLD_KINDS for text in s)}
    return sorted(found - in_world - {()})


FLIGHT_S = 60


CONFIGS = Path(__file__).parents[3] / "configs"
CAMPAIGNS = sorted(p for p in CONFIGS.glob("*.toml") if "[axes]" in p.read_text(encoding="utf-8"))
ONE_BLACK_IMAGE = """
name = "blind"
mode = "land"
[axes]
scene = ["crossroad"]
[axes.faults]
events = [["camera_black@20"]]
[[expect]]
name = "camera dark"
when = { faults.events = [["camera_black@20"]] }
outcome = ["LANDED"]
"""


plan_of = functools.cache(load_plan)


def undemanded(plan: Plan) -> tuple[str, ...]:
    return forecast(plan, plan.runs, None, 1).undemanded


def test_every_variant_of_wrong_beliefs_is_another_flight_of_each_method() -> None:
    """By its own name, with an override of keys that this method's flight depends on."""
    plan = plan_of(CONFIGS / "wrong_beliefs.toml")
    flown: dict[str, list[str]] = {}
    for run in plan.runs:
        values = {k: v for k, v in run.values.items() if k not in ("variant", "scene", "seed")}
        assert run.run_id.endswith(f"-{run.values['variant']}")
        if (run.values["scene"], run.values["seed"]) == ("lake", 20200):
            flown.setdefault(run.values["estimator"], []).append(str(sorted(values.items())))
    assert {name: len(found) for name, found in flown.items()} == {
        "livo": 20, "zou2024": 5, "stereo": 5, "hybrid_flow": 5, "optical_flow": 5, "gps": 3,
    }  # fmt: skip
    assert all(len(set(found)) == len(found) for found in flown.values())


@pytest.mark.parametrize("file", CAMPAIGNS, ids=lambda path: path.stem)
def test_every_named_condition_is_demanded(file: Path) -> None:
    assert undemanded(plan_of(file)) == ()


def test_a_condition_that_no_expectation_demands_is_found(tmp_path: Path) -> None:
    file = tmp_path / "blind.toml"
    file.write_text(ONE_BLACK_IMAGE)
    assert undemanded(load_plan(file)) == ("camera_black@20",)
    file.write_text(ONE_BLACK_IMAGE + 'happened = ["camera_black@0"]\n')
    assert undemanded(load_plan(file)) == ("camera_black@20",)
    file.write_text(ONE_BLACK_IMAGE + 'happened = ["camera_black@20"]\n')
    assert undemanded(load_plan(file)) == ()


def test_every_scheduled_fault_of_messages_happens() -> None:
    """The injector changes as many messages of a flight of a minute as the entries say: an approach
    at 20 s, a descent from 15 m at 30 s."""
    observations = [obs for obs in world(FLIGHT_S * HZ) if obs.scans]
    schedules = scheduled()
    assert len(schedules) >= 15 and ("camera_black@20",) in schedules
    for events in schedules:
        config = load_config(fault=events)
        params = FaultParams(events=events)
        marks = Marks(params.schedule(), HZ)
        injector = FaultInjector(params, HZ, marks)
        for observation in observations:
            time_s = observation.time_s
            phase = "SURVEY" if time_s < 20.0 else "APPROACH" if time_s < 30.0 else "DESCEND"
            marks.follow(observation.tick, phase, 15.0 - 0.5 * (time_s - 30.0))
            injector.apply(observation)
        records = {record["fault"]: record for record in injector.summary()}
        for fault in config.faults.schedule():
            assert set(records[fault.text]["came"]) == set(FAULT_KINDS[fault.kind])
            verdict = judge_fault(fault, records[fault.text], float(FLIGHT_S), config)
            assert verdict.happened, verdict.text
