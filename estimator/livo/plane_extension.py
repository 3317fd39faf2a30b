"""Depth of features without LIDAR returns nearby, from a plane that most returns around lie in.

Still water reflects the laser away: returns come from right below only, while the camera sees
ripples all over the image. If most recent returns lie in one plane, and none below it, the features
around are assumed to lie in it as well. Features that do not are outliers, which the gate of the
visual update removes.
"""

from __future__ import annotations

from zlib import crc32

import numpy as np

from touchdown.estimator.filtering.keyframes import Keyframe, bearing_rays
from touchdown.estimator.filtering.landmark_depth import RecentReturns
from touchdown.estimator.typing import Array
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.frames import Pose

_MIN_RETURNS = 150
_CELL = 0.02
"""side of the image cells, normalised units; one return per cell counts, so that area, not the
density of returns, decides"""
_TRIALS = 60
_VIEW_MARGIN = 1.5
"""returns are gathered within so many half widths of the image"""
_THICKNESS_M = 0.08
"""four standard deviations of a range"""
_MIN_DISTANCE_M = 20.0
"""distance to the plane below which unevenness of that size moves features by more than the
tracking error"""
_MIN_FRACTION = 0.5
"""fraction of the image's returns that must lie in the plane"""
_MAX_BELOW = 0.03
"""fraction of those returns that may lie beyond it: objects stand on the ground or float on the
water"""
_MIN_SPREAD = 0.05
"""standard deviation of the returns along the plane's narrower direction, relative to its distance:
the plane must be determined up to the edge of the image"""


def common_plane(points: Array) -> Array | None:
    """Returns the lowest plane ``n . P = 1``, n (3,), that most of (N, 3) points in the camera
    frame lie in; None if there is none or it is not determined. Random sample consensus (Fischler
    and Bolles 1981) with the same draws every time, then least squares."""
    if len(points) < _MIN_RETURNS:
        return None
    rng = np.random.default_rng(crc32(b"plane_extension"))
    triples = points[rng.integers(0, len(points), (_TRIALS, 3))]
    normals = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    offsets = np.einsum("ij,ij->i", normals, triples[:, 0])
    near = np.abs(points @ normals.T - offsets) < _THICKNESS_M
    inside = points[near[:, int(np.argmax(near.sum(axis=0)))]]
    for _ in range(2):
        if len(inside) < max(_MIN_RETURNS, _MIN_FRACTION * len(points)):
            return None
        centre = inside.mean(axis=0)
        values, vectors = np.linalg.eigh(np.cov((inside - centre).T))
        normal = vectors[:, 0] * np.sign(vectors[:, 0] @ centre)
        distance = float(normal @ centre)
        beyond = points @ normal - distance
        inside = points[np.abs(beyond) < _THICKNESS_M]
    if distance < _MIN_DISTANCE_M or np.sqrt(max(values[1], 0.0)) < _MIN_SPREAD * distance:
        return None
    if float((beyond > _THICKNESS_M).mean()) > _MAX_BELOW:
        return None
    return np.asarray(normal / distance, dtype=np.float64)


def extend_plane(
    keyframe: Keyframe, recent: RecentReturns, camera_from_odom: Pose, camera: CameraIntrinsics
) -> int:
    """Assigns the plane of the returns around to the features without one; returns their number."""
    missing = np.flatnonzero(~keyframe.valid)
    points = recent.points().astype(np.float64)
    if len(points) == 0 or len(missing) == 0:
        return 0
    seen = camera_from_odom.apply(points)
    depth = np.maximum(seen[:, 2], 1e-3)
    near = (seen[:, 2] > 0.1) & (
        np.abs(seen[:, 0] / depth) < _VIEW_MARGIN * 0.5 * camera.width / camera.fx
    )
    near &= np.abs(seen[:, 1] / depth) < _VIEW_MARGIN * 0.5 * camera.height / camera.fy
    seen = seen[near]
    cells = np.floor(seen[:, :2] / (_CELL * seen[:, 2:])).astype(np.int64)
    # one number a cell sorts much faster than rows
    _, first = np.unique((cells[:, 0] << 32) + cells[:, 1], return_index=True)
    plane = common_plane(seen[np.sort(first)])
    if plane is None:
        return 0
    facing = bearing_rays(keyframe.pixels[missing], camera) @ plane > 1e-3
    keyframe.valid[missing[facing]] = True
    keyframe.planes[missing[facing]] = plane
    keyframe.depth_m = float(np.median(keyframe.landmarks_camera(camera)[keyframe.valid, 2]))
    return int(facing.sum())
