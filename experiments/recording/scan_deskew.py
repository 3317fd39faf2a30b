"""Deskewing of a recorded scan: returns in the odom frame, each from the pose at its own time."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.api import PoseTrack
from touchdown.estimator.filtering.deskew import deskewed_points
from touchdown.sim.api import LidarScan
from touchdown.sim.frames import Pose, matrices_from_quats_wxyz

Array = NDArray[np.float64]

_HEIGHT_SPAN_M = 12.0
_TURBO_BGR = np.asarray(cv2.applyColorMap(np.arange(256, dtype=np.uint8), cv2.COLORMAP_TURBO))
_TURBO_RGB: NDArray[np.uint8] = _TURBO_BGR.reshape(256, 3)[:, ::-1].astype(np.uint8)


def scan_points_odom(
    scan: LidarScan, track: PoseTrack, body_from_lidar: Pose, max_points: int
) -> Array:
    """(N, 3) returns in the odom frame, about ``max_points`` at most, spread over the scan."""
    hits = np.flatnonzero(scan.ranges > 0.0)
    return deskewed_points(scan, hits[:: max(1, len(hits) // max_points)], track, body_from_lidar)


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
