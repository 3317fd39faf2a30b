"""A stereo pair in place of a LIDAR that a recording lacks: its disparities as a scan."""

import cv2
import numpy as np

from touchdown.experiments.recordings.contract import RawScan
from touchdown.sim.api import CameraIntrinsics, LidarSheet
from touchdown.sim.typing import Bytes

_DISPARITIES, _BLOCK, _EVERY = 96, 7, 4
"""pixels searched, side of a block, and of the raster of pixels that become points"""
_DISPARITY_SIGMA = 0.25
_FARTHEST_SIGMA_M = 0.15
"""points whose depth is less certain are left out"""


def pair_sheet(focal_baseline: float) -> LidarSheet:
    """The data sheet of such a scan. ``focal_baseline``: pixels times metres."""
    farthest = float(np.sqrt(_FARTHEST_SIGMA_M * focal_baseline / _DISPARITY_SIGMA))
    nearest = focal_baseline / _DISPARITIES
    return LidarSheet(
        range_sigma_m=0.5 * _FARTHEST_SIGMA_M, angle_sigma_deg=0.1, min_range_m=nearest,
        max_range_m=1.5 * farthest,
    )  # fmt: skip


def pair_scan(
    left: Bytes, right: Bytes, camera: CameraIntrinsics, baseline_m: float, stamp_ns: int
) -> RawScan:
    """The points of a rectified pair (H, W, 3) in the frame of the left camera (Hirschmueller
    2008, semi-global matching)."""
    grey = [np.asarray(cv2.cvtColor(one, cv2.COLOR_RGB2GRAY), np.uint8) for one in (left, right)]
    matcher = cv2.StereoSGBM.create(
        minDisparity=0, numDisparities=_DISPARITIES, blockSize=_BLOCK, P1=8 * _BLOCK**2,
        P2=32 * _BLOCK**2, disp12MaxDiff=1, uniquenessRatio=15, speckleWindowSize=100,
        speckleRange=2,
    )  # fmt: skip
    found = matcher.compute(*grey)[::_EVERY, ::_EVERY].astype(np.float32) / 16.0
    rows, cols = np.nonzero(found > 0.5)
    depth = camera.fx * baseline_m / found[rows, cols]
    near = depth**2 * _DISPARITY_SIGMA < _FARTHEST_SIGMA_M * camera.fx * baseline_m
    rows, cols, depth = rows[near], cols[near], depth[near]
    x = (cols * _EVERY - camera.cx) / camera.fx * depth
    y = (rows * _EVERY - camera.cy) / camera.fy * depth
    points = np.column_stack([x, y, depth]).astype(np.float32)
    level = grey[0][rows * _EVERY, cols * _EVERY]
    return RawScan(
        stamp_ns=stamp_ns, points=points, offsets_s=np.zeros(len(points), np.float32),
        intensity=np.ascontiguousarray(level),
    )  # fmt: skip
