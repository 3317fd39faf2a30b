"""Loosely coupled error-state filter on the IMU, of the paper's estimator and the baselines.

The paper's vehicle had an IMU in its flight controller; the paper does not state how poses of 10 Hz
became control at 200 Hz. Here they are measurements of a filter, whose state is propagated over the
IMU samples to the present.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.api import Estimate, PoseTrack
from touchdown.estimator.filtering.deskew import PlacedScan, place_scan, screen_scan
from touchdown.estimator.filtering.eskf import Eskf
from touchdown.estimator.filtering.gravity_alignment import align_with_gravity
from touchdown.estimator.filtering.imu_propagation import (
    ImuBuffer,
    NavState,
    propagate_nominal,
)
from touchdown.estimator.filtering.rolling_shutter import CameraTwist
from touchdown.estimator.filtering.zero_velocity import ZeroVelocityUpdate
from touchdown.sim.api import (
    GRAVITY_MPS2,
    CameraImage,
    ImuParams,
    ImuSample,
    LidarScan,
    Observation,
    SensorRig,
)
from touchdown.sim.frames import (
    Pose,
    cross,
    quat_wxyz_from_matrix,
    so3_exp,
    so3_log,
)

Array = NDArray[np.float64]

_START_SIGMAS = np.repeat([2e-4, 2e-3, 5e-3], 3)
"""rad, m, m/s: the take-off pose is known, but the legs settle"""
_LEVEL_SIGMA = 5e-3
"""m/s^2, of the mean specific force at rest, beside the accelerometer's bias"""
_TRAIL_STEPS = 128
_LIFTING_THRUST = 0.85
"""of the weight: with less static thrust before the first lift-off the vehicle is on the ground"""
_IDLE_MARGIN = 1.2


@dataclass(slots=True)
class _Trail:
    """Filter poses at the last IMU ticks, odom_from_imu."""

    ticks: NDArray[np.int64]
    rotations: Array
    positions: Array

    def extend(self, ticks: Array, rotations: Array, positions: Array) -> None:
        whole = ticks.astype(np.int64)
        self.ticks = np.concatenate([self.ticks, whole])[-_TRAIL_STEPS:]
        self.rotations = np.concatenate([self.rotations, rotations])[-_TRAIL_STEPS:]
        self.positions = np.concatenate([self.positions, positions])[-_TRAIL_STEPS:]

    def follow(self, state: NavState) -> None:
        """Moves the whole trail rigidly so that it ends at the filter's state."""
        rotation = state.rotation @ self.rotations[-1].T
        self.positions = (self.positions - self.positions[-1]) @ rotation.T + state.position
        self.rotations = rotation @ self.rotations

    def start_of(self, scan: LidarScan) -> int | None:
        """Returns the index of the pose at the scan's start, if the trail spans the scan
        exactly."""
        first = int(np.searchsorted(self.ticks, scan.start_tick))
        spans = first + 1 < len(self.ticks) and self.ticks[first] == scan.start_tick
        return first if spans and self.ticks[-1] == scan.end_tick else None


def bias_sigmas(imu: ImuParams) -> Array:
    """(6,) rad/s and m/s^2: errors of gyroscope and accelerometer that stay in level flight as they
    are: turn-on biases, and gravity along misaligned and wrongly scaled axes."""
    bend, scale = math.radians(imu.misalignment_sigma_deg), imu.scale_sigma
    gyro = math.hypot(imu.gyro_bias_sigma, GRAVITY_MPS2 * imu.gyro_g_sensitivity)
    across = math.hypot(imu.accel_bias_sigma, GRAVITY_MPS2 * bend)
    along = math.hypot(imu.accel_bias_sigma, GRAVITY_MPS2 * scale)
    return np.array([gyro, gyro, gyro, across, across, along])


class InertialFilter:
    """An error-state filter at measurement time, its recent poses (trail), and the state propagated
    to the present."""

    def __init__(
        self, rig: SensorRig, correction_time_s: float, attitude_known: bool = True
    ) -> None:
        self.rig = rig
        self.imu_from_body = rig.body_from_imu.inverse()
        self.imu_from_lidar = self.imu_from_body @ rig.body_from_lidar
        self.imu_from_camera = self.imu_from_body @ rig.body_from_camera
        self.step_s = rig.imu_ticks / rig.tick_hz
        self._correction_time_s = correction_time_s
        start = rig.world_from_body_start @ rig.body_from_imu
        zero = np.zeros(3)
        state = NavState(0, start.rotation, start.translation, zero, zero, zero)
        self._unlevelled = attitude_known and rig.start_tilt_sigma_rad > 0.0
        sigmas = np.concatenate([_START_SIGMAS, bias_sigmas(rig.imu)])
        if self._unlevelled:
            sigmas[:2] = np.hypot(sigmas[:2], rig.start_tilt_sigma_rad)
        self.eskf = Eskf(state, sigmas**2)
        self._buffer = ImuBuffer(rig.imu, self.step_s)
        self._zero_velocity = ZeroVelocityUpdate(
            rig.imu.gyro_density, self.step_s, attitude_known and not self._unlevelled
        )
        self._propagated = state
        self._trail = _Trail(np.zeros(1, np.int64), state.rotation[None], state.position[None])
        self._newest = ImuSample(tick=0, time_s=0.0, angular_velocity=zero, specific_force=zero)
        self._jump = np.zeros(9)
        self._airborne_once = False
        self.stationary = False

    @property
    def tick(self) -> int:
        """Tick of the filter's state, which is behind the newest IMU sample."""
        return self.eskf.state.tick

    @property
    def propagated_tick(self) -> int:
        """Tick of the newest IMU sample."""
        return self._propagated.tick

    # ------------------------------------------------------------------------ inertial samples

    def take_imu(self, obs: Observation) -> None:
        """Buffers the samples and propagates the present state over them."""
        stationary = self._is_stationary(obs.rotor_speed_radps)
        for sample in obs.imu:
            rate, force = sample.angular_velocity, sample.specific_force
            self._newest = sample
            self._buffer.push(sample.tick, rate, force, stationary)
            if self._unlevelled:
                self._propagated = replace(self._propagated, tick=sample.tick)
                continue
            ticks = np.array([sample.tick])
            self._propagated = propagate_nominal(
                self._propagated, ticks, rate[None], force[None], self.step_s
            )

    def _is_stationary(self, rotor_speed: Array) -> bool:
        vehicle = self.rig.vehicle
        thrust = vehicle.thrust_coefficient * float(np.sum(rotor_speed**2))
        if thrust > _LIFTING_THRUST * vehicle.mass_kg * GRAVITY_MPS2:
            self._airborne_once = True
        idle = float(rotor_speed.max()) <= _IDLE_MARGIN * vehicle.rotor_speed_min
        return idle or not self._airborne_once

    def carry_to(self, tick: int) -> None:
        """Propagates the filter over the buffered samples up to ``tick``."""
        count = self._buffer.until(tick)
        if count == 0:
            return
        if self._unlevelled:
            self._level()
        _, gyro, force, stationary = self._buffer.samples(count)
        ticks, rotations, positions = self.eskf.propagate(self._buffer, count)
        self._trail.extend(ticks[1:], rotations[1:], positions[1:])
        self.stationary = self._zero_velocity.update(self.eskf, gyro, force, stationary)
        self._buffer.drop(count)
        if self.stationary:
            self._trail.follow(self.eskf.state)

    def _level(self) -> None:
        """Finds roll and pitch from the samples so far, all taken at rest; the given heading stays.
        Sensors are late, so that a sixth of a second has passed before the first of them."""
        self._unlevelled = False
        _, _, force, _ = self._buffer.samples(self._buffer.count)
        spread = self.rig.imu.accel_density / np.sqrt(len(force) * self.step_s)
        align_with_gravity(self.eskf, force.mean(axis=0), _LEVEL_SIGMA + spread)
        # the start is that of the body, about which the IMU was rotated
        attitude = self.eskf.state.rotation @ self.imu_from_body.rotation
        lever = self.rig.body_from_imu.translation
        position = self.rig.world_from_body_start.translation + attitude @ lever
        state = self.eskf.state = replace(self.eskf.state, position=position)
        self._trail = _Trail(np.array([state.tick]), state.rotation[None], position[None])
        self._propagated = state

    # ------------------------------------------------------------------------ measurements

    def place_scan(self, scan: LidarScan) -> PlacedScan | None:
        """Returns the valid returns of a scan, deskewed to its end; None if the trail does not span
        the scan."""
        first = self._trail.start_of(scan)
        if first is None:
            return None
        pulses = screen_scan(scan, self.rig.lidar)
        rotations, positions = self._trail.rotations[first:], self._trail.positions[first:]
        return place_scan(scan, pulses, self.imu_from_lidar, rotations, positions, self.step_s)

    def _track(self, first: int) -> PoseTrack:
        trail, offset = self._trail, self.imu_from_body
        bodies = trail.rotations[first:] @ offset.rotation
        return PoseTrack(
            times_s=trail.ticks[first:] / self.rig.tick_hz,
            positions_odom=trail.positions[first:] + trail.rotations[first:] @ offset.translation,
            quats_wxyz=np.array([quat_wxyz_from_matrix(rotation) for rotation in bodies]),
        )

    def track_of(self, scan: LidarScan, earlier: PoseTrack | None = None) -> PoseTrack | None:
        """Returns the body's poses over a scan, after its corrections; from the start of the
        ``earlier`` track, if there is one."""
        first = self._trail.start_of(scan)
        if first is None:
            return earlier
        if earlier is not None:
            start = round(earlier.times_s[0] * self.rig.tick_hz)
            first = min(first, int(np.searchsorted(self._trail.ticks, start)))
        return self._track(first)

    def pose_at(self, tick: int) -> Pose:
        """odom_from_imu at ``tick``: of the trail, as far as it reaches."""
        trail = self._trail
        at = float(np.interp(tick, trail.ticks, np.arange(len(trail.ticks))))
        first = min(int(at), max(len(trail.ticks) - 2, 0))
        last = min(first + 1, len(trail.ticks) - 1)
        share = at - first
        rotation = so3_log(trail.rotations[first].T @ trail.rotations[last])
        translation = trail.positions[last] - trail.positions[first]
        return Pose(
            trail.rotations[first] @ so3_exp(share * rotation),
            trail.positions[first] + share * translation,
        )

    def camera_twist(self, image: CameraImage) -> CameraTwist:
        """Twist of the camera at the filter's time, and the delay of ``image`` after it."""
        state = self.eskf.state
        velocity = state.rotation.T @ state.velocity
        late_s = image.time_s - state.tick / self.rig.tick_hz
        return CameraTwist.of_imu(self.eskf.rate, velocity, self.imu_from_camera, late_s)

    def pose_information(self) -> Array:
        """(6, 6) inverse covariance of the present pose, all else marginalised."""
        covariance = self.eskf.covariance[:6, :6] + 1e-12 * np.eye(6)
        inverse = np.linalg.inv(covariance)
        symmetric: Array = 0.5 * (inverse + inverse.T)
        return symmetric

    def correct(self, pose: Pose, information: Array, vector: Array) -> None:
        """Updates the filter by a measured odom_from_imu with its information (6, 6); ``vector``
        (6,): the remaining gradient at ``pose`` (zero where a solver has converged)."""
        prior = self.eskf.state
        offset = np.concatenate(
            [so3_log(prior.rotation.T @ pose.rotation), pose.translation - prior.position]
        )
        touched = self.eskf.touched([])
        delta = self.eskf.correction(touched, information, vector + information @ offset)
        self.eskf.state, self.eskf.clones = self.eskf.boxplus(prior, self.eskf.clones, delta)
        self.eskf.update_covariance(touched, information)
        self._trail.follow(self.eskf.state)

    # ------------------------------------------------------------------------ output

    def catch_up(self) -> None:
        """Propagates the corrected state to the present; the resulting jump decays over
        ``correction_time_s``."""
        before = self._propagated
        ticks, gyro, force, _ = self._buffer.samples(self._buffer.count)
        after = propagate_nominal(self.eskf.state, ticks, gyro, force, self.step_s)
        handed_out = before.rotation @ so3_exp(self._jump[:3])
        rotation = so3_log(after.rotation.T @ handed_out)
        translation = before.position + self._jump[3:6] - after.position
        velocity = before.velocity + self._jump[6:] - after.velocity
        self._jump, self._propagated = np.concatenate([rotation, translation, velocity]), after

    def estimate(
        self,
        obs: Observation,
        world_from_odom: Pose,
        extra_covariance: Array,
        scan_track: PoseTrack | None,
        diagnostics: dict[str, float],
        events: tuple[str, ...] = (),
    ) -> Estimate:
        """Returns the estimate at the present. ``extra_covariance`` (3, 3) m^2 is added to the
        position's."""
        self._jump = self._jump * np.exp(-self.step_s / self._correction_time_s)
        propagated, offset = self._propagated, self.imu_from_body
        rotation = propagated.rotation @ so3_exp(self._jump[:3])
        rate = self._newest.angular_velocity - propagated.gyro_bias
        force = rotation @ (self._newest.specific_force - propagated.accel_bias)
        to_body = self.rig.body_from_imu.rotation
        covariance = self.eskf.covariance
        to_world = world_from_odom.rotation
        position_covariance = to_world @ covariance[3:6, 3:6] @ to_world.T + extra_covariance
        return Estimate(
            tick=obs.tick,
            time_s=obs.time_s,
            odom_from_body=Pose(rotation, propagated.position + self._jump[3:6]) @ offset,
            world_from_odom=world_from_odom,
            velocity_odom=propagated.velocity
            + self._jump[6:]
            + rotation @ cross(rate, offset.translation),
            angular_velocity_body=to_body @ rate,
            acceleration_odom=force - np.array([0.0, 0.0, GRAVITY_MPS2]),
            position_covariance=position_covariance,
            rotation_covariance=to_body @ covariance[:3, :3] @ to_body.T,
            healthy=bool(np.trace(position_covariance) < 1.0),
            scan_track=scan_track,
            diagnostics=diagnostics,
            events=events,
        )
