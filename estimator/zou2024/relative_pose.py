"""Poses relative to the keyframes: how PnP and Algorithm 1 enter the filter.

The maps are made with the filter's own poses. Taken for exact, they would give every image and scan
an independent measurement of the pose, while landmarks and map points, and their errors, repeat.
Here the newest keyframes are clones of the filter, and a measurement is one of the present pose, of
the calibration, and of the keyframes that its landmarks and map points belong to. What repeats is
then the error of a keyframe, which the filter knows.
"""

from dataclasses import dataclass

import numpy as np

from touchdown.estimator.filtering.anchors import Anchors
from touchdown.estimator.filtering.error_state import (
    MOUNT_DIM,
    POSE,
    POSE_DIM,
    POSITION,
    Frame,
    Pinhole,
    error_between,
)
from touchdown.estimator.filtering.eskf import Eskf, IteratedUpdate, without_directions
from touchdown.estimator.filtering.online_calibration import (
    corrected_camera,
    corrected_lens,
    exposed,
    landmark_jacobians,
)
from touchdown.estimator.filtering.reprojection import (
    LandmarkViews,
    MountedCamera,
    PixelNoise,
    calibrated_information,
)
from touchdown.estimator.zou2024.registration import ScanPose, relative_equations
from touchdown.estimator.zou2024.visual_map import LandmarkSet, MapKeyframe, Sightings, by_host
from touchdown.sim.typing import Array, Indices

_GATES_PX = (12.0, 6.0, 6.0)
_UNSEEN_SIGMAS = np.repeat([0.01, 0.1], 3)
"""rad and m, of a keyframe whose own landmarks leave its pose open"""


@dataclass(frozen=True, slots=True)
class ImageModel:
    """What the equations of an image depend on besides the filter."""

    camera: MountedCamera
    lidar_in_camera: Array
    """(3,) m"""
    sigmas_px: Array
    """(2,) by kind"""
    depth_sigma_m: float

    def views(
        self, eskf: Eskf, host: MapKeyframe, landmarks: LandmarkSet, at: Indices,
        pixels: Array,
    ) -> LandmarkViews:  # fmt: skip
        """Landmarks ``at`` (N,) of a keyframe with a clone, seen at ``pixels`` (N, 2)."""
        mount = self.camera.imu_from_camera
        points = landmarks.points[at]
        arms = points - mount.translation
        spreads = arms * (self.depth_sigma_m / np.linalg.norm(arms, axis=1))[:, None]
        views = LandmarkViews.fixed(pixels, points, spreads)
        if not eskf.shared:
            return views
        inside = arms @ mount.rotation
        up = (host.odom_from_imu.rotation @ mount.rotation)[2]
        twist = host.twist.copy()
        twist[POSITION] = host.odom_from_imu.rotation.T @ twist[POSITION]
        jacobians = landmark_jacobians(
            inside / inside[:, 2:], up / (inside @ up)[:, None], self.lidar_in_camera,
            Frame.of(mount), twist, Pinhole.of(self.camera.intrinsics),
        )  # fmt: skip
        change = eskf.state.calibration[: eskf.shared].copy()
        change[:MOUNT_DIM] -= host.calibration[:MOUNT_DIM]
        return views._replace(landmarks=points + jacobians @ change, jacobians=jacobians)

    def own_covariance(self, eskf: Eskf, host: MapKeyframe) -> Array:
        """(6, 6) of the pose of a new keyframe as its own landmarks show it: the noise of their
        pixels and depths there is the same in all images that see them."""
        information = np.diag(_UNSEEN_SIGMAS**-2.0)
        pose = Frame.of(host.odom_from_imu)
        for kind, landmarks in enumerate(host.landmarks):
            at = np.arange(len(landmarks.points))
            views = self.views(eskf, host, landmarks, at, landmarks.pixels)
            fixed = views._replace(jacobians=np.zeros((len(at), 3, 0)), landmarks=landmarks.points)
            information += calibrated_information(
                fixed, pose, pose, np.zeros((2, POSE_DIM)),
                Frame.of(self.camera.imu_from_camera.inverse()),
                Pinhole.of(self.camera.intrinsics), PixelNoise(self.sigmas_px[kind], 1e3),
            ).information[POSE, POSE]  # fmt: skip
        inverse = np.linalg.inv(information)
        return 0.5 * (inverse + inverse.T)


def update_with_image(
    eskf: Eskf, model: ImageModel, hosts: list[MapKeyframe], sightings: Sightings, fraction: float
) -> None:
    """Iterated update by landmarks of ``hosts``, the keyframes of the filter's clones, in order.
    ``fraction``: of the correction that mounts and lens take."""
    place = {host.number: k for k, host in enumerate(hosts)}
    known = {host.number: host for host in hosts}
    groups = list(by_host(sightings, known))
    names = [int(sightings.hosts[mine[0]]) for mine, _ in groups]
    keys = sorted({place[name] for name in names})
    head = POSE_DIM + eskf.shared
    size = head + POSE_DIM * len(keys)
    update = IteratedUpdate(eskf, fraction)
    twists = [np.array([eskf.twist, known[name].twist]) for name in names]
    for gate in _GATES_PX:
        information, vector = np.zeros((size, size)), np.zeros(size)
        calibration = eskf.state.calibration
        poses = exposed(
            [eskf.state.pose, *(eskf.clones[k] for k in keys)],
            np.array([eskf.twist, *(hosts[k].twist for k in keys)]), np.zeros(1 + len(keys)),
            calibration,
        )  # fmt: skip
        camera = corrected_camera(model.camera.imu_from_camera, calibration).inverse()
        lens = corrected_lens(model.camera.intrinsics, calibration)
        for (mine, landmarks), name, twist in zip(groups, names, twists, strict=True):
            slot, kind = keys.index(place[name]), int(sightings.kinds[mine[0]])
            views = model.views(
                eskf, known[name], landmarks, sightings.indices[mine], sightings.pixels[mine]
            )
            part = calibrated_information(
                views, Frame.of(poses[0]), Frame.of(poses[1 + slot]), twist, Frame.of(camera),
                lens, PixelNoise(model.sigmas_px[kind], gate),
            )  # fmt: skip
            where = np.append(np.arange(head), np.arange(POSE_DIM) + head + POSE_DIM * slot)
            information[where[:, None], where] += part.information
            vector[where] += part.vector
        if update.step(keys, information, vector):
            break
    update.finish()


def update_with_scan(
    eskf: Eskf, result: ScanPose, lever: Array, anchors: Anchors, sigmas: Array, floor: Array,
    fraction: float,
) -> None:  # fmt: skip
    """Update by the residuals of Algorithm 1, linearised at its pose; degenerate directions are
    left out. ``sigmas`` (2,): of edges and of planes; ``floor`` (6,): standard deviations of errors
    that do not average out, of the scan and of each clone's part of the map."""
    found, pose = result.matches, result.pose
    keys = np.unique(found.owners[found.owners >= 0])
    frames = anchors.frames(eskf.clones, eskf.state.calibration, keys)
    update = IteratedUpdate(eskf, fraction)
    floors = np.concatenate([floor, np.zeros(eskf.shared), np.tile(floor, len(keys))])
    information, vector, _ = relative_equations(
        found, lever, Frame.of(pose), frames, len(keys), eskf.shared, sigmas, False
    )
    vector = vector + information[:, POSE] @ error_between(eskf.state.pose, pose)
    information, vector = without_directions(information, vector, result.weak)
    update.step(keys.tolist(), information, vector, floors)
    update.finish()
