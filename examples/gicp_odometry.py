"""An estimator: LIDAR-inertial odometry, scans registered to a map by small_gicp.

touchdown fly crossroad --preset short --estimator examples.gicp_odometry:build

A Kalman filter integrates the IMU. Each scan is straightened by the poses since integrated and
registered to the map of the scans before it (GICP); the pose found corrects the state at the
scan's end, and the IMU samples since then are integrated anew. Images are not used.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np
import small_gicp
from scipy.spatial.transform import Rotation, Slerp

from touchdown.estimator.api import Estimate
from touchdown.sim.api import (
    GRAVITY_MPS2,
    ImuSample,
    LidarScan,
    Observation,
    SensorNeeds,
    SensorRig,
)
from touchdown.sim.frames import Pose, skew, so3_exp, so3_log

GRAVITY = np.array([0.0, 0.0, GRAVITY_MPS2])
P, V, R, BG, BA = (slice(3 * i, 3 * i + 3) for i in range(5))
"""Errors of the state: position, velocity (odom), rotation (body), biases of gyroscope and
accelerometer (body)."""


@dataclass(frozen=True)
class State:
    tick: int
    pose: Pose
    velocity: np.ndarray
    gyro_bias: np.ndarray
    accel_bias: np.ndarray
    covariance: np.ndarray  # (15, 15)
    rates: np.ndarray
    acceleration: np.ndarray


class GicpOdometry:
    def __init__(self, params: dict, rig: SensorRig) -> None:
        self.needs, self.rig = SensorNeeds(lidar=True), rig
        self.sampling_m = params.get("sampling_m", 0.5)  # of a scan
        self.map_m = params.get("map_m", 0.25)
        self.reach_m = params.get("reach_m", 1.0)
        self.keyframe_m = params.get("keyframe_m", 1.0)
        # Neighbouring returns share errors, so that a scan tells less than its number of points.
        self.weight = params.get("weight", 0.02)
        # Odometry drifts with the way flown: no scan sees the take-off again.
        self.drift = params.get("drift", 0.02)
        tilt = max(rig.start_tilt_sigma_rad, 2e-3)
        sigmas = np.repeat([0.01, 0.02, tilt, 1e-3, 2e-2], 3)
        zero = np.zeros(3)
        start = rig.world_from_body_start
        self.state = State(0, start, zero, zero, zero, np.diag(sigmas**2), zero, zero)
        self.past: deque[tuple[ImuSample | None, State]] = deque([(None, self.state)], maxlen=300)
        self.points = np.zeros((0, 3))  # of the map, odom frame
        self.map: tuple[small_gicp.PointCloud, small_gicp.KdTree] | None = None
        self.airborne, self.rest, self.way_m = False, 0, 0.0
        self.inliers, self.kept = 0, start.translation

    def update(self, obs: Observation) -> Estimate:
        vehicle = self.rig.vehicle
        speed = obs.rotor_speed_radps
        thrust = vehicle.thrust_coefficient * float(speed @ speed)
        self.airborne |= thrust > 0.85 * vehicle.mass_kg * GRAVITY_MPS2
        for sample in obs.imu:
            before = self.state.pose.translation
            advance = self._integrated if self.airborne else self._resting
            self.state = advance(self.state, sample)
            self.past.append((sample, self.state))
            self.way_m += float(np.linalg.norm(self.state.pose.translation - before))
        for scan in obs.scans:
            if self.airborne:
                self._register(scan)
        state = self.state
        drift = (self.drift * self.way_m) ** 2
        position = state.covariance[P, P] + drift * np.eye(3)
        return Estimate(
            tick=obs.tick,
            time_s=obs.time_s,
            odom_from_body=state.pose,
            world_from_odom=Pose.identity(),
            velocity_odom=state.velocity,
            angular_velocity_body=state.rates,
            acceleration_odom=state.acceleration,
            position_covariance=0.5 * (position + position.T),
            rotation_covariance=0.5 * (state.covariance[R, R] + state.covariance[R, R].T),
            healthy=bool(np.trace(position) < 4.0),
            diagnostics={"inliers": float(self.inliers)},
        )

    def _resting(self, state: State, sample: ImuSample) -> State:
        """On the ground the mean IMU output beside gravity is its bias."""
        self.rest += 1
        rotation = self.rig.body_from_imu.rotation
        rates = rotation @ sample.angular_velocity
        force = rotation @ sample.specific_force - state.pose.rotation.T @ GRAVITY
        gyro = state.gyro_bias + (rates - state.gyro_bias) / self.rest
        accel = state.accel_bias + (force - state.accel_bias) / self.rest
        zero = np.zeros(3)
        return State(sample.tick, state.pose, zero, gyro, accel, state.covariance, zero, zero)

    def _integrated(self, state: State, sample: ImuSample) -> State:
        step_s = (sample.tick - state.tick) / self.rig.tick_hz
        mount = self.rig.body_from_imu.rotation
        rates = mount @ sample.angular_velocity - state.gyro_bias
        force = mount @ sample.specific_force - state.accel_bias
        before = state.pose.rotation
        rotation = before @ so3_exp(rates * step_s)
        acceleration = 0.5 * (before + rotation) @ force - GRAVITY
        velocity = state.velocity + acceleration * step_s
        position = state.pose.translation + 0.5 * (state.velocity + velocity) * step_s
        change = np.eye(15)
        change[P, V] = step_s * np.eye(3)
        change[V, R] = -step_s * before @ skew(force)
        change[V, BA] = -step_s * before
        change[R, R] = so3_exp(-rates * step_s)
        change[R, BG] = -step_s * np.eye(3)
        # The densities of the data sheet are those of the bench: in flight the frame vibrates.
        sheet = self.rig.imu
        densities = [0.0, 10 * sheet.accel_density, 10 * sheet.gyro_density,
                     sheet.gyro_bias_walk, sheet.accel_bias_walk]  # fmt: skip
        noise = np.diag(np.repeat(np.square(densities), 3)) * step_s
        covariance = change @ state.covariance @ change.T + noise
        return State(
            sample.tick, Pose(rotation, position), velocity, state.gyro_bias, state.accel_bias,
            covariance, rates, acceleration,
        )  # fmt: skip

    def _register(self, scan: LidarScan) -> None:
        at = next((i for i, (_, s) in enumerate(self.past) if s.tick >= scan.end_tick), None)
        back = scan.ranges > 1.0
        if at is None or self.past[0][1].tick > scan.start_tick or back.sum() < 200:
            return
        state = self.past[at][1]
        points = self._straightened(scan, back, state)
        cloud, _ = small_gicp.preprocess_points(points, self.sampling_m)
        if cloud.size() < 50:  # so low that a scan covers a few metres only
            return
        if self.map is not None:
            found = small_gicp.align(
                self.map[0],
                cloud,
                self.map[1],
                state.pose.matrix(),
                max_correspondence_distance=self.reach_m,
            )
            self.inliers = found.num_inliers
            if not found.converged or found.num_inliers < 0.3 * cloud.size():
                return
            state = self._corrected(state, found)
            self._replay_from(at, state)
        self._keep(points, state)

    def _keep(self, points: np.ndarray, state: State) -> None:
        """Adds a scan where the vehicle has moved on: scans from one place would be matched with
        each other, and drag the pose along."""
        here = state.pose.translation
        if self.map is not None and np.linalg.norm(here - self.kept) < self.keyframe_m:
            return
        self.kept = here
        points = np.vstack([self.points, state.pose.apply(points)])
        near = np.linalg.norm(points - here, axis=1) < 60.0  # bounds the map
        cloud, tree = small_gicp.preprocess_points(points[near], self.map_m)
        self.points, self.map = cloud.points()[:, :3].copy(), (cloud, tree)

    def _straightened(self, scan: LidarScan, back: np.ndarray, state: State) -> np.ndarray:
        """Returns as seen from the body at ``state``."""
        states = [s for _, s in self.past]
        ticks = np.array([s.tick for s in states], dtype=float)
        when = (scan.start_time_s + scan.time_offsets[back]) * self.rig.tick_hz
        when = np.clip(when, ticks[0], ticks[-1])
        turns = Slerp(ticks, Rotation.from_matrix([s.pose.rotation for s in states]))(when)
        places = np.array([s.pose.translation for s in states])
        place = np.stack([np.interp(when, ticks, places[:, axis]) for axis in range(3)], axis=1)
        in_body = self.rig.body_from_lidar.apply(scan.points[back].astype(np.float64))
        return state.pose.inverse().apply(turns.apply(in_body) + place)

    def _corrected(self, state: State, found: small_gicp.RegistrationResult) -> State:
        """Kalman update with the registered pose. Its information is the Hessian: small along what
        the ground does not show."""
        pose = np.asarray(found.T_target_source)
        rotation = state.pose.rotation
        wrong = np.concatenate([
            so3_log(rotation.T @ pose[:3, :3]),
            rotation.T @ (pose[:3, 3] - state.pose.translation),
        ])  # fmt: skip
        seen = np.zeros((6, 15))
        seen[:3, R], seen[3:, P] = np.eye(3), rotation.T
        floor = np.diag(np.repeat([1e-3, 0.01], 3) ** 2)  # of the map itself: rad, m
        noise = np.linalg.inv(self.weight * np.asarray(found.H) + 1e-3 * np.eye(6)) + floor
        crossed = state.covariance @ seen.T
        gain = crossed @ np.linalg.inv(seen @ crossed + noise)
        step, kept = gain @ wrong, np.eye(15) - gain @ seen
        covariance = kept @ state.covariance @ kept.T + gain @ noise @ gain.T
        corrected = Pose(rotation @ so3_exp(step[R]), state.pose.translation + step[P])
        return State(
            state.tick, corrected, state.velocity + step[V], state.gyro_bias + step[BG],
            state.accel_bias + step[BA], covariance, state.rates, state.acceleration,
        )  # fmt: skip

    def _replay_from(self, at: int, state: State) -> None:
        """Integrates the samples since ``state`` again."""
        later = list(self.past)[at + 1 :]
        for _ in range(len(later) + 1):
            sample_of_state = self.past.pop()[0]
        self.past.append((sample_of_state, state))
        for sample, _ in later:
            state = self._integrated(state, sample)
            self.past.append((sample, state))
        self.state = state


def build(params: dict, rig: SensorRig) -> GicpOdometry:
    return GicpOdometry(params, rig)
