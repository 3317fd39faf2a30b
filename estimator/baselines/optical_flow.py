"""Optical flow: velocity over ground from corners tracked by a downward camera.

Pyramidal Lucas-Kanade (Bouguet 2001) from image to image; the gyroscope compensates rotation, the
rangefinder gives the scale. Integrated from the take-off spot. The heading is the gyroscope's,
corrected by the magnetometer.
"""

from __future__ import annotations

import numpy as np

from touchdown.estimator.api import Estimate, OpticalFlowParams
from touchdown.estimator.baselines.ground_flow import (
    level_directions,
    pixels_of,
    solve_displacement,
    update_with_displacement,
)
from touchdown.estimator.baselines.image_motion import follow
from touchdown.estimator.baselines.navigator import Navigator
from touchdown.estimator.filtering.camera_model import (
    STATIONARY,
    CameraTwist,
    ShutterModel,
    ground_depths,
)
from touchdown.estimator.filtering.keyframes import detect_features
from touchdown.estimator.ground_below import GroundBelow
from touchdown.estimator.typing import Array, Grey
from touchdown.sim.api import CameraImage, Observation, SensorNeeds, SensorRig
from touchdown.sim.frames import Pose

_GATE = 4.0
_TRACKING_TIMEOUT_S = 1.5
_SPACING_PX = 12
_BORDER_PX = 6


class OpticalFlowEstimator:
    """The optical flow estimator. Deterministic; nothing is drawn at random."""

    def __init__(self, rig: SensorRig, params: OpticalFlowParams | None = None) -> None:
        self._rig = rig
        self._params = params = params or OpticalFlowParams()
        self.needs = SensorNeeds(
            camera_hz=params.camera_hz, rangefinder=True, magnetometer=True, barometer=True
        )
        self._nav = Navigator(
            rig, self.needs, known_start=True,
            heading_sigma_deg=params.heading_sigma_deg, baro_sigma_m=params.baro_sigma_m,
        )  # fmt: skip
        self._imu_from_camera = rig.body_from_imu.inverse() @ rig.body_from_camera
        self._ground = GroundBelow(rig, params.ground_memory_s)
        self._shutter = ShutterModel(rig)
        self._before: Grey | None = None
        self._twist_before = STATIONARY
        self._height_before = 0.0
        self._distance = 0.0
        self._seen_s = 0.0
        self._diagnostics = {"flow_used": 0.0, "flow_rms_m": 0.0, "flow_innovation": 0.0}

    def update(self, obs: Observation) -> Estimate:
        """Processes the arrived messages and returns the estimate at ``obs.tick``."""
        for epoch in self._nav.epochs(obs):
            self._ground.take(epoch.rangefinder, self._nav.eskf.state)
            if epoch.image is not None:
                self._take_image(epoch.image)
        drift = (self._params.drift_fraction * self._distance) ** 2 * np.eye(3)
        untracked_s = obs.time_s - self._seen_s
        return self._nav.estimate(
            obs,
            healthy=untracked_s < _TRACKING_TIMEOUT_S,
            diagnostics=self._diagnostics | {"ground_height_m": self._ground.height_m},
            extra_covariance=drift,
        )

    def _take_image(self, image: CameraImage) -> None:
        grey, eskf = self._nav.grey(image.rgb), self._nav.eskf
        twist = self._nav.filter.camera_twist(image)
        if self._nav.stationary:
            self._seen_s = image.time_s
        elif self._before is not None:
            self._measure(self._before, grey, image.time_s, twist)
        self._nav.renew_clone()
        camera = eskf.state.pose @ self._imu_from_camera
        self._before, self._twist_before = grey, twist
        self._height_before = float(camera.translation[2]) - self._ground.height_m

    def _measure(self, before: Grey, now: Grey, time_s: float, twist: CameraTwist) -> None:
        params, eskf, camera = self._params, self._nav.eskf, self._rig.camera
        pose = eskf.state.pose @ self._imu_from_camera
        pose_before = eskf.clones[0] @ self._imu_from_camera
        pixels = self._corners(before)
        if len(pixels) < 8:
            return
        shutter, ground_m = self._shutter, self._ground.height_m
        start = shutter.at_instant(pixels, pose_before, ground_m, self._twist_before)
        guess = self._expected(start, pose_before, pose)
        depths = ground_depths(guess, camera, pose, ground_m)
        guess = shutter.to_rows(guess, depths, twist)
        found, reached = follow(before, now, pixels, guess)
        reached = shutter.at_instant(reached, pose, ground_m, twist)
        measured = solve_displacement(
            level_directions(start[found], camera, pose_before.rotation),
            level_directions(reached, camera, pose.rotation),
            self._height_before,
            params.pixel_sigma / camera.fx,
        )
        if measured is None:
            return
        innovation = update_with_displacement(
            eskf, measured, self._imu_from_camera.translation, floor_m=params.floor_sigma_m,
            scale_sigma=params.scale_sigma, gate=_GATE,
        )  # fmt: skip
        self._distance += float(np.linalg.norm(measured.translation))
        self._seen_s = time_s
        self._diagnostics = {
            "flow_used": float(measured.used),
            "flow_rms_m": measured.rms,
            "flow_innovation": innovation,
        }

    def _corners(self, grey: Grey) -> Array:
        """(N, 2) corners of the central part of the image, where the rangefinder points."""
        height, width = grey.shape
        side = self._params.window_pixels
        left, top = max((width - side) // 2, 0), max((height - side) // 2, 0)
        middle = np.ascontiguousarray(grey[top : height - top, left : width - left])
        found = detect_features(middle, self._params.features, _SPACING_PX, _BORDER_PX)
        return found + [left, top]

    def _expected(self, pixels: Array, pose_before: Pose, pose: Pose) -> Array:
        """Returns the pixels predicted for level ground by the filter's own motion."""
        directions = level_directions(pixels, self._rig.camera, pose_before.rotation)
        translation = pose_before.translation - pose.translation
        height = max(self._height_before, 0.02)
        lower = max(height - float(translation[2]), 0.02)
        moved = (height * directions + translation[:2]) / lower
        expected = pixels_of(moved, self._rig.camera, pose.rotation)
        return np.where(np.isfinite(expected), expected, pixels)
