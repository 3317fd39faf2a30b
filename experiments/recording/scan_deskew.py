"""Deskewing of a recorded scan: returns in the odom frame, each from the pose at its own time."""

from __future__ import annotations

from collections import deque

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.api import Estimate, PoseTrack
from touchdown.sim.api import LidarScan
from touchdown.sim.frames import Pose, matrices_from_quats_wxyz, quat_wxyz_from_matrix

Array = NDArray[np.float64]

_TRACK_POSES = 80
"""0.4 s at 200 Hz: a scan of 0.1 s and its delivery."""
_HEIGHT_SPAN_M = 12.0
_TURBO_BGR = np.asarray(cv2.applyColorMap(np.arange(256, dtype=np.uint8), cv2.COLORMAP_TURBO))
_TURBO_RGB: NDArray[np.uint8] = _TURBO_BGR.reshape(256, 3)[:, ::-1].astype(np.uint8)


class OdomTrack:
    """Latest odometry poses, for estimators that provide no scan track."""

    def __init__(self) -> None:
        self._poses: deque[tuple[float, Pose]] = deque(maxlen=_TRACK_POSES)

    def add(self, estimate: Estimate) -> None:
        if not self._poses or estimate.time_s > self._poses[-1][0]:
            self._poses.append((estimate.time_s, estimate.odom_from_body))

    def around(self, scan: LidarScan) -> PoseTrack:
        """Returns the poses over the span of a scan and one on either side."""
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
    return (_turned(quats, in_body.T) + positions).T


def height_colours(heights_m: Array) -> NDArray[np.uint8]:
    """(N, 3) RGB from blue at the ground to red at ``_HEIGHT_SPAN_M``."""
    level = np.clip((heights_m + 1.0) / _HEIGHT_SPAN_M, 0.0, 1.0)
    return _TURBO_RGB[(55 + 200 * level).astype(np.uint8)]


def poses_at(track: PoseTrack, times: Array) -> tuple[Array, Array]:
    """Rotations (N, 3, 3) and positions (N, 3) at ``times``; poses at the ends hold beyond them."""
    quats, positions = _quats_at(track, times)
    return matrices_from_quats_wxyz(quats.T), positions.T


def _quats_at(track: PoseTrack, times: Array) -> tuple[Array, Array]:
    """Unit quaternions wxyz (4, N) and positions (3, N), as `poses_at`."""
    quats = track.quats_wxyz
    turned_over = np.einsum("mi,mi->m", quats[1:], quats[:-1]) < 0.0
    signs = np.where(np.cumsum([False, *turned_over]) % 2, -1.0, 1.0)
    columns = (*(quats * signs[:, None]).T, *track.positions_odom.T)
    between = np.array([np.interp(times, track.times_s, column) for column in columns])
    return between[:4] / np.sqrt(np.sum(between[:4] ** 2, axis=0)), between[4:]


def _turned(quats_wxyz: Array, vectors: Array) -> Array:
    """(3, N) vectors rotated by (4, N) unit quaternions: v + 2 w (r x v) + 2 r x (r x v)."""
    w, x, y, z = quats_wxyz
    a, b, c = vectors
    i, j, k = 2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a)
    return np.array(
        [a + w * i + y * k - z * j, b + w * j + z * i - x * k, c + w * k + x * j - y * i]
    )
