"""Stereo visual odometry: corners of a keyframe with depth from the stereo pair, tracked in the
left image.

The baseline is 50 mm: from 30 m all disparities are about one pixel, and a tenth of a pixel is a
tenth of the depth. Therefore the height of the ground, which all corners share, is filtered over
many pairs, and each corner adds the information of its own disparity. Disparity is inverse depth
times ``scale`` = focal length times baseline, pixels times metres.

The mount of the pair and the clock of its cameras are estimated. How the right camera stands to the
left one is not: by 0.05 degrees it moves all disparities by a third of a pixel, which only the
height of the ground shows, and that is what the pair measures.
"""

import math
from dataclasses import dataclass

import numpy as np

from touchdown.estimator.api import CalibrationPriors, Estimate, StereoParams
from touchdown.estimator.baselines.ground_flow import follow
from touchdown.estimator.baselines.navigator import Navigator
from touchdown.estimator.filtering.camera_model import STATIONARY, ShutterModel, ground_depths
from touchdown.estimator.filtering.error_state import (
    CAMERA_ROTATION,
    CAMERA_TRANSLATION,
    Frame,
    Pinhole,
)
from touchdown.estimator.filtering.eskf import IteratedUpdate
from touchdown.estimator.filtering.keyframes import bearing_rays, detect_features
from touchdown.estimator.filtering.online_calibration import exposed
from touchdown.estimator.filtering.reprojection import (
    LandmarkViews,
    PixelNoise,
    calibrated_information,
)
from touchdown.sim.api import CameraImage, Observation, SensorNeeds, SensorRig
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array, Bytes, Grey, Indices

_MIN_DEPTH_M = 0.03
_ROWS_PX = 1.0
"""largest difference of a corner's rows in the two images"""


def disparities(
    left: Grey, right: Grey, pixels: Array, expected_m: Array, scale: float
) -> tuple[Indices, Array]:
    """Returns the indices (M,) of the matched corners (N, 2) of the left image and their sub-pixel
    disparities (M,). ``expected_m`` (N,): initial depths."""
    guess = pixels.copy()
    guess[:, 0] -= scale / np.maximum(expected_m, _MIN_DEPTH_M)
    found, reached = follow(left, right, pixels, guess)
    level = np.abs(reached[:, 1] - pixels[found, 1]) < _ROWS_PX
    found, reached = found[level], reached[level]
    return found, pixels[found, 0] - reached[:, 0]


class GroundHeight:
    """Mean height of the ground in view, odometry frame: a random walk in time, measured by every
    pair through all its corners."""

    def __init__(self, start_m: float, params: StereoParams) -> None:
        self._params = params
        self.height_m = start_m
        self._variance = 1e-4
        self._time_s = 0.0

    @property
    def sigma_m(self) -> float:
        """Standard deviation of the height."""
        return math.sqrt(self._variance)

    def depths(self, rays: Array, odom_from_camera: Pose) -> Array:
        """(N,) depths at which rays (N, 3), z = 1, meet the ground; NaN where they do not."""
        down = -(rays @ odom_from_camera.rotation[2])
        height = max(float(odom_from_camera.translation[2]) - self.height_m, _MIN_DEPTH_M)
        return height / np.where(down > 0.2, down, np.nan)

    def take(
        self, rays: Array, shifts: Array, odom_from_camera: Pose, scale: float, time_s: float
    ) -> None:
        """Updates by disparities (N,) along rays (N, 3): level ground at height h below the camera
        has the disparity ``scale * down / h``, so that one number, 1 / h, is fitted robustly."""
        self._variance += self._params.ground_density**2 * max(time_s - self._time_s, 0.0)
        self._time_s = time_s
        if len(shifts) < 10:
            return
        design = -scale * (rays @ odom_from_camera.rotation[2])
        camera_z = float(odom_from_camera.translation[2])
        inverse = 1.0 / max(camera_z - self.height_m, _MIN_DEPTH_M)
        sigma = self._params.disparity_sigma
        weights = np.ones(len(shifts))
        for _ in range(5):
            inverse = float((weights * design) @ shifts / ((weights * design) @ design))
            residuals = np.abs(shifts - design * inverse)
            spread = max(2.0 * float(np.median(residuals)), sigma)
            weights = 1.0 / (1.0 + (residuals / spread) ** 2)
        if inverse <= 0.0:
            return
        noise = sigma**2 / float((weights * design) @ design)
        noise += (self._params.disparity_floor_sigma / float(np.mean(design))) ** 2
        measured = camera_z - 1.0 / inverse
        variance = noise / inverse**4
        gain = self._variance / (self._variance + variance)
        self.height_m += gain * (measured - self.height_m)
        self._variance *= 1.0 - gain


class DepthAhead:
    """What stands for `GroundHeight` where the cameras do not look down: the median depth of the
    corners of the last pair. Each corner has the depth of its own disparity."""

    height_m, sigma_m = math.nan, math.nan

    def __init__(self) -> None:
        self._depth_m = 5.0

    def depths(self, rays: Array, _odom_from_camera: Pose) -> Array:
        """(N,) the same depth for rays (N, 3)."""
        return np.full(len(rays), self._depth_m)

    def take(
        self, _rays: Array, shifts: Array, _odom_from_camera: Pose, scale: float, _time_s: float
    ) -> None:
        """Takes disparities (N,)."""
        if len(shifts) and (shift := float(np.median(shifts))) > 0.0:
            self._depth_m = scale / shift


def inverse_depths(
    found: Indices, shifts: Array, ground_m: Array, scale: float, params: StereoParams
) -> tuple[Array, Array]:
    """(N,) inverse depths of corners and their variances: those of the ground ``ground_m`` (N,),
    updated by the disparities ``shifts`` (M,) of the corners ``found`` (M,), as far as these
    resolve relief. In inverse depth the noise of disparities is the same at all ranges. NaN where
    there is no ground."""
    inverse = 1.0 / ground_m
    variance = (params.relief_sigma_m * inverse**2) ** 2
    own = (params.disparity_sigma / scale) ** 2
    gain = variance[found] / (variance[found] + own)
    inverse[found] += gain * (shifts / scale - inverse[found])
    variance[found] *= 1.0 - gain
    return inverse, variance


_LOOKS_DOWN = 0.5
"""cosine between the cameras' axis and the vertical at the start, above which they see ground"""
_TRACKING_TIMEOUT_S = 1.5
_MIN_USED = 15
_GATES_PX = (12.0, 6.0, 3.0, 3.0)


@dataclass(slots=True)
class _Keyframe:
    grey: Grey
    pixels: Array
    """(N, 2) corners"""
    rays: Array
    """(N, 3) of the corners, camera frame, z = 1"""
    inverse: Array
    """(N,) inverse depths along the optical axis, 1/m"""
    variance: Array
    """(N,) of these"""
    clock_s: float = 0.0
    """clock of the cameras as estimated then, by which the rays were moved to one instant"""

    def landmarks(self, imu_from_camera: Pose) -> Array:
        """(N, 3) in the keyframe's IMU frame."""
        return imu_from_camera.apply(self.rays / self.inverse[:, None])


class StereoEstimator:
    """The stereo estimator. Deterministic; nothing is drawn at random."""

    def __init__(
        self,
        rig: SensorRig,
        params: StereoParams | None = None,
        priors: CalibrationPriors | None = None,
    ) -> None:
        self._params = params = params or StereoParams()
        self.needs = SensorNeeds(camera_hz=params.camera_hz, stereo=True)
        self._nav = Navigator(rig, self.needs, known_start=True, priors=priors)
        self._rig = rig = self._nav.rig
        right_from_left = rig.body_from_camera_right.inverse() @ rig.body_from_camera
        self._baseline = -float(right_from_left.translation[0])
        start = rig.world_from_body_start.translation
        axis = (rig.world_from_body_start @ rig.body_from_camera).rotation[:, 2]
        self._looks_down = bool(-axis[2] > _LOOKS_DOWN)
        self._ground: GroundHeight | DepthAhead = DepthAhead()
        if self._looks_down:
            self._ground = GroundHeight(float(start[2]) - rig.vehicle.leg_height_m, params)
        self._shutter = ShutterModel(rig)
        self._twist = STATIONARY
        self._keyframe: _Keyframe | None = None
        self._distance, self._position = 0.0, start
        self._seen_s = 0.0
        self._diagnostics = {"features_tracked": 0.0, "visual_rms_px": 0.0}

    def update(self, obs: Observation) -> Estimate:
        """Processes the arrived messages and returns the estimate at ``obs.tick``."""
        for epoch in self._nav.epochs(obs):
            if epoch.image is not None and epoch.image.right_rgb is not None:
                self._take_pair(epoch.image, epoch.image.right_rgb)
        drift = (self._params.drift_fraction * self._distance) ** 2 * np.eye(3)
        return self._nav.estimate(
            obs,
            healthy=obs.time_s - self._seen_s < _TRACKING_TIMEOUT_S,
            diagnostics=self._diagnostics
            | {"ground_height_m": self._ground.height_m, "ground_sigma_m": self._ground.sigma_m},
            extra_covariance=drift,
        )

    def _take_pair(self, image: CameraImage, right_rgb: Bytes) -> None:
        eskf = self._nav.eskf
        left, right = self._nav.grey(image.rgb), self._nav.grey(right_rgb)
        self._twist = self._nav.camera_twist(image)
        fraction = 0.0
        if self._nav.stationary:
            self._seen_s = image.time_s
        elif self._keyframe is not None:
            fraction = self._track(self._keyframe, left, image.time_s)
        position = eskf.state.position
        self._distance += float(np.linalg.norm(position - self._position))
        self._position = position
        self._look(
            left, right, image.time_s, new_keyframe=fraction < self._params.keyframe_fraction
        )

    def _track(self, keyframe: _Keyframe, left: Grey, time_s: float) -> float:
        """Updates the filter; returns the fraction of the keyframe's corners that were used."""
        expected = self._project(keyframe.landmarks(self._nav.imu_from_camera))
        appear = self._shutter.to_rows(expected, self._depths(expected), self._twist)
        guess = np.where(np.isfinite(appear), appear, keyframe.pixels)
        found, reached = follow(keyframe.grey, left, keyframe.pixels, guess)
        reached = self._at_one_instant(reached)
        used, rms = self._iterate(keyframe, found, reached)
        self._diagnostics = {"features_tracked": float(used), "visual_rms_px": rms}
        if used:
            self._seen_s = time_s
            self._update_depths(keyframe, found, reached)
        return used / len(keyframe.pixels)

    def _update_depths(self, keyframe: _Keyframe, found: Indices, reached: Array) -> None:
        """Updates the corners' depths from the motion since the keyframe, by a scalar Kalman filter
        each: relief shows as parallax, while the scale stays that of the pair."""
        eskf, camera = self._nav.eskf, self._rig.camera
        key = eskf.clones[0] @ self._nav.imu_from_camera
        now_from_key = self._pose.inverse() @ key
        inverse, variance = keyframe.inverse[found], keyframe.variance[found]
        shift = now_from_key.translation
        points = keyframe.rays[found] @ now_from_key.rotation.T + inverse[:, None] * shift
        focal = np.array([camera.fx, camera.fy])
        places = points[:, :2] / points[:, 2:]
        slopes = focal * (shift[:2] - places * shift[2]) / points[:, 2:]
        residuals = reached - (focal * places + [camera.cx, camera.cy])
        noise = self._params.track_sigma**2
        near = np.hypot(*residuals.T) < _GATES_PX[0]
        power = variance * (slopes**2).sum(axis=1)
        gain = np.where(near, variance / (power + noise), 0.0)
        inverse = inverse + gain * (slopes * residuals).sum(axis=1)
        keyframe.inverse[found] = np.maximum(inverse, 1e-4)
        keyframe.variance[found] = np.where(near, variance * noise / (power + noise), variance)

    def _depths(self, pixels: Array) -> Array:
        """(N,) of level ground along the optical axis at the filter's time."""
        camera = self._rig.camera
        if isinstance(self._ground, DepthAhead):
            return self._ground.depths(bearing_rays(pixels, camera), self._pose)
        return ground_depths(pixels, camera, self._pose, self._ground.height_m)

    @property
    def _pose(self) -> Pose:
        """odom_from_camera at the filter's time."""
        return self._nav.eskf.state.pose @ self._nav.imu_from_camera

    def _at_one_instant(self, pixels: Array) -> Array:
        return self._shutter.to_instant(pixels, self._depths(pixels), self._twist)

    def _project(self, landmarks: Array) -> Array:
        """(N, 2) pixels of landmarks (N, 3) of the clone's IMU frame, NaN where behind."""
        eskf, camera = self._nav.eskf, self._rig.camera
        now_from_key = self._pose.inverse() @ eskf.clones[0]
        points = now_from_key.apply(landmarks)
        depth = np.where(points[:, 2] > 0.02, points[:, 2], np.nan)
        focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
        return points[:, :2] / depth[:, None] * focal + centre

    def _iterate(self, keyframe: _Keyframe, found: Indices, pixels: Array) -> tuple[int, float]:
        """Iterated update by reprojections (frame to keyframe) of the corners ``found`` (N,) at
        ``pixels`` (N, 2); nothing changes if fewer than ``_MIN_USED`` are inliers. Returns their
        number and their rms in pixels."""
        nav, eskf = self._nav, self._nav.eskf
        clocks = np.array([nav.clock_s, keyframe.clock_s])
        update, used, rms = IteratedUpdate(eskf), 0, 0.0
        for gate in _GATES_PX:
            mount, twists = nav.imu_from_camera, np.array([eskf.twist, nav.twist_of_clone])
            landmarks = keyframe.landmarks(mount)[found]
            # pixels are at the instants of the poses by the clock as it was estimated then
            now, then = exposed(
                [eskf.state.pose, eskf.clones[0]], twists, clocks, eskf.state.calibration
            )
            views = LandmarkViews.fixed(pixels, landmarks, np.zeros((len(pixels), 3)))
            views = views._replace(jacobians=_by_mount(landmarks, mount.translation, eskf.shared))
            information, vector, used, rms = calibrated_information(
                views, Frame.of(now), Frame.of(then), twists, Frame.of(mount.inverse()),
                Pinhole.of(self._rig.camera), PixelNoise(self._params.pixel_sigma, gate),
            )  # fmt: skip
            if used < _MIN_USED:
                update.abandon()
                return 0, 0.0
            update.step([0], information, vector)
        update.finish()
        return used, rms

    def _look(self, left: Grey, right: Grey, time_s: float, *, new_keyframe: bool) -> None:
        """Measures the ground's height by the pair; makes it a keyframe if one is needed."""
        camera = self._rig.camera
        pixels = detect_features(left, self._params.features)
        pose, rays = self._pose, bearing_rays(pixels, camera)
        scale = camera.fx * self._baseline
        found, shifts = disparities(left, right, pixels, self._ground.depths(rays, pose), scale)
        self._ground.take(rays[found], shifts, pose, scale, time_s)
        if not new_keyframe:
            return
        inverse, variance = inverse_depths(
            found, shifts, self._ground.depths(rays, pose), scale, self._params
        )
        good = inverse > 0.0
        if not self._looks_down:  # nothing but its disparity says where a corner is
            good &= np.isin(np.arange(len(pixels)), found)
        if int(good.sum()) < _MIN_USED:
            return
        self._nav.renew_clone()
        seen = bearing_rays(self._at_one_instant(pixels[good]), camera)
        self._keyframe = _Keyframe(
            left, pixels[good], seen, inverse[good], variance[good], self._nav.clock_s
        )


def _by_mount(landmarks: Array, camera: Array, shared: int) -> Array:
    """(N, 3, S) derivatives of landmarks (N, 3), IMU frame, by the shared calibration: they move
    with the camera at ``camera`` (3,)."""
    jacobians = np.zeros((len(landmarks), 3, shared))
    if shared:
        # the columns of minus the cross product with each arm
        crossed = np.cross(np.eye(3), (landmarks - camera)[:, None])
        jacobians[:, :, CAMERA_ROTATION] = crossed.transpose(0, 2, 1)
        jacobians[:, :, CAMERA_TRANSLATION] = np.eye(3)
    return jacobians
