"""Conformance check of an estimator against the rules that a flight relies on.

`check_estimator` runs an estimator over a few seconds of synthetic or logged sensor messages and
returns every rule that it breaks, with the reason. It needs no flight and no simulator.
"""

import copy
import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from touchdown.estimator.api import Estimate
from touchdown.experiments.external.examination import Examined, Findings, attempt, examine_as
from touchdown.experiments.external.examination import Violation as Violation
from touchdown.experiments.external.loading import Build
from touchdown.experiments.external.synthetic_stream import SyntheticStream, synthetic_rig
from touchdown.sim.api import Observation, SensorNeeds, SensorRig
from touchdown.sim.frames import Pose, so3_log
from touchdown.sim.typing import Array

START_DISTANCE_M, START_ANGLE_DEG = 5.0, 20.0
"""Limits of the first estimate to the take-off pose: above the error of a first GPS fix, below that
of a mistaken frame."""
JUMP_M, JUMP_DEG = 0.5, 10.0
"""Limits of ``odom_from_body`` between two control steps, beyond the motion by its own velocity."""
TURN_RAD = 0.5
"""Turn of the synthetic flight, which distinguishes degrees from radians."""
MOVED_M, MIN_FRACTION = 0.5, 0.25
"""Way of the vehicle from which on the estimator must have moved, and least fraction along it."""
WINDOW_S, _STRIDE_S = 1.0, 0.1
_GAP = (0.4, 0.75)
"""Part of the stream in which data is missing."""


def check_estimator(build: Build, **options: Any) -> list[Violation]:
    """Returns the first violation of every rule that the estimator of ``build`` breaks; an empty
    list is a pass. Options as in `examine_estimator`."""
    return examine_estimator(build, **options).violations


def examine_estimator(
    build: Build,
    *,
    rig: SensorRig | None = None,
    observations: Sequence[Observation] | None = None,
    params: Mapping[str, Any] | None = None,
    seconds: float = 3.0,
    true_position: Callable[[int], Array | None] = lambda _tick: None,
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
    start = functools.partial(Examined, "estimator", build, rig, params or {})

    @functools.cache
    def messages(needs: SensorNeeds) -> list[tuple[Observation, Array | None]]:
        if observations is not None:
            return [(obs, true_position(obs.tick)) for obs in observations]
        stream = SyntheticStream(rig, needs, seconds, turn_rad=TURN_RAD)
        return [(obs, stream.true_pose(obs.tick).translation) for obs in stream]

    def follow(part: Examined) -> Iterator[tuple[str, str]]:
        steps = [
            # It may use its arrays again.
            Step(obs, copy.deepcopy(part.ask("update", obs, when=_when(obs))), true)
            for obs, true in messages(part.inner.needs)
        ]
        if (ways := _ways(steps)) is not None:
            part.figures["moved"] = _told(*ways)
        for check in CHECKS:
            yield check.__name__, check(steps)
        yield "frames", frames(rig.world_from_body_start, steps[0].estimate)

    def without(field: str, part: Examined) -> Iterator[tuple[str, str]]:
        """A pass in the middle of which ``field`` of the observations is empty."""
        stream = [obs for obs, _ in messages(part.inner.needs)]
        first, last = (int(part_of * len(stream)) for part_of in _GAP)
        for number, obs in enumerate(stream if any(getattr(o, field) for o in stream) else ()):
            nothing: dict[str, Any] = {field: ()} if first <= number < last else {}
            part.ask("update", dataclasses.replace(obs, **nothing), rule="missing data",
                     when=f"without {field}, {_when(obs)},")  # fmt: skip
        return iter(())

    findings = examine_as(follow, start)
    if "latency" in findings.figures:
        for field in ("scans", "images"):
            attempt(findings, start, functools.partial(without, field))
    return findings


class Step(NamedTuple):
    """One update. ``true``: the position (3,) of the vehicle, world frame, None where unknown."""

    obs: Observation
    estimate: Estimate
    true: Array | None


def _when(obs: Observation) -> str:
    return f"at {obs.time_s:.3f} s"


def time(steps: Sequence[Step]) -> str:
    """An estimate is for the time of its observation, so that time never goes back."""
    last_s = -np.inf
    for obs, estimate, _ in steps:
        if estimate.time_s < last_s:
            return (
                f"{_when(obs)} after an estimate for {last_s:.3f} s came one for "
                f"{estimate.time_s:.3f} s"
            )
        if (estimate.tick, estimate.time_s) != (obs.tick, obs.time_s):
            return (
                f"the estimate for the observation of tick {obs.tick} ({obs.time_s:.3f} s) says "
                f"tick {estimate.tick} ({estimate.time_s:.3f} s)"
            )
        last_s = estimate.time_s
    return ""


def shapes(steps: Sequence[Step]) -> str:
    """Rotations are rotations, covariances symmetric and not negative; times of tracks ascend."""
    for obs, estimate, _ in steps:
        reason = ""
        for name in ("odom_from_body", "world_from_odom"):
            rotation = getattr(estimate, name).rotation
            if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-6:
                reason = f"{name}.rotation is no rotation matrix"
        for name in ("position_covariance", "rotation_covariance"):
            matrix = getattr(estimate, name)
            scale = float(np.abs(matrix).max())
            if np.abs(matrix - matrix.T).max() > 1e-6 * scale:
                reason = f"{name} is not symmetric"
            elif np.linalg.eigvalsh(matrix)[0] < -1e-9 * scale:
                reason = f"{name} has a negative eigenvalue"
        track = estimate.scan_track
        if track is not None and np.any(np.diff(track.times_s) <= 0.0):
            reason = "scan_track.times_s does not ascend"
        if reason:
            return f"{_when(obs)} {reason}"
    return ""


def finite(steps: Sequence[Step]) -> str:
    """Diagnostics are finite, as all numbers are."""
    for obs, estimate, _ in steps:
        for name, value in estimate.diagnostics.items():
            if not np.all(np.isfinite(value)):
                return f"{_when(obs)} diagnostics['{name}'] is not finite"
    return ""


def frames(start: Pose, first: Estimate) -> str:
    """The first estimate is near the take-off pose: world ENU, body FLU."""
    distance, angle_deg = _between(start, first.world_from_body)
    if distance > START_DISTANCE_M:
        return f"the first estimate is {distance:.1f} m from the take-off point"
    if angle_deg > START_ANGLE_DEG:
        return (
            f"the first estimate is rotated by {angle_deg:.0f} degrees from the take-off "
            "attitude; odom_from_body maps the body (x forward, y left, z up)"
        )
    return ""


def continuity(steps: Sequence[Step]) -> str:
    """The pose odom_from_body does not jump."""
    for before, now in itertools.pairwise(steps):
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


def motion(steps: Sequence[Step]) -> str:
    """It moves with the vehicle: one that ignores every sensor is none."""
    ways = _ways(steps)
    if ways is None:
        return ""
    estimated, true = ways
    true_m = float(np.linalg.norm(true))
    along_m = float(estimated @ true) / max(true_m, 1e-9)
    if true_m < MOVED_M or along_m >= MIN_FRACTION * true_m:
        return ""
    return f"it does not move with the vehicle: it moved {_told(estimated, true)}"


def twist(steps: Sequence[Step]) -> str:
    """The fields velocity_odom and angular_velocity_body are those of odom_from_body.

    Corrections move a pose without a velocity, so that one disagreement proves nothing: twist and
    poses must agree in most seconds with motion."""
    estimates = [step.estimate for step in steps]
    times = np.array([step.obs.time_s for step in steps[1:]])
    if len(times) == 0 or times[-1] - times[0] < WINDOW_S:
        return ""
    moved = [_moved(*pair) for pair in itertools.pairwise(estimates)]
    sums = np.vstack([np.zeros(12), np.cumsum(moved, axis=0)])
    starts = np.arange(times[0], times[-1] - WINDOW_S, _STRIDE_S)
    windows = sums[np.searchsorted(times, starts + WINDOW_S)] - sums[np.searchsorted(times, starts)]
    for first, names, unit, minimum, floor in (
        (0, ("moved", "velocity_odom", "m/s, in the odom frame"), "m", 0.5, 0.3),
        (6, ("rotated", "angular_velocity_body", "rad/s, in the body frame"), "degrees", 10.0, 5.0),
    ):
        by_poses, by_twist = windows[:, first : first + 3], windows[:, first + 3 : first + 6]
        larger = np.maximum(*(np.linalg.norm(way, axis=1) for way in (by_poses, by_twist)))
        off = np.linalg.norm(by_poses - by_twist, axis=1) - floor - 0.25 * larger
        counts = larger > minimum
        if counts.any() and np.mean(off[counts] > 0.0) > 0.5:
            worst = int(np.argmax(np.where(counts, off, -np.inf)))
            verb, field, meaning = names
            return (
                f"in the second from {starts[worst]:.1f} s odom_from_body {verb} by "
                f"{_text(by_poses[worst])} {unit}, but {field} adds up to "
                f"{_text(by_twist[worst])} {unit}; it is in {meaning}"
            )
    return ""


CHECKS = (time, shapes, finite, continuity, twist, motion)
"""Checks of what an estimator answers over a whole stream; the names are those of the rules."""


def _moved(last: Estimate, now: Estimate) -> Array:
    """(12,): the step of the position, m, and that of the velocity; the step of the attitude,
    degrees, and that of the rates."""
    step_s = now.time_s - last.time_s
    moved = now.odom_from_body.translation - last.odom_from_body.translation
    velocity = 0.5 * (last.velocity_odom + now.velocity_odom)
    # Small rotations in the body frame add up to any total rotation.
    rotation = so3_log(last.odom_from_body.rotation.T @ now.odom_from_body.rotation)
    turn = np.rad2deg([rotation, now.angular_velocity_body * step_s])
    return np.concatenate([moved, velocity * step_s, *turn])


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


def _text(vector: Array) -> str:
    return "(" + ", ".join(f"{value:.2f}" for value in vector) + ")"
