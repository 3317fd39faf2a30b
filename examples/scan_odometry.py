"""What `rko_lio_odometry.py` and `evalio_odometry.py` share: an odometry of scans, as an estimator.

The odometry says late, ten times a second, where the body was. An observer integrates the IMU to
the present and follows it with fixed gains. What its poses correct of the velocity within two
seconds is the slip: the accelerometer knows a change of velocity to tenths of a metre a second in
that time, and an odometry that slides over flat ground, or loses the map, contradicts it. The
slip's way is added to the reported error, and a slip of `lost_mps` means lost: from then on the IMU
alone is integrated and the estimate is unhealthy.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np

from touchdown.estimator.api import Estimate
from touchdown.sim.api import (
    GRAVITY_MPS2,
    ImuSample,
    LidarScan,
    Observation,
    SensorNeeds,
    SensorRig,
)
from touchdown.sim.frames import Pose, rotation_from_yaw, so3_exp, so3_log, yaw_from_rotation

GRAVITY = np.array([0.0, 0.0, GRAVITY_MPS2])
POSITION_GAIN, VELOCITY_GAIN, ROTATION_GAIN = 0.5, 0.1, 0.3
"""fractions of a pose's difference that correct position, velocity (over the time since the last
pose) and attitude"""
WINDOW_S, SILENT_S, LEAST_RETURNS = 2.0, 1.0, 100
TRUSTED_MPS = 0.3
"""slip that the accelerometer's errors explain"""
LOST_DEG = 10.0
"""by which poses turn against the gyroscope within the same time, and are lost"""
BIAS_GAIN, BIAS_MPS2 = 0.03, 0.3
"""fraction of a steady correction that becomes a bias of the accelerometer, and its bound: a tilt
of the odometry by a degree looks like 0.17 m/s^2"""
BLIND_MPS2 = 0.05
"""error of an acceleration once poses are not followed: bias and tilt"""


Sample = tuple[float, np.ndarray, np.ndarray]
"""time, s; angular velocity, rad/s; specific force, m/s^2"""


@dataclass(frozen=True)
class Seen:
    """``odom_from_level`` of the odometry at ``time_s``, in its own frame."""

    time_s: float
    pose: Pose


class ScanOdometry:
    """A part that derives from it builds its odometry in ``begin`` and feeds it in ``register``.

    Both use the level frame: fixed to the body, at its origin, level when the odometry begins. That
    is with the first scan above `start_m`, until when the IMU alone is integrated: low over the
    ground a scan shows little, and some odometries take their start for rest.
    """

    needs = SensorNeeds(lidar=True)

    def __init__(self, params: dict, rig: SensorRig) -> None:
        self.rig, self.step_s = rig, rig.imu_ticks / rig.tick_hz
        own = dict(params)
        self.lost_mps = own.pop("lost_mps", 1.5)
        self.drift = own.pop("drift", 0.005)  # of the way flown, assumed
        self.start_m = own.pop("start_m", 3.0)  # above the take-off spot
        self.settings = own
        self.pose, self.velocity = rig.world_from_body_start, np.zeros(3)
        self.rates = self.acceleration = np.zeros(3)
        self.rest: list[tuple[np.ndarray, np.ndarray]] = []
        self.gyro_bias = self.force_bias = np.zeros(3)  # at rest
        self.bias_since = np.zeros(3)
        self.airborne = self.begun = self.lost = False
        self.past: deque[tuple[float, Pose]] = deque(maxlen=100)
        self.waiting: deque[Sample] = deque(maxlen=400)
        self.slips: deque[tuple[float, np.ndarray, np.ndarray]] = deque()
        self.level_from_body = Pose.identity()
        self.world_from_odometry: Pose | None = None
        self.heard_s, self.way_m, self.slip_m, self.blind_s = 0.0, 0.0, 0.0, 0.0
        self.events: list[str] = []

    def begin(self, level_from_imu: Pose, level_from_lidar: Pose) -> None:
        """Builds the odometry anew; the IMU's axes are those of the level frame."""
        raise NotImplementedError

    def register(self, scan: LidarScan, samples: list[Sample]) -> Seen | None:
        """``samples``: those up to the scan's end, biases removed, level axes."""
        raise NotImplementedError

    def update(self, obs: Observation) -> Estimate:
        vehicle, speed, self.events = self.rig.vehicle, obs.rotor_speed_radps, []
        thrust = vehicle.thrust_coefficient * float(speed @ speed)
        if not self.airborne and thrust > 0.85 * vehicle.mass_kg * GRAVITY_MPS2 and self.rest:
            self.airborne = True
        for sample in obs.imu:
            self._integrate(sample)
        for scan in obs.scans:
            climbed = self.pose.translation - self.rig.world_from_body_start.translation
            if self.begun or climbed[2] > self.start_m:
                self._take(scan, obs.time_s)
        if self.begun and not self.lost and obs.time_s - self.heard_s > SILENT_S:
            self._lose(f"no pose for {SILENT_S:g} s")
        return self._estimate(obs)

    def _take(self, scan: LidarScan, now_s: float) -> None:
        if self.lost or int((scan.ranges > 0.0).sum()) < LEAST_RETURNS:
            return
        if not self.begun and (pose := self._at(scan.start_time_s)) is not None:
            level = rotation_from_yaw(yaw_from_rotation(pose.rotation)).T @ pose.rotation
            self.level_from_body = Pose(level, np.zeros(3))
            imu = self.level_from_body.apply(self.rig.body_from_imu.translation)
            self.begin(Pose(np.eye(3), imu), self.level_from_body @ self.rig.body_from_lidar)
            self.begun, self.heard_s = True, now_s
            early_s = scan.start_time_s - 0.05
            self.waiting = deque((s for s in self.waiting if s[0] > early_s), maxlen=400)
        turn, ready = self.level_from_body.rotation, []
        while self.waiting and self.waiting[0][0] <= scan.end_time_s + 1e-6:
            time_s, rates, force = self.waiting.popleft()
            ready.append((time_s, turn @ rates, turn @ force))
        if (seen := self.register(scan, ready)) is not None:
            self._follow(seen.pose @ self.level_from_body, seen.time_s, now_s)

    def _integrate(self, sample: ImuSample) -> None:
        """At rest the mean is the gyroscope's bias and shows what is up."""
        mount = self.rig.body_from_imu.rotation
        rates, force = mount @ sample.angular_velocity, mount @ sample.specific_force
        if not self.airborne:
            self.rest.append((rates, force))
            if len(self.rest) % 20 == 0:
                self._level()
        else:
            self.rates = rates - self.gyro_bias
            self.waiting.append((sample.time_s, self.rates, force - self.force_bias))
            rotation = self.pose.rotation @ so3_exp(self.rates * self.step_s)
            self.acceleration = rotation @ (force - self.force_bias - self.bias_since) - GRAVITY
            self.velocity = self.velocity + self.acceleration * self.step_s
            moved = self.velocity * self.step_s
            self.way_m += float(np.linalg.norm(moved))
            self.blind_s += self.step_s * (self.lost or not self.begun)
            self.pose = Pose(rotation, self.pose.translation + moved)
        self.past.append((sample.time_s, self.pose))

    def _level(self) -> None:
        rates, force = np.mean(self.rest, axis=0)
        up = force / np.linalg.norm(force)
        turn = np.cross(up, [0.0, 0.0, 1.0])
        level = so3_exp(turn * np.arcsin(np.linalg.norm(turn)) / max(np.linalg.norm(turn), 1e-9))
        start = self.rig.world_from_body_start
        self.pose = Pose(
            rotation_from_yaw(yaw_from_rotation(start.rotation)) @ level, start.translation
        )
        self.gyro_bias, self.force_bias = rates, force - up * GRAVITY_MPS2

    def _follow(self, pose: Pose, seen_s: float, now_s: float) -> None:
        then = self._at(seen_s)
        if then is None or not np.isfinite(pose.translation).all():
            return
        if self.world_from_odometry is None:
            turn = yaw_from_rotation(then.rotation) - yaw_from_rotation(pose.rotation)
            level = rotation_from_yaw(turn)
            self.world_from_odometry = Pose(level, then.translation - level @ pose.translation)
        pose = self.world_from_odometry @ pose
        wrong, since_s = pose.translation - then.translation, seen_s - self.heard_s
        turned = ROTATION_GAIN * so3_log(pose.rotation @ then.rotation.T)
        change = VELOCITY_GAIN * wrong / max(since_s, 0.05)
        self.heard_s = seen_s
        self.slips.append((seen_s, change, turned))
        while seen_s - self.slips[0][0] > WINDOW_S:
            self.slips.popleft()
        slip = np.sum([change for _, change, _ in self.slips], axis=0)
        turn = np.degrees(np.linalg.norm(np.sum([turn for *_, turn in self.slips], axis=0)))
        self.slip_m += max(float(np.linalg.norm(slip)) - TRUSTED_MPS, 0.0) * since_s
        if np.linalg.norm(slip) > self.lost_mps or turn > LOST_DEG:
            self.velocity = self.velocity - slip + change
            self.slip_m += float(np.linalg.norm(slip)) * WINDOW_S  # followed until now
            self._lose(f"poses slip by {np.linalg.norm(slip):.1f} m/s, turn by {turn:.0f} degrees")
            return
        shift = np.clip(POSITION_GAIN * wrong + change * (now_s - seen_s), -0.4, 0.4)
        rotate = so3_exp(turned)
        self.velocity = self.velocity + change
        bias = self.bias_since - BIAS_GAIN * self.pose.rotation.T @ change / max(since_s, 0.05)
        self.bias_since = np.clip(bias, -BIAS_MPS2, BIAS_MPS2)
        self.past = deque(
            ((at, Pose(rotate @ p.rotation, p.translation + shift)) for at, p in self.past),
            maxlen=self.past.maxlen,
        )
        self.pose = self.past[-1][1]

    def _at(self, time_s: float) -> Pose | None:
        return next((pose for at, pose in reversed(self.past) if at <= time_s + 1e-6), None)

    def _lose(self, why: str) -> None:
        self.lost = True
        self.events.append(f"odometry of scans lost: {why}")

    def _estimate(self, obs: Observation) -> Estimate:
        blind_m = 0.5 * BLIND_MPS2 * self.blind_s**2
        sigma = 0.05 + self.drift * self.way_m + self.slip_m + blind_m
        return Estimate(
            tick=obs.tick,
            time_s=obs.time_s,
            odom_from_body=self.pose,
            world_from_odom=Pose.identity(),
            velocity_odom=self.velocity,
            angular_velocity_body=self.rates,
            acceleration_odom=self.acceleration,
            position_covariance=sigma**2 * np.eye(3),
            rotation_covariance=1e-4 * np.eye(3),
            healthy=not self.lost and sigma < 3.0,
            diagnostics={"slip_m": self.slip_m},
            events=tuple(self.events),
        )
