"""Registration of scans, for what an estimator cannot know at the start of a recording, and for a
truth where there is no better one."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from scipy.spatial.transform import Rotation

from touchdown.experiments.recordings.contract import PoseTable, RawScan
from touchdown.sim.frames import Pose, quat_wxyz_from_matrix
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


_KEY_M = 10.0
"""way after which a scan is registered with another one"""


def registered_path(scans: Iterable[RawScan], body_from_lidar: Pose) -> PoseTable:
    """Poses of the body, in the frame of the first, at the stamps of scans that are moved to one
    instant: each scan is registered with the first of all, and every ten metres with the one before
    in its place. Raises ValueError for a scan that does not fit, and for a sweep in motion."""
    stamps: list[int] = []
    poses: list[Pose] = []
    step = key = Pose.identity()
    onto = last = np.zeros((0, 3), np.float32)
    for scan in scans:
        if scan.offsets_s.any():
            raise ValueError("its sweeps are not moved to one instant, which registration needs")
        if poses:
            if np.linalg.norm(poses[-1].translation - key.translation) > _KEY_M:
                onto, key = last, poses[-1]
            found = registered(onto, scan.points, key.inverse() @ poses[-1] @ step)
            if found is None:
                raise ValueError(f"the scan at {scan.stamp_ns * 1e-9:.3f} s fits no other")
            step = poses[-1].inverse() @ key @ found
        poses.append(poses[-1] @ step if poses else key)
        stamps.append(scan.stamp_ns)
        last = scan.points
        onto = onto if len(onto) else last
    bodies = [body_from_lidar @ pose @ body_from_lidar.inverse() for pose in poses]
    if len(bodies) < 2:
        raise ValueError("fewer than two scans cannot be registered")
    return PoseTable(
        stamps_ns=np.array(stamps, np.int64),
        positions=np.array([pose.translation for pose in bodies]),
        quats_wxyz=np.array([quat_wxyz_from_matrix(pose.rotation) for pose in bodies]),
    )


def moved_by_twist(points: Array, times_s: Array, twist: Array) -> Array:
    """(N, 3) points of a sweep in the frame of its sensor at time 0, of points measured at
    ``times_s`` (N,) by a sensor with the constant ``twist`` (6,), rad/s and m/s."""
    turned = Rotation.from_rotvec(times_s[:, None] * twist[:3]).apply(points)
    return np.asarray(turned + times_s[:, None] * twist[3:])
