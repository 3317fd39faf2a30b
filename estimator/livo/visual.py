"""Visual update: reprojection of the landmarks of a few keyframes into the present image."""

from dataclasses import dataclass, replace

import numpy as np

from touchdown.estimator.api import LivoParams
from touchdown.estimator.filtering.camera_model import Shutter, rows_of_keyframe
from touchdown.estimator.filtering.error_state import (
    CAMERA_ROTATION,
    CAMERA_TRANSLATION,
    CENTER,
    CLONE_DIM,
    FOCAL,
    MOUNT_TRANSLATION,
    POSE_DIM,
    POSITION,
    Frame,
    Pinhole,
)
from touchdown.estimator.filtering.eskf import Eskf, IteratedUpdate, NormalEquations
from touchdown.estimator.filtering.keyframes import (
    Keyframe,
    bearing_rays,
    choose,
    detect_features,
    measure_planes,
    most_redundant,
    overlaps,
)
from touchdown.estimator.filtering.landmark_depth import RecentReturns
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
from touchdown.estimator.livo.depth_without_returns import (
    SeenGround,
    assume_level_ground,
    extend_plane,
    move_along_rays,
    update_with_range,
)
from touchdown.estimator.livo.patch_tracker import track
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array, Grey, Indices

_GATES_PX = (12.0, 6.0, 3.0, 3.0)
"""largest residuals of the four iterations"""
_MIN_LANDMARKS = 15
"""number of landmarks that an update needs"""
_LAST_FEW = 4
"""newest keyframes, whose tracking is no loop closure"""
_MIN_PLANES = 25
"""features of a keyframe with depth; with fewer, the others are assigned the common plane of the
returns around, if there is one"""
_GROUND_FRACTION = 0.15
"""fraction of the image with returns, from which on features elsewhere are not of the ground:
beyond its edge there may be stars. Over still water most images have returns in a tenth or less."""


@dataclass(frozen=True, kw_only=True, slots=True)
class VisualReport:
    """Result of an update by one image, for the recording."""

    used: int = 0
    keyframes_tracked: int = 0
    rms_px: float = 0.0
    best_fraction: float = 0.0

    def diagnostics(self) -> dict[str, float]:
        """The figures by the name of their plot."""
        return {
            "features_tracked": float(self.used), "visual_rms_px": self.rms_px,
            "keyframes_tracked": float(self.keyframes_tracked), "overlap": self.best_fraction,
        }  # fmt: skip


@dataclass(frozen=True, slots=True)
class _Track:
    """Landmarks of one keyframe that were found in the present image."""

    keyframe: int
    which: Indices
    """(N,) of its features"""
    views: LandmarkViews
    """views of the landmarks as they were created"""
    made_with: Array
    """(C,) calibration at which ``landmarks`` hold"""

    def by(self, calibration: Array) -> LandmarkViews:
        """The views with the landmarks at the present ``calibration`` (C,)."""
        moved = self.views.jacobians @ (calibration - self.made_with)
        return self.views._replace(landmarks=self.views.landmarks + moved)


_DEPTHS = POSE_DIM + MOUNT_TRANSLATION.stop - 1
"""the LIDAR's height, with which the depths of all landmarks move alike"""
_NO_IMAGE = np.zeros((0, 0), dtype=np.uint8)


class VisualFrontEnd:
    """Keyframes and the update by an image. Keyframe k is clone k of the filter.

    ``open_ticks``: age up to which a keyframe still receives depths; ``lidar_in_camera`` (3,):
    position of the LIDAR, m.
    """

    def __init__(
        self,
        camera: MountedCamera,
        params: LivoParams,
        shutter: Shutter,
        *,
        open_ticks: int,
        lidar_in_camera: Array | None = None,
    ) -> None:
        self._camera = camera.intrinsics
        self._imu_from_camera = camera.imu_from_camera
        self._params, self._shutter, self._open_ticks = params, shutter, open_ticks
        self._lidar_in_camera = np.zeros(3) if lidar_in_camera is None else lidar_in_camera
        self._own_variances = np.array([0.0, 0.0, 0.0, 0.0, 0.0, params.anchor_height_m**2])
        self.keyframes: list[Keyframe] = []

    # ------------------------------------------------------------------------ keyframes

    def measure_open_keyframes(self, eskf: Eskf, recent: RecentReturns, tick: int) -> None:
        """Completes the planes of new keyframes, whose borders the LIDAR covers a little later."""
        for k, keyframe in enumerate(self.keyframes):
            age = tick - keyframe.tick
            if (
                keyframe.pixels.size
                and age <= self._open_ticks
                and age % (self._open_ticks // 4) == 0
            ):
                camera_from_odom = self._camera_at(eskf.clones[k], keyframe).inverse()
                measure_planes(keyframe, recent, camera_from_odom, self._camera)

    def _camera_at(self, pose: Pose, keyframe: Keyframe) -> Pose:
        """odom_from_camera of a keyframe with stamp at ``pose``, by the calibration at its
        creation."""
        (taken,) = exposed(
            [pose], keyframe.twist[None], np.array([keyframe.delay_s]), keyframe.calibration
        )
        return taken @ self._imu_from_camera

    def new_keyframe(
        self,
        eskf: Eskf,
        levels: tuple[Grey, Grey, Grey],
        recent: RecentReturns,
        tick: int,
        *,
        delay_s: float = 0.0,
        ground_m: float | None = None,
    ) -> Keyframe | None:
        """Returns the present image as a keyframe if enough of its features have a plane, else
        None. ``delay_s``: its stamp less the instant of the filter's state; ``ground_m``: height of
        the ground for features without returns while there are no scans. While there are, features
        without may take the common plane of the returns around."""
        pixels = detect_features(levels[0], self._params.features)
        keyframe = self._keyframe(eskf, levels, pixels, tick, delay_s)
        camera_from_odom = self._camera_at(eskf.state.pose, keyframe).inverse()
        measure_planes(keyframe, recent, camera_from_odom, self._camera)
        if ground_m is not None:
            fraction = self._params.assumed_depth_fraction
            assume_level_ground(keyframe, camera_from_odom, ground_m, self._camera, fraction)
        elif int(keyframe.valid.sum()) < _MIN_PLANES:
            keyframe = self._completed(keyframe, recent, camera_from_odom)
        if int(keyframe.valid.sum()) < _MIN_PLANES:
            return None
        return keyframe

    def _completed(
        self, keyframe: Keyframe, recent: RecentReturns, camera_from_odom: Pose
    ) -> Keyframe:
        """Returns ``keyframe`` with features near returns of the LIDAR alone where these are in a
        good fraction of the image, else with all features in the common plane of the returns."""
        grey = keyframe.levels[0]
        every = replace(keyframe, pixels=detect_features(grey, grey.size))
        measure_planes(every, recent, camera_from_odom, self._camera)
        known = every.pixels[every.valid]
        if len(known) < max(_MIN_PLANES, _GROUND_FRACTION * len(every.pixels)):
            extend_plane(keyframe, recent, camera_from_odom, self._camera)
            return keyframe
        chosen = replace(keyframe, pixels=detect_features(grey, self._params.features, near=known))
        measure_planes(chosen, recent, camera_from_odom, self._camera)
        return chosen

    def new_anchor(self, eskf: Eskf, depth_m: float, tick: int) -> Keyframe:
        """Returns the present pose, ``depth_m`` above the ground, as a keyframe without an image,
        to anchor the map to."""
        keyframe = self._keyframe(eskf, 3 * (_NO_IMAGE,), np.zeros((0, 2)), tick, 0.0)
        keyframe.depth_m = depth_m
        return keyframe

    def _keyframe(
        self, eskf: Eskf, levels: tuple[Grey, Grey, Grey], pixels: Array, tick: int, delay_s: float
    ) -> Keyframe:
        return Keyframe(
            tick=tick, levels=levels, pixels=pixels,
            calibration=eskf.state.calibration, twist=eskf.twist, delay_s=delay_s,
        )  # fmt: skip

    def surplus(self, eskf: Eskf) -> int | None:
        """The clone that must go before another can be added; None: there is room."""
        if len(self.keyframes) < self._params.keyframes:
            return None
        return most_redundant(eskf.clones, [k.depth_m for k in self.keyframes])

    def append(self, eskf: Eskf, keyframe: Keyframe, surplus: int | None) -> None:
        """Clones the present pose for ``keyframe``; the clone ``surplus`` goes first."""
        if surplus is not None:
            eskf.remove_clone(surplus)
            del self.keyframes[surplus]
        eskf.add_clone(self._own_variances)
        self.keyframes.append(keyframe)

    def wants_keyframe(self, report: VisualReport, tick: int) -> bool:
        """True if the overlap has become too small for the next image. While tracking fails, new
        keyframes come at a low rate, so that they do not replace all others."""
        ticks = [keyframe.tick for keyframe in self.keyframes if keyframe.pixels.size]
        newest = ticks[-1] if ticks else -self._open_ticks
        if report.used == 0:
            return tick - newest >= self._open_ticks // 4
        return report.used < 80 or report.best_fraction < 0.6

    # ------------------------------------------------------------------------ update

    def update(
        self, eskf: Eskf, levels: tuple[Grey, Grey, Grey], delay_s: float = 0.0,
        fraction: float = 1.0, spot: Array | None = None,
    ) -> VisualReport:  # fmt: skip
        """Iterated update by one image whose stamp is ``delay_s`` after the filter's state; nothing
        is changed if fewer than 15 landmarks are found. ``fraction``: of the correction that mounts
        and lens take; ``spot`` (3,): the ground that the rangefinder's beam meets, IMU frame."""
        middle = self._shutter.middle_s
        mount = corrected_camera(self._imu_from_camera, eskf.state.calibration)
        every = list(range(len(self.keyframes)))
        *poses, now = (p @ mount for p in self._exposed(eskf, every, delay_s, middle))
        candidates = overlaps(self.keyframes, poses, now, self._camera, self._params.track_scale)
        if not self._params.use_closures:
            first = len(self.keyframes) - _LAST_FEW
            candidates = [c for c in candidates if c.index >= first]
        best = max((c.fraction * _closeness(c.scale) for c in candidates), default=0.0)
        variances = np.diag(eskf.covariance)[eskf.base :].reshape(-1, CLONE_DIM)[:, POSITION]
        chosen = choose(candidates, variances.sum(axis=1), self._params.track_keyframes, 0.35)
        tracks: list[_Track] = []
        for k in chosen:
            keyframe = self.keyframes[k]
            usable = np.flatnonzero(keyframe.valid)
            found, pixels, _ = track(
                keyframe.levels, levels, keyframe.pixels[usable], keyframe.planes[usable],
                Frame.of(now.inverse() @ poses[k]), Pinhole.of(self._camera),
            )  # fmt: skip
            if int(found.sum()) >= 10:
                tracks.append(self._track(eskf, k, usable[found], pixels[found]))
        if sum(len(t.views.pixels) for t in tracks) < _MIN_LANDMARKS:
            return VisualReport(best_fraction=best)
        used, rms = self._iterate(IteratedUpdate(eskf, fraction), eskf, tracks, delay_s)
        if used:
            self._refine_depths(eskf, tracks, delay_s)
            if spot is not None:
                self._scale_way(eskf, tracks, delay_s, spot)
        return VisualReport(
            used=used, keyframes_tracked=len(tracks), rms_px=rms, best_fraction=best
        )

    def _exposed(
        self, eskf: Eskf, which: list[int], delay_s: float, after_s: float = 0.0
    ) -> list[Pose]:
        """odom_from_imu of the clones ``which`` and of the present, ``after_s`` after the stamps of
        their images."""
        keyframes = [self.keyframes[k] for k in which]
        twists = np.array([*(keyframe.twist for keyframe in keyframes), eskf.twist])
        delays = np.array([*(keyframe.delay_s for keyframe in keyframes), delay_s])
        poses = [*(eskf.clones[k] for k in which), eskf.state.pose]
        return exposed(poses, twists, delays + after_s, eskf.state.calibration)

    def _track(self, eskf: Eskf, k: int, which: Indices, pixels: Array) -> _Track:
        """Landmarks of keyframe ``k`` as created, and their derivatives by the calibration."""
        keyframe, mount = self.keyframes[k], self._imu_from_camera
        twist = keyframe.twist.copy()
        twist[POSITION] = eskf.clones[k].rotation.T @ twist[POSITION]
        rays, starts = rows_of_keyframe(
            bearing_rays(keyframe.pixels[which], self._camera), twist, mount,
            self._shutter.row_times(keyframe.pixels[which, 1], self._camera.height),
        )  # fmt: skip
        planes = keyframe.planes[which]
        along = np.einsum("ij,ij->i", rays, planes)
        before = np.einsum("ij,ij->i", starts, planes)
        landmarks = mount.apply(starts + rays * ((1.0 - before) / along)[:, None])
        rows = self._shutter.row_times(pixels[:, 1], self._camera.height)
        arms = landmarks - mount.translation
        sigmas = np.hypot(self._params.depth_sigma_m, keyframe.sigmas[which])
        spreads = arms * (sigmas / np.linalg.norm(arms, axis=1))[:, None]
        views = LandmarkViews(pixels, rows, landmarks, np.zeros((len(which), 3, 0)), spreads)
        if not eskf.shared:
            return _Track(k, which, views, np.zeros(0))
        made_with = keyframe.calibration[: eskf.shared].copy()
        for given in (FOCAL, CENTER, CAMERA_ROTATION, CAMERA_TRANSLATION):
            made_with[given] = 0.0  # rays are those of the given lens and mount
        jacobians = landmark_jacobians(
            rays, planes, self._lidar_in_camera, Frame.of(mount), twist, Pinhole.of(self._camera)
        )
        return _Track(k, which, views._replace(jacobians=jacobians), made_with)

    def _iterate(
        self, update: IteratedUpdate, eskf: Eskf, tracks: list[_Track], delay_s: float
    ) -> tuple[int, float]:
        keys = [track.keyframe for track in tracks]
        used, rms = 0, 0.0
        for gate in _GATES_PX:
            information, vector, used, rms = self._accumulate(eskf, tracks, delay_s, gate)
            if used < _MIN_LANDMARKS:
                update.abandon()
                return 0, 0.0
            if update.step(keys, information, vector) and gate == _GATES_PX[-1]:
                break
        update.finish()
        return used, rms

    def _refine_depths(self, eskf: Eskf, tracks: list[_Track], delay_s: float) -> None:
        """Moves features whose depth is assumed to where the image shows them."""
        calibration, params = eskf.state.calibration, self._params
        mount = corrected_camera(self._imu_from_camera, calibration)
        lens = corrected_lens(self._camera, calibration)
        *clones, now = self._exposed(eskf, [track.keyframe for track in tracks], delay_s)
        noise = PixelNoise(params.pixel_sigma, _GATES_PX[0])
        for clone, track_ in zip(clones, tracks, strict=True):
            move_along_rays(
                self.keyframes[track_.keyframe], track_.which,
                track_.by(calibration[: eskf.shared]), (Frame.of(now), Frame.of(clone)),
                eskf.twist, (mount, lens), params.assumed_depth_floor, noise,
            )  # fmt: skip

    def _scale_way(self, eskf: Eskf, tracks: list[_Track], delay_s: float, spot: Array) -> None:
        """Corrects the filter by the range to the ``spot`` where depths are assumed."""
        tracks = [t for t in tracks if self.keyframes[t.keyframe].assumed[t.which].any()]
        if not tracks:  # as a rule while scans come
            return
        calibration = eskf.state.calibration
        camera = corrected_camera(self._imu_from_camera, calibration).inverse()
        *clones, now = self._exposed(eskf, [track.keyframe for track in tracks], delay_s)
        seen = []
        for clone, track_ in zip(clones, tracks, strict=True):
            k, features = track_.keyframe, track_.which
            assumed = self.keyframes[k].assumed[features]
            moved = self._track(eskf, k, features[assumed], track_.views.pixels[assumed])
            landmarks = moved.by(calibration[: eskf.shared]).landmarks
            points = (camera @ now.inverse() @ clone).apply(landmarks)
            seen.append(SeenGround(k, now.translation - clone.translation, points))
        update_with_range(eskf, seen, camera.apply(spot), self._params)

    def _accumulate(
        self, eskf: Eskf, tracks: list[_Track], delay_s: float, gate_px: float
    ) -> NormalEquations:
        state = eskf.state
        shared = eskf.shared
        head = POSE_DIM + shared
        size = head + CLONE_DIM * len(tracks)
        information, vector = np.zeros((size, size)), np.zeros(size)
        lens = corrected_lens(self._camera, state.calibration)
        used, total = 0, 0.0
        *clones, now = self._exposed(eskf, [track.keyframe for track in tracks], delay_s)
        camera = corrected_camera(self._imu_from_camera, state.calibration).inverse()
        calibration = state.calibration[:shared]
        for slot, track_ in enumerate(tracks):
            clone, keyframe = clones[slot], self.keyframes[track_.keyframe]
            part = calibrated_information(
                track_.by(calibration),
                Frame.of(now), Frame.of(clone), np.array([eskf.twist, keyframe.twist]),
                Frame.of(camera), lens, PixelNoise(self._params.pixel_sigma, gate_px),
            )  # fmt: skip
            where = np.append(np.arange(head), np.arange(CLONE_DIM) + head + CLONE_DIM * slot)
            own, pull = part.information, part.vector
            if shared and self._params.depth_shared_sigma_m > 0.0:
                own, pull = _without(own, pull, _DEPTHS, self._params.depth_shared_sigma_m)
            information[where[:, None], where] += own
            vector[where] += pull
            used += part.used
            total += part.used * part.rms * part.rms
        return NormalEquations(information, vector, used, float(np.sqrt(total / max(used, 1))))


def _without(information: Array, vector: Array, which: int, sigma: float) -> tuple[Array, Array]:
    """Normal equations after an error of the standard deviation ``sigma`` that acts as the
    coordinate ``which`` does is marginalised."""
    row = information[which]
    gain = row / (row[which] + sigma**-2)
    return information - gain[:, None] * row, vector - gain * vector[which]


def _closeness(scale: float) -> float:
    """1 at equal scale, falling to 0.6 at a quarter apart: a keyframe at a different scale is
    tracked less accurately."""
    ratio = max(scale, 1.0 / scale)
    return float(1.0 if ratio < 1.0 else 1.0 - 1.6 * (ratio - 1.0))
