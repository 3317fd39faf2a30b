"""Checks of estimators and estimates that a flight depends on.

Each function returns the defect as text, or an empty string. Those of a single estimate are cheap
enough for every control step.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from touchdown.estimator.api import Estimate, PoseTrack
from touchdown.experiments.errors import nearest
from touchdown.sim.api import SensorNeeds, SensorRig
from touchdown.sim.frames import Pose

SHAPES = {
    "velocity_odom": (3,),
    "angular_velocity_body": (3,),
    "acceleration_odom": (3,),
    "position_covariance": (3, 3),
    "rotation_covariance": (3, 3),
}
"""Arrays of an estimate beside its poses."""


def wrong_estimator(estimator: Any, rig: SensorRig) -> str:
    """Defect of ``estimator`` that can be found before its first update."""
    kind = type(estimator).__name__
    try:
        needs = getattr(estimator, "needs", None)
    except (Exception, SystemExit) as error:  # a property may raise anything
        return f"'needs' of the estimator raised {describe_error(error)}"
    if needs is None:
        return f"the estimator, a {kind}, has no SensorNeeds in an attribute 'needs'"
    if not isinstance(needs, SensorNeeds):
        return f"the estimator's attribute 'needs' is no SensorNeeds but a {type(needs).__name__}"
    if not callable(getattr(estimator, "update", None)):
        known = (name for name in dir(estimator) if not name.startswith("_") and name != "needs")
        return f"the estimator has no method update(obs){nearest('update', known)}"
    try:
        needs.check_camera_rate(rig.tick_hz // rig.camera_ticks)
    except ValueError as error:
        return str(error)
    return ""


def call(function: Callable[..., Any], *arguments: Any) -> tuple[Any, BaseException | None]:
    """Calls code of others: its value, or whatever it raised but Ctrl-C. A copy of this process
    that it has forked ends here: the copy must not go on as well."""
    process = os.getpid()
    try:
        return function(*arguments), None
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        return None, error
    finally:
        if os.getpid() != process:
            os._exit(1)


def describe_error(error: BaseException) -> str:
    """Exception as one line of text."""
    try:
        text = " ".join(str(error).split())
    except Exception:  # of its own __str__
        text = ""
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


# ------------------------------------------------------------------------------------ an estimate


def wrong_shape(estimate: Estimate) -> str:
    """Defect in the shapes and types of an estimate."""
    for name, pose in _poses(estimate):
        if not isinstance(pose, Pose):
            return f"{name} is no Pose"
        if np.shape(pose.rotation) != (3, 3) or np.shape(pose.translation) != (3,):
            return f"{name} has a rotation of {np.shape(pose.rotation)}, not (3, 3), or a " + (
                f"translation of {np.shape(pose.translation)}, not (3,)"
            )
    for name, value, shape in _arrays(estimate):
        if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu":
            return f"{name} is no NumPy array of numbers"
        if value.shape != shape:
            return f"{name} has shape {value.shape}, not {shape}"
    track = estimate.scan_track
    if track is None:
        return ""
    if not isinstance(track, PoseTrack):
        return "scan_track is no PoseTrack"
    count = len(track.times_s)
    if np.shape(track.positions_odom) != (count, 3) or np.shape(track.quats_wxyz) != (count, 4):
        return f"scan_track has {count} times, but not as many positions and quaternions"
    return ""


def not_finite(estimate: Estimate) -> str:
    """Name of the first part that is not finite, without diagnostics. The shapes must be valid."""
    for name, value, _ in _arrays(estimate):
        if not np.isfinite(value).all():
            return name
    track = estimate.scan_track
    if track is not None:
        for name in ("times_s", "positions_odom", "quats_wxyz"):
            if not np.isfinite(getattr(track, name)).all():
                return f"scan_track.{name}"
    return ""


def wrong_estimate(estimate: Any) -> str:
    """Defect that ends a flight, as in "at 1 s update returned ..."."""
    if not isinstance(estimate, Estimate):
        return f"{type(estimate).__name__}, not Estimate"
    reason = wrong_shape(estimate) or no_number(estimate)
    if reason:
        return f"an estimate whose {reason}"
    name = not_finite(estimate)
    if name:
        return f"an estimate whose {name} is not finite"
    for name, pose in _poses(estimate):
        rotation = pose.rotation
        if abs(rotation @ rotation.T - _IDENTITY).max() > _ROTATION_OFF:
            return f"an estimate whose {name}.rotation is no rotation matrix"
    return ""


_IDENTITY = np.eye(3)
_ROTATION_OFF = 1e-2
"""Limit of the deviation from orthonormal: above rounding, below a mistake."""


def no_number(estimate: Estimate) -> str:
    """Defect in the time, the diagnostics or the events."""
    try:
        if not math.isfinite(estimate.time_s):
            return "time_s is not finite"
        for value in estimate.diagnostics.values():
            float(value)
    except (TypeError, ValueError, AttributeError):
        return "time_s or diagnostics holds a value that is no number"
    if not isinstance(estimate.events, tuple | list):
        return f"events is {type(estimate.events).__name__}, not a tuple of texts"
    return ""


def _poses(estimate: Estimate) -> tuple[tuple[str, Pose], tuple[str, Pose]]:
    return (
        ("odom_from_body", estimate.odom_from_body),
        ("world_from_odom", estimate.world_from_odom),
    )


def _arrays(estimate: Estimate) -> Iterator[tuple[str, Any, tuple[int, ...]]]:
    """(name, value, shape) of the arrays; the poses must be of type Pose."""
    for name, pose in _poses(estimate):
        yield f"{name}.rotation", pose.rotation, (3, 3)
        yield f"{name}.translation", pose.translation, (3,)
    for name, shape in SHAPES.items():
        yield name, getattr(estimate, name), shape


def meaningless(estimate: Estimate) -> str:
    """Name of an invalid rotation, covariance or track, of valid shape, with its defect."""
    for name, pose in _poses(estimate):
        off = float(np.abs(pose.rotation @ pose.rotation.T - np.eye(3)).max())
        if off > 1e-6 or np.linalg.det(pose.rotation) < 0.0:
            return f"{name}.rotation is no rotation matrix"
    for name in ("position_covariance", "rotation_covariance"):
        matrix = getattr(estimate, name)
        scale = float(np.abs(matrix).max())
        if np.abs(matrix - matrix.T).max() > 1e-6 * scale:
            return f"{name} is not symmetric"
        if np.linalg.eigvalsh(matrix)[0] < -1e-9 * scale:
            return f"{name} has a negative eigenvalue"
    track = estimate.scan_track
    if track is not None and np.any(np.diff(track.times_s) <= 0.0):
        return "scan_track.times_s does not ascend"
    return ""
