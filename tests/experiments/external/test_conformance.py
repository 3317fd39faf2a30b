"""The contract check separates good estimators from bad ones; the page's example is a good one."""

import dataclasses
import functools
import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from touchdown.estimator.api import Estimate
from touchdown.experiments.external.conformance import Violation, check_estimator
from touchdown.experiments.external.examination import RULES
from touchdown.experiments.external.synthetic_stream import SyntheticStream, synthetic_rig
from touchdown.sim.api import GRAVITY_MPS2, Observation, SensorNeeds, SensorRig
from touchdown.sim.frames import Pose, rotation_from_yaw

from support.command import Says
from support.flight_fakes import make_estimate

PAGE = Path(__file__).parents[3] / "docs" / "writing-an-estimator.md"


class Still:
    """Keeps the contract by standing still; ``spoil`` changes what it hands out."""

    needs = SensorNeeds(camera_hz=10, lidar=True)

    def __init__(self, rig: SensorRig, spoil: Callable[[Any, Observation, Estimate], Any]) -> None:
        self.rig, self.spoil, self.calls = rig, spoil, 0
        self.kept: list[Any] = []

    def update(self, obs: Observation) -> Any:
        self.calls += 1
        return self.spoil(self, obs, make_estimate(obs.time_s, self.rig.world_from_body_start))


@functools.cache
def _messages() -> tuple[Observation, ...]:
    return tuple(SyntheticStream(synthetic_rig(), Still.needs, 0.8))


def _check(spoil: Callable[[Any, Observation, Estimate], Any]) -> list[Violation]:
    return check_estimator(
        lambda _params, rig: Still(rig, spoil), rig=synthetic_rig(), observations=_messages()
    )


def _but(estimate: Estimate, **changes: Any) -> Estimate:
    return dataclasses.replace(estimate, **changes)


def _moved(estimate: Estimate, offset: Any) -> Estimate:
    pose = estimate.odom_from_body
    return _but(estimate, odom_from_body=Pose(pose.rotation, pose.translation + offset))


def _writes_scans(_self: Any, obs: Observation, estimate: Estimate) -> Estimate:
    for scan in obs.scans:
        scan.ranges[0] = 1.0
    return estimate


def _writes_later(self: Any, obs: Observation, estimate: Estimate) -> Estimate:
    self.kept += obs.images
    if self.kept and self.calls % 7 == 0:
        self.kept[0].rgb[:] = 0
    return estimate


def _is_nan(self: Any, _obs: Observation, estimate: Estimate) -> Estimate:
    return _but(estimate, velocity_odom=np.full(3, np.nan)) if self.calls > 50 else estimate


def _goes_back(self: Any, obs: Observation, estimate: Estimate) -> Estimate:
    late = self.calls > 40
    return _but(estimate, tick=obs.tick - 60, time_s=obs.time_s - 0.1) if late else estimate


def _raises(_self: Any, obs: Observation, estimate: Estimate) -> Estimate:
    if obs.time_s > 0.3:
        raise RuntimeError("no more")
    return estimate


def _raises_anything(_self: Any, _obs: Observation, _estimate: Estimate) -> Estimate:
    class Odd(BaseException):
        def __str__(self) -> str:
            raise RuntimeError("\x1b[31m")

    raise Odd


def _forks(_self: Any, obs: Observation, estimate: Estimate) -> Estimate:
    if obs.tick == 0 and os.fork():
        os.wait()
    return estimate


def _wants_scans(self: Any, obs: Observation, estimate: Estimate) -> Estimate:
    self.kept = [*self.kept, *obs.scans][-1:]
    if obs.time_s > 0.5 and obs.time_s - self.kept[0].end_time_s > 0.35:
        raise KeyError("scan")
    return estimate


def _rotated(estimate: Estimate, turn: Any) -> Estimate:
    pose = estimate.odom_from_body
    return _but(estimate, odom_from_body=Pose(pose.rotation @ turn, pose.translation))


def test_a_good_estimator_breaks_nothing() -> None:
    assert _check(lambda _self, _obs, estimate: estimate) == []


@pytest.mark.parametrize(("spoil", "rule", "words"), [
    (_writes_scans, "inputs", "update modified what it was given"),
    (_writes_later, "inputs", "update modified what it was given"),
    (_is_nan, "finite", "velocity_odom is not finite"),
    (_goes_back, "time", "after an estimate for 0.195 s came one for 0.100 s"),
    (lambda _s, o, e: _but(e, tick=max(0, o.tick - 3), time_s=max(0.0, o.time_s - 0.005)),
     "time", "observation of tick 3 (0.005 s) says tick 0 (0.000 s)"),
    (lambda _s, _o, e: _moved(e, 1e-6 * np.random.rand(3)),  # noqa: NPY002
     "deterministic", "two runs differ from 0.000 s on"),
    (_raises, "answers", "update raised RuntimeError: no more"),
    (_raises_anything, "answers", "update raised Odd"),
    (_wants_scans, "missing data", "without scans"),
    (lambda s, _o, e: _moved(e, [2.0, 0.0, 0.0]) if s.calls > 30 else e,
     "continuity", "jumped by 2.00 m"),
    (lambda _s, _o, e: _moved(e, [0.0, 0.0, -50.0]), "frames", "50.0 m from the take-off point"),
    (lambda _s, _o, e: _rotated(e, rotation_from_yaw(np.pi / 2)),
     "frames", "rotated by 90 degrees"),
    (lambda _s, _o, e: _rotated(e, np.diag([1.0, 1.0, -1.0])),
     "shapes", "odom_from_body.rotation is no rotation matrix"),
    (lambda _s, _o, e: _but(e, velocity_odom=np.zeros((1, 3))),
     "shapes", "velocity_odom has shape (1, 3), not (3,)"),
    (lambda _s, _o, e: _but(e, position_covariance=-np.eye(3)),
     "shapes", "position_covariance has a negative eigenvalue"),
    (lambda *_: None, "answers", "returned NoneType, not Estimate"),
])  # fmt: skip
def test_each_bad_habit_is_reported_with_its_reason(
    spoil: Callable[[Any, Observation, Estimate], Any], rule: str, words: str
) -> None:
    violations = _check(spoil)
    assert [violation.rule for violation in violations] == [rule] and words in violations[0].reason
    assert rule in RULES["estimator"]


def test_one_that_ignores_every_sensor_does_not_conform() -> None:
    (found,) = check_estimator(lambda _params, rig: Still(rig, lambda _self, _obs, e: e))
    assert found.rule == "motion" and "moved 0.00 m beside 2.69 m of the vehicle" in found.reason


def test_a_copy_that_it_forks_does_not_check_on() -> None:
    here = os.getpid()
    assert _check(_forks) == [] and os.getpid() == here


def test_a_builder_that_writes_to_the_rig_is_reported() -> None:
    def writes_the_rig(_params: Any, rig: SensorRig) -> Any:
        rig.world_from_body_start.translation[0] += 1.0
        return Still(rig, lambda _self, _obs, estimate: estimate)

    (found,) = check_estimator(writes_the_rig, seconds=0.2)
    assert found.rule == "inputs" and found.reason.startswith("build modified what it was given")


ALL = SensorNeeds(
    camera_hz=10, stereo=True, lidar=True, gps=True, barometer=True, magnetometer=True,
    rangefinder=True,
)  # fmt: skip


def test_messages_arrive_when_a_flight_s_would() -> None:
    rig = synthetic_rig()
    stream = list(SyntheticStream(rig, ALL, 0.5))
    assert [obs.tick for obs in stream] == list(range(0, 301, 3))
    assert [obs.tick for obs in stream if obs.scans] == [96, 156, 216, 276]
    assert [obs.images[0].tick for obs in stream if obs.images] == [60, 120, 180, 240]
    assert all(obs.imu[0].tick == obs.tick for obs in stream[1:])
    assert [obs.tick for obs in stream if obs.gps] == [192] and stream[0].imu == ()


def test_messages_are_what_the_true_path_measures() -> None:
    rig = synthetic_rig()
    stream = SyntheticStream(rig, ALL, 1.0)
    velocity, height = np.zeros(3), rig.world_from_body_start.translation[2]
    for obs in stream:
        for sample in obs.imu:
            force = rig.world_from_body_start.rotation @ sample.specific_force
            velocity = velocity + (force - [0.0, 0.0, GRAVITY_MPS2]) / 200.0
            height = height + velocity[2] / 200.0
        for scan in obs.scans:
            track = stream.true_pose(scan.end_tick) @ rig.body_from_lidar
            back = scan.ranges > 0.0
            ground = track.apply(scan.points[back].astype(float))[:, 2]
            assert abs(ground).max() < 0.5  # the vehicle moves by less during a scan
    assert height == pytest.approx(stream.true_pose(600).translation[2], abs=0.02)


def _example() -> str:
    blocks = re.findall(r"^```python\n(.*?)^```", PAGE.read_text("utf-8"), re.M | re.S)
    return next(block for block in blocks if "class GroundFlow" in block)


def _module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, text: str) -> None:
    (tmp_path / f"{name}.py").write_text(text, encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))


def test_the_example_of_the_page_keeps_the_contract_and_its_way() -> None:
    module: dict[str, Any] = {"__name__": "my_lab.flow"}
    exec(compile(_example(), "flow.py", "exec", dont_inherit=True), module)
    assert check_estimator(module["build"]) == []
    rig = synthetic_rig()
    estimator = module["build"]({}, rig)
    stream = SyntheticStream(rig, estimator.needs, 3.0)
    for obs in stream:
        estimate = estimator.update(obs)
    true = stream.true_pose(obs.tick).translation
    assert np.linalg.norm(true - rig.world_from_body_start.translation) > 2.0
    assert np.linalg.norm(estimate.world_from_body.translation - true) < 0.5


def test_the_command_passes_the_example(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, says: Says
) -> None:
    _module(tmp_path, monkeypatch, "ground_flow_example", _example())
    printed = says(0, "check-estimator", "ground_flow_example:build", "--seconds", "1").out
    moved, latency, verdict = printed.splitlines()
    assert " beside 0.07 m of the vehicle" in moved and " ms a call, " in latency
    assert verdict == "estimator ground_flow_example:build: conforms"


def test_the_command_tells_what_is_wrong(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, says: Says
) -> None:
    bad = _example().replace("time_s=obs.time_s,", "time_s=-obs.time_s,")
    _module(tmp_path, monkeypatch, "ground_flow_backwards", bad)
    command = ["check-estimator", "ground_flow_backwards:build", "--seconds", "0.5", "--json"]
    found = json.loads(says(1, *command).out)
    assert [row["rule"] for row in found["violations"]] == ["time"]
    assert "did you mean 'livo'" in says(2, "check-estimator", "livvo").err
    says(2, "check-estimator", "livo", "--seconds", "-1")
