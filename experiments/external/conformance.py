"""Conformance check of an estimator against the rules that a flight relies on.

`check_estimator` runs an estimator over a few seconds of synthetic or logged sensor messages and
returns every rule that it breaks, with the reason. It needs no flight and no simulator.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.api import Estimate
from touchdown.experiments.external.conformance_twist import twist_fault
from touchdown.experiments.external.estimate_checks import (
    meaningless,
    no_number,
    not_finite,
    wrong_estimator,
    wrong_shape,
)
from touchdown.experiments.external.examination import (
    COMMON_RULES,
    Examination,
    Findings,
    checks_of,
)
from touchdown.experiments.external.examination import Violation as Violation
from touchdown.experiments.external.loading import Build
from touchdown.experiments.external.synthetic_stream import SyntheticStream, synthetic_rig
from touchdown.experiments.external.wrapper import Defect
from touchdown.sim.api import Observation, SensorRig
from touchdown.sim.frames import Pose, so3_log

Array = NDArray[np.float64]

START_DISTANCE_M, START_ANGLE_DEG = 5.0, 20.0
"""Limits of the first estimate to the take-off pose: above the error of a first GPS fix, below that
of a mistaken frame."""
JUMP_M, JUMP_DEG = 0.5, 10.0
"""Limits of ``odom_from_body`` between two control steps, beyond the motion by its own velocity."""
TURN_RAD = 0.5
"""Turn of the synthetic flight, which distinguishes degrees from radians."""
MOVED_M, MIN_FRACTION = 0.5, 0.25
"""Way of the vehicle from which on the estimator must have moved, and least fraction along it."""
_GAP = (0.4, 0.75)
"""Part of the stream in which data is missing."""
_KEPT_CALLS = 200
"""Calls in a second, for which observations are watched for later writes."""


class Step(NamedTuple):
    """One update. ``true``: the position (3,) of the vehicle, world frame, None where unknown."""

    obs: Observation
    estimate: Estimate
    true: Array | None


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
    estimator is built and run up to five times.
    """
    if observations is not None and rig is None:
        raise ValueError("observations need the rig that recorded them")
    rig = rig or synthetic_rig()
    asked = Examination("estimator", build, params or {}, rig,
                        lambda part: wrong_estimator(part, rig), _KEPT_CALLS)  # fmt: skip
    estimator = asked.built()
    if estimator is None:
        return asked.findings
    needs = estimator.needs
    stream, truth = observations, true_position or (lambda _tick: None)
    if stream is None:
        synthetic = SyntheticStream(rig, needs, seconds, turn_rad=TURN_RAD)
        stream, truth = tuple(synthetic), lambda tick: synthetic.true_pose(tick).translation
    passes: list[list[Step]] = []

    def follow(part: Any) -> None:
        passes.append([])
        for obs in stream:
            estimate = asked.ask(part, "update", obs, when=_when(obs), wrong=_no_estimate)
            # It may use its arrays again.
            passes[-1].append(Step(obs, copy.deepcopy(estimate), truth(obs.tick)))

    asked.twice(follow)
    _judge(asked, passes[0] if passes else ())
    if not asked.findings.broke("answers"):
        for field, used in (("scans", needs.lidar), ("images", needs.camera_hz)):
            if used:
                asked.once(functools.partial(_without, asked, field, stream))
    return asked.findings


def _when(obs: Observation) -> str:
    return f"at {obs.time_s:.3f} s"


def _no_estimate(answer: Any) -> Defect | None:
    kind = type(answer).__name__
    return None if isinstance(answer, Estimate) else Defect("answers", f"{kind}, not Estimate")


def _judge(asked: Examination, steps: Sequence[Step]) -> None:
    """Judges each estimate by itself, and those before the first invalid one by their motion."""
    start = asked.rig.world_from_body_start
    last: Estimate | None = None
    sound: list[Step] = []
    for step in steps:
        defects = [*_wrong_time(step, last), *_invalid(step.estimate)]
        for defect in defects:
            asked.findings.note(defect.rule, f"{_when(step.obs)} {defect.reason}")
        if any(defect.rule != "time" for defect in defects):
            break
        last = step.estimate
        if not asked.findings.broke("time"):
            sound.append(step)
    asked.judge(CHECKS, (start, sound))
    ways = _ways(sound)
    if ways is not None:
        asked.findings.figures = {"moved": _told(*ways), **asked.findings.figures}


def _wrong_time(step: Step, last: Estimate | None) -> Iterator[Defect]:
    obs, estimate = step.obs, step.estimate
    if no_number(estimate):
        return
    if last is not None and estimate.time_s < last.time_s:
        yield Defect(
            "time",
            f"after an estimate for {last.time_s:.3f} s came one for {estimate.time_s:.3f} s",
        )
    elif (estimate.tick, estimate.time_s) != (obs.tick, obs.time_s):
        yield Defect(
            "time",
            f"the estimate for the observation of tick {obs.tick} ({obs.time_s:.3f} s) says "
            f"tick {estimate.tick} ({estimate.time_s:.3f} s)",
        )


def _invalid(estimate: Estimate) -> Iterator[Defect]:
    """The defect of the numbers of an estimate, if there is one."""
    if reason := no_number(estimate) or wrong_shape(estimate):
        yield Defect("shapes", reason)
    elif name := _not_finite(estimate):
        yield Defect("finite", f"{name} is not finite")
    elif reason := meaningless(estimate):
        yield Defect("shapes", reason)


def _not_finite(estimate: Estimate) -> str:
    """Name of the first part that is not finite, or an empty string."""
    diagnostics = (
        (f"diagnostics['{name}']", value) for name, value in estimate.diagnostics.items()
    )
    return not_finite(estimate) or next(
        (name for name, value in diagnostics if not np.all(np.isfinite(value))), ""
    )


# --------------------------------------------------------------------------------- checks of motion

Flown = tuple[Pose, Sequence[Step]]
"""The take-off pose and all valid steps."""


def frames(flown: Flown) -> str:
    """The first estimate is near the take-off pose: world ENU, body FLU."""
    start, steps = flown
    for step in steps[:1]:
        distance, angle_deg = _between(start, step.estimate.world_from_body)
        if distance > START_DISTANCE_M:
            return f"the first estimate is {distance:.1f} m from the take-off point"
        if angle_deg > START_ANGLE_DEG:
            return (
                f"the first estimate is rotated by {angle_deg:.0f} degrees from the take-off "
                "attitude; odom_from_body maps the body (x forward, y left, z up)"
            )
    return ""


def continuity(flown: Flown) -> str:
    """The pose odom_from_body does not jump."""
    for before, now in itertools.pairwise(flown[1]):
        estimate = now.estimate
        distance, angle_deg = _between(before.estimate.odom_from_body, estimate.odom_from_body)
        step_s = now.obs.time_s - before.obs.time_s
        distance -= step_s * float(np.linalg.norm(estimate.velocity_odom))
        angle_deg -= step_s * float(np.degrees(np.linalg.norm(estimate.angular_velocity_body)))
        if distance > JUMP_M or angle_deg > JUMP_DEG:
            return (
                f"{_when(now.obs)} odom_from_body jumped by {max(distance, 0.0):.2f} m and "
                f"{max(angle_deg, 0.0):.0f} degrees; let corrections in over time"
            )
    return ""


def twist(flown: Flown) -> str:
    """The fields velocity_odom and angular_velocity_body are those of odom_from_body."""
    return twist_fault([step.estimate for step in flown[1]])


def motion(flown: Flown) -> str:
    """It moves with the vehicle: one that ignores every sensor is none."""
    ways = _ways(flown[1])
    if ways is None:
        return ""
    estimated, true = ways
    true_m = float(np.linalg.norm(true))
    along_m = float(estimated @ true) / max(true_m, 1e-9)
    if true_m < MOVED_M or along_m >= MIN_FRACTION * true_m:
        return ""
    return f"it does not move with the vehicle: it moved {_told(estimated, true)}"


CHECKS = checks_of(frames, continuity, twist, motion)
RULES: Mapping[str, str] = {
    **COMMON_RULES,
    "time": "an estimate is for the time of its observation, so that time never goes back",
    **{check.rule: check.sentence for check in CHECKS},
}
"""Checked rules by name."""


def _ways(steps: Sequence[Step]) -> tuple[Array, Array] | None:
    """Way (3,) of the estimate and of the vehicle when the vehicle is farthest from where it was
    at first; None without true positions."""
    known = [
        (step.estimate.world_from_body.translation, step.true)
        for step in steps
        if step.true is not None
    ]
    if not known:
        return None
    estimated, true = (np.array(positions) - positions[0] for positions in zip(*known, strict=True))
    farthest = int(np.argmax(np.linalg.norm(true, axis=1)))
    return estimated[farthest], true[farthest]


def _told(estimated: Array, true: Array) -> str:
    """Such as "2.62 m beside 2.69 m of the vehicle, 0.12 m apart"."""
    lengths = (float(np.linalg.norm(way)) for way in (estimated, true, estimated - true))
    return "{:.2f} m beside {:.2f} m of the vehicle, {:.2f} m apart".format(*lengths)


def _between(first: Pose, second: Pose) -> tuple[float, float]:
    """Distance in metres and angle in degrees."""
    distance = float(np.linalg.norm(second.translation - first.translation))
    angle = float(np.linalg.norm(so3_log(first.rotation.T @ second.rotation)))
    return distance, float(np.degrees(angle))


# ------------------------------------------------------------------------------------- missing data


def _without(asked: Examination, field: str, stream: Sequence[Observation], part: Any) -> None:
    """Runs a pass in the middle of which ``field`` of the observations is empty."""
    known = asked.findings.broke("shapes", "finite")

    def wrong(answer: Any) -> Defect | None:
        reason = "" if isinstance(answer, Estimate) else f"{type(answer).__name__}, not Estimate"
        if not reason and not known and (wrong_shape(answer) or _not_finite(answer)):
            reason = "an estimate that is not finite"
        return Defect("missing data", reason) if reason else None

    first, last = (int(part_of * len(stream)) for part_of in _GAP)
    for number, obs in enumerate(stream):
        nothing: dict[str, Any] = {field: ()} if first <= number < last else {}
        when = f"without {field}, {_when(obs)},"
        asked.ask(part, "update", dataclasses.replace(obs, **nothing), when=when,
                  rule="missing data", wrong=wrong)  # fmt: skip
