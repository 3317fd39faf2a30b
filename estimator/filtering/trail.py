"""The poses that the filter has passed: for deskewing, and as the track of a scan."""

from __future__ import annotations

import copy
from typing import NamedTuple

import numpy as np

from touchdown.estimator.api import PoseTrack
from touchdown.estimator.filtering.imu_propagation import NavState
from touchdown.estimator.typing import Array
from touchdown.sim.api import LidarScan
from touchdown.sim.frames import Pose, interpolate_pose, quat_wxyz_from_matrix

_STEPS = 128


class ScanPath(NamedTuple):
    """odom_from_imu at M >= 2 instants that span a scan."""

    times: Array  # (M,) s after the scan's start
    rotations: Array  # (M, 3, 3)
    positions: Array  # (M, 3) m
    now: int  # index of the filter's pose: that at the last IMU sample of the scan


class Trail:
    """odom_from_imu at the last IMU ticks: ``ticks`` (N,), ``rotations`` (N, 3, 3), ``positions``
    (N, 3)."""

    def __init__(self, state: NavState) -> None:
        self.ticks = np.array([state.tick], np.int64)
        self.rotations = state.rotation[None]
        self.positions = state.position[None]

    def extend(self, ticks: Array, rotations: Array, positions: Array) -> None:
        """Adds the poses passed by the newest propagation."""
        whole = ticks.astype(np.int64)
        self.ticks = np.concatenate([self.ticks, whole])[-_STEPS:]
        self.rotations = np.concatenate([self.rotations, rotations])[-_STEPS:]
        self.positions = np.concatenate([self.positions, positions])[-_STEPS:]

    def follow(self, state: NavState) -> None:
        """Moves the whole trail rigidly so that it ends at the filter's state."""
        rotation = state.rotation @ self.rotations[-1].T
        self.positions = (self.positions - self.positions[-1]) @ rotation.T + state.position
        self.rotations = rotation @ self.rotations

    def reaching(self, state: NavState) -> Trail:
        """Returns the trail with one pose more, without changing it."""
        longer = copy.copy(self)
        longer.extend(np.array([state.tick]), state.rotation[None], state.position[None])
        return longer

    def start_of(self, scan: LidarScan, imu_ticks: int) -> int | None:
        """Returns the index of the last pose at or before the scan's start, if the trail ends at
        the scan's end or less than ``imu_ticks`` after it."""
        first = int(np.searchsorted(self.ticks, scan.start_tick, side="right")) - 1
        spans = 0 <= first < len(self.ticks) - 1
        return first if spans and 0 <= self.ticks[-1] - scan.end_tick < imu_ticks else None

    def track(self, first: int, imu_from_body: Pose, tick_hz: int) -> PoseTrack:
        """Returns the body's poses from index ``first`` on."""
        bodies = self.rotations[first:] @ imu_from_body.rotation
        return PoseTrack(
            times_s=self.ticks[first:] / tick_hz,
            positions_odom=self.positions[first:]
            + self.rotations[first:] @ imu_from_body.translation,
            quats_wxyz=np.array([quat_wxyz_from_matrix(rotation) for rotation in bodies]),
        )

    def pose_at(self, tick: int) -> Pose:
        """odom_from_imu at ``tick``, as far as the trail reaches."""
        at = float(np.interp(tick, self.ticks, np.arange(len(self.ticks))))
        first = min(int(at), max(len(self.ticks) - 2, 0))
        last = min(first + 1, len(self.ticks) - 1)
        ends = [Pose(self.rotations[k], self.positions[k]) for k in (first, last)]
        return interpolate_pose(ends[0], ends[1], at - first)
