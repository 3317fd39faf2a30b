"""Optical flow of a downward camera, with the scale of the rangefinder.

`OpticalFlowEstimator`: velocity over ground by corners followed from image to image (pyramidal
Lucas-Kanade, Bouguet 2001); the gyroscope compensates rotation. Integrated from the take-off spot.
The heading is the gyroscope's, corrected by the magnetometer.

`HybridFlowEstimator`: dense optical flow and phase correlation, fused with GPS. Each image is
rectified to a level camera of constant heading by the attitude, so that level ground moves
uniformly. Phase correlation finds that shift, dense flow (Farneback 2003) refines it everywhere,
and a robust fit makes it a displacement in metres. The filter fuses it with the receiver's
velocity; fixes give the position in the world.
"""

import cv2
import numpy as np

from touchdown.estimator.api import (
    CalibrationPriors,
    Estimate,
    HybridFlowParams,
    OpticalFlowParams,
)
from touchdown.estimator.baselines.gps import SatelliteAiding, WanderingAnchor
from touchdown.estimator.baselines.ground_flow import (
    Displacement,
    Shift,
    follow,
    level_directions,
    phase_shift,
    pixels_of,
    solve_displacement,
    update_with_displacement,
)
from touchdown.estimator.baselines.navigator import Navigator
from touchdown.estimator.filtering.camera_model import (
    STATIONARY,
    CameraTwist,
    ShutterModel,
    ground_depths,
)
from touchdown.estimator.filtering.keyframes import detect_features
from touchdown.estimator.ground_below import GroundBelow
from touchdown.sim.api import CameraImage, CameraIntrinsics, Observation, SensorNeeds, SensorRig
from touchdown.sim.frames import BODY_FROM_DOWNWARD_OPTICAL, Pose
from touchdown.sim.typing import Array, Grey, Mask

_GATE = 4.0
_TRACKING_TIMEOUT_S = 1.5
_SPACING_PX = 12
_BORDER_PX = 6


class OpticalFlowEstimator:
    """The optical flow estimator. Deterministic; nothing is drawn at random."""

    def __init__(
        self,
        rig: SensorRig,
        params: OpticalFlowParams | None = None,
        priors: CalibrationPriors | None = None,
    ) -> None:
        self._params = params = params or OpticalFlowParams()
        self.needs = SensorNeeds(
            camera_hz=params.camera_hz, rangefinder=True, magnetometer=True, barometer=True
        )
        self._nav = Navigator(
            rig, self.needs, known_start=True, priors=priors,
            heading_sigma_deg=params.heading_sigma_deg, baro_sigma_m=params.baro_sigma_m,
        )  # fmt: skip
        self._rig = rig = self._nav.rig
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
        twist = self._nav.camera_twist(image)
        if self._nav.stationary:
            self._seen_s = image.time_s
        elif self._before is not None:
            self._measure(self._before, grey, image.time_s, twist)
        self._nav.renew_clone()
        camera = eskf.state.pose @ self._nav.imu_from_camera
        self._before, self._twist_before = grey, twist
        self._height_before = float(camera.translation[2]) - self._ground.height_m

    def _measure(self, before: Grey, now: Grey, time_s: float, twist: CameraTwist) -> None:
        params, eskf, camera = self._params, self._nav.eskf, self._rig.camera
        pose = eskf.state.pose @ self._nav.imu_from_camera
        pose_before = eskf.clones[0] @ self._nav.imu_from_camera
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
            eskf, measured, self._nav.imu_from_camera.translation, self._nav.twist_of_clone,
            floor_m=params.floor_sigma_m, scale_sigma=params.scale_sigma, gate=_GATE,
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


_MIN_HEIGHT_M = 0.1
_FIELD = 0.36
"""half the side of the levelled image, in metres per metre of height"""
_GRID = 10
"""pixels between the flow vectors that are fitted"""
_MAX_EXPANSION = 0.3
_PHASE_SIGMA_PX = 1.0
"""standard deviation of the shift by phase correlation, taken alone where the dense flow fails"""
_LOOKING_DOWN = BODY_FROM_DOWNWARD_OPTICAL
"""world_from_camera of the levelled image"""


class LevelView:
    """A virtual camera that points straight down with constant heading."""

    def __init__(self, camera: CameraIntrinsics, side: int) -> None:
        self._camera = camera
        centre = 0.5 * (side - 1)
        focal = 0.5 * side / _FIELD
        self.focal = focal
        self._pinhole = CameraIntrinsics(
            width=side, height=side, fx=focal, fy=focal, cx=centre, cy=centre
        )
        self._size = (side, side)
        axis = np.arange(_GRID // 2, side, _GRID)
        rows, cols = np.meshgrid(axis, axis, indexing="ij")
        self.rows, self.cols = rows.ravel(), cols.ravel()
        ys, xs = np.mgrid[:side, :side]
        self.offsets = np.stack([xs - centre, ys - centre], axis=-1).astype(np.float32)

    def draw(self, grey: Grey, world_from_camera: Array) -> Grey:
        """Returns the image (side, side) of the virtual camera for distant ground."""
        rotation = world_from_camera.T @ _LOOKING_DOWN
        homography = self._camera.matrix() @ rotation @ np.linalg.inv(self._pinhole.matrix())
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        level = cv2.warpPerspective(grey, homography, self._size, flags=flags)
        return np.asarray(level, np.uint8)

    def directions(self, pixels: Array) -> Array:
        """(N, 2) level directions of pixels (N, 2) of the virtual camera."""
        rays = (pixels - 0.5 * (self._size[0] - 1)) / self.focal
        return rays @ _LOOKING_DOWN[:2, :2].T

    def seen(self, pixels: Array, world_from_camera: Array) -> Mask:
        """Mask (N,) of the pixels (N, 2) of the virtual camera that the real one covers."""
        real = pixels_of(self.directions(pixels), self._camera, world_from_camera)
        far = [self._camera.width - 4.0, self._camera.height - 4.0]
        inside = np.asarray((real > 3.0) & (real < far))
        return np.asarray(inside.all(axis=1), np.bool_)


class HybridFlowEstimator:
    """The hybrid flow estimator. Deterministic; nothing is drawn at random."""

    def __init__(
        self,
        rig: SensorRig,
        params: HybridFlowParams | None = None,
        priors: CalibrationPriors | None = None,
    ) -> None:
        self._params = params = params or HybridFlowParams()
        self.needs = SensorNeeds(
            camera_hz=params.camera_hz, gps=True, rangefinder=True, magnetometer=True,
            barometer=True,
        )  # fmt: skip
        self._nav = Navigator(
            rig, self.needs, known_start=False, priors=priors,
            heading_sigma_deg=params.heading_sigma_deg, baro_sigma_m=params.baro_sigma_m,
        )  # fmt: skip
        anchor = WanderingAnchor(
            params.wander_period_s, params.drift_density, white_m=0.02, correction_time_s=1.0
        )
        self._satellites = SatelliteAiding(self._nav, anchor)
        rig = self._nav.rig
        self._ground = GroundBelow(rig, params.ground_memory_s)
        self._view = LevelView(rig.camera, params.side_pixels)
        self._shutter = ShutterModel(rig)
        self._camera = rig.camera
        self._before: Grey | None = None
        self._twist = self._twist_before = STATIONARY
        self._attitude_before = np.eye(3)
        self._height_before = 0.0
        self._diagnostics = {"flow_used": 0.0, "flow_rms_m": 0.0, "phase_response": 0.0}

    def update(self, obs: Observation) -> Estimate:
        """Processes the arrived messages and returns the estimate at ``obs.tick``."""
        for epoch in self._nav.epochs(obs):
            self._ground.take(epoch.rangefinder, self._nav.eskf.state)
            if epoch.fix is not None:
                self._satellites.take(epoch.fix)
            if epoch.image is not None:
                self._take_image(epoch.image)
        return self._satellites.estimate(obs, self._diagnostics)

    def _take_image(self, image: CameraImage) -> None:
        eskf = self._nav.eskf
        attitude = (eskf.state.pose @ self._nav.imu_from_camera).rotation
        level = self._view.draw(self._nav.grey(image.rgb), attitude)
        self._twist = self._nav.camera_twist(image)
        if self._before is not None and not self._nav.stationary:
            self._measure(self._before, level, attitude)
        self._nav.renew_clone()
        self._before, self._attitude_before = level, attitude
        self._twist_before = self._twist
        camera = eskf.state.pose @ self._nav.imu_from_camera
        self._height_before = float(camera.translation[2]) - self._ground.height_m

    def _measure(self, before: Grey, now: Grey, attitude: Array) -> None:
        params, eskf = self._params, self._nav.eskf
        if self._height_before <= _MIN_HEIGHT_M:
            return
        clone = eskf.clones[0] @ self._nav.imu_from_camera
        expected = clone.translation - (eskf.state.pose @ self._nav.imu_from_camera).translation
        # the attitude estimate of the previous image has changed since its rectification
        rotation = clone.rotation @ self._attitude_before.T
        shift = phase_shift(before, now)
        measured = self._dense(before, now, attitude, rotation, shift, expected)
        if measured is None:
            measured = self._coarse(attitude, rotation, shift, expected)
        if measured is None:
            return
        update_with_displacement(
            eskf, measured, self._nav.imu_from_camera.translation, self._nav.twist_of_clone,
            floor_m=params.floor_sigma_m, scale_sigma=params.scale_sigma, gate=_GATE,
        )  # fmt: skip
        self._diagnostics = {
            "flow_used": float(measured.used),
            "flow_rms_m": measured.rms,
            "phase_response": shift.response,
        }

    def _dense(
        self,
        before: Grey,
        now: Grey,
        attitude: Array,
        rotation: Array,
        shift: Shift,
        expected: Array,
    ) -> Displacement | None:
        """Returns the displacement by Farneback's flow, initialised by the phase correlation (or
        the filter) and by the expansion from the filter's climb."""
        view, height = self._view, self._height_before
        start = shift.pixels
        if shift.response == 0.0:
            start = expected[:2] @ _LOOKING_DOWN[:2, :2] * view.focal / height
        expansion = expected[2] / max(height - expected[2], 0.1)
        expansion = float(np.clip(expansion, -_MAX_EXPANSION, _MAX_EXPANSION))
        guess = (expansion * view.offsets + start).astype(np.float32)
        flow = cv2.calcOpticalFlowFarneback(
            before, now, guess, 0.5, 2, 15, 2, 5, 1.1, cv2.OPTFLOW_USE_INITIAL_FLOW
        )
        pixels = np.column_stack([view.cols, view.rows]).astype(np.float64)
        reached = pixels + flow[view.rows, view.cols]
        seen = view.seen(pixels, self._attitude_before) & view.seen(reached, attitude)
        return solve_displacement(
            _rotated(self._directions_before(pixels[seen]), rotation),
            self._directions_now(reached[seen], attitude), height,
            self._params.pixel_sigma / view.focal, min_used=20,
        )  # fmt: skip

    def _directions_before(self, pixels: Array) -> Array:
        return self._directions(
            pixels, self._attitude_before, self._twist_before, self._height_before
        )

    def _directions_now(self, pixels: Array, attitude: Array) -> Array:
        camera = self._nav.eskf.state.pose @ self._nav.imu_from_camera
        height = float(camera.translation[2]) - self._ground.height_m
        return self._directions(pixels, attitude, self._twist, height)

    def _directions(
        self, pixels: Array, attitude: Array, twist: CameraTwist, height_m: float
    ) -> Array:
        """(N, 2) level directions at the filter's time of pixels (N, 2) of the levelled image."""
        directions = self._view.directions(pixels)
        if self._shutter.idle(twist):
            return directions
        real = pixels_of(directions, self._camera, attitude)
        depths = ground_depths(
            real, self._camera, Pose(attitude, np.array([0.0, 0.0, height_m])), 0.0
        )
        real = self._shutter.to_instant(real, depths, twist)
        return level_directions(real, self._camera, attitude)

    def _coarse(
        self, attitude: Array, rotation: Array, shift: Shift, expected: Array
    ) -> Displacement | None:
        """Returns the displacement by phase correlation alone; its vertical part is the
        filter's."""
        if shift.response == 0.0:
            return None
        view, height = self._view, self._height_before
        middle = np.full((1, 2), 0.5 * (view.offsets.shape[0] - 1))
        start = _rotated(self._directions_before(middle), rotation)
        moved = self._directions_now(middle + shift.pixels, attitude) - start
        sigma = _PHASE_SIGMA_PX * height / view.focal
        lever = height * np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
        return Displacement(
            translation=np.array([*(height * moved[0]), expected[2]]),
            covariance=np.diag([sigma, sigma, 10.0]) ** 2, by_rotation_before=-lever,
            by_rotation_now=lever, used=1, rms=0.0,
        )  # fmt: skip


def _rotated(directions: Array, rotation: Array) -> Array:
    """Level directions (N, 2) after a small rotation (3, 3) of the world's axes."""
    rays = np.column_stack([directions, np.full(len(directions), -1.0)]) @ rotation.T
    return rays[:, :2] / -rays[:, 2:]
