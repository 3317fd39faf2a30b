"""A recorded scan: its returns in the odom frame, each from the pose of its own instant."""

from __future__ import annotations

from collections import deque

import cv2
import numpy as np
from numpy.typing import NDArray

from estimator.api import Estimate, PoseTrack
from sim.api import LidarScan
from sim.frames import Pose, matrices_from_quats_wxyz, quat_wxyz_from_matrix

Array = NDArray[np.float64]

_TRACK_POSES = 80
"""0.4 s at 200 Hz: a scan of 0.1 s and its delivery."""
_HEIGHT_SPAN_M = 12.0
_TURBO_BGR = np.asarray(cv2.applyColorMap(np.arange(256, dtype=np.uint8), cv2.COLORMAP_TURBO))
_TURBO_RGB: NDArray[np.uint8] = _TURBO_BGR.reshape(256, 3)[:, ::-1].astype(np.uint8)


class OdomTrack:
    """The newest odometry poses, for estimators that offer no track of their own."""

    def __init__(self) -> None:
        self._poses: deque[tuple[float, Pose]] = deque(maxlen=_TRACK_POSES)

    def add(self, estimate: Estimate) -> None:
        if not self._poses or estimate.time_s > self._poses[-1][0]:
            self._poses.append((estimate.time_s, estimate.odom_from_body))

    def around(self, scan: LidarScan) -> PoseTrack:
        """The poses over the span of a scan and one on either side."""
        times = np.array([time_s for time_s, _ in self._poses])
        first = max(int(np.searchsorted(times, scan.start_time_s)) - 1, 0)
        last = int(np.searchsorted(times, scan.end_time_s)) + 1
        poses = [pose for _, pose in self._poses][first:last]
        return PoseTrack(
            times_s=times[first:last],
            positions_odom=np.array([pose.translation for pose in poses]),
            quats_wxyz=np.array([quat_wxyz_from_matrix(pose.rotation) for pose in poses]),
        )


def scan_points_odom(
    scan: LidarScan, track: PoseTrack, body_from_lidar: Pose, max_points: int
) -> Array:
    """(N, 3) returns in the odom frame, about ``max_points`` at most, spread over the scan."""
    hits = np.flatnonzero(scan.ranges > 0.0)
    hits = hits[:: max(1, len(hits) // max_points)]
    times = scan.start_time_s + scan.time_offsets[hits].astype(np.float64)
    in_lidar = (scan.directions[hits] * scan.ranges[hits, None]).astype(np.float64)
    in_body = body_from_lidar.apply(in_lidar)
    quats, positions = _quats_at(track, times)
    return _turned(quats, in_body) + positions


def height_colours(heights_m: Array) -> NDArray[np.uint8]:
    """(N, 3) RGB from blue at the ground to red at ``_HEIGHT_SPAN_M``."""
    level = np.clip((heights_m + 1.0) / _HEIGHT_SPAN_M, 0.0, 1.0)
    return _TURBO_RGB[(55 + 200 * level).astype(np.uint8)]


def poses_at(track: PoseTrack, times: Array) -> tuple[Array, Array]:
    """Rotations (N, 3, 3) and positions (N, 3) at ``times``; poses at the ends hold beyond them."""
    quats, positions = _quats_at(track, times)
    return matrices_from_quats_wxyz(quats), positions


def _quats_at(track: PoseTrack, times: Array) -> tuple[Array, Array]:
    """Unit quaternions wxyz (N, 4) and positions (N, 3), as `poses_at`."""
    if len(track.times_s) == 1:
        shape = len(times), 1
        return np.tile(track.quats_wxyz, shape), np.tile(track.positions_odom, shape)
    after = np.clip(np.searchsorted(track.times_s, times), 1, len(track.times_s) - 1)
    start, end = track.times_s[after - 1], track.times_s[after]
    share = np.clip((times - start) / (end - start), 0.0, 1.0)[:, None]
    first, second = track.quats_wxyz[after - 1], track.quats_wxyz[after]
    second = np.where(np.sum(first * second, axis=1, keepdims=True) < 0.0, -second, second)
    quats = (1.0 - share) * first + share * second
    quats /= np.sqrt(np.einsum("ni,ni->n", quats, quats))[:, None]
    positions = (1.0 - share) * track.positions_odom[after - 1]
    return quats, positions + share * track.positions_odom[after]


def _turned(quats_wxyz: Array, vectors: Array) -> Array:
    """(N, 3) vectors turned by (N, 4) unit quaternions: v + 2 w (r x v) + 2 r x (r x v)."""
    w, x, y, z = np.ascontiguousarray(quats_wxyz.T)
    a, b, c = np.ascontiguousarray(vectors.T)
    i, j, k = 2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a)
    out = np.empty_like(vectors)
    out[:, 0] = a + w * i + y * k - z * j
    out[:, 1] = b + w * j + z * i - x * k
    out[:, 2] = c + w * k + x * j - y * i
    return out
