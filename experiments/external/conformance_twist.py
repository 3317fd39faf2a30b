"""Check that an estimator's twist matches its own poses in unit, sign and frame.

Corrections move a pose without a velocity, so that one disagreement proves nothing: twist and poses
must agree in most seconds with motion.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.api import Estimate
from touchdown.sim.frames import so3_log

Array = NDArray[np.float64]

WINDOW_S = 1.0
_STRIDE_S = 0.1


@dataclass(frozen=True, slots=True)
class _Limits:
    """Limits of a window. It counts if pose or velocity gives at least ``least``; the two agree
    within ``floor`` plus ``share`` of the larger."""

    least: float
    floor: float
    share: float


_POSITION = _Limits(least=0.5, floor=0.3, share=0.25)
"""metres"""
_ATTITUDE = _Limits(least=np.deg2rad(10.0), floor=np.deg2rad(5.0), share=0.25)
"""radians"""


def twist_fault(estimates: Sequence[Estimate]) -> str:
    """Disagreement in one line; empty if there is none or less than a second of data. The estimates
    are those of successive control steps, valid in shapes and numbers."""
    times = np.array([estimate.time_s for estimate in estimates[1:]])
    if len(times) == 0 or times[-1] - times[0] < WINDOW_S:
        return ""
    steps = [_step(*pair) for pair in itertools.pairwise(estimates)]
    sums = np.vstack([np.zeros(12), np.cumsum(steps, axis=0)])
    starts = np.arange(times[0], times[-1] - WINDOW_S, _STRIDE_S)
    first = np.searchsorted(times, starts)
    windows = sums[np.searchsorted(times, starts + WINDOW_S)] - sums[first]
    found = _disagreement(windows[:, :3], windows[:, 3:6], _POSITION)
    if found is not None:
        moved, summed = windows[found, :3], windows[found, 3:6]
        return (
            f"in the second from {starts[found]:.1f} s odom_from_body moved by {_text(moved)} "
            f"m, but velocity_odom adds up to {_text(summed)} m; it is in m/s, "
            "in the odom frame"
        )
    found = _disagreement(windows[:, 6:9], windows[:, 9:], _ATTITUDE)
    if found is not None:
        rotated, summed = np.rad2deg(windows[found, 6:9]), np.rad2deg(windows[found, 9:])
        return (
            f"in the second from {starts[found]:.1f} s odom_from_body rotated by "
            f"{_text(rotated)} degrees, but angular_velocity_body adds up to {_text(summed)} "
            "degrees; it is in rad/s, in the body frame"
        )
    return ""


def _step(last: Estimate, now: Estimate) -> Array:
    """(12,): the steps of position and attitude, each with that of the velocities."""
    step_s = now.time_s - last.time_s
    moved = now.odom_from_body.translation - last.odom_from_body.translation
    velocity = 0.5 * (last.velocity_odom + now.velocity_odom)
    # Small rotations in the body frame add up to any total rotation.
    rotation = so3_log(last.odom_from_body.rotation.T @ now.odom_from_body.rotation)
    rates = now.angular_velocity_body
    return np.concatenate([moved, velocity * step_s, rotation, rates * step_s])


def _disagreement(moved: Array, summed: Array, limits: _Limits) -> int | None:
    """Index of the largest difference of (N, 3) and (N, 3) if most windows that count disagree,
    else None."""
    larger = np.maximum(np.linalg.norm(moved, axis=1), np.linalg.norm(summed, axis=1))
    off = np.linalg.norm(moved - summed, axis=1) - limits.floor - limits.share * larger
    counts = larger > limits.least
    if not counts.any() or np.mean(off[counts] > 0.0) <= 0.5:
        return None
    return int(np.argmax(np.where(counts, off, -np.inf)))


def _text(vector: Array) -> str:
    return "(" + ", ".join(f"{value:.2f}" for value in vector) + ")"
