"""Conformance check of an estimator against the rules that a flight relies on.

`check_estimator` runs an estimator over a few seconds of synthetic or logged sensor messages and
returns every rule that it breaks, with the reason. It needs no flight and no simulator.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.api import Estimate, Estimator
from touchdown.experiments.external.conformance_report import (
    Findings,
    LatencyWatch,
    digest,
    digests_of,
    slow,
    trace_of,
)
from touchdown.experiments.external.conformance_report import Violation as Violation
from touchdown.experiments.external.conformance_twist import TwistCheck
from touchdown.experiments.external.estimate_checks import (
    call,
    describe_error,
    meaningless,
    no_number,
    not_finite,
    wrong_estimator,
    wrong_shape,
)
from touchdown.experiments.external.loading import Build, wrong_signature
from touchdown.experiments.external.synthetic_stream import SyntheticStream, synthetic_rig
from touchdown.sim.api import Observation, SensorRig
from touchdown.sim.frames import Pose, so3_log

Array = NDArray[np.float64]

RULES = {
    "builds": "build(params, rig) returns an object with needs and update",
    "answers": "update returns an Estimate and does not raise",
    "shapes": "every field has its shape and meaning: rotations are rotations, covariances are",
    "finite": "every number is finite",
    "time": "an estimate is for the time of its observation, so that time never goes back",
    "inputs": "observations and rig are left as they were",
    "deterministic": "the same messages give the same estimates to the bit",
    "frames": "the first estimate is near the take-off pose: world ENU, body FLU",
    "continuity": "odom_from_body does not jump",
    "twist": "velocity_odom and angular_velocity_body are those of odom_from_body",
    "motion": "it moves with the vehicle: one that ignores every sensor is none",
    "missing data": "a second without scans, or without images, is survived",
    "latency": "an update takes at most 20 ms of wall time on average",
}
"""Checked rules by name."""

START_DISTANCE_M, START_ANGLE_DEG = 5.0, 20.0
"""Limits of the first estimate to the take-off pose: above the error of a first GPS fix, below that
of a mistaken frame."""
JUMP_M, JUMP_DEG = 0.5, 10.0
"""Limits of ``odom_from_body`` between two control steps, beyond the motion by its own velocity."""
TURN_RAD = 0.5
"""Turn of the synthetic flight, which distinguishes degrees from radians."""
MOVED_M, LEAST_SHARE = 0.5, 0.25
"""Way of the vehicle from which on the estimator must have moved, and its least share along it."""
_GAP = (0.4, 0.75)
"""share of the stream between which data is missing"""


def check_estimator(
    build: Build,
    *,
    rig: SensorRig | None = None,
    observations: Sequence[Observation] | None = None,
    params: dict[str, Any] | None = None,
    seconds: float = 3.0,
    true_position: Callable[[int], Array | None] | None = None,
) -> list[Violation]:
    """Returns the first violation of every rule that the estimator of ``build`` breaks; an empty
    list is a pass. Arguments as in `examine_estimator`."""
    return examine_estimator(
        build,
        rig=rig,
        observations=observations,
        params=params,
        seconds=seconds,
        true_position=true_position,
    ).violations


def examine_estimator(
    build: Build,
    *,
    rig: SensorRig | None = None,
    observations: Sequence[Observation] | None = None,
    params: dict[str, Any] | None = None,
    seconds: float = 3.0,
    true_position: Callable[[int], Array | None] | None = None,
) -> Findings:
    """Returns the broken rules of an estimator, its latency, and how far it moved beside the
    vehicle.

    Without ``observations``, ``seconds`` of synthetic messages are used, with all that the
    estimator needs; with them, ``rig`` must be the rig that recorded them, and ``true_position``
    gives the vehicle's position (3,) at a tick, world frame, None where it is not known. The
    estimator is built and run up to four times.
    """
    if observations is not None and rig is None:
        raise ValueError("observations need the rig that recorded them")
    rig = rig or synthetic_rig()
    check = _Check(build, rig, params or {})
    estimator = check.built()
    if estimator is None:
        return check.findings
    needs = estimator.needs
    synthetic = SyntheticStream(rig, needs, seconds, turn_rad=TURN_RAD)
    stream = observations or tuple(synthetic)
    if observations is None:
        true_position = lambda tick: synthetic.true_pose(tick).translation  # noqa: E731
    first = check.run(estimator, stream, true_position)
    if not check.broke("answers"):
        check.repeat(stream, first)
        if needs.lidar:
            check.without("scans", stream)
        if needs.camera_hz:
            check.without("images", stream)
    return check.findings


class _Check:
    """One estimator under examination."""

    def __init__(self, build: Build, rig: SensorRig, params: dict[str, Any]) -> None:
        self._build, self._rig, self._params = build, rig, params
        self.findings = Findings()
        self.violations = self.findings.violations

    def broke(self, rule: str) -> bool:
        return any(violation.rule == rule for violation in self.violations)

    def _note(self, rule: str, reason: str, trace: str = "") -> None:
        if not self.broke(rule):
            self.violations.append(Violation(rule, reason, trace))

    def built(self) -> Estimator | None:
        """A new estimator, or None with the reason noted."""
        before = digest(self._rig)
        reason = wrong_signature(self._build)
        if reason:
            self._note("builds", reason)
            return None
        estimator: Estimator
        estimator, error = call(self._build, copy.deepcopy(self._params), self._rig)
        if error is not None:
            self._note("builds", f"build raised {describe_error(error)}", trace_of(error))
            return None
        reason = wrong_estimator(estimator, self._rig)
        if reason:
            self._note("builds", reason)
            return None
        if digest(self._rig) != before:
            self._note("inputs", "build modified the rig")
        return estimator

    def run(
        self,
        estimator: Estimator,
        stream: Sequence[Observation],
        true_position: Callable[[int], Array | None] | None,
    ) -> list[bytes]:
        """Checks all rules of a single pass; returns digests of the estimates."""
        latency, ways = LatencyWatch(), _Ways()
        digests: list[bytes] = []
        previous: tuple[Observation, Estimate] | None = None
        rig_before, twist = digest(self._rig), TwistCheck()
        kept: list[tuple[Observation, list[tuple[str, bytes]]]] = []
        for original in stream:
            obs = copy.deepcopy(original)
            kept.append((obs, digests_of(obs)))
            with latency:
                estimate = self._answer(estimator, obs)
            if estimate is None:
                break
            self._judge(obs, estimate, previous)
            if not any(self.broke(rule) for rule in ("shapes", "finite", "time")):
                twist.add(estimate)
                if true_position is not None:
                    ways.add(true_position(obs.tick), estimate)
            previous = (obs, estimate)
            digests.append(digest(estimate))
            if len(kept) > 200:  # one second: later writes are not detected
                self._compare(kept.pop(0), obs.time_s)
        for pair in kept:
            self._compare(pair, pair[0].time_s)
        reason = twist.reason()
        if reason:
            self._note("twist", reason)
        if ways.rest is not None:
            self.findings.figures["moved"] = ways.text()
            if ways.stayed():
                self._note("motion", f"it does not move with the vehicle: it moved {ways.text()}")
        self.findings.figures["latency"] = latency.text()
        if reason := slow("estimator", latency):
            self._note("latency", reason)
        if digest(self._rig) != rig_before:
            self._note("inputs", "update modified the rig")
        return digests

    def _answer(self, estimator: Estimator, obs: Observation) -> Estimate | None:
        estimate, error = call(estimator.update, obs)
        if error is not None:
            reason = f"at {obs.time_s:.3f} s update raised {describe_error(error)}"
            self._note("answers", reason, trace_of(error))
            return None
        if not isinstance(estimate, Estimate):
            kind = type(estimate).__name__
            self._note("answers", f"at {obs.time_s:.3f} s update returned {kind}, not Estimate")
            return None
        return estimate

    def _compare(self, pair: tuple[Observation, list[tuple[str, bytes]]], now_s: float) -> None:
        obs, before = pair
        for (name, old), (_, new) in zip(before, digests_of(obs), strict=True):
            if old != new:
                self._note("inputs", f"the observation of {obs.time_s:.3f} s had '{name}' modified")

    # ------------------------------------------------------------------------ one estimate

    def _judge(
        self, obs: Observation, estimate: Estimate, previous: tuple[Observation, Estimate] | None
    ) -> None:
        reason = no_number(estimate)
        if reason:
            self._note("shapes", f"at {obs.time_s:.3f} s {reason}")
            return
        self._judge_time(obs, estimate, None if previous is None else previous[1])
        reason = wrong_shape(estimate)
        if reason:
            self._note("shapes", f"at {obs.time_s:.3f} s {reason}")
            return
        name = _not_finite(estimate)
        if name:
            self._note("finite", f"at {obs.time_s:.3f} s {name} is not finite")
            return
        reason = meaningless(estimate)
        if reason:
            self._note("shapes", f"at {obs.time_s:.3f} s {reason}")
            return
        if previous is None:
            self._judge_start(estimate)
        elif not self.broke("finite") and not self.broke("shapes"):
            self._judge_step(obs, estimate, previous)

    def _judge_time(self, obs: Observation, estimate: Estimate, last: Estimate | None) -> None:
        if last is not None and estimate.time_s < last.time_s:
            self._note(
                "time",
                f"after an estimate for {last.time_s:.3f} s came one for {estimate.time_s:.3f} s",
            )
        elif (estimate.tick, estimate.time_s) != (obs.tick, obs.time_s):
            self._note(
                "time",
                f"the estimate for the observation of tick {obs.tick} ({obs.time_s:.3f} s) says "
                f"tick {estimate.tick} ({estimate.time_s:.3f} s)",
            )

    def _judge_start(self, estimate: Estimate) -> None:
        start = self._rig.world_from_body_start
        distance, angle_deg = _between(start, estimate.world_from_body)
        if distance > START_DISTANCE_M:
            self._note("frames", f"the first estimate is {distance:.1f} m from the take-off point")
        elif angle_deg > START_ANGLE_DEG:
            self._note(
                "frames",
                f"the first estimate is rotated by {angle_deg:.0f} degrees from the take-off "
                "attitude; odom_from_body maps the body (x forward, y left, z up)",
            )

    def _judge_step(
        self, obs: Observation, estimate: Estimate, previous: tuple[Observation, Estimate]
    ) -> None:
        before, last = previous
        distance, angle_deg = _between(last.odom_from_body, estimate.odom_from_body)
        step_s = obs.time_s - before.time_s
        distance -= step_s * float(np.linalg.norm(estimate.velocity_odom))
        angle_deg -= step_s * float(np.degrees(np.linalg.norm(estimate.angular_velocity_body)))
        if distance > JUMP_M or angle_deg > JUMP_DEG:
            self._note(
                "continuity",
                f"at {obs.time_s:.3f} s odom_from_body jumped by {max(distance, 0.0):.2f} m and "
                f"{max(angle_deg, 0.0):.0f} degrees; let corrections in over time",
            )

    # ------------------------------------------------------------------------ more passes

    def repeat(self, stream: Sequence[Observation], first: list[bytes]) -> None:
        """Runs a second estimator over the same messages with another state of the global random
        stream, and compares."""
        estimator = self.built()
        if estimator is None:
            return
        # The global stream is the one that two estimators would share by mistake.
        state = np.random.get_state()  # noqa: NPY002
        np.random.seed(20240229)  # noqa: NPY002
        try:
            for obs, before in zip(stream, first, strict=False):
                estimate = self._answer(estimator, copy.deepcopy(obs))
                if estimate is None:
                    return
                if digest(estimate) != before:
                    self._note("deterministic", f"two runs differ from {obs.time_s:.3f} s on")
                    return
        finally:
            np.random.set_state(state)  # noqa: NPY002

    def without(self, field: str, stream: Sequence[Observation]) -> None:
        """Runs a pass in the middle of which ``field`` of the observations is empty."""
        estimator = self.built()
        if estimator is None:
            return
        for obs in _with_gap(field, stream):
            estimate, error = call(estimator.update, obs)
            if error is not None:
                self._note(
                    "missing data",
                    f"without {field}, at {obs.time_s:.3f} s, update raised "
                    f"{describe_error(error)}",
                    trace_of(error),
                )
                return
            if not isinstance(estimate, Estimate):
                kind = type(estimate).__name__
                self._note(
                    "missing data",
                    f"without {field}, at {obs.time_s:.3f} s, update returned {kind}, not Estimate",
                )
                return
            known = self.broke("shapes") or self.broke("finite")
            if not known and (wrong_shape(estimate) or _not_finite(estimate)):
                self._note(
                    "missing data",
                    f"without {field}, at {obs.time_s:.3f} s, the estimate is not finite",
                )
                return


class _Ways:
    """The farthest way of the vehicle from its start, and that of the estimate then."""

    def __init__(self) -> None:
        self.rest: tuple[Array, Array] | None = None
        """the first true and estimated position"""
        self._true: Array = np.zeros(3)
        self._estimated: Array = np.zeros(3)

    def add(self, true: Array | None, estimate: Estimate) -> None:
        """Takes the true position (3,) and the estimate of one control step."""
        if true is None:
            return
        here = estimate.world_from_body.translation
        if self.rest is None:
            self.rest = (true, here)
        way = true - self.rest[0]
        if np.linalg.norm(way) >= np.linalg.norm(self._true):
            self._true, self._estimated = way, here - self.rest[1]

    def stayed(self) -> bool:
        """True where the vehicle has moved and the estimate has not gone along."""
        true_m = float(np.linalg.norm(self._true))
        along_m = float(self._estimated @ self._true) / max(true_m, 1e-9)
        return true_m >= MOVED_M and along_m < LEAST_SHARE * true_m

    def text(self) -> str:
        """Such as "2.62 m beside 2.69 m of the vehicle, 0.12 m apart"."""
        lengths = (float(np.linalg.norm(way)) for way in (self._estimated, self._true))
        apart = float(np.linalg.norm(self._estimated - self._true))
        return "{:.2f} m beside {:.2f} m of the vehicle, {:.2f} m apart".format(*lengths, apart)


def _with_gap(field: str, stream: Sequence[Observation]) -> Iterator[Observation]:
    first, last = (int(share * len(stream)) for share in _GAP)
    for number, obs in enumerate(stream):
        nothing: dict[str, Any] = {field: ()} if first <= number < last else {}
        yield dataclasses.replace(copy.deepcopy(obs), **nothing)


def _between(first: Pose, second: Pose) -> tuple[float, float]:
    """Distance in metres and angle in degrees."""
    distance = float(np.linalg.norm(second.translation - first.translation))
    angle = float(np.linalg.norm(so3_log(first.rotation.T @ second.rotation)))
    return distance, float(np.degrees(angle))


def _not_finite(estimate: Estimate) -> str:
    """Name of the first part that is not finite, or an empty string."""
    diagnostics = (
        (f"diagnostics['{name}']", value) for name, value in estimate.diagnostics.items()
    )
    return not_finite(estimate) or next(
        (name for name, value in diagnostics if not np.all(np.isfinite(value))), ""
    )
