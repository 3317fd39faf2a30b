"""Anchors: the clone of the filter that each part of the map belongs to.

The map is made with the filter's own poses and shares their errors. Every voxel is anchored to a
clone: it moves with the clone's estimate, and a scan matched to it measures the present pose
relative to that clone, not to the world.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from touchdown.estimator.filtering.error_state import (
    MOUNT_DIM,
    MOUNT_ROTATION,
    MOUNT_TRANSLATION,
    POSE_DIM,
    POSITION,
    ROTATION,
    Frames,
)
from touchdown.estimator.filtering.vectors import Vector, cross
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array, Indices

# derivatives of a residual: pose, mount of the LIDAR, and the clone that its part of the map is
# anchored to
MOUNT_AT, CLONE_AT = POSE_DIM, POSE_DIM + MOUNT_DIM
ANCHORED_DIM = CLONE_AT + POSE_DIM


class Sight(NamedTuple):
    """A return of a scan and what of the map it is compared with."""

    point: Vector  # IMU frame
    beam: Vector  # IMU frame, from the LIDAR
    arm: Vector  # frame of the clone, from where the map was seen
    reach: Vector  # frame of the clone


@njit(cache=True, error_model="numpy")
def derivatives_into(
    row: Array, direction: Vector, in_imu: Vector, in_clone: Vector, sight: Sight, alone: bool
) -> None:
    """Writes the derivatives of a distance along ``direction`` by the pose and, unless ``alone``,
    by mount and clone into ``row`` (18,). ``in_imu``, ``in_clone``: the same direction there.

    What the map shows was seen along a beam of its own, which turns with the LIDAR's mount as that
    of the scan does, and moves with its clone."""
    turn = cross(sight.point, in_imu)
    for a in range(3):
        row[ROTATION.start + a], row[POSITION.start + a] = turn[a], direction[a]
    if alone:
        return
    mount, moment = cross(sight.beam, in_imu), cross(sight.arm, in_clone)
    by_clone = cross(in_clone, sight.reach)
    for a in range(3):
        row[MOUNT_AT + MOUNT_ROTATION.start + a] = mount[a] - moment[a]
        row[MOUNT_AT + MOUNT_TRANSLATION.start + a] = in_imu[a] - in_clone[a]
        row[CLONE_AT + ROTATION.start + a] = by_clone[a]
        row[CLONE_AT + POSITION.start + a] = -direction[a]


class AnchorFrames(NamedTuple):
    """The K anchors of the map at the present estimate."""

    moves: Frames  # that move stored planes to it
    clones: Frames  # odom_from_imu
    mount_changes: Array  # (K, 6) present mount less the mount when the clone was made
    slots: Indices
    """(K,) place of each among the clones that are touched; -1: not touched"""


class Anchors:
    """Pose and calibration at the creation of each clone of the filter, in the order of the clones.
    Voxels are stored as if made with these."""

    def __init__(self) -> None:
        self._poses: list[Pose] = []
        self._calibrations: list[Array] = []

    def __len__(self) -> int:
        return len(self._poses)

    def add(self, pose: Pose, calibration: Array) -> None:
        """Adds the anchor of a new clone; ``calibration`` (C,), C = 0 or 38."""
        self._poses.append(pose)
        self._calibrations.append(_mount_part(calibration))

    def remove(self, k: int) -> None:
        """Removes the anchor of clone ``k``."""
        del self._poses[k], self._calibrations[k]

    def moves_to_kept(self, clones: list[Pose]) -> Frames:
        """(K,) transforms from the present estimate of the ``clones`` to the anchors as kept."""
        return _between(Frames.of(self._poses), Frames.of(clones))

    def as_kept(
        self, points: Array, sensor: Array, clone: Pose, calibration: Array, imu_rotation: Array
    ) -> Array:
        """Returns (N, 3) points of a scan as the newest anchor keeps them, odom frame: relative to
        its ``clone`` as they are now. ``sensor`` (3,): position of the LIDAR; ``imu_rotation``
        (3, 3): odom_from_imu of the scan."""
        change = self._calibrations[-1] - _mount_part(calibration)
        turn, shift = (imu_rotation @ change[part] for part in (MOUNT_ROTATION, MOUNT_TRANSLATION))
        with_mount = points + np.cross(turn, points - sensor) + shift
        return (self._poses[-1] @ clone.inverse()).apply(with_mount)

    def frames(self, clones: list[Pose], calibration: Array, touched: Indices) -> AnchorFrames:
        """The anchors at the present estimate; ``touched``: of them, ascending."""
        slots = np.full(len(self), -1, dtype=np.int64)
        slots[touched] = np.arange(len(touched))
        now = Frames.of(clones)
        moves = _between(now, Frames.of(self._poses))
        changes = [_mount_part(calibration) - own for own in self._calibrations]
        return AnchorFrames(moves, now, np.array(changes).reshape(-1, MOUNT_DIM), slots)

    def reassignment(self, k: int, clones: list[Pose]) -> tuple[int, Pose]:
        """Reassignment of clone ``k``: returns its successor, the nearest other clone, and the
        transform of its voxels that keeps them at their present estimate. Needs two clones or
        more."""
        positions = np.array([clone.translation for clone in clones])
        gap = np.linalg.norm(positions - positions[k], axis=1)
        gap[k] = np.inf
        successor = int(np.argmin(gap))
        there = self._poses[successor] @ clones[successor].inverse()
        return successor, there @ clones[k] @ self._poses[k].inverse()


def _mount_part(calibration: Array) -> Array:
    return calibration[:MOUNT_DIM] if len(calibration) else np.zeros(MOUNT_DIM)


def _between(ends: Frames, starts: Frames) -> Frames:
    """``end @ start.inverse()`` of each."""
    rotations = ends.rotations @ starts.rotations.transpose(0, 2, 1)
    moved = (rotations @ starts.translations[:, :, None])[:, :, 0]
    return Frames(rotations, ends.translations - moved)
