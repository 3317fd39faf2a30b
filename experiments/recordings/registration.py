"""Registration of two scans, for what an estimator cannot know at the start of a recording."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

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


_TWIST_REACHES_M = (4.0, 2.0, 1.0, 0.5, 0.3, 0.2)
_TWIST_ITERATIONS = 5
_ROBUST = 0.3
"""fraction of the reach at which a residual weighs half"""


def moved_by_twist(points: Array, times_s: Array, twist: Array) -> Array:
    """(N, 3) points of a sweep in the frame of its sensor at time 0, of points measured at
    ``times_s`` (N,) by a sensor with the constant ``twist`` (6,), rad/s and m/s."""
    turned = Rotation.from_rotvec(times_s[:, None] * twist[:3]).apply(points)
    return np.asarray(turned + times_s[:, None] * twist[3:])


def twist_onto(points: Array, times_s: Array, target: Array) -> Array:
    """The constant twist (6,), rad/s and m/s, that brings the points (N, 3) of a sweep, measured at
    ``times_s`` (N,), onto the cloud ``target`` (M, 3): point-to-plane ICP over the sweep (Zhang and
    Singh 2014 deskew by the same motion model; Dellenbach et al. 2022, "CT-ICP")."""
    from open3d.geometry import KDTreeSearchParamKNN, PointCloud
    from open3d.utility import Vector3dVector

    cloud = PointCloud(Vector3dVector(np.asarray(target, np.float64)))
    cloud.estimate_normals(KDTreeSearchParamKNN(12))
    normals, tree, twist = np.asarray(cloud.normals), cKDTree(target), np.zeros(6)
    for reach in np.repeat(_TWIST_REACHES_M, _TWIST_ITERATIONS):
        placed = moved_by_twist(points, times_s, twist)
        distances, nearest = tree.query(placed, distance_upper_bound=reach)
        found = np.isfinite(distances)
        near, normal, at = nearest[found], normals[nearest[found]], times_s[found, None]
        residuals = np.einsum("ij,ij->i", placed[found] - target[near], normal)
        arms = placed[found] - at * twist[3:]
        rows = at * np.hstack([np.cross(arms, normal), normal])
        weighted = rows / (1.0 + (residuals / (_ROBUST * reach)) ** 2)[:, None]
        twist = twist - np.linalg.solve(
            weighted.T @ rows + 1e-9 * np.eye(6), weighted.T @ residuals
        )
    return twist
