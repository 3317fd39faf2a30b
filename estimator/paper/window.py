"""Bundle adjustment of a window of keyframes: sets up the problem and writes back the result."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.filtering.keyframes import bearing_rays
from touchdown.estimator.filtering.reprojection import MountedCamera
from touchdown.estimator.paper.bundle import BundleProblem, Observations, adjust
from touchdown.estimator.paper.visual_map import MapKeyframe, Sightings, by_host, joined
from touchdown.sim.frames import Pose

Array = NDArray[np.float64]

_PRIOR_SIGMAS = np.array([1e-3, 1e-3, 5e-3, 0.3, 0.3, 0.02])
"""rad and m: tilt and height as LIDAR and gravity have them, the rest nearly free"""


@dataclass(frozen=True, slots=True)
class LocalisedImage:
    """The newest image: its odom_from_imu and the landmarks seen in it."""

    pose: Pose
    sightings: Sightings


def build_problem(
    window: list[MapKeyframe],
    newest: LocalisedImage,
    known: dict[int, MapKeyframe],
    camera: MountedCamera,
    sigmas_px: Array,
    first_free: int,
) -> tuple[BundleProblem, Sightings] | None:
    """Returns the problem of ``window`` (oldest first) and the newest image, and its landmarks, one
    sighting of each; None if nothing ties the poses.

    Hosts outside the window join it with fixed poses. ``sigmas_px`` (2,) by kind. Keyframes with an
    index below ``first_free`` in the window are fixed.
    """
    views = [*(keyframe.sightings for keyframe in window), newest.sightings]
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
    fixed = [known[number] for number in outside] + window[:first_free]
    free = window[first_free:]
    places = {keyframe.number: at for at, keyframe in enumerate(fixed + free)}
    landmarks = seen.select(first)
    points, pixels = np.empty((len(landmarks), 3)), np.empty((len(landmarks), 2))
    priors = np.empty(len(landmarks))
    for mine, source in by_host(landmarks, known):
        at = landmarks.indices[mine]
        points[mine], pixels[mine] = source.points[at], source.pixels[at]
        priors[mine] = source.depths[at]
    problem = BundleProblem(
        poses=[k.odom_from_imu for k in fixed + free] + [newest.pose],
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
    newest: LocalisedImage,
    known: dict[int, MapKeyframe],
    camera: MountedCamera,
    sigmas_px: Array,
    depth_sigma_m: float,
    first_free: int = 2,
) -> Pose:
    """Bundle adjustment: refines poses and landmarks of the window in place and returns the pose
    of the newest image. Parameters as in ``build_problem``."""
    built = build_problem(window, newest, known, camera, sigmas_px, first_free)
    if built is None or len(window) <= first_free:
        return newest.pose
    problem, landmarks = built
    poses, depths = adjust(
        problem, camera.imu_from_camera, camera.intrinsics, depth_sigma_m=depth_sigma_m,
        prior_sigmas=_PRIOR_SIGMAS,
    )  # fmt: skip
    for keyframe, pose in zip(window[first_free:], poses[problem.fixed : -1], strict=True):
        moved = keyframe.odom_from_imu.inverse() @ pose
        keyframe.map_from_imu = keyframe.map_from_imu @ moved
        keyframe.odom_from_imu = pose
    points = camera.imu_from_camera.apply(problem.seen.rays * depths[:, None])
    for mine, source in by_host(landmarks, known):
        source.points[landmarks.indices[mine]] = points[mine]
    return poses[-1]
