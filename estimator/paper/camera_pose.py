"""The camera's part: landmarks at keyframes, PnP, and the map that grows by it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from estimator.api import PaperParams
from estimator.keyframes import bearing_rays
from estimator.landmark_depth import RecentReturns
from estimator.lidar_update import floored
from estimator.paper.depth_field import DepthField
from estimator.paper.inertial import InertialFilter
from estimator.paper.landmarks import Features, LandmarkDetector
from estimator.paper.pnp import CameraPose, solve_pnp
from estimator.paper.visual_map import LandmarkSet, MapKeyframe, Sightings, VisualMap
from sim.api import CameraImage, SensorRig
from sim.frames import Pose

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]
Indices = NDArray[np.int64]

_FLOOR_SIGMAS = np.array([np.radians(0.03), np.radians(0.03), np.radians(0.02), 0.01, 0.01, 0.02])
"""rad and m: errors of the landmarks that all of an image's landmarks share"""
_LEAST_LANDMARKS = 30


class CameraPositioning:
    """Visual map and the correction of the filter by the images of keyframes."""

    def __init__(
        self,
        rig: SensorRig,
        params: PaperParams,
        inertial: InertialFilter,
        recent: RecentReturns,
    ) -> None:
        self._rig = rig
        self._params = params
        self._filter = inertial
        self._recent = recent
        self._imu_from_camera = inertial.imu_from_camera
        self._detector = LandmarkDetector(params.sift_features, params.brisk_features)
        self._map = VisualMap(rig.camera, inertial.imu_from_camera)
        self._last_tick = -(10**9)
        self._last_position = inertial.eskf.state.position
        self._next_number = 0
        self.diagnostics: dict[str, float] = {}

    def due(self, tick: int) -> bool:
        """Whether an image of ``tick`` is far enough from the last one taken."""
        params = self._params
        moved = np.linalg.norm(self._filter.eskf.state.position - self._last_position)
        age_s = (tick - self._last_tick) / self._rig.tick_hz
        return age_s >= params.keyframe_period_s or bool(moved >= params.keyframe_distance_m)

    def take(self, image: CameraImage, energy: Float32) -> bool:
        """Localises an image taken at the filter's time and remembers it. Returns whether the
        filter was corrected."""
        self._last_tick = image.tick
        grey = np.asarray(cv2.cvtColor(image.rgb, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
        features = self._detector(grey)
        sightings, behind, solved = self._localise(features)
        corrected = False
        if solved is not None and self._params.use_camera_pose:
            information, vector = floored(solved.information, np.zeros(6), _FLOOR_SIGMAS)
            self._filter.correct(solved.pose, information, vector)
            corrected = True
        self._remember(image.tick, features, behind, sightings, energy)
        self._last_position = self._filter.eskf.state.position
        return corrected

    def _sigmas(self, kinds: Indices) -> Array:
        return np.array([self._params.sift_sigma_px, self._params.brisk_sigma_px])[kinds]

    def _localise(
        self, features: tuple[Features, Features]
    ) -> tuple[Sightings, tuple[Indices, Indices], CameraPose | None]:
        hosts = self._map.keyframes[-self._params.recent_keyframes :]
        frames = {host.number: host.odom_from_imu for host in hosts}
        pose = self._filter.eskf.state.pose
        sightings, behind = self._map.match(features, hosts, frames, pose, self._radius(hosts))
        landmarks = self._map.positions(sightings, frames, self._map.by_number())
        solved = None
        if len(sightings) >= 15:
            solved = solve_pnp(
                sightings.pixels, landmarks, self._sigmas(sightings.kinds), pose,
                self._filter.pose_information(), self._imu_from_camera, self._rig.camera,
            )  # fmt: skip
        self.diagnostics = {
            "landmarks_matched": float(len(sightings)),
            "landmarks_used": float(solved.inliers.sum()) if solved else 0.0,
            "visual_rms_px": solved.rms_px if solved else 0.0,
            "features": float(len(features[0]) + len(features[1])),
        }
        return sightings, behind, solved

    def _radius(self, hosts: list[MapKeyframe]) -> float:
        """Search radius in pixels: three standard deviations of the prediction, within limits."""
        if not hosts:
            return 10.0
        covariance = self._filter.eskf.covariance
        sigma = np.sqrt(covariance[3:6, 3:6].trace()) / max(hosts[-1].depth_m, 0.2)
        sigma += np.sqrt(covariance[:3, :3].trace())
        return float(np.clip(6.0 + 3.0 * sigma * self._rig.camera.fx, 10.0, 40.0))

    def _remember(
        self,
        tick: int,
        features: tuple[Features, Features],
        behind: tuple[Indices, Indices],
        sightings: Sightings,
        energy: Float32,
    ) -> None:
        pose = self._filter.eskf.state.pose
        camera_from_odom = (pose @ self._imu_from_camera).inverse()
        field = DepthField(energy, self._recent, camera_from_odom, self._rig.camera)
        if field.returns < 100:
            return
        sets = []
        for found, used in zip(features, behind, strict=True):
            fresh = np.setdiff1d(np.arange(len(found)), used)
            depth, spread = field.depth(found.pixels[fresh])
            good = np.isfinite(depth) & (spread < 0.05 + 0.01 * depth)
            fresh, depth = fresh[good], depth[good]
            rays = bearing_rays(found.pixels[fresh], self._rig.camera) * depth[:, None]
            sets.append(
                LandmarkSet(
                    self._imu_from_camera.apply(rays), found.pixels[fresh],
                    found.descriptors[fresh], np.full(len(fresh), -1, dtype=np.int64),
                )
            )  # fmt: skip
        depths = np.concatenate([self._camera_depths(s) for s in sets])
        if len(depths) < _LEAST_LANDMARKS and len(sightings) < _LEAST_LANDMARKS:
            return
        depth_m = float(np.median(depths)) if len(depths) else self._map.keyframes[-1].depth_m
        self._map.keyframes.append(
            MapKeyframe(self._next_number, tick, pose, pose, depth_m, (sets[0], sets[1]), sightings)
        )
        self._next_number += 1
        self.diagnostics["keyframes"] = float(len(self._map.keyframes))
        self.diagnostics["landmarks_new"] = float(len(depths))

    def _camera_depths(self, landmarks: LandmarkSet) -> Array:
        return self._imu_from_camera.inverse().apply(landmarks.points)[:, 2]

    def world_from_odom(self, seconds: float) -> tuple[Pose, Array]:
        """Where closures have put the odometry frame, ``seconds`` after the last call, and the
        covariance (3, 3) of the drift that they have not seen."""
        return Pose.identity(), np.zeros((3, 3))
