"""Rotations, poses and camera frames: the only place where representations are converted.

Conventions: world ENU (z up), body FLU (x forward, y left, z up), camera optical (x right, y down,
z forward), LIDAR (x along the long axis of its field of view, z along the boresight). Quaternions
are Hamilton, unit, in the order w, x, y, z. Names read right to left: ``world_from_body`` maps body
coordinates to world coordinates.
"""

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from touchdown.sim.typing import Array

_SMALL_ANGLE = 1e-8


@dataclass(frozen=True, slots=True)
class Pose:
    """A rigid transform ``target_from_source``.

    rotation: (3, 3) float64, orthonormal; translation: (3,) float64, metres, origin of the source
    frame expressed in the target frame.
    """

    rotation: Array
    translation: Array

    @staticmethod
    def identity() -> "Pose":
        return Pose(np.eye(3), np.zeros(3))

    def __matmul__(self, other: "Pose") -> "Pose":
        """Composition: ``a_from_c = a_from_b @ b_from_c``."""
        return Pose(
            self.rotation @ other.rotation, self.rotation @ other.translation + self.translation
        )

    def inverse(self) -> "Pose":
        transposed = self.rotation.T
        return Pose(transposed, -transposed @ self.translation)

    def apply(self, points: Array) -> Array:
        """Transforms (..., 3) points from the source frame to the target frame."""
        return points @ self.rotation.T + self.translation

    def matrix(self) -> Array:
        """The (4, 4) homogeneous matrix."""
        homogeneous = np.eye(4)
        homogeneous[:3, :3] = self.rotation
        homogeneous[:3, 3] = self.translation
        return homogeneous


def skew(vector: Array) -> Array:
    """(3,) -> (3, 3) with ``skew(a) @ b == cross(a, b)``."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def cross(first: Array, second: Array) -> Array:
    """``np.cross`` of two vectors (3,), to the bit, without what it costs on so few numbers."""
    a, b, c = first.tolist()
    x, y, z = second.tolist()
    return np.array([b * z - c * y, c * x - a * z, a * y - b * x])


def so3_exp(rotation_vector: Array) -> Array:
    """Rotation matrix of a rotation vector (3,) in radians (Rodrigues)."""
    # Scalars throughout: numpy on arrays of three costs several times as much.
    x, y, z = rotation_vector.tolist()
    squared = x * x + y * y + z * z
    angle = math.sqrt(squared)
    if angle < _SMALL_ANGLE:
        return np.array([[1.0, -z, y], [z, 1.0, -x], [-y, x, 1.0]])
    a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / squared
    return np.array(
        [
            [1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y],
            [b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x],
            [b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)],
        ]
    )


def so3_log(rotation: Array) -> Array:
    """Rotation vector (3,) in radians, angle in [0, pi], of a rotation matrix."""
    w, x, y, z = _quat_scalars(rotation)
    sine = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 if sine < _SMALL_ANGLE else 2.0 * math.atan2(sine, w) / sine
    return np.array([scale * x, scale * y, scale * z])


def so3_right_jacobian(rotation_vector: Array) -> Array:
    """Jr with ``exp(v + d) ~ exp(v) exp(Jr(v) d)``."""
    angle = float(np.sqrt(rotation_vector @ rotation_vector))
    generator = skew(rotation_vector)
    if angle < 1e-5:
        return np.eye(3) - 0.5 * generator
    return (
        np.eye(3)
        - ((1.0 - np.cos(angle)) / angle**2) * generator
        + ((angle - np.sin(angle)) / angle**3) * generator @ generator
    )


def quat_wxyz_from_matrix(rotation: Array) -> Array:
    """Unit quaternion (4,) wxyz with w >= 0 of a rotation matrix (Shepperd's method)."""
    return np.array(_quat_scalars(rotation))


def _quat_scalars(rotation: Array) -> tuple[float, float, float, float]:
    """w, x, y, z from the largest of the four squared components, so that nothing cancels."""
    (m00, m01, m02), (m10, m11, m12), (m20, m21, m22) = rotation.tolist()
    trace = m00 + m11 + m22
    largest = max(trace, m00, m11, m22)
    if largest == trace:
        w, x, y, z = 1.0 + trace, m21 - m12, m02 - m20, m10 - m01
    elif largest == m00:
        w, x, y, z = m21 - m12, 1.0 + m00 - m11 - m22, m10 + m01, m20 + m02
    elif largest == m11:
        w, x, y, z = m02 - m20, m10 + m01, 1.0 + m11 - m22 - m00, m21 + m12
    else:
        w, x, y, z = m10 - m01, m20 + m02, m21 + m12, 1.0 + m22 - m00 - m11
    norm = math.copysign(math.sqrt(w * w + x * x + y * y + z * z), w)
    return w / norm, x / norm, y / norm, z / norm


def matrix_from_quat_wxyz(quat_wxyz: Array) -> Array:
    """Rotation matrix (3, 3) of a quaternion (4,) wxyz of any non-zero norm."""
    w, x, y, z = np.asarray(quat_wxyz, dtype=np.float64).tolist()
    s = 2.0 / (w * w + x * x + y * y + z * z)
    return np.array(
        [
            [1.0 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)],
            [s * (x * y + w * z), 1.0 - s * (x * x + z * z), s * (y * z - w * x)],
            [s * (x * z - w * y), s * (y * z + w * x), 1.0 - s * (x * x + y * y)],
        ]
    )


def matrices_from_quats_wxyz(quats_wxyz: Array) -> Array:
    """(N, 4) wxyz unit quaternions -> (N, 3, 3) rotation matrices."""
    w, x, y, z = np.moveaxis(np.asarray(quats_wxyz, dtype=np.float64), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def rotation_from_yaw(yaw: float) -> Array:
    """Rotation about +z by ``yaw`` radians."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def yaw_from_rotation(rotation: Array) -> float:
    """Heading in radians of the body x axis projected on the ground, in (-pi, pi]."""
    return math.atan2(rotation.item(1, 0), rotation.item(0, 0))


def tilt_from_rotation(rotation: Array) -> float:
    """Angle in radians between the body z axis and the world z axis."""
    return math.acos(min(max(rotation.item(2, 2), -1.0), 1.0))


def wrap_angle(angle: float) -> float:
    """Wraps radians to (-pi, pi]."""
    return float(-((-angle + np.pi) % (2.0 * np.pi) - np.pi))


def interpolate_pose(first: Pose, second: Pose, fraction: float) -> Pose:
    """Geodesic in SO(3), straight line in R3: 0 gives ``first``, 1 gives ``second``."""
    step = so3_log(first.rotation.T @ second.rotation)
    return Pose(
        first.rotation @ so3_exp(fraction * step),
        (1.0 - fraction) * first.translation + fraction * second.translation,
    )


class TimedPose(NamedTuple):
    """A pose at a time, s."""

    time_s: float
    pose: Pose


class PoseHistory:
    """The last ``length`` poses of a body, in the order of time."""

    def __init__(self, length: int) -> None:
        self._poses: deque[TimedPose] = deque(maxlen=length)

    def add(self, time_s: float, pose: Pose) -> None:
        """Adds the pose at ``time_s``, unless it is not finite or not newer than the last."""
        newer = not self._poses or time_s > self._poses[-1].time_s
        if newer and math.isfinite(float(pose.translation.sum() + pose.rotation.sum())):
            self._poses.append(TimedPose(time_s, pose))

    def at(self, time_s: float) -> Pose | None:
        """The pose at ``time_s``, interpolated; the last one after it, None before the first."""
        later = self._poses[-1] if self._poses else None
        for entry in reversed(self._poses):
            assert later is not None
            if entry.time_s <= time_s:
                span = later.time_s - entry.time_s
                fraction = (time_s - entry.time_s) / span if span > 0.0 else 0.0
                return interpolate_pose(entry.pose, later.pose, min(fraction, 1.0))
            later = entry
        return None

    def around(self, start_s: float, end_s: float) -> list[TimedPose]:
        """The poses of a span of time and one on either side, as far as there are any; the oldest
        two for a span before them, and fewer than two where there are no more."""
        entries: list[TimedPose] = []
        for entry in reversed(self._poses):  # the span is close to the newest entry
            if entry.time_s >= end_s:
                entries = [entry]
                continue
            entries.append(entry)
            if entry.time_s <= start_s and len(entries) > 1:
                break
        entries.reverse()
        return entries if len(entries) > 1 else list(self._poses)[:2]


# A sensor that looks straight down from a body that faces +x: image up is forward, image right is
# right. The LIDAR's long axis (x) lies across the flight direction, like the camera's.
BODY_FROM_DOWNWARD_OPTICAL: Array = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
