"""Bundle adjustment of a window of keyframes: sets up the problem and writes back the result."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.filtering.keyframes import bearing_rays
from touchdown.estimator.filtering.reprojection import MountedCamera
from touchdown.estimator.paper.bundle import BundleProblem, Observations, adjust
from touchdown.estimator.paper.visual_map import MapKeyframe, Sightings
from touchdown.sim.frames import Pose

Array = NDArray[np.float64]

_PRIOR_SIGMAS = np.array([1e-3, 1e-3, 5e-3, 0.3, 0.3, 0.02])
"""rad and m: tilt and height as LIDAR and gravity have them, the rest nearly free"""


class LandmarkKey(NamedTuple):
    """Identifies a landmark of the visual map."""

    host: int
    kind: int
    landmark: int


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
) -> tuple[BundleProblem, list[LandmarkKey]] | None:
    """Returns the problem of ``window`` (oldest first) and the newest image, and the keys of its
    landmarks; None if nothing ties the poses.

    Hosts outside the window join it with fixed poses. ``sigmas_px`` (2,) by kind. Keyframes with an
    index below ``first_free`` in the window are fixed.
    """
    inside = {keyframe.number for keyframe in window}
    views = [(k.number, k.sightings) for k in window] + [(-1, newest.sightings)]
    rows = [
        (LandmarkKey(int(h), int(kind), int(i)), observer, n)
        for observer, (_, seen) in enumerate(views)
        for n, (h, kind, i) in enumerate(zip(seen.hosts, seen.kinds, seen.indices, strict=True))
        if int(h) in known
    ]
    if len(rows) < 20:
        return None
    outside = sorted({key.host for key, _, _ in rows} - inside)
    fixed = [known[number] for number in outside] + window[:first_free]
    free = window[first_free:]
    numbers = [k.number for k in fixed + free] + [-1]
    place = {number: at for at, number in enumerate(numbers)}
    rows.sort()
    keys: list[LandmarkKey] = []
    landmarks, observers, pixels, sigmas = [], [], [], []
    for key, observer, n in rows:
        if not keys or keys[-1] != key:
            keys.append(key)
        number, seen = views[observer]
        landmarks.append(len(keys) - 1)
        observers.append(place[number])
        pixels.append(seen.pixels[n])
        sigmas.append(sigmas_px[key.kind])
    camera_from_imu = camera.imu_from_camera.inverse()
    sets = [known[host].landmarks[kind] for host, kind, _ in keys]
    points = np.array([s.points[key.landmark] for s, key in zip(sets, keys, strict=True)])
    depths = camera_from_imu.apply(points)[:, 2]
    first_pixels = np.array([s.pixels[key.landmark] for s, key in zip(sets, keys, strict=True)])
    priors = np.array([s.depths[key.landmark] for s, key in zip(sets, keys, strict=True)])
    problem = BundleProblem(
        poses=[k.odom_from_imu for k in fixed + free] + [newest.pose],
        fixed=len(fixed),
        depths=depths,
        seen=Observations(
            hosts=np.array([place[host] for host, _, _ in keys]),
            rays=bearing_rays(first_pixels, camera.intrinsics),
            prior_depths=priors,
            landmarks=np.array(landmarks),
            observers=np.array(observers),
            pixels=np.array(pixels),
            sigmas_px=np.array(sigmas),
        ),
    )
    return problem, keys


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
    problem, keys = built
    poses, depths = adjust(
        problem, camera.imu_from_camera, camera.intrinsics, depth_sigma_m=depth_sigma_m,
        prior_sigmas=_PRIOR_SIGMAS,
    )  # fmt: skip
    for keyframe, pose in zip(window[first_free:], poses[problem.fixed : -1], strict=True):
        moved = keyframe.odom_from_imu.inverse() @ pose
        keyframe.map_from_imu = keyframe.map_from_imu @ moved
        keyframe.odom_from_imu = pose
    for (host, kind, index), ray, depth in zip(keys, problem.seen.rays, depths, strict=True):
        known[host].landmarks[kind].points[index] = camera.imu_from_camera.apply(ray * depth)
    return poses[-1]
