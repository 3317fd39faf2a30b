"""Depth of features beside the laser's returns, where most returns around lie in one plane.

Still water mirrors a laser away: returns come back from right below only, while the camera sees
ripples all over its picture. If most of what came back of late lies in one plane, and nothing below
it, the features around are taken to lie in it as well. Those that do not will not follow the motion
that the others tell, and the gate of the visual update drops them.
"""

from __future__ import annotations

from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.filtering.keyframes import Keyframe, bearing_rays
from touchdown.estimator.filtering.landmark_depth import RecentReturns
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.frames import Pose

Array = NDArray[np.float64]

_LEAST_RETURNS = 150
_CELL = 0.02
"""one return of each cell of the picture counts, normalised units: area, not echo, has the say"""
_TRIALS = 60
_VIEW_MARGIN = 1.5
"""returns are gathered within so many half widths of the picture"""
_THICKNESS_M = 0.08
"""four standard deviations of a range"""
_LEAST_DISTANCE_M = 20.0
"""nearer, unevenness of that size would move features by more than a tracked corner errs"""
_LEAST_SHARE = 0.5
"""of the picture's returns, that must lie in the plane"""
_MOST_BELOW = 0.03
"""of them that may lie beyond it: things stand on ground, or swim on water"""
_LEAST_SPREAD = 0.05
"""standard deviation of the returns along the plane's narrower direction, in distances to it: the
plane must carry as far as the picture's edge"""


def common_plane(points: Array) -> Array | None:
    """The lowest plane ``n . P = 1``, n (3,), that most of (N, 3) points in the camera's frame lie
    in, or None if there is none or they do not determine it. Random sample consensus (Fischler and
    Bolles 1981) with always the same draws, then least squares."""
    if len(points) < _LEAST_RETURNS:
        return None
    rng = np.random.default_rng(crc32(b"plane_extension"))
    triples = points[rng.integers(0, len(points), (_TRIALS, 3))]
    normals = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    offsets = np.einsum("ij,ij->i", normals, triples[:, 0])
    near = np.abs(points @ normals.T - offsets) < _THICKNESS_M
    inside = points[near[:, int(np.argmax(near.sum(axis=0)))]]
    for _ in range(2):
        if len(inside) < max(_LEAST_RETURNS, _LEAST_SHARE * len(points)):
            return None
        centre = inside.mean(axis=0)
        values, vectors = np.linalg.eigh(np.cov((inside - centre).T))
        normal = vectors[:, 0] * np.sign(vectors[:, 0] @ centre)
        distance = float(normal @ centre)
        beyond = points @ normal - distance
        inside = points[np.abs(beyond) < _THICKNESS_M]
    if distance < _LEAST_DISTANCE_M or np.sqrt(max(values[1], 0.0)) < _LEAST_SPREAD * distance:
        return None
    if float((beyond > _THICKNESS_M).mean()) > _MOST_BELOW:
        return None
    return np.asarray(normal / distance, dtype=np.float64)


def extend_plane(
    keyframe: Keyframe, recent: RecentReturns, camera_from_odom: Pose, camera: CameraIntrinsics
) -> int:
    """Gives the features without plane that of the returns around; returns to how many."""
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
