"""Geometric verification of a loop hypothesis: PnP by RANSAC, then on all landmarks in view."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from touchdown.estimator.filtering.error_state import POSE, POSE_DIM, Frame, Pinhole
from touchdown.estimator.filtering.reprojection import (
    LandmarkViews,
    PixelNoise,
    calibrated_information,
)
from touchdown.estimator.typing import Array
from touchdown.estimator.zou2024.closures import level_transform
from touchdown.estimator.zou2024.landmarks import SIFT, Features
from touchdown.estimator.zou2024.pnp import solve_pnp
from touchdown.estimator.zou2024.relative_pose import ImageModel
from touchdown.estimator.zou2024.visual_map import MapKeyframe, Sightings, VisualMap, by_host
from touchdown.sim.frames import Pose

_ITERATIONS = 300
"""``Vis/Iterations`` of RTAB-Map"""
_CLEAR_RATIO = 0.8
"""ratio of the distances to the nearest descriptor and to the next; ``Vis/CorNNDR`` of RTAB-Map"""
_RANSAC_PX = 3.0
_GATE_PX = 6.0
_RADIUS_PX = 40.0
"""``Vis/CorGuessWinSize`` of RTAB-Map"""
_GUESS_SIGMAS = np.array([0.003, 0.003, 0.05, 2.0, 2.0, 0.2])
_MIN_SCALE = 0.7
"""a large change of scale magnifies the depth errors of landmarks"""


class Revisit(NamedTuple):
    """The present keyframe as the landmarks of an old one show it."""

    pose: Pose  # map_from_imu
    information: Array  # (6, 6) of rotation (right perturbation) and position in the map


@dataclass(frozen=True, slots=True)
class LoopVerifier:
    """Localises a keyframe by the landmarks of old ones."""

    visual_map: VisualMap
    model: ImageModel
    minimum: int
    """landmarks that agree"""

    def __call__(
        self, features: tuple[Features, Features], hosts: list[MapKeyframe], keyframe: MapKeyframe
    ) -> Revisit | None:
        """None where the landmarks of ``hosts`` do not agree on a pose of ``keyframe``, whose image
        has ``features``."""
        hosts = [
            host for host in hosts
            if _MIN_SCALE < host.depth_m / keyframe.depth_m < 1.0 / _MIN_SCALE
        ]  # fmt: skip
        rough = self.by_descriptors(features, hosts)
        if rough is None:
            return None
        # gravity is known better than the tilt by a few landmarks
        guess = level_transform(keyframe.map_from_imu, rough) @ keyframe.map_from_imu
        frames = {host.number: host.map_from_imu for host in hosts}
        known = {host.number: host for host in hosts}
        sightings, _ = self.visual_map.match(features, hosts, frames, guess, _RADIUS_PX)
        if len(sightings) < self.minimum:
            return None
        solved = solve_pnp(
            sightings.pixels, self.visual_map.positions(sightings, frames, known),
            self.model.sigmas_px[sightings.kinds], guess, np.diag(_GUESS_SIGMAS**-2.0),
            self.model.camera.imu_from_camera, self.model.camera.intrinsics, self.minimum,
        )  # fmt: skip
        if solved is None:
            return None
        inliers = sightings.select(solved.inliers)
        return Revisit(solved.pose, self._information(solved.pose, inliers, known))

    def by_descriptors(
        self, features: tuple[Features, Features], hosts: list[MapKeyframe]
    ) -> Pose | None:
        """map_from_imu of an image by P3P in RANSAC over matches that nothing but their descriptors
        predicts; the same for the same input, as OpenCV's generator has a fixed seed."""
        points, pixels = [np.zeros((0, 3))], [np.zeros((0, 2))]
        for kind, found in enumerate(features):
            sets = [host.landmarks[kind] for host in hosts]
            if len(found) == 0 or sum(len(one.points) for one in sets) == 0:
                continue
            norm = cv2.NORM_L2 if kind == SIFT else cv2.NORM_HAMMING
            known = np.concatenate([one.descriptors for one in sets])
            found_twice = cv2.BFMatcher(norm).knnMatch(found.descriptors, known, k=2)
            pairs = [
                two[0] for two in found_twice
                if len(two) == 2 and two[0].distance < _CLEAR_RATIO * two[1].distance
            ]  # fmt: skip
            placed = [h.map_from_imu.apply(h.landmarks[kind].points) for h in hosts]
            points.append(np.concatenate(placed)[[pair.trainIdx for pair in pairs]])
            pixels.append(found.pixels[[pair.queryIdx for pair in pairs]])
        landmarks, seen = np.concatenate(points), np.concatenate(pixels)
        if len(seen) < self.minimum:
            return None
        # near the origin, where single precision is enough
        middle, matrix = landmarks.mean(axis=0), self.model.camera.intrinsics.matrix()
        done, _, _, chosen = cv2.solvePnPRansac(
            landmarks - middle, seen, matrix, None, iterationsCount=_ITERATIONS,
            reprojectionError=_RANSAC_PX, confidence=0.999, flags=cv2.SOLVEPNP_AP3P,
        )  # fmt: skip
        if not done or chosen is None or len(chosen) < self.minimum:
            return None
        inside = chosen[:, 0]
        done, turn, shift = cv2.solvePnP(
            landmarks[inside] - middle, seen[inside], matrix, None, flags=cv2.SOLVEPNP_SQPNP
        )
        if not done:
            return None
        rotation = np.asarray(cv2.Rodrigues(turn)[0], np.float64).T
        map_from_camera = Pose(rotation, middle - rotation @ shift[:, 0])
        return map_from_camera @ self.model.camera.imu_from_camera.inverse()

    def _information(self, pose: Pose, inliers: Sightings, known: dict[int, MapKeyframe]) -> Array:
        """(6, 6) of ``pose`` from its inliers: their pixels in both images, the depths of the
        landmarks, and the scatter of the residuals where that is larger."""
        mount, lens = self.model.camera.imu_from_camera, self.model.camera.intrinsics
        information, excess = np.zeros((POSE_DIM, POSE_DIM)), 0.0
        for mine, landmarks in by_host(inliers, known):
            points = landmarks.points[inliers.indices[mine]]
            arms = points - mount.translation
            spreads = arms * (self.model.depth_sigma_m / np.linalg.norm(arms, axis=1))[:, None]
            views = LandmarkViews.fixed(inliers.pixels[mine], points, spreads)
            sigma = float(np.sqrt(2.0) * self.model.sigmas_px[inliers.kinds[mine[0]]])
            part = calibrated_information(
                views, Frame.of(pose), Frame.of(known[int(inliers.hosts[mine[0]])].map_from_imu),
                np.zeros((2, POSE_DIM)), Frame.of(mount.inverse()), Pinhole.of(lens),
                PixelNoise(sigma, _GATE_PX),
            )  # fmt: skip
            information += part.information[POSE, POSE]
            excess += part.used * part.rms**2 / (2.0 * sigma**2)
        scaled: Array = information / max(1.0, excess / len(inliers))
        return scaled
