"""LIDAR-inertial-visual odometry: a tightly coupled estimator for flight over ground.

One error-state filter estimates pose, velocity, IMU biases and the poses of cloned keyframes. Scans
measure height, roll and pitch against a map of planes (and lateral motion where walls and slopes
allow); images measure x, y and yaw against landmarks of keyframes with depth from the LIDAR. The
order, LIDAR before vision, and the sequential update follow FAST-LIVO (Zheng et al. 2022).
Landmarks are anchored to cloned keyframe poses, not to a map without errors, so that a later view
of the same ground closes the loop.

While no scans come, new features are assumed on the ground below the rangefinder, parallax moves
them, and the rangefinder gives the way since their keyframe its length
(``depth_without_returns``).
"""

import numpy as np

from touchdown.estimator.api import Estimate, LivoParams, PoseTrack
from touchdown.estimator.filtering.anchors import Anchors
from touchdown.estimator.filtering.camera_model import Shutter, Undistorter
from touchdown.estimator.filtering.deskew import PlacedScan, moved, thin_out
from touchdown.estimator.filtering.error_state import POSITION, Frame
from touchdown.estimator.filtering.eskf import Eskf
from touchdown.estimator.filtering.inertial_filter import InertialFilter, with_flown_noise
from touchdown.estimator.filtering.keyframes import Keyframe
from touchdown.estimator.filtering.landmark_depth import RecentReturns
from touchdown.estimator.filtering.online_calibration import (
    calibration_diagnostics,
    corrected_mount,
    prior_sigmas,
)
from touchdown.estimator.filtering.plane_map import PlaneMap
from touchdown.estimator.filtering.reprojection import MountedCamera
from touchdown.estimator.filtering.synchronizer import MessageSynchronizer
from touchdown.estimator.ground_below import GroundBelow
from touchdown.estimator.livo.intensity import PhotometricUpdate
from touchdown.estimator.livo.patch_tracker import grey_levels
from touchdown.estimator.livo.scan_update import (
    DegeneracyWatch,
    LidarReport,
    scan_diagnostics,
    scan_errors,
    update_with_scan,
)
from touchdown.estimator.livo.visual import VisualFrontEnd
from touchdown.sim.api import CameraImage, LidarScan, Observation, SensorNeeds, SensorRig
from touchdown.sim.frames import Pose, so3_log
from touchdown.sim.typing import Array, Bytes

_SPREAD = 0.12
"""fraction of a voxel between two points of a scan that are stored: close to the ground a scan
would fill a voxel from one corner of it"""


class AnchoredMap:
    """Part k of ``anchors`` and ``images`` belongs to clone k of the filter."""

    def __init__(
        self, params: LivoParams, lever: Array, dark_ticks: int | None, tick_hz: int
    ) -> None:
        """``lever`` (3,), ``dark_ticks``: see ``PhotometricUpdate``; ``tick_hz``: of ticks."""
        self._voxel_m = params.voxel_m
        self._open_ticks = params.map_open_s * tick_hz, params.image_open_s * tick_hz
        self._begun = 0
        self.planes = PlaneMap(params.voxel_m, params.map_voxels, params.voxel_points)
        self.recent = RecentReturns()
        self.anchors = Anchors()
        self.photometric = PhotometricUpdate(lever, dark_ticks, params.dark_height_sigma_m)

    def extend(self, eskf: Eskf, scan: PlacedScan, intensity: Bytes, lever: Array) -> None:
        """Adds the scan just used, with its ``intensity`` (N,), at the present pose to the newest
        clone's part while that is open. ``lever`` (3,): of the LIDAR in the IMU frame."""
        state, age = eskf.state, eskf.state.tick - self._begun
        pose = Frame(state.rotation, state.position)
        self.recent.add(scan.points, pose)
        if not eskf.clones:
            return
        if age <= self._open_ticks[0]:
            sensor = state.rotation @ lever + state.position
            spread = thin_out(scan.points, _SPREAD * self._voxel_m, 16)
            points = moved(scan.points, spread, pose)
            clone, calibration = eskf.clones[-1], state.calibration
            points = self.anchors.as_kept(points, sensor, clone, calibration, state.rotation)
            self.planes.insert(points, sensor, len(self.anchors) - 1)
        if age <= self._open_ticks[1]:
            self.photometric.extend(eskf, scan.points, intensity)

    def begin(self, eskf: Eskf, height_m: float, dark_ticks: int) -> None:
        """Begins the part of the clone just added, ``height_m`` above the ground."""
        self._begun = eskf.state.tick
        self.photometric.begin(eskf, height_m, dark_ticks)
        self.anchors.add(eskf.clones[-1], eskf.state.calibration)

    def hand_over(self, k: int, eskf: Eskf) -> None:
        """Gives the planes of clone ``k``, which is about to go, to the clone nearest to it."""
        self.photometric.drop(k)
        successor, move = self.anchors.reassignment(k, eskf.clones)
        self.planes.reassign(k, successor, move)
        self.anchors.remove(k)


_MIN_RETURNS = 50
"""minimum of a usable scan"""
_FRESH_SCANS = 3
"""periods of a scan after which the last one no longer covers the ground in view"""
_INFLATION, _FLOOR = 1.8, 0.005
"""inflation and floor of the reported covariance: errors of a landmark or a voxel repeat from image
to image and scan to scan, while the filter takes them for white noise"""
_DARK_INFLATION = 2.7
"""inflation of the reported covariance where intensities measure: the noise of an image of
intensity repeats in all scans that are compared with it"""


class Livo:
    """Tightly coupled estimator, see the module. Deterministic; nothing is drawn at random."""

    spare_sensors = ("rangefinder",)
    """the rangefinder is read while no scans come"""

    def __init__(self, rig: SensorRig, params: LivoParams | None = None) -> None:
        self._undistort = Undistorter(rig)
        self._rig = rig = self._undistort.rig
        self._params = params = params or LivoParams()
        camera_hz = params.camera_hz if params.use_vision else 0
        self.needs = SensorNeeds(camera_hz=camera_hz, lidar=True, rangefinder=True)
        flown = with_flown_noise(rig, params).imu
        self._filter = InertialFilter(
            rig, flown=flown, calibration_sigmas=prior_sigmas(params)
        )  # fmt: skip
        self._eskf = self._filter.eskf
        self._eskf.loosely_coupled = params.loose
        self._synchronizer = MessageSynchronizer(rig, self._filter, camera_hz)
        self._vision = VisualFrontEnd(
            MountedCamera(rig.camera, self._filter.imu_from_camera), params,
            Shutter(rig.camera_readout_s), open_ticks=2 * rig.tick_hz,
            lidar_in_camera=(rig.body_from_camera.inverse() @ rig.body_from_lidar).translation,
        )  # fmt: skip
        dark_ticks = round(params.intensity_after_s * rig.tick_hz) if params.use_intensity else None
        self._map = AnchoredMap(
            params, self._filter.imu_from_lidar.translation, dark_ticks, rig.tick_hz
        )  # fmt: skip
        self._scan_errors = scan_errors(rig, params)
        floor = np.array([_FLOOR, _FLOOR, np.hypot(_FLOOR, params.ground_sigma_m)])
        self._floor = np.diag(floor**2)
        self._degeneracy = DegeneracyWatch()
        self._vision_tick, self._scan_tick = 0, 0
        self._odom = Pose.identity()
        self._ground = GroundBelow(rig, params.ground_memory_s)
        self._height = 0.0
        """median range of the newest scan, m"""
        self._skipped = 0
        self._diagnostics: dict[str, float] = {}
        self._scan_track: PoseTrack | None = None

    # ------------------------------------------------------------------------ the cycle

    def update(self, obs: Observation) -> Estimate:
        """Processes the arrived messages and returns the estimate at ``obs.tick``."""
        self._scan_track = None
        for message in self._synchronizer.push(obs):
            if not self._synchronizer.advance(message):
                continue
            if isinstance(message, LidarScan):
                self._take_scan(message)
            else:
                self._take_image(message)
        self._synchronizer.flush(obs)
        self._ground.take(obs.rangefinder, self._filter.present)
        # the reported pose differs from the best estimate by the decaying jump
        jump = self._filter.jump[POSITION]
        self._diagnostics["skipped"] = float(self._skipped + self._synchronizer.skipped)
        self._diagnostics["stationary"] = float(self._filter.stationary)
        dark = self._map.photometric.measures(self._dark_ticks)
        inflation = _DARK_INFLATION if dark else _INFLATION
        return self._filter.estimate(
            obs, self._odom, self._floor + jump * jump[:, None], self._scan_track,
            dict(self._diagnostics), tuple(self._synchronizer.events), inflation,
        )  # fmt: skip

    # ------------------------------------------------------------------------ scan update

    def _take_scan(self, scan: LidarScan) -> None:
        mount = corrected_mount(self._filter.imu_from_lidar, self._eskf.state.calibration)
        placed = self._filter.place_scan(scan, mount, check_blind_zone=True)
        if placed is None:
            self._skipped += 1
            return
        report, intensity = LidarReport(), scan.intensity[placed.pulses]
        if len(placed) >= _MIN_RETURNS:
            self._height = float(np.median(scan.ranges[placed.pulses]))
            report = self._update_with_scan(placed, intensity)
            self._synchronizer.events += self._degeneracy.events(report)
        self._filter.trail.follow(self._eskf.state)
        if len(placed) >= _MIN_RETURNS and self._lacks_anchor(scan.end_tick):
            self._add_clone(self._vision.new_anchor(self._eskf, self._height, scan.end_tick))
        self._map.extend(self._eskf, placed, intensity, mount.translation)
        self._scan_tick = scan.end_tick
        self._scan_track = self._filter.track_of(scan, self._scan_track)
        self._diagnostics |= scan_diagnostics(report, len(placed), self._map.planes.used)

    def _update_with_scan(self, scan: PlacedScan, intensity: Bytes) -> LidarReport:
        params, photometric = self._params, self._map.photometric
        fraction = params.scan_calibration_gain * (self._height >= params.calibrate_above_m)
        report = LidarReport()
        if params.use_lidar:
            # the footprint is about 1.75 x 0.5 of the height: so many even cells cover it
            cell = np.sqrt(1.75 * 0.5 / params.scan_points) * self._height
            chosen = thin_out(scan.points, float(cell), 15)[: 2 * params.scan_points]
            report = update_with_scan(
                self._eskf, self._map.planes, self._map.anchors, scan.select(chosen),
                photometric.errors_of_planes(self._scan_errors, self._dark_ticks),
                fraction=fraction,
            )  # fmt: skip
        self._diagnostics |= photometric.measure(
            self._eskf, scan, intensity, self._dark_ticks, fraction
        )
        return report

    @property
    def _dark_ticks(self) -> int:
        """Time since an image last measured the pose."""
        return self._eskf.state.tick - self._vision_tick

    # ------------------------------------------------------------------------ image update

    def _take_image(self, image: CameraImage) -> None:
        eskf, vision, recent = self._eskf, self._vision, self._map.recent
        levels = grey_levels(self._undistort.grey(image.rgb))
        delay_s = image.time_s - eskf.state.tick / self._rig.tick_hz
        vision.measure_open_keyframes(eskf, recent, image.tick)
        report = vision.update(
            eskf, levels, delay_s, self._params.image_calibration_gain,
            spot=self._ground.spot(image.time_s),
        )  # fmt: skip
        if report.used:
            self._vision_tick = image.tick
            self._filter.trail.follow(eskf.state)
        elif vision.keyframes:
            self._skipped += 1
        if vision.wants_keyframe(report, image.tick):
            # old returns lie at one side of the image, and may be on a roof there
            fresh = image.tick - self._scan_tick <= _FRESH_SCANS * self._rig.lidar_scan_ticks
            ground = None if fresh else self._ground.height_m
            keyframe = vision.new_keyframe(
                eskf, levels, recent, image.tick, delay_s=delay_s, ground_m=ground
            )
            if keyframe is not None:
                self._add_clone(keyframe)
        self._diagnostics |= report.diagnostics() | {"keyframes": float(len(vision.keyframes))}
        self._diagnostics |= calibration_diagnostics(eskf.state.calibration)

    # ------------------------------------------------------------------------ clones and map

    def _add_clone(self, keyframe: Keyframe) -> None:
        """Clones the present pose: what the map gains from now on belongs to it."""
        surplus = self._vision.surplus(self._eskf)
        if surplus is not None:
            self._map.hand_over(surplus, self._eskf)
        self._vision.append(self._eskf, keyframe, surplus)
        self._map.begin(self._eskf, self._height, self._dark_ticks)

    def _lacks_anchor(self, tick: int) -> bool:
        """True if the map would grow far from the newest clone, as it does where images fail."""
        if not self._eskf.clones:
            return True
        if tick - self._vision_tick <= self._rig.tick_hz // 2:
            return False
        newest, pose, params = self._eskf.clones[-1], self._eskf.state.pose, self._params
        height, way = max(self._height, 2.0), pose.translation - newest.translation
        turned = np.linalg.norm(so3_log(newest.rotation.T @ pose.rotation))
        return bool(
            turned > np.radians(params.anchor_turn_deg)
            or np.hypot(way[0], way[1]) > params.anchor_spacing * height
            or abs(way[2]) > params.anchor_climb * height
        )
