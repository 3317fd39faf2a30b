"""Anchors: the clone of the filter that each part of the map belongs to.

The map is made with the filter's own poses and shares their errors. Every voxel is anchored to a
clone: it moves with the clone's estimate, and a scan matched to it measures the present pose
relative to that clone, not to the world.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.livo.online_calibration import MOUNT_DIM
from touchdown.sim.frames import Pose

Array = NDArray[np.float64]


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

    def now_from_kept(self, clones: list[Pose]) -> tuple[Array, Array]:
        """Rotations (K, 3, 3) and translations (K, 3) that move stored voxels to the present
        estimate of their clones."""
        moves = [clone @ kept.inverse() for clone, kept in zip(clones, self._poses, strict=True)]
        return _stack(moves)

    def kept_from_now(
        self, clones: list[Pose], calibration: Array, imu_rotation: Array
    ) -> tuple[Array, Array, Array]:
        """Inverse of ``now_from_kept`` for new returns: rotations (K, 3, 3), translations (K, 3)
        and mount corrections (K, 6): rotation of the beam and translation, odom frame, to be
        applied first. ``imu_rotation`` (3, 3): odom_from_imu of the scan."""
        moves = [kept @ clone.inverse() for clone, kept in zip(clones, self._poses, strict=True)]
        mount = _mount_part(calibration)
        changes = np.array([(c - mount).reshape(2, 3) for c in self._calibrations])
        changes = changes.reshape(-1, 2, 3) @ imu_rotation.T
        return *_stack(moves), changes.reshape(-1, MOUNT_DIM)

    def mount_changes(self, calibration: Array) -> Array:
        """(K, 6) differences of the mount's rotation and translation from those at each clone's
        creation."""
        mount = _mount_part(calibration)
        return np.array([mount - c for c in self._calibrations]).reshape(-1, MOUNT_DIM)

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


def _stack(poses: list[Pose]) -> tuple[Array, Array]:
    rotations = np.array([pose.rotation for pose in poses]).reshape(-1, 3, 3)
    translations = np.array([pose.translation for pose in poses]).reshape(-1, 3)
    return rotations, translations
