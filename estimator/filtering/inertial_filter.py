"""The inertial core that every estimator stands on.

Scans, images and fixes arrive late. The error-state filter is at the time of measurement, where
they correct it; what is reported is that state propagated over the buffered IMU samples to the
present. (The paper's vehicle had an IMU in its flight controller; the paper does not state how its
poses of 10 Hz became control at 200 Hz.)

In this order: samples come in (``take_imu``), the filter is propagated to a measurement
(``carry_to``: levelling, propagation, zero velocity), the estimator corrects ``eskf``, and the
correction is brought to the present (``settle``) and reported (``estimate``).
"""

import math
from dataclasses import fields, replace
from typing import NamedTuple

import numpy as np
from numba import njit

from touchdown.estimator.api import Estimate, FlownImuParams, LivoParams, PoseTrack
from touchdown.estimator.filtering.camera_model import CameraTwist
from touchdown.estimator.filtering.deskew import (
    PlacedScan,
    ScanPath,
    Trail,
    place_scan,
    screen_scan,
)
from touchdown.estimator.filtering.error_state import (
    ACCEL_BIAS,
    GYRO_BIAS,
    NAVIGATION,
    POSE,
    POSE_DIM,
    POSITION,
    ROTATION,
    STATE_DIM,
    VELOCITY,
    Frame,
)
from touchdown.estimator.filtering.eskf import Eskf
from touchdown.estimator.filtering.imu_propagation import (
    ImuBuffer,
    NavState,
    exp_so3,
    propagate_nominal,
)
from touchdown.estimator.filtering.vectors import cross, turned_back, xyz
from touchdown.estimator.filtering.zero_velocity import (
    ZeroVelocityUpdate,
    align_with_gravity,
    judge_rest,
)
from touchdown.sim.api import (
    GRAVITY_MPS2,
    CameraImage,
    ImuSample,
    ImuSheet,
    LidarScan,
    Observation,
    SensorRig,
)
from touchdown.sim.frames import Pose, so3_exp, so3_log
from touchdown.sim.typing import Array

_GRAVITY: Array = np.array([0.0, 0.0, GRAVITY_MPS2])
_START_SIGMAS = np.repeat([2e-4, 2e-3, 5e-3], 3)
"""rad, m, m/s: the take-off pose is known, but the legs settle"""
_LEVEL_SIGMA = 5e-3
"""m/s^2, of the mean specific force at rest, beside the accelerometer's bias"""
_LIFTING_THRUST = 0.85
"""fraction of the weight: with less static thrust before the first lift-off the vehicle is on the
ground"""
CORRECTION_TIME_S = 0.15
"""time constant with which a correction of the filter reaches control"""
_REST_SAMPLES = 20
"""at rest, from which on their noise is known to a tenth"""
_IDLE_MARGIN = 1.2
"""multiple of the idle speed: below it the rotors give no lift"""


def with_flown_noise(rig: SensorRig, params: FlownImuParams | LivoParams) -> SensorRig:
    """The rig with the IMU's noise as it is on the flying vehicle, whose rotors shake it: the
    larger of that of the data sheet and ``params``."""
    larger = {
        field.name: max(getattr(rig.imu, field.name), getattr(params, field.name))
        for field in fields(FlownImuParams)
    }
    return replace(rig, imu=replace(rig.imu, **larger))


def bias_sigmas(imu: ImuSheet, *, estimated: bool = False) -> Array:
    """(6,) rad/s and m/s^2: errors of gyroscope and accelerometer that stay in level flight as they
    are: turn-on biases, and gravity along misaligned and wrongly scaled axes. Where such errors are
    ``estimated``, the turn-on biases alone: the accelerometer's misalignment, which is not among
    them, did not make replays better."""
    if estimated:
        return np.repeat([imu.gyro_bias_sigma, imu.accel_bias_sigma], 3)
    bend, scale = math.radians(imu.misalignment_sigma_deg), imu.scale_sigma
    gyro = math.hypot(imu.gyro_bias_sigma, GRAVITY_MPS2 * imu.gyro_g_sensitivity)
    across = math.hypot(imu.accel_bias_sigma, GRAVITY_MPS2 * bend)
    along = math.hypot(imu.accel_bias_sigma, GRAVITY_MPS2 * scale)
    return np.array([gyro, gyro, gyro, across, across, along])


class InertialFilter:
    """An error-state filter at measurement time, its recent poses (``trail``), and state and
    covariance propagated to the present.

    ``attitude_known`` False: the heading alone is known. ``flown``: noise of the IMU in flight,
    that of the rig by default. ``calibration_sigmas`` (C,): priors of the calibration's errors, if
    they are estimated.
    """

    def __init__(
        self,
        rig: SensorRig,
        attitude_known: bool = True,
        *,
        flown: ImuSheet | None = None,
        calibration_sigmas: Array | None = None,
    ) -> None:
        self.rig = rig
        self.imu_from_body = rig.body_from_imu.inverse()
        self.imu_from_lidar = self.imu_from_body @ rig.body_from_lidar
        self.imu_from_camera = self.imu_from_body @ rig.body_from_camera
        self.step_s = rig.imu_ticks / rig.tick_hz
        start = rig.world_from_body_start @ rig.body_from_imu
        zero, own = np.zeros(3), np.zeros(0) if calibration_sigmas is None else calibration_sigmas
        speed = rig.start_velocity_mps
        state = NavState(
            0, start.rotation, start.translation, speed, zero, zero, np.zeros(len(own))
        )  # fmt: skip
        self._unlevelled = attitude_known and rig.start_tilt_sigma_rad > 0.0
        biases = bias_sigmas(rig.imu, estimated=len(own) > 0)
        sigmas = np.concatenate([_START_SIGMAS, biases, own])
        if self._unlevelled:
            sigmas[:2] = np.hypot(sigmas[:2], rig.start_tilt_sigma_rad)
        if rig.start_velocity_sigma_mps > 0.0:
            sigmas[VELOCITY] = np.hypot(sigmas[VELOCITY], rig.start_velocity_sigma_mps)
        self.eskf = Eskf(state, sigmas**2)
        self.trail = Trail(state)
        self.stationary = False
        self._buffer = ImuBuffer(flown or rig.imu, self.step_s)
        self._zero_velocity = ZeroVelocityUpdate(
            rig.imu.gyro_density, self.step_s, attitude_known and not self._unlevelled
        )
        self._propagated = state
        self.covariance = self.eskf.covariance[NAVIGATION, NAVIGATION].copy()
        """(15, 15) of the state at the present"""
        self.jump = np.zeros(STATE_DIM)
        """what is reported less the present state: rotation, position, velocity"""
        self._newest = ImuSample(tick=0, time_s=0.0, angular_velocity=zero, specific_force=zero)
        self._lifted = False
        self._stopped, self._judged = True, False
        """the rotors have not turned yet; samples at rest were looked at"""

    @property
    def tick(self) -> int:
        """Tick of the filter's state, which is behind the newest IMU sample."""
        return self.eskf.state.tick

    @property
    def present(self) -> NavState:
        """The state at the newest IMU sample."""
        return self._propagated

    # ------------------------------------------------------------------------ propagation

    def take_imu(self, obs: Observation) -> None:
        """Buffers the samples and propagates the present state over them."""
        stationary = self.is_stationary(obs.rotor_speed_radps)
        self._stopped = self._stopped and not obs.rotor_speed_radps.any()
        for sample in obs.imu:
            rate, force = sample.angular_velocity, sample.specific_force
            self._newest = sample
            self._buffer.push(sample.tick, rate, force, stationary)
            if self._unlevelled and stationary:
                self._propagated = replace(self._propagated, tick=sample.tick)
                continue
            ticks = np.array([sample.tick])
            self._propagated = propagate_nominal(
                self._propagated, ticks, rate[None], force[None], self.step_s
            ).end

    def is_stationary(self, rotor_speed: Array) -> bool:
        """True if the rotor speeds imply that the vehicle stands on the ground. A descending
        vehicle needs less speed than its static thrust suggests, so that after the first lift-off
        only idling rotors count."""
        vehicle = self.rig.vehicle
        thrust = vehicle.thrust_coefficient * float(rotor_speed @ rotor_speed)
        self._lifted |= thrust > _LIFTING_THRUST * vehicle.mass_kg * GRAVITY_MPS2
        idle = float(rotor_speed.max()) <= _IDLE_MARGIN * vehicle.rotor_speed_min
        return idle or not self._lifted

    def carry_to(self, tick: int) -> None:
        """Propagates the filter over the buffered samples up to ``tick``."""
        count = self._buffer.until(tick)
        if count == 0:
            return
        if not self._judged:
            self._judge_sheet()
        if self._unlevelled:
            self._level()
        _, gyro, force, stationary = self._buffer.samples(count)
        ticks, rotations, positions = self.eskf.propagate(self._buffer, count)
        self.trail.extend(ticks[1:], rotations[1:], positions[1:])
        self.stationary = self._zero_velocity.update(self.eskf, gyro, force, stationary)
        self._buffer.drop(count)
        if self.stationary:
            self.trail.follow(self.eskf.state)

    def _judge_sheet(self) -> None:
        """Widens biases and noise where the samples before the rotors turned are against the data
        sheet."""
        self._judged = True
        _, gyro, force, _ = self._buffer.samples(self._buffer.count)
        if not self._stopped or len(gyro) < _REST_SAMPLES:
            return
        judged = judge_rest(gyro, force, bias_sigmas(self.rig.imu), self.rig.imu, self.step_s)
        biases = np.r_[GYRO_BIAS, ACCEL_BIAS]
        self.eskf.covariance[biases, biases] *= judged.bias_factor**2
        self._buffer.expect(judged.gyro_density, judged.accel_density)
        self._zero_velocity.expect(judged)

    def _level(self) -> None:
        """Finds roll and pitch from the samples so far, if all were taken at rest; the given
        heading stays. Sensors are late, so that a sixth of a second has passed before the first of
        them."""
        _, _, force, stationary = self._buffer.samples(self._buffer.count)
        if not stationary.all():
            return
        self._unlevelled = False
        spread = self.rig.imu.accel_density / np.sqrt(len(force) * self.step_s)
        align_with_gravity(self.eskf, force.mean(axis=0), _LEVEL_SIGMA + spread)
        # the start is that of the body, about which the IMU was rotated
        attitude = self.eskf.state.rotation @ self.imu_from_body.rotation
        lever = self.rig.body_from_imu.translation
        position = self.rig.world_from_body_start.translation + attitude @ lever
        self.eskf.state = replace(self.eskf.state, position=position)
        self.trail = Trail(self.eskf.state)
        self._propagated = replace(self.eskf.state, tick=self._propagated.tick)

    # ------------------------------------------------------------------------ measurements

    def place_scan(
        self, scan: LidarScan, imu_from_lidar: Pose | None = None, *, check_blind_zone: bool = False
    ) -> PlacedScan | None:
        """Returns the valid returns of a scan, deskewed to the filter's time, which is that of the
        last IMU sample at or before the scan's end; None if the trail does not span the scan.
        ``imu_from_lidar``: the given mount by default; ``check_blind_zone``: see
        ``screen_scan``."""
        trail = self._trail_over(scan)
        first = trail.start_of(scan, self.rig.imu_ticks)
        if first is None:
            return None
        pulses = screen_scan(scan, self.rig.lidar, check_blind_zone=check_blind_zone)
        mount = self.imu_from_lidar if imu_from_lidar is None else imu_from_lidar
        ticks = trail.ticks[first:]
        late_s = scan.start_time_s - float(ticks[0]) / self.rig.tick_hz
        times = self.step_s * ((ticks - ticks[0]) / self.rig.imu_ticks) - late_s
        now = int(np.searchsorted(ticks, self.tick))
        path = ScanPath(times, trail.rotations[first:], trail.positions[first:], now)
        return place_scan(scan, pulses, mount, path)

    def _trail_over(self, scan: LidarScan) -> Trail:
        """The trail to the scan's end: where that lies between two IMU samples, to the second, or
        on at the present twist if that has not come."""
        state = self.eskf.state
        if scan.end_tick <= state.tick:
            return self.trail
        if self._buffer.count:
            ticks, gyro, force, _ = self._buffer.samples(1)
            following = propagate_nominal(state, ticks, gyro, force, self.step_s).end
            return self.trail.reaching(following)
        turn = so3_exp(self.step_s * self.eskf.rate)
        position = state.position + self.step_s * state.velocity
        tick, rotation = state.tick + self.rig.imu_ticks, state.rotation @ turn
        return self.trail.reaching(replace(state, tick=tick, rotation=rotation, position=position))

    def track_of(self, scan: LidarScan, earlier: PoseTrack | None = None) -> PoseTrack | None:
        """Returns the body's poses over a scan, after its corrections; from the start of the
        ``earlier`` track, if there is one."""
        trail = self._trail_over(scan)
        first = trail.start_of(scan, self.rig.imu_ticks)
        if first is None:
            return earlier
        if earlier is not None:
            start = round(earlier.times_s[0] * self.rig.tick_hz)
            first = min(first, int(np.searchsorted(trail.ticks, start)))
        return trail.track(first, self.imu_from_body, self.rig.tick_hz)

    def camera_twist(self, image: CameraImage) -> CameraTwist:
        """Twist of the camera at the filter's time, and the delay of ``image`` after it."""
        state = self.eskf.state
        velocity = state.rotation.T @ state.velocity
        late_s = image.time_s - state.tick / self.rig.tick_hz
        return CameraTwist.of_imu(self.eskf.rate, velocity, self.imu_from_camera, late_s)

    def pose_information(self) -> Array:
        """(6, 6) inverse covariance of the present pose, all else marginalised."""
        covariance = self.eskf.covariance[POSE, POSE] + 1e-12 * np.eye(POSE_DIM)
        inverse = np.linalg.inv(covariance)
        return 0.5 * (inverse + inverse.T)

    # ------------------------------------------------------------------------ output

    def settle(self, changed: bool) -> None:
        """Ends the processing of an observation: brings what has ``changed`` to the present, and
        lets the jump decay."""
        if changed:
            self.catch_up()
        self.jump = self.jump * math.exp(-self.step_s / CORRECTION_TIME_S)

    def catch_up(self) -> None:
        """Propagates the corrected state to the present; the resulting jump decays over
        ``CORRECTION_TIME_S``."""
        before, jump = self._propagated, self.jump.copy()
        after, self.covariance = self.eskf.predicted(self._buffer)
        handed_out = before.rotation @ so3_exp(jump[ROTATION])
        jump[ROTATION] = so3_log(after.rotation.T @ handed_out)
        jump[POSITION] += before.position - after.position
        jump[VELOCITY] += before.velocity - after.velocity
        self.jump, self._propagated = jump, after

    def estimate(
        self,
        obs: Observation,
        world_from_odom: Pose,
        extra_covariance: Array,
        scan_track: PoseTrack | None,
        diagnostics: dict[str, float],
        events: tuple[str, ...] = (),
        inflation: float = 1.0,
    ) -> Estimate:
        """Returns the estimate at the present. The position's covariance is that of the filter
        times ``inflation`` plus ``extra_covariance`` (3, 3) m^2."""
        present, newest = self._propagated, self._newest
        rates, forces = present.corrected(
            newest.angular_velocity[None], newest.specific_force[None]
        )
        imu = _Motion(present.rotation, present.position, present.velocity, rates[0], forces[0])
        body = _motion_of_body(imu, self.jump, Frame.of(self.imu_from_body))
        turn, to_body = world_from_odom.rotation, self.rig.body_from_imu.rotation
        spread = turn @ self.covariance[POSITION, POSITION] @ turn.T
        position_covariance = inflation * spread + extra_covariance
        return Estimate(
            tick=obs.tick,
            time_s=obs.time_s,
            odom_from_body=Pose(body.rotation, body.position),
            world_from_odom=world_from_odom,
            velocity_odom=body.velocity,
            angular_velocity_body=body.rate,
            acceleration_odom=body.force,
            position_covariance=position_covariance,
            rotation_covariance=to_body @ self.covariance[ROTATION, ROTATION] @ to_body.T,
            healthy=bool(position_covariance.trace() < 1.0),
            scan_track=scan_track,
            diagnostics=diagnostics,
            events=events,
        )


class _Motion(NamedTuple):
    """Motion of the IMU or of the body's origin, odom frame; the angular rate in its own frame."""

    rotation: Array  # (3, 3)
    position: Array
    velocity: Array
    rate: Array
    force: Array
    """specific force of the IMU in its own frame; acceleration of the body"""


@njit(cache=True, error_model="numpy")
def _motion_of_body(imu: _Motion, jump: Array, imu_from_body: Frame) -> _Motion:
    """The body's motion from that of the IMU with ``jump`` (15,) added."""
    rotation = imu.rotation @ exp_so3(jump[ROTATION])
    position, velocity = imu.position + jump[POSITION], imu.velocity + jump[VELOCITY]
    lever = np.array(cross(xyz(imu.rate), xyz(imu_from_body.translation)))
    rate = np.array(turned_back(imu_from_body.rotation, xyz(imu.rate)))
    return _Motion(
        rotation @ imu_from_body.rotation,
        position + rotation @ imu_from_body.translation,
        velocity + rotation @ lever,
        rate,
        rotation @ imu.force - _GRAVITY,
    )
