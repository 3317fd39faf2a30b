"""LIDAR-inertial-visual odometry: a tightly coupled estimator for flight over ground.

One error-state filter estimates pose, velocity, IMU biases and the poses of cloned keyframes. Scans
measure height, roll and pitch against a map of planes (and lateral motion where walls and slopes
allow); images measure x, y and yaw against landmarks of keyframes with depth from the LIDAR. The
order, LIDAR before vision, and the sequential update follow FAST-LIVO (Zheng et al. 2022).
Landmarks are anchored to cloned keyframe poses, not to a map without errors, so that a later view
of the same ground closes the loop.

Scans and images arrive late. The filter's state is at measurement time; the estimate is that state
propagated over the buffered IMU samples to the present.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.api import Estimate, LivoParams, PoseTrack
from touchdown.estimator.filtering.deskew import PlacedScan, place_scan, screen_scan, thin_out
from touchdown.estimator.filtering.error_state import CLOCK, SHARED_DIM, STATE_DIM
from touchdown.estimator.filtering.eskf import Eskf
from touchdown.estimator.filtering.gravity_alignment import align_with_gravity
from touchdown.estimator.filtering.imu_propagation import (
    ImuBuffer,
    NavState,
    integrate,
    propagate_nominal,
    transition,
)
from touchdown.estimator.filtering.landmark_depth import RecentReturns
from touchdown.estimator.filtering.message_order import Message, MessageOrder, stamp_of
from touchdown.estimator.filtering.plane_map import PlaneMap
from touchdown.estimator.filtering.reprojection import MountedCamera
from touchdown.estimator.filtering.undistortion import Undistorter
from touchdown.estimator.filtering.zero_velocity import ZeroVelocityUpdate
from touchdown.estimator.guard import InputGuard
from touchdown.estimator.livo.anchored_update import update_with_scan
from touchdown.estimator.livo.anchors import Anchors
from touchdown.estimator.livo.error_model import flown_imu, scan_errors, visual_diagnostics
from touchdown.estimator.livo.intensity_update import PhotometricUpdate
from touchdown.estimator.livo.lidar_update import DegeneracyWatch, LidarReport
from touchdown.estimator.livo.online_calibration import (
    calibration_diagnostics,
    corrected_mount,
    prior_sigmas,
)
from touchdown.estimator.livo.patch_tracker import grey_levels
from touchdown.estimator.livo.shutter import Shutter
from touchdown.estimator.livo.visual import VisualFrontEnd, VisualParams
from touchdown.sim.api import (
    GRAVITY_MPS2,
    CameraImage,
    LidarScan,
    Observation,
    SensorNeeds,
    SensorRig,
)
from touchdown.sim.frames import Pose, cross, quat_wxyz_from_matrix, so3_exp, so3_log

Array = NDArray[np.float64]

_START_SIGMAS = np.repeat([2e-4, 2e-3, 5e-3], 3)
"""rad, m, m/s: the take-off pose is known, but the legs settle"""
_LEVEL_SIGMA = 5e-3
"""m/s^2, of the mean specific force at rest, beside the accelerometer's bias"""
_PATIENCE_S = 0.3
"""longest delay of a scan or image that is waited for"""
_FEWEST_RETURNS = 50
"""minimum of a usable scan"""
_FRESH_SCANS = 3
"""periods of a scan after which the last one no longer covers the ground in view"""
_LAST_FEW = 4
"""newest keyframes, whose tracking is no loop closure"""
_ANCHOR_REACH = 0.5
"""of the height: distance from the newest keyframe beyond which the map needs another anchor"""
_HISTORY = 128
"""IMU steps of past poses kept for deskewing"""
_LIFTING_THRUST = 0.85
"""of the weight: with less static thrust the vehicle has not left the ground"""
_IDLE_MARGIN = 1.2
"""of the idle speed: below it the rotors give no lift"""
_INFLATION, _FLOOR = 1.8, 0.005
"""inflation and floor of the reported covariance: errors of a landmark or a voxel repeat from image
to image and scan to scan, while the filter takes them for white noise"""
_GRAVITY: Array = np.array([0.0, 0.0, GRAVITY_MPS2])


class Livo:
    """Tightly coupled estimator, see the module. Deterministic: ``seed`` is unused because nothing
    is drawn at random."""

    def __init__(self, rig: SensorRig, params: LivoParams | None = None, seed: int = 0) -> None:
        self._rig = rig
        self._params = params = params or LivoParams()
        camera_hz = params.camera_hz if params.use_vision else 0
        self.needs = SensorNeeds(camera_hz=camera_hz, lidar=True)
        self._guard = InputGuard(rig, camera_hz)
        periods = {"scans": rig.lidar_scan_ticks}
        if camera_hz:
            periods["images"] = rig.tick_hz // camera_hz
        patience = max(rig.compute_latency_ticks, round(_PATIENCE_S * rig.tick_hz))
        self._order = MessageOrder(rig, periods, patience)
        self._events: list[str] = []
        step_s = rig.imu_ticks / rig.tick_hz
        self._buffer = ImuBuffer(flown_imu(rig.imu, params), step_s)
        self._imu_from_body = rig.body_from_imu.inverse()
        self._imu_from_lidar = self._imu_from_body @ rig.body_from_lidar
        start = rig.world_from_body_start @ rig.body_from_imu
        zero = np.zeros(3)
        rig_sigmas = prior_sigmas(params)
        state = NavState(
            0, start.rotation, start.translation, zero, zero, zero, np.zeros(len(rig_sigmas))
        )
        bias_sigmas = np.repeat([rig.imu.gyro_bias_sigma, rig.imu.accel_bias_sigma], 3)
        sigmas = np.concatenate([_START_SIGMAS, bias_sigmas, rig_sigmas])
        sigmas[:2] = np.hypot(sigmas[:2], rig.start_tilt_sigma_rad)
        self._eskf = Eskf(state, sigmas**2)
        self._levelled = rig.start_tilt_sigma_rad == 0.0
        self._eskf.loosely_coupled = params.loose
        self._calibrate_by(0.0)
        self._anchors = Anchors()
        self._propagated = state
        self._propagated_covariance = self._eskf.covariance[:STATE_DIM, :STATE_DIM].copy()
        self._zero_velocity = ZeroVelocityUpdate(rig.imu.gyro_density, step_s, self._levelled)
        self._map = PlaneMap(params.voxel_m, params.map_voxels, params.voxel_points)
        self._recent = RecentReturns()
        self._vision = VisualFrontEnd(
            MountedCamera(rig.camera, self._imu_from_body @ rig.body_from_camera),
            VisualParams(
                max_keyframes=params.keyframes,
                track_keyframes=params.track_keyframes,
                features=params.features,
                sigma_px=params.pixel_sigma,
                open_ticks=2 * rig.tick_hz,
                newest_only=None if params.use_closures else _LAST_FEW,
                depth_sigma_m=params.depth_sigma_m,
                height_sigma_m=params.anchor_height_m,
                shutter=Shutter(rig.camera_readout_s),
            ),
            lidar_in_camera=(rig.body_from_camera.inverse() @ rig.body_from_lidar).translation,
            on_change=self._follow_clones,
        )
        self._scan_errors = scan_errors(rig, params)
        self._floor = np.array([_FLOOR, _FLOOR, np.hypot(_FLOOR, params.ground_sigma_m)]) ** 2
        dark_ticks = rig.tick_hz // 2 if params.use_intensity else None
        self._photometric = PhotometricUpdate(self._imu_from_lidar.translation, dark_ticks)
        self._degeneracy = DegeneracyWatch()
        self._undistort = Undistorter(rig)
        self._history_ticks = np.zeros(1, dtype=np.int64)
        self._history_rotations = state.rotation[None]
        self._history_positions = state.position[None]
        self._gyro, self._force = np.zeros(3), np.zeros(3)
        self._offset = np.zeros(9)
        self._vision_tick, self._scan_tick = 0, 0
        self._lifted = False
        self._last_height = 0.0
        self._diagnostics: dict[str, float] = {"skipped": 0.0}
        self._scan_track: PoseTrack | None = None

    # ------------------------------------------------------------------------ the cycle

    def update(self, obs: Observation) -> Estimate:
        """Processes the arrived messages and returns the estimate at ``obs.tick``."""
        self._scan_track = None
        obs = self._guard.screen(obs)
        self._events = list(self._guard.events)
        self._diagnostics["skipped"] += self._guard.refused
        stationary = self._is_stationary(obs.rotor_speed_radps)
        for sample in obs.imu:
            self._gyro, self._force = sample.angular_velocity, sample.specific_force
            self._buffer.push(sample.tick, self._gyro, self._force, stationary)
            self._propagated = propagate_nominal(
                self._propagated, np.array([sample.tick]), self._gyro[None], self._force[None],
                self._buffer.step_s,
            )  # fmt: skip
        measured = False
        for message in self._order.push(obs):
            measured |= self._take(message)
        lag = self._rig.lidar_scan_ticks + max(
            self._rig.compute_latency_ticks, self._order.longest_wait_ticks
        )
        if obs.tick - self._eskf.state.tick > lag + self._rig.lidar_scan_ticks:
            self._advance(obs.tick - lag)
            measured = True
        if measured:
            self._propagate_to_now()
        return self._estimate(obs)

    def _is_stationary(self, rotor_speed: Array) -> bool:
        """True if the rotor speeds imply that the vehicle stands on the ground. A descending
        vehicle needs less speed than its static thrust suggests, so that after the first lift-off
        only idling rotors count."""
        vehicle = self._rig.vehicle
        thrust = vehicle.thrust_coefficient * float(rotor_speed @ rotor_speed)
        self._lifted |= thrust > _LIFTING_THRUST * vehicle.mass_kg * GRAVITY_MPS2
        slow = bool(np.all(rotor_speed <= _IDLE_MARGIN * vehicle.rotor_speed_min))
        return slow or not self._lifted

    def _take(self, message: Message) -> bool:
        tick = stamp_of(message)
        if tick < self._eskf.state.tick or tick > self._propagated.tick:
            self._diagnostics["skipped"] += 1.0
            name = "scan" if isinstance(message, LidarScan) else "image"
            self._events.append(f"{name} {tick} refused: it came too late")
            return False
        self._advance(tick)
        if isinstance(message, LidarScan):
            self._take_scan(message)
        else:
            self._take_image(message)
        return True

    def _advance(self, tick: int) -> None:
        """Propagates the filter to ``tick`` over buffered samples."""
        count = self._buffer.until(tick)
        if count == 0:
            return
        _, gyro, force, stationary = self._buffer.samples(count)
        if not self._levelled and stationary.all():
            sigma = _LEVEL_SIGMA + self._rig.imu.accel_density / np.sqrt(
                count * self._buffer.step_s
            )
            align_with_gravity(self._eskf, force.mean(axis=0), sigma)
            self._levelled = True
            self._history_rotations[-1] = self._eskf.state.rotation
        ticks, rotations, positions = self._eskf.propagate(self._buffer, count)
        self._history_ticks = np.concatenate([self._history_ticks, ticks[1:]])[-_HISTORY:]
        self._history_rotations = np.concatenate([self._history_rotations, rotations[1:]])
        self._history_positions = np.concatenate([self._history_positions, positions[1:]])
        self._history_rotations = self._history_rotations[-_HISTORY:]
        self._history_positions = self._history_positions[-_HISTORY:]
        held = self._zero_velocity.update(self._eskf, gyro, force, stationary)
        self._diagnostics["stationary"] = float(held)
        if held:
            self._correct_history()
        self._buffer.drop(count)

    def _correct_history(self) -> None:
        """Moves the pose history rigidly, so that the newest is the filter's."""
        state = self._eskf.state
        rotation = state.rotation @ self._history_rotations[-1].T
        offset = self._history_positions - self._history_positions[-1]
        self._history_positions = offset @ rotation.T + state.position
        self._history_rotations = rotation @ self._history_rotations

    # ------------------------------------------------------------------------ measurements

    def _take_scan(self, scan: LidarScan) -> None:
        first = int(np.searchsorted(self._history_ticks, scan.start_tick))
        if (
            first + 1 >= len(self._history_ticks)
            or self._history_ticks[first] != scan.start_tick
            or self._history_ticks[-1] != scan.end_tick
        ):
            self._diagnostics["skipped"] += 1.0
            return
        mount = self._imu_from_lidar
        if len(self._eskf.state.calibration):
            mount = corrected_mount(mount, self._eskf.state.calibration)
        pulses = screen_scan(scan, self._rig.lidar, check_blind_zone=True)
        placed = place_scan(
            scan, pulses, mount, self._history_rotations[first:],
            self._history_positions[first:], self._buffer.step_s,
        )  # fmt: skip
        report = LidarReport(matched=0, rms_m=0.0, lateral_strength=np.zeros(3))
        if len(placed) >= _FEWEST_RETURNS:
            report = self._update_with_scan(placed)
            self._events += self._degeneracy.events(report)
            self._diagnostics |= self._photometric.measure(
                self._eskf, placed, scan.intensity[pulses], self._dark_ticks
            )
        self._correct_history()
        self._extend_map(placed.points, mount.translation, scan.end_tick)
        self._photometric.extend(self._eskf, placed.points, scan.intensity[pulses])
        self._scan_tick = scan.end_tick
        if self._scan_track is not None:  # over all scans of this update
            start = round(self._scan_track.times_s[0] * self._rig.tick_hz)
            first = min(first, int(np.searchsorted(self._history_ticks, start)))
        self._scan_track = self._track_over(first)
        self._diagnostics |= {
            "scan_returns": float(len(placed)),
            "lidar_matched": float(report.matched),
            "lidar_rms_m": report.rms_m,
            "lidar_lateral_weakest": float(report.lateral_strength[0]),
            "lidar_lateral_middle": float(report.lateral_strength[1]),
            "lidar_weak_translation": float(report.weak_translation),
            "lidar_weak_rotation": float(report.weak_rotation),
            "map_voxels": float(self._map.used),
        }

    def _update_with_scan(self, scan: PlacedScan) -> LidarReport:
        params = self._params
        reach = float(np.median(np.linalg.norm(scan.beams, axis=1)))
        self._last_height = reach
        self._calibrate_by(params.scan_calibration_gain * (reach >= params.calibrate_above_m))
        if not params.use_lidar:
            return LidarReport(matched=0, rms_m=0.0, lateral_strength=np.zeros(3))
        # the footprint is about 1.75 x 0.5 of the height: so many even cells cover it
        cell = np.sqrt(1.75 * 0.5 / params.scan_points) * reach
        chosen = thin_out(scan.points, float(cell), 15)[: 2 * params.scan_points]
        return update_with_scan(
            self._eskf, self._map, self._anchors, scan.select(chosen),
            self._photometric.errors_of_planes(self._scan_errors, self._dark_ticks),
        )  # fmt: skip

    @property
    def _dark_ticks(self) -> int:
        """Time since an image last measured the pose."""
        return self._eskf.state.tick - self._vision_tick

    def _extend_map(self, points: Array, lidar_position: Array, tick: int) -> None:
        """Adds (N, 3) points of the scan just used, IMU frame, to the map."""
        state = self._eskf.state
        if len(points) >= _FEWEST_RETURNS and self._lacks_anchor(tick):
            self._vision.add_anchor(self._eskf, self._last_height, tick)
        odom_points = points @ state.rotation.T + state.position
        sensor = state.rotation @ lidar_position + state.position
        terms = self._anchors.kept_from_now(self._eskf.clones, state.calibration, state.rotation)
        # close to the ground a scan would fill a voxel from one corner of it: spread its points
        spread = thin_out(points, 0.12 * self._params.voxel_m, 16)
        self._map.insert(odom_points[spread], sensor, len(self._anchors) - 1, terms)
        self._recent.add(odom_points)

    def _lacks_anchor(self, tick: int) -> bool:
        """True if the map would grow far from the newest clone, as it does where images fail."""
        if not self._eskf.clones:
            return True
        if tick - self._vision_tick <= self._rig.tick_hz // 2:
            return False
        gap = np.linalg.norm(self._eskf.state.position - self._eskf.clones[-1].translation)
        return float(gap) > _ANCHOR_REACH * max(self._last_height, 2.0)

    def _follow_clones(self, gone: int | None) -> None:
        """Keeps the map's anchors in step with the filter's clones."""
        eskf = self._eskf
        self._photometric.follow(gone, eskf, self._last_height, self._dark_ticks)
        if gone is None:
            self._anchors.add(eskf.clones[-1], eskf.state.calibration)
            return
        successor, move = self._anchors.reassignment(gone, eskf.clones)
        self._map.reassign(gone, successor, move)
        self._anchors.remove(gone)

    def _take_image(self, image: CameraImage) -> None:
        levels = grey_levels(self._undistort(image.rgb))
        delay_s = image.time_s - self._eskf.state.tick / self._rig.tick_hz
        self._vision.measure_open_keyframes(self._eskf, self._recent, image.tick)
        self._calibrate_by(self._params.image_calibration_gain)
        report = self._vision.update(self._eskf, levels, delay_s)
        if report.used:
            self._vision_tick = image.tick
            self._correct_history()
        elif self._vision.keyframes:
            self._diagnostics["skipped"] += 1.0
        if self._vision.wants_keyframe(report, image.tick):
            # old returns lie at one side of the image, and may be on a roof there
            fresh = image.tick - self._scan_tick <= _FRESH_SCANS * self._rig.lidar_scan_ticks
            self._vision.add_keyframe(
                self._eskf, levels, self._recent, image.tick, delay_s=delay_s, extend=fresh
            )
        self._diagnostics |= visual_diagnostics(report, len(self._vision.keyframes))
        self._diagnostics |= calibration_diagnostics(self._eskf.state.calibration)

    def _calibrate_by(self, gain: float) -> None:
        """Sets the share of the next measurement's correction that mounts and lens take; the
        camera's clock, which no other error resembles, and the errors of the IMU take all."""
        gains = self._eskf.calibration_gain
        gains[:] = gain
        gains[CLOCK : CLOCK + 1] = 1.0
        gains[SHARED_DIM:] = 1.0

    def _track_over(self, first: int) -> PoseTrack:
        imu_from_body = self._imu_from_body
        rotations = self._history_rotations[first:] @ imu_from_body.rotation
        positions = self._history_positions[first:] + (
            self._history_rotations[first:] @ imu_from_body.translation
        )
        return PoseTrack(
            times_s=self._history_ticks[first:] / self._rig.tick_hz,
            positions_odom=positions,
            quats_wxyz=np.array([quat_wxyz_from_matrix(r) for r in rotations]),
        )

    # ------------------------------------------------------------------------ the estimate

    def _propagate_to_now(self) -> None:
        """Propagates the corrected filter to the present; the jump is kept as an offset that
        decays."""
        old = self._propagated
        ticks, gyro, force, _ = self._buffer.samples(self._buffer.count)
        self._propagated = propagate_nominal(
            self._eskf.state, ticks, gyro, force, self._buffer.step_s
        )
        self._propagated_covariance = self._covariance_of_now(gyro, force)
        shown = old.rotation @ so3_exp(self._offset[:3])
        self._offset = np.concatenate(
            [
                so3_log(self._propagated.rotation.T @ shown),
                old.position + self._offset[3:6] - self._propagated.position,
                old.velocity + self._offset[6:9] - self._propagated.velocity,
            ]
        )

    def _covariance_of_now(self, gyro: Array, force: Array) -> Array:
        """(15, 15) of the propagated state."""
        state, step_s = self._eskf.state, self._buffer.step_s
        covariance = self._eskf.covariance[:STATE_DIM, :STATE_DIM]
        if len(gyro) == 0:
            return covariance.copy()
        gyro, force = state.corrected(gyro, force)
        rotations, _, _ = integrate(
            state.rotation, state.position, state.velocity, gyro, force, step_s, GRAVITY_MPS2
        )
        total, noise, _ = transition(rotations, gyro, force, step_s, self._buffer.densities)
        return np.asarray(total @ covariance @ total.T + noise)

    def _estimate(self, obs: Observation) -> Estimate:
        propagated = self._propagated
        self._offset = self._offset * np.exp(-self._buffer.step_s / self._params.correction_time_s)
        rotation = propagated.rotation @ so3_exp(self._offset[:3])
        rate_imu = self._gyro - propagated.gyro_bias
        pose = Pose(rotation, propagated.position + self._offset[3:6]) @ self._imu_from_body
        lever = cross(rate_imu, self._imu_from_body.translation)
        acceleration = rotation @ (self._force - propagated.accel_bias) - _GRAVITY
        cov = self._propagated_covariance
        # the reported pose differs from the best estimate by the decaying offset
        shown = _INFLATION * cov[3:6, 3:6] + np.diag(self._floor)
        shown += np.outer(self._offset[3:6], self._offset[3:6])
        body_from_imu = self._rig.body_from_imu.rotation
        return Estimate(
            tick=obs.tick,
            time_s=obs.time_s,
            odom_from_body=pose,
            world_from_odom=Pose.identity(),
            velocity_odom=propagated.velocity + self._offset[6:9] + rotation @ lever,
            angular_velocity_body=body_from_imu @ rate_imu,
            acceleration_odom=acceleration,
            position_covariance=shown,
            rotation_covariance=body_from_imu @ cov[:3, :3] @ body_from_imu.T,
            healthy=bool(np.trace(shown) < 1.0),
            scan_track=self._scan_track,
            diagnostics=dict(self._diagnostics),
            events=tuple(self._events),
        )
