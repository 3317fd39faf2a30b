"""`livo` and the paper's estimator as a whole on short made-up flights, and on broken input."""

import dataclasses
import itertools
from typing import Any

import numpy as np
import pytest

from touchdown.estimator.api import Estimate
from touchdown.estimator.filtering.synchronizer import stamp_of
from touchdown.sim.api import FaultParams, Observation
from touchdown.sim.faults.injector import FaultInjector

from support import livo_flight, zou2024_flight
from support.livo_flight import error

BOTH = pytest.mark.parametrize("module", [livo_flight, zou2024_flight], ids=["livo", "zou2024"])
FAULTS = {
    "lidar_nan": "not a number", "lidar_empty": "no pulses", "lidar_blind": "no returns",
    "camera_black": "no contrast", "timestamp_repeat": "repeats its time stamp",
    "timestamp_swap": "out of order", "lidar_frozen": "the same as the one before",
    "camera_frozen": "the same as the one before",
}  # fmt: skip


@BOTH
def test_same_input_same_output_to_the_bit(module: Any) -> None:
    for a, b in zip(module.clean(), module.fly(module.FLIGHT), strict=True):
        np.testing.assert_array_equal(a.world_from_body.translation, b.world_from_body.translation)
        np.testing.assert_array_equal(a.odom_from_body.rotation, b.odom_from_body.rotation)
        assert a.diagnostics == b.diagnostics


@BOTH
def test_a_clean_flight_is_followed_without_a_jump(module: Any) -> None:
    """The moving start contradicts nothing: the rotors spin at lifting speed from the beginning.
    Between two estimates the position moves by the velocity and no more than millimetres."""
    estimates = module.clean()
    last = estimates[-1]
    assert [e.tick for e in estimates] == [o.tick for o in module.FLIGHT] and last.healthy
    assert max(map(error, estimates)) < 0.012
    used = {"lidar_matched", "lidar_planes"} & last.diagnostics.keys()
    assert used and all(last.diagnostics[name] > 400.0 for name in used)
    np.testing.assert_allclose(last.velocity_odom, [last.time_s, 0.0, 0.0], atol=0.02)
    np.testing.assert_allclose(last.acceleration_odom, [1.0, 0.0, 0.0], atol=0.05)
    for a, b in itertools.pairwise(estimates):
        step = b.odom_from_body.translation - a.odom_from_body.translation
        expected = 0.5 * (a.velocity_odom + b.velocity_odom) * (b.time_s - a.time_s)
        assert np.linalg.norm(step - expected) < 2e-3


@BOTH
def test_scans_and_images_that_overtake_one_another_are_all_used(module: Any) -> None:
    """Images arrive 66 ticks after the scans of their instant, after the scan of the next one."""
    arrivals: dict[int, dict[str, list[Any]]] = {}
    for obs in module.FLIGHT:
        for name, later in (("scans", 0), ("images", 66)):
            for message in getattr(obs, name):
                due = arrivals.setdefault(obs.tick + later, {"scans": [], "images": []})
                due[name].append(message)
    nothing: dict[str, list[Any]] = {"scans": [], "images": []}
    flight = [
        dataclasses.replace(o, **{k: tuple(m) for k, m in arrivals.get(o.tick, nothing).items()})
        for o in module.FLIGHT
    ]
    stamps = [stamp_of(m) for o in flight for m in (*o.scans, *o.images)]
    assert sum(b < a for a, b in itertools.pairwise(stamps)) > 8
    estimates, clean = module.fly(flight), module.clean()[-1].diagnostics
    last = estimates[-1]
    assert error(last) < 0.03
    # one image is lost: before the first has come, nothing shows that they are late
    assert last.diagnostics["skipped"] <= clean["skipped"] + 1.0
    assert sum("came too late" in event for e in estimates for event in e.events) <= 1
    used = {"features_tracked", "landmarks_used"} & last.diagnostics.keys()
    assert used and all(last.diagnostics[name] > 0.5 * clean[name] for name in used)


def check(estimates: list[Estimate]) -> None:
    assert max(map(error, estimates)) < 0.06
    assert all(np.isfinite(e.position_covariance).all() for e in estimates)


@BOTH
@pytest.mark.parametrize("kind", [*FAULTS, "lidar_dropout", "camera_dropout"])
def test_estimators_survive_and_report(module: Any, kind: str) -> None:
    last_s = module.FLIGHT[-1].time_s
    event = f"{kind}@{0.6 * last_s:g}*{2 if kind == 'timestamp_swap' else 1}"
    if kind.endswith("dropout"):
        event = f"{kind}@{0.3 * last_s:g}+0.8"
    injector = FaultInjector(FaultParams(events=(event,)), 600)
    estimates = module.fly([injector.apply(observation) for observation in module.FLIGHT])
    events = [text for estimate in estimates for text in estimate.events]
    assert any(FAULTS.get(kind, "no ") in text for text in events), events
    check(estimates)


@BOTH
@pytest.mark.parametrize("kind", ["late", "IMU", "no sensors"])
def test_broken_input_costs_centimetres_at_most(module: Any, kind: str) -> None:
    flight: list[Observation] = list(module.FLIGHT)
    k = max(i for i, obs in enumerate(flight) if obs.scans and obs.tick < 600)
    scan, image = flight[k].scans[0], flight[k].images[0]
    if kind == "late":
        flight[k + 30] = dataclasses.replace(flight[k + 30], scans=(scan,), images=(image,))
    elif kind == "IMU":
        sample = dataclasses.replace(flight[k].imu[0], angular_velocity=np.full(3, np.nan))
        flight[k] = dataclasses.replace(flight[k], imu=(sample,))
    else:
        flight = [dataclasses.replace(obs, scans=(), images=()) for obs in flight]
    estimates = module.fly(flight)
    check(estimates)
    assert estimates[-1].diagnostics["skipped"] >= (kind != "no sensors")
