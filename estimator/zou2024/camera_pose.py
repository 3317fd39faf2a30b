"""Camera positioning: landmarks at keyframes, PnP, and growth of the visual map."""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np

from touchdown.estimator.api import Zou2024Params
from touchdown.estimator.filtering.camera_model import CameraTwist, ShutterModel
from touchdown.estimator.filtering.error_state import POSE
from touchdown.estimator.filtering.inertial_filter import InertialFilter
from touchdown.estimator.filtering.keyframes import bearing_rays, most_redundant
from touchdown.estimator.filtering.landmark_depth import RecentReturns
from touchdown.estimator.filtering.reprojection import MountedCamera
from touchdown.estimator.zou2024.bundle import CameraPose, adjust_window, solve_pnp
from touchdown.estimator.zou2024.closures import Closures, LoopVerifier
from touchdown.estimator.zou2024.depth_field import DepthField
from touchdown.estimator.zou2024.place_recognition import MemoryLimits
from touchdown.estimator.zou2024.registration import FeatureMaps
from touchdown.estimator.zou2024.relative_pose import ImageModel, update_with_image
from touchdown.estimator.zou2024.visual_map import (
    Features,
    LandmarkDetector,
    LandmarkSet,
    MapKeyframe,
    Sightings,
    VisualMap,
    no_sightings,
)
from touchdown.sim.api import CameraImage, SensorRig
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array, Float32, Indices

_MIN_LANDMARKS = 30
_QUERY_PERIOD_S = 1.0
"""time between keyframes that the dictionary holds and is asked about: ``Rtabmap/DetectionRate``"""
_AROUND = 2
"""keyframes before and after the one of a hypothesis whose landmarks verify it"""


class CameraPositioning:
    """Visual map and the correction of the filter by the images of keyframes."""

    def __init__(
        self, rig: SensorRig, params: Zou2024Params, inertial: InertialFilter,
        recent: RecentReturns, maps: FeatureMaps,
    ) -> None:  # fmt: skip
        self._rig = rig
        self._params = params
        self._filter = inertial
        self._recent = recent
        self._imu_from_camera = inertial.imu_from_camera
        self._detector = LandmarkDetector(params.sift_features, params.brisk_features)
        self._shutter = ShutterModel(rig)
        self._map = VisualMap(rig.camera, inertial.imu_from_camera)
        rate = float(np.radians(params.closure_rate_deg_s))
        self._maps = maps
        sigmas_px = np.array([params.sift_sigma_px, params.brisk_sigma_px])
        self._model = ImageModel(
            MountedCamera(rig.camera, inertial.imu_from_camera),
            (rig.body_from_camera.inverse() @ rig.body_from_lidar).translation,
            sigmas_px, params.depth_sigma_m,
        )  # fmt: skip
        features = max(params.sift_features, params.brisk_features)
        limits = MemoryLimits(
            params.short_term_locations, params.loop_words, features, params.rehearsal_similarity
        )
        self._closures = Closures(params.closure_speed_mps, rate, limits)
        self._verify = LoopVerifier(self._map, self._model, params.loop_inliers)
        self._last_tick = self._asked_tick = -(10**9)
        self._last_position = inertial.eskf.state.position
        self._next_number = 0
        self.failed = 0
        """images that could not be localised in the map"""
        self.diagnostics: dict[str, float] = {}

    def due(self, tick: int) -> bool:
        """True if an image of ``tick`` is far enough from the last one processed."""
        params = self._params
        moved = np.linalg.norm(self._filter.eskf.state.position - self._last_position)
        age_s = (tick - self._last_tick) / self._rig.tick_hz
        return age_s >= params.keyframe_period_s or bool(moved >= params.keyframe_distance_m)

    def take(self, image: CameraImage, energy: Callable[[], Float32]) -> bool:
        """Localises an image taken at the filter's time and may add a keyframe, for which alone it
        asks for the edge ``energy``. Returns True if the filter was corrected."""
        self._last_tick = image.tick
        grey = np.asarray(cv2.cvtColor(image.rgb, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
        found = self._detector(grey)
        twist = self._filter.camera_twist(image)
        features = self._at_one_instant(found[0], twist), self._at_one_instant(found[1], twist)
        self._follow_clones()
        sightings, behind, solved = self._localise(features)
        corrected = False
        if solved is not None:
            sightings = sightings.select(solved.inliers)
            if self._params.use_camera_pose:
                eskf, height = self._filter.eskf, self._map.keyframes[-1].depth_m
                fraction = self._params.image_calibration_gain
                fraction *= height >= self._params.calibrate_above_m
                update_with_image(eskf, self._model, self._cloned(), sightings, fraction)
                self._filter.trail.follow(eskf.state)
                self._follow_clones()
                corrected = True
            if self._params.use_bundle:
                self._refine(sightings)
        else:
            self.failed += bool(self._map.keyframes)
            sightings = no_sightings()
        self._last_position = self._filter.eskf.state.position
        if self._worth_keeping(sightings):
            edges = energy()
            if not self._params.use_geodesic_depth:
                edges = np.zeros_like(edges)
            self._remember(features, behind, sightings, edges)
        self.diagnostics["keyframes"] = float(len(self._map.keyframes))
        self.diagnostics["closures"] = float(self._closures.closed)
        return corrected

    def _at_one_instant(self, found: Features, twist: CameraTwist) -> Features:
        """The features as a camera without rolling shutter sees them at the filter's time."""
        camera = self._filter.eskf.state.pose @ self._imu_from_camera
        ground = self._recent.median_height()
        if ground is None:
            ground = float(self._rig.world_from_body_start.translation[2])
        return replace(found, pixels=self._shutter.at_instant(found.pixels, camera, ground, twist))

    def _worth_keeping(self, sightings: Sightings) -> bool:
        """True if the image shows enough that the newest keyframe does not."""
        if not self._map.keyframes or len(sightings) < _MIN_LANDMARKS:
            return True
        newest = self._map.keyframes[-1]
        position = self._filter.eskf.state.position
        moved = float(np.linalg.norm(position - newest.odom_from_imu.translation))
        return moved > 0.03 * newest.depth_m

    def _refine(self, sightings: Sightings) -> None:
        """Bundle adjustment of the newest keyframes and the present image."""
        adjust_window(
            self._map.keyframes[-self._params.bundle_keyframes :],
            self._filter.eskf.state.pose, sightings, self._map.by_number(),
            MountedCamera(self._rig.camera, self._imu_from_camera),
            np.sqrt(2.0) * self._model.sigmas_px, self._params.depth_sigma_m,
        )  # fmt: skip

    def _cloned(self) -> list[MapKeyframe]:
        """The newest keyframes, which are the filter's clones."""
        keyframes = self._map.keyframes
        return keyframes[len(keyframes) - len(self._filter.eskf.clones) :]

    def _follow_clones(self) -> None:
        """Moves the newest keyframes to the filter's estimate of them."""
        for keyframe, pose in zip(self._cloned(), self._filter.eskf.clones, strict=True):
            moved = keyframe.odom_from_imu.inverse() @ pose
            keyframe.map_from_imu = keyframe.map_from_imu @ moved
            keyframe.odom_from_imu = pose

    def _clone(self, keyframe: MapKeyframe) -> None:
        """Makes a new keyframe a clone of the filter; the oldest clone ends."""
        eskf = self._filter.eskf
        if len(eskf.clones) >= self._params.recent_keyframes:
            self._maps.hand_over(0, eskf)
            eskf.remove_clone(0)
        eskf.add_clone(self._model.own_covariance(eskf, keyframe))
        self._maps.anchors.add(keyframe.odom_from_imu, eskf.state.calibration)

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
                sightings.pixels, landmarks, self._model.sigmas_px[sightings.kinds], pose,
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
                    found.descriptors[fresh], depth,
                )
            )  # fmt: skip
        if sum(len(s.points) for s in sets) + len(sightings) < _MIN_LANDMARKS:
            return
        depths = np.concatenate([s.depths for s in sets])
        newest = self._map.keyframes[-1] if self._map.keyframes else None
        depth_m = float(np.median(depths)) if len(depths) else self._filter_height()
        in_map = pose
        if newest is not None:
            in_map = newest.map_from_imu @ newest.odom_from_imu.inverse() @ pose
        keyframe = MapKeyframe(
            self._next_number, pose, in_map, depth_m, (sets[0], sets[1]), sightings,
            self._filter.eskf.twist, self._filter.eskf.state.calibration,
        )  # fmt: skip
        self._next_number += 1
        self._map.keyframes.append(keyframe)
        self._clone(keyframe)
        if self._params.use_closures:
            self._close_loops(keyframe, features, newest)
        self._forget()

    def _filter_height(self) -> float:
        """Height above the take-off ground, used without any depth."""
        start = self._rig.world_from_body_start.translation[2]
        return max(float(self._filter.eskf.state.position[2] - start), 0.3)

    def _forget(self) -> None:
        """Removes the most redundant keyframe once there are too many."""
        keyframes = self._map.keyframes
        if len(keyframes) <= self._params.max_keyframes:
            return
        poses = [k.odom_from_imu for k in keyframes]
        depths = [k.depth_m for k in keyframes]
        gone = most_redundant(poses, depths, keep_last=self._params.recent_keyframes + 1)
        if self._params.use_closures:
            self._closures.remove(keyframes[gone].number)
        del keyframes[gone]

    # ------------------------------------------------------------------------ closures

    def _close_loops(
        self, keyframe: MapKeyframe, features: tuple[Features, Features], before: MapKeyframe | None
    ) -> None:
        """Adds the new keyframe to the graph. Once a second asks whether it shows a known place,
        and adds a closure if its landmarks agree."""
        closures, known = self._closures, self._map.by_number()
        closures.add(keyframe, self._filter.eskf.covariance[POSE, POSE], before)
        closures.refresh_odometry(self._map.keyframes, len(self._filter.eskf.clones))
        if self._last_tick - self._asked_tick >= _QUERY_PERIOD_S * self._rig.tick_hz:
            self._asked_tick = self._last_tick
            found = closures.ask(keyframe.number, features, self._params.loop_threshold)
            if found is not None and self._close(known[found], keyframe, features):
                closures.settle(self._map.keyframes)
                return
        closures.aim(keyframe)

    def _close(
        self, source: MapKeyframe, keyframe: MapKeyframe, features: tuple[Features, Features]
    ) -> bool:
        """Adds a closure, if landmarks around ``source`` agree on the keyframe's pose."""
        older = self._map.keyframes[: -len(self._cloned())]
        at = next((i for i, k in enumerate(older) if k is source), None)
        if at is None:
            return False
        seen = self._verify(features, older[max(at - _AROUND, 0) : at + _AROUND + 1], keyframe)
        if seen is not None:
            self._closures.close(source, keyframe, seen.pose, seen.information)
        return seen is not None

    def world_from_odom(self, seconds: float) -> tuple[Pose, Array]:
        """Returns the pose of the odometry frame after loop closures, ``seconds`` after the last
        call, and the covariance (3, 3) of the remaining drift."""
        moved = self._closures.advance(self._filter.eskf.state.position, seconds)
        return moved, self._closures.drift_covariance
