"""Deskewing of a recorded scan: returns in the odom frame, each from the pose at its own time."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.api import PoseTrack
from touchdown.estimator.filtering.deskew import deskewed_points
from touchdown.sim.api import LidarScan
from touchdown.sim.frames import Pose

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
