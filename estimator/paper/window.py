"""From keyframes to a bundle problem and back."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.filtering.keyframes import bearing_rays
from touchdown.estimator.paper.bundle import BundleProblem, adjust
from touchdown.estimator.paper.visual_map import MapKeyframe, Sightings
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.frames import Pose

Array = NDArray[np.float64]

_PRIOR_SIGMAS = np.array([1e-3, 1e-3, 5e-3, 0.3, 0.3, 0.02])
"""rad and m: tilt and height as LIDAR and gravity have them, the rest nearly free"""


def build_problem(
    window: list[MapKeyframe],
    newest: Pose,
    sightings: Sightings,
    known: dict[int, MapKeyframe],
    camera: CameraIntrinsics,
    imu_from_camera: Pose,
    sigmas_px: Array,
    first_free: int,
) -> tuple[BundleProblem, list[tuple[int, int, int]]] | None:
    """The problem of ``window`` (oldest first) and of an image at ``newest`` (odom_from_imu) with
    its ``sightings``. Hosts outside the window join it fixed. ``sigmas_px`` by kind. Keyframes
    with an index below ``first_free`` in the window are fixed. Returns also the landmarks' keys
    (host, kind, index), or None if nothing ties the poses."""
    inside = {keyframe.number for keyframe in window}
    views = [(k.number, k.sightings) for k in window] + [(-1, sightings)]
    rows = [
        (int(h), int(kind), int(i), observer, n)
        for observer, (_, seen) in enumerate(views)
        for n, (h, kind, i) in enumerate(zip(seen.hosts, seen.kinds, seen.indices, strict=True))
        if int(h) in known
    ]
    if len(rows) < 20:
        return None
    outside = sorted({row[0] for row in rows} - inside)
    fixed = [known[number] for number in outside] + window[:first_free]
    free = window[first_free:]
    numbers = [k.number for k in fixed + free] + [-1]
    place = {number: at for at, number in enumerate(numbers)}
    rows.sort()
    keys: list[tuple[int, int, int]] = []
    landmarks, observers, pixels, sigmas = [], [], [], []
    for host, kind, index, observer, n in rows:
        if not keys or keys[-1] != (host, kind, index):
            keys.append((host, kind, index))
        number, seen = views[observer]
        landmarks.append(len(keys) - 1)
        observers.append(place[number])
        pixels.append(seen.pixels[n])
        sigmas.append(sigmas_px[kind])
    camera_from_imu = imu_from_camera.inverse()
    sets = [known[host].landmarks[kind] for host, kind, _ in keys]
    points = np.array([s.points[key[2]] for s, key in zip(sets, keys, strict=True)])
    depths = camera_from_imu.apply(points)[:, 2]
    first_pixels = np.array([s.pixels[key[2]] for s, key in zip(sets, keys, strict=True)])
    priors = np.array([s.depths[key[2]] for s, key in zip(sets, keys, strict=True)])
    problem = BundleProblem(
        poses=[k.odom_from_imu for k in fixed + free] + [newest],
        fixed=len(fixed),
        hosts=np.array([place[host] for host, _, _ in keys]),
        rays=bearing_rays(first_pixels, camera),
        depths=depths,
        prior_depths=priors,
        landmarks=np.array(landmarks),
        observers=np.array(observers),
        pixels=np.array(pixels),
        sigmas_px=np.array(sigmas),
    )
    return problem, keys


def adjust_window(
    window: list[MapKeyframe],
    newest: Pose,
    sightings: Sightings,
    known: dict[int, MapKeyframe],
    camera: CameraIntrinsics,
    imu_from_camera: Pose,
    sigmas_px: Array,
    depth_sigma_m: float,
    first_free: int = 2,
) -> Pose:
    """Bundle adjustment: refines poses and landmarks of the window in place and returns the pose
    of the newest image."""
    built = build_problem(
        window, newest, sightings, known, camera, imu_from_camera, sigmas_px, first_free
    )
    if built is None or len(window) <= first_free:
        return newest
    problem, keys = built
    poses, depths = adjust(
        problem,
        imu_from_camera,
        camera,
        depth_sigma_m=depth_sigma_m,
        prior_sigmas=_PRIOR_SIGMAS,
    )
    for keyframe, pose in zip(window[first_free:], poses[problem.fixed : -1], strict=True):
        moved = keyframe.odom_from_imu.inverse() @ pose
        keyframe.map_from_imu = keyframe.map_from_imu @ moved
        keyframe.odom_from_imu = pose
    for (host, kind, index), ray, depth in zip(keys, problem.rays, depths, strict=True):
        known[host].landmarks[kind].points[index] = imu_from_camera.apply(ray * depth)
    return poses[-1]
