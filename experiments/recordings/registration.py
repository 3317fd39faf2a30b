"""Registration of two scans, for what an estimator cannot know at the start of a recording."""

from __future__ import annotations

import numpy as np

from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array, Float32

_VOXEL_M = 0.2
_REACHES_M = (2.0, 0.8, 0.3)
"""largest distances of corresponding points, from coarse to fine"""
_ITERATIONS = 60
_MIN_POINTS = 200
_MIN_FITNESS = 0.5
"""fraction of the points that must have found one within the last reach"""


def registered(
    first: Float32 | Array, second: Float32 | Array, start: Pose | None = None
) -> Pose | None:
    """``first_from_second`` of two clouds (N, 3) and (M, 3), m, by point-to-plane ICP (Chen and
    Medioni 1992); None where they do not fit each other. ``start``: a first guess."""
    from open3d.geometry import KDTreeSearchParamHybrid, PointCloud
    from open3d.pipelines import registration as icp
    from open3d.utility import Vector3dVector

    clouds = []
    for points in (first, second):
        good = np.isfinite(points).all(axis=1) & (np.abs(points) > 0.0).any(axis=1)
        cloud = PointCloud(Vector3dVector(points[good].astype(np.float64)))
        cloud = cloud.voxel_down_sample(_VOXEL_M)
        cloud.estimate_normals(KDTreeSearchParamHybrid(3.0 * _VOXEL_M, 30))
        clouds.append(cloud)
    if min(len(cloud.points) for cloud in clouds) < _MIN_POINTS:
        return None
    moved, fitness = (start or Pose.identity()).matrix(), 0.0
    for reach in _REACHES_M:
        found = icp.registration_icp(
            clouds[1], clouds[0], reach, moved, icp.TransformationEstimationPointToPlane(),
            icp.ICPConvergenceCriteria(max_iteration=_ITERATIONS),
        )  # fmt: skip
        moved, fitness = np.asarray(found.transformation), found.fitness
    if fitness < _MIN_FITNESS:
        return None
    return Pose(moved[:3, :3].copy(), moved[:3, 3].copy())
