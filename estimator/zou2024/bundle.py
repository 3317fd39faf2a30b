"""The camera pose from landmarks of known position (Eq. 11; Eq. 1 is `Pose.apply`), and bundle
adjustment over the newest keyframes (paper, section 3.3.2).

In the bundle a landmark is a depth along the ray of the keyframe that saw it first, with the
LIDAR's depth (Eq. 12) as prior: one number, so that the Schur complement over the landmarks needs
no matrix inversion. Poses of keyframes are odom_from_imu.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

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
from touchdown.estimator.filtering.keyframes import bearing_rays
from touchdown.estimator.filtering.reprojection import MountedCamera, reprojection_information
from touchdown.estimator.filtering.vectors import along, cross, dot, turned, turned_back, xyz
from touchdown.estimator.zou2024.visual_map import MapKeyframe, Sightings, by_host, joined, project
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array, Indices, Mask

_GATES_PX = (24.0, 12.0, 6.0, 4.0, 3.0, 3.0)


@dataclass(frozen=True, kw_only=True, slots=True)
class CameraPose:
    """``pose``: global_from_imu; ``inliers`` (N,)."""

    pose: Pose
    inliers: Mask
    rms_px: float


def reprojection_errors(
    pixels: Array,
    landmarks: Array,
    global_from_imu: Pose,
    imu_from_camera: Pose,
    camera: CameraIntrinsics,
) -> Array:
    """(N, 2) measured pixels minus predicted ones of the landmarks (N, 3); infinite behind the
    camera."""
    points = (global_from_imu @ imu_from_camera).inverse().apply(landmarks)
    predicted, front = project(points, camera.matrix())
    return np.where(front[:, None], pixels - predicted, np.inf)


def solve_pnp(
    pixels: Array,
    landmarks: Array,
    sigmas_px: Array,
    guess: Pose,
    guess_information: Array,
    imu_from_camera: Pose,
    camera: CameraIntrinsics,
    min_inliers: int = 15,
) -> CameraPose | None:
    """Solves Eq. 11 for the pose: robust Gauss-Newton on the reprojection errors from ``guess``.

    ``pixels`` (N, 2), ``landmarks`` (N, 3) global, ``sigmas_px`` (N,). The predicted pose is
    accurate enough that neither a closed form nor random sampling is needed: the gates of the
    Cauchy weights tighten step by step. ``guess_information`` (6, 6) keeps directions that the
    pixels leave unobserved (over a plane tilt and lateral motion look alike) at the guess. None
    with fewer than ``min_inliers`` landmarks within 3 pixels at the end.
    """
    mounted = MountedCamera(camera, imu_from_camera)
    # the landmarks are global: their frame takes the place of the keyframe's
    origin = Pose.identity()
    groups = [(s, np.flatnonzero(sigmas_px == s)) for s in np.unique(sigmas_px)]
    pose = guess
    for gate in _GATES_PX:
        information, vector, used = np.zeros((6, 6)), np.zeros(6), 0
        for sigma, members in groups:
            part = reprojection_information(
                pixels[members], landmarks[members], pose, origin, mounted,
                sigma_px=sigma, gate_px=gate,
            )  # fmt: skip
            information += part.information[:6, :6]
            vector += part.vector[:6]
            used += part.used
        if used < min_inliers:
            return None
        gradient = vector - guess_information @ error_between(guess, pose)
        step: Array = np.linalg.solve(information + guess_information, gradient).astype(np.float64)
        pose = moved_by(pose, step)
    errors = reprojection_errors(pixels, landmarks, pose, imu_from_camera, camera)
    length = np.hypot(errors[:, 0], errors[:, 1])
    inliers = length < _GATES_PX[-1]
    if int(inliers.sum()) < min_inliers:
        return None
    rms = float(np.sqrt(np.mean(length[inliers] ** 2)))
    return CameraPose(pose=pose, inliers=inliers, rms_px=rms)


_PRIOR_SIGMAS = np.array([1e-3, 1e-3, 5e-3, 0.3, 0.3, 0.02])
"""rad and m: tilt and height as LIDAR and gravity have them, the rest nearly free"""
_ITERATIONS = 4
_FIRST_FREE = 2
"""index in the window of the first keyframe whose pose is not fixed"""


class Observations(NamedTuple):
    """L landmarks, each seen first along a ray of its host, and M observations, by landmark."""

    hosts: Indices  # (L,) poses that saw each first
    rays: Array  # (L, 3) camera frame, z = 1
    prior_depths: Array  # (L,) m, by the LIDAR
    landmarks: Indices  # (M,)
    observers: Indices  # (M,) poses
    pixels: Array  # (M, 2)
    sigmas_px: Array  # (M,)


class BundleProblem(NamedTuple):
    """Poses and the depths of the landmarks that they have seen."""

    poses: list[Pose]
    fixed: int  # so many of the poses, the first, stay
    depths: Array  # (L,) m
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
    ends, j = np.empty(2, np.int64), np.zeros((2, 2 * POSE_DIM))
    place, j_depth, cost = xyz(camera_position), np.empty(2), 0.0
    for o in range(landmarks.shape[0]):
        m, k, h = landmarks[o], observers[o], hosts[landmarks[o]]
        direction = turned(camera_rotation, xyz(rays[m]))
        in_host = along(place, depths[m], direction)
        step = along(xyz(positions[h]), -1.0, xyz(positions[k]))
        world = along(turned(rotations[h], in_host), 1.0, step)
        in_observer = turned_back(rotations[k], world)
        c = turned_back(camera_rotation, along(in_observer, -1.0, place))
        if c[2] < 0.05:
            continue
        ru = pixels[o, 0] - (fx * c[0] / c[2] + cx)
        rv = pixels[o, 1] - (fy * c[1] / c[2] + cy)
        of_pixel = (
            (fx / c[2], 0.0, -fx * c[0] / (c[2] * c[2])),
            (0.0, fy / c[2], -fy * c[1] / (c[2] * c[2])),
        )
        error2 = (ru * ru + rv * rv) / sigmas[o] ** 2
        weight = 1.0 / ((1.0 + error2 / scale**2) * sigmas[o] ** 2)
        cost += scale**2 * np.log(1.0 + error2 / scale**2)
        for a in range(2):
            in_imu = turned(camera_rotation, of_pixel[a])
            in_world = turned(rotations[k], in_imu)
            through_host = turned_back(rotations[h], in_world)
            turn, host_turn = cross(in_imu, in_observer), cross(in_host, through_host)
            j_depth[a] = dot(through_host, direction)
            for b in range(3):
                j[a, ROTATION.start + b], j[a, POSITION.start + b] = turn[b], -in_world[b]
                j[a, POSE_DIM + ROTATION.start + b] = host_turn[b]
                j[a, POSE_DIM + POSITION.start + b] = in_world[b]
        ends[0], ends[1] = POSE_DIM * k, POSE_DIM * h
        for a in range(2 * POSE_DIM):
            row = ends[a // POSE_DIM] + a % POSE_DIM
            wu, wv = weight * j[0, a], weight * j[1, a]
            vector[row] += wu * ru + wv * rv
            coupling[m, row] += wu * j_depth[0] + wv * j_depth[1]
            for b in range(2 * POSE_DIM):
                column = ends[b // POSE_DIM] + b % POSE_DIM
                information[row, column] += wu * j[0, b] + wv * j[1, b]
        curvature[m] += weight * (j_depth[0] ** 2 + j_depth[1] ** 2)
        slope[m] += weight * (j_depth[0] * ru + j_depth[1] * rv)
    for m in range(count):  # a landmark couples the few poses that see it
        row = coupling[m]
        touched = np.flatnonzero(row)
        for at in touched:
            fraction = row[at] / curvature[m]
            vector[at] -= fraction * slope[m]
            for to in touched:
                information[at, to] -= fraction * row[to]
    return information, vector, coupling, curvature, slope, cost


def adjusted_depths(problem: BundleProblem, camera: MountedCamera, depth_sigma_m: float) -> Array:
    """Returns the depths (L,) of least reprojection error: Gauss-Newton with Cauchy weights. A free
    pose has a prior about its initial value, which keeps height and tilt at those from the
    LIDAR."""
    poses, depths = list(problem.poses), problem.depths.copy()
    free = slice(6 * problem.fixed, 6 * len(poses))
    prior = 1.0 / _PRIOR_SIGMAS**2
    seen, lens = problem.seen, Pinhole.of(camera.intrinsics)
    mount = Frame.of(camera.imu_from_camera)
    for _ in range(_ITERATIONS):
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
    return depths


def build_problem(
    window: list[MapKeyframe],
    newest: Pose,
    sightings: Sightings,
    known: dict[int, MapKeyframe],
    camera: MountedCamera,
    sigmas_px: Array,
) -> tuple[BundleProblem, Sightings] | None:
    """Returns the problem of ``window`` (oldest first) and the newest image, by its odom_from_imu
    and ``sightings``, and its landmarks, one sighting of each; None if nothing ties the poses.

    Hosts outside the window join it with fixed poses, as those of the first keyframes in it are.
    ``sigmas_px`` (2,) by kind.
    """
    views = [*(keyframe.sightings for keyframe in window), sightings]
    seen, view = joined(views), np.repeat(np.arange(len(views)), [len(one) for one in views])
    usable = np.isin(seen.hosts, list(known))
    seen, view = seen.select(usable), view[usable]
    if len(seen) < 20:
        return None
    order = np.lexsort((view, seen.indices, seen.kinds, seen.hosts))
    seen, view = seen.select(order), view[order]
    labels = np.column_stack([seen.hosts, seen.kinds, seen.indices])
    first = np.concatenate([[True], (labels[1:] != labels[:-1]).any(axis=1)])
    inside = [keyframe.number for keyframe in window]
    outside = np.setdiff1d(seen.hosts, inside).tolist()
    fixed = [known[number] for number in outside] + window[:_FIRST_FREE]
    free = window[_FIRST_FREE:]
    places = {keyframe.number: at for at, keyframe in enumerate(fixed + free)}
    landmarks = seen.select(first)
    points, pixels = np.empty((len(landmarks), 3)), np.empty((len(landmarks), 2))
    priors = np.empty(len(landmarks))
    for mine, source in by_host(landmarks, known):
        at = landmarks.indices[mine]
        points[mine], pixels[mine] = source.points[at], source.pixels[at]
        priors[mine] = source.depths[at]
    problem = BundleProblem(
        poses=[k.odom_from_imu for k in fixed + free] + [newest],
        fixed=len(fixed),
        depths=camera.imu_from_camera.inverse().apply(points)[:, 2],
        seen=Observations(
            hosts=np.array([places[host] for host in landmarks.hosts.tolist()]),
            rays=bearing_rays(pixels, camera.intrinsics),
            prior_depths=priors,
            landmarks=np.cumsum(first) - 1,
            observers=np.array([*(places[n] for n in inside), len(places)])[view],
            pixels=seen.pixels,
            sigmas_px=sigmas_px[seen.kinds],
        ),
    )
    return problem, landmarks


def adjust_window(
    window: list[MapKeyframe],
    newest: Pose,
    sightings: Sightings,
    known: dict[int, MapKeyframe],
    camera: MountedCamera,
    sigmas_px: Array,
    depth_sigma_m: float,
) -> None:
    """Bundle adjustment: refines the landmarks of the window in place. Their keyframes move with
    them in the solution, but not in the map: these poses are the filter's, which has had the same
    pixels. Parameters as in ``build_problem``."""
    built = build_problem(window, newest, sightings, known, camera, sigmas_px)
    if built is None or len(window) <= _FIRST_FREE:
        return
    problem, landmarks = built
    depths = adjusted_depths(problem, camera, depth_sigma_m)
    points = camera.imu_from_camera.apply(problem.seen.rays * depths[:, None])
    for mine, source in by_host(landmarks, known):
        source.points[landmarks.indices[mine]] = points[mine]
