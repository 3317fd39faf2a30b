"""Bundle adjustment over the newest keyframes (paper, section 3.3.2).

A landmark is a depth along the ray of the keyframe that saw it first, with the LIDAR's depth (Eq.
12) as prior: one number, so that the Schur complement over the landmarks needs no matrix inversion.
Poses of keyframes are odom_from_imu.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from touchdown.estimator.filtering.error_state import (
    POSE_DIM,
    POSITION,
    ROTATION,
    Frame,
    Frames,
    Pinhole,
    error_between,
    moved_by,
)
from touchdown.estimator.filtering.imu_propagation import cross_into
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.frames import Pose

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


class Observations(NamedTuple):
    """L landmarks, each seen first along a ray of its host, and M observations, by landmark."""

    hosts: Indices  # (L,) poses that saw each first
    rays: Array  # (L, 3) camera frame, z = 1
    prior_depths: Array  # (L,) m, by the LIDAR
    landmarks: Indices  # (M,)
    observers: Indices  # (M,) poses
    pixels: Array  # (M, 2)
    sigmas_px: Array  # (M,)


@dataclass(slots=True)
class BundleProblem:
    """``poses`` K, of which the first ``fixed`` stay, and the ``depths`` (L,) of the landmarks that
    they have ``seen``."""

    poses: list[Pose]
    fixed: int
    depths: Array
    seen: Observations


@njit(cache=True)
def _reduced_system(
    poses: Frames,
    depths: Array,
    seen: Observations,
    depth_sigma: float,
    imu_from_camera: Frame,
    lens: Pinhole,
    scale: float,
) -> tuple[Array, Array, Array, Array, Array, float]:
    """Normal equations of the poses after elimination of the depths.

    Returns information (6K, 6K), vector (6K,), and for the substitution back: depth couplings
    (L, 6K), curvatures (L,) and slopes (L,); the robust cost.
    """
    rotations, positions = poses
    hosts, rays, prior_depths, landmarks, observers, pixels, sigmas = seen
    camera_rotation, camera_position = imu_from_camera
    fx, fy, cx, cy = lens
    size = 6 * rotations.shape[0]
    count = depths.shape[0]
    information, vector = np.zeros((size, size)), np.zeros(size)
    coupling = np.zeros((count, size))
    curvature, slope = np.empty(count), np.empty(count)
    for m in range(count):
        curvature[m] = 1.0 / depth_sigma**2
        slope[m] = (prior_depths[m] - depths[m]) / depth_sigma**2
    back = np.ascontiguousarray(camera_rotation.T)
    projection = np.zeros((2, 3))
    j_observer, j_host = np.zeros((2, 6)), np.zeros((2, 6))
    cost = 0.0
    for o in range(landmarks.shape[0]):
        m, k, h = landmarks[o], observers[o], hosts[landmarks[o]]
        direction = camera_rotation @ rays[m]
        in_host = direction * depths[m] + camera_position
        world = rotations[h] @ in_host + positions[h]
        to_observer = np.ascontiguousarray(rotations[k].T)
        in_observer = to_observer @ (world - positions[k])
        c = back @ (in_observer - camera_position)
        if c[2] < 0.05:
            continue
        ru = pixels[o, 0] - (fx * c[0] / c[2] + cx)
        rv = pixels[o, 1] - (fy * c[1] / c[2] + cy)
        projection[0, 0], projection[0, 2] = fx / c[2], -fx * c[0] / (c[2] * c[2])
        projection[1, 1], projection[1, 2] = fy / c[2], -fy * c[1] / (c[2] * c[2])
        error2 = (ru * ru + rv * rv) / sigmas[o] ** 2
        weight = 1.0 / ((1.0 + error2 / scale**2) * sigmas[o] ** 2)
        cost += scale**2 * np.log(1.0 + error2 / scale**2)
        in_imu = projection @ back
        in_world = in_imu @ to_observer
        through_host = in_world @ rotations[h]
        for a in range(2):
            cross_into(in_imu[a], in_observer, j_observer[a], ROTATION.start)
            cross_into(in_host, through_host[a], j_host[a], ROTATION.start)
        j_observer[:, POSITION], j_host[:, POSITION] = -in_world, in_world
        j_depth = through_host @ direction
        at, to = POSE_DIM * k, POSE_DIM * h
        for a in range(POSE_DIM):
            ra = j_observer[0, a] * ru + j_observer[1, a] * rv
            rh = j_host[0, a] * ru + j_host[1, a] * rv
            vector[at + a] += weight * ra
            vector[to + a] += weight * rh
            da = j_observer[0, a] * j_depth[0] + j_observer[1, a] * j_depth[1]
            dh = j_host[0, a] * j_depth[0] + j_host[1, a] * j_depth[1]
            coupling[m, at + a] += weight * da
            coupling[m, to + a] += weight * dh
            for b in range(POSE_DIM):
                kk = j_observer[0, a] * j_observer[0, b] + j_observer[1, a] * j_observer[1, b]
                hh = j_host[0, a] * j_host[0, b] + j_host[1, a] * j_host[1, b]
                kh = j_observer[0, a] * j_host[0, b] + j_observer[1, a] * j_host[1, b]
                information[at + a, at + b] += weight * kk
                information[to + a, to + b] += weight * hh
                information[at + a, to + b] += weight * kh
                information[to + b, at + a] += weight * kh
        curvature[m] += weight * (j_depth[0] ** 2 + j_depth[1] ** 2)
        slope[m] += weight * (j_depth[0] * ru + j_depth[1] * rv)
    for m in range(count):
        row = coupling[m]
        for a in range(size):
            if row[a] == 0.0:
                continue
            vector[a] -= row[a] * slope[m] / curvature[m]
            for b in range(size):
                information[a, b] -= row[a] * row[b] / curvature[m]
    return information, vector, coupling, curvature, slope, cost


def adjust(
    problem: BundleProblem,
    imu_from_camera: Pose,
    camera: CameraIntrinsics,
    *,
    depth_sigma_m: float,
    prior_sigmas: Array,
    iterations: int = 4,
) -> tuple[list[Pose], Array]:
    """Returns the poses and depths (L,) of least reprojection error: Gauss-Newton with Cauchy
    weights.

    ``prior_sigmas`` (6,): rad and m, prior of a free pose about its initial value; it keeps height
    and tilt at those from the LIDAR.
    """
    poses, depths = list(problem.poses), problem.depths.copy()
    free = slice(6 * problem.fixed, 6 * len(poses))
    prior = 1.0 / prior_sigmas**2
    seen, mount, lens = problem.seen, Frame.of(imu_from_camera), Pinhole.of(camera)
    for _ in range(iterations):
        information, vector, coupling, curvature, slope, _ = _reduced_system(
            Frames.of(poses), depths, seen, depth_sigma_m, mount, lens, 3.0
        )
        offsets = [error_between(*ends) for ends in zip(problem.poses, poses, strict=True)]
        stray = np.concatenate(offsets)[free]
        weights = np.tile(prior, len(poses) - problem.fixed)
        delta = np.zeros(len(vector))
        delta[free] = np.linalg.solve(
            information[free, free] + np.diag(weights), vector[free] - weights * stray
        )
        poses = [moved_by(*move) for move in zip(poses, delta.reshape(-1, 6), strict=True)]
        depths = depths + (slope - coupling @ delta) / curvature
        depths = np.clip(depths, 0.5 * seen.prior_depths, 2.0 * seen.prior_depths)
        if float(np.abs(delta).max()) < 1e-5:
            break
    return poses, depths
