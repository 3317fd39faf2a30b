"""Depth of features beside the laser's returns, where all returns around lie in one plane.

Still water mirrors a laser away: returns come back from right below only, while the camera sees
ripples all over its picture. If whatever came back of late lies in one plane, the features around
are taken to lie in it as well. Those that do not will not follow the motion that the others tell,
and the gate of the visual update drops them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimator.keyframes import Keyframe, bearing_rays
from estimator.landmark_depth import RecentReturns
from sim.api import CameraIntrinsics
from sim.frames import Pose

Array = NDArray[np.float64]

_LEAST_RETURNS = 150
_USED_RETURNS = 3000
_VIEW_MARGIN = 1.5
"""returns are gathered within so many half widths of the picture"""
_THICKNESS_M = 0.08
"""four standard deviations of a range"""
_LEAST_DISTANCE_M = 20.0
"""nearer, unevenness of that size would move features by more than a tracked corner errs"""
_LEAST_SHARE = 0.97
"""of the returns that must lie within it"""
_LEAST_SPREAD = 0.05
"""standard deviation of the returns along the plane's narrower direction, in distances to it: the
plane must carry as far as the picture's edge"""


def common_plane(points: Array) -> Array | None:
    """The plane ``n . P = 1`` of (N, 3) points as n (3,), or None if they do not lie in one plane
    or do not determine it."""
    if len(points) < _LEAST_RETURNS:
        return None
    chosen = points[:: max(1, len(points) // _USED_RETURNS)]
    for _ in range(2):
        centre = chosen.mean(axis=0)
        values, vectors = np.linalg.eigh(np.cov((chosen - centre).T))
        normal = vectors[:, 0]
        distance = float(normal @ centre)
        off = np.abs(points @ normal - distance)
        inside = points[off < _THICKNESS_M]
        if len(inside) < _LEAST_SHARE * len(points) or abs(distance) < _LEAST_DISTANCE_M:
            return None
        chosen = inside[:: max(1, len(inside) // _USED_RETURNS)]
    if np.sqrt(max(values[1], 0.0)) < _LEAST_SPREAD * abs(distance):
        return None
    return np.asarray(normal / distance, dtype=np.float64)


def extend_plane(
    keyframe: Keyframe, recent: RecentReturns, camera_from_odom: Pose, camera: CameraIntrinsics
) -> int:
    """Gives the features without plane that of all returns around; returns to how many."""
    missing = np.flatnonzero(~keyframe.valid)
    points, counts, per_scan = recent.view()
    filled = [points[s * per_scan : s * per_scan + n] for s, n in enumerate(counts) if n]
    if not filled or len(missing) == 0:
        return 0
    seen = camera_from_odom.apply(np.concatenate(filled).astype(np.float64))
    depth = np.maximum(seen[:, 2], 1e-3)
    near = (seen[:, 2] > 0.1) & (
        np.abs(seen[:, 0] / depth) < _VIEW_MARGIN * 0.5 * camera.width / camera.fx
    )
    near &= np.abs(seen[:, 1] / depth) < _VIEW_MARGIN * 0.5 * camera.height / camera.fy
    plane = common_plane(seen[near])
    if plane is None:
        return 0
    facing = bearing_rays(keyframe.pixels[missing], camera) @ plane > 1e-3
    keyframe.valid[missing[facing]] = True
    keyframe.planes[missing[facing]] = plane
    keyframe.depth_m = float(np.median(keyframe.landmarks_camera(camera)[keyframe.valid, 2]))
    return int(facing.sum())
