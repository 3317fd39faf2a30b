"""The inertial filter of the baselines: order of their messages, alignment, heading and height."""

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from touchdown.estimator.api import CalibrationPriors, Estimate, ImageThinning
from touchdown.estimator.baselines.aiding import BaroHeight, heading_of, update_heading
from touchdown.estimator.filtering.camera_model import CameraTwist, Undistorter, at_middle_row
from touchdown.estimator.filtering.error_state import CLOCK, ROTATION, SHARED_DIM
from touchdown.estimator.filtering.eskf import Eskf
from touchdown.estimator.filtering.inertial_filter import InertialFilter
from touchdown.estimator.filtering.online_calibration import (
    calibration_diagnostics,
    corrected_camera,
    prior_sigmas,
)
from touchdown.estimator.filtering.synchronizer import ArrivingStream, max_delay_ticks
from touchdown.estimator.filtering.zero_velocity import align_with_gravity
from touchdown.estimator.guard import InputGuard
from touchdown.sim.api import (
    GRAVITY_MPS2,
    BarometerSample,
    CameraImage,
    GpsFix,
    MagnetometerParams,
    MagnetometerSample,
    Observation,
    RangefinderSample,
    SensorNeeds,
    SensorRig,
)
from touchdown.sim.frames import Pose, rotation_from_yaw, yaw_from_rotation
from touchdown.sim.typing import Array

_EVENTS, _SAMPLES = ("images", "gps"), ("magnetometer", "barometer", "rangefinder")
"""fields of `Observation`: messages that are epochs, and what is used at the next one"""
_EPOCH_HZ = 10
"""smallest rate of epochs, whatever messages come"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Epoch:
    """An instant at which a filter is corrected: the time of an image or a fix, or of a clock. The
    samples are those since the previous epoch, oldest first."""

    tick: int
    image: CameraImage | None = None
    fix: GpsFix | None = None
    magnetometer: tuple[MagnetometerSample, ...] = ()
    barometer: tuple[BarometerSample, ...] = ()
    rangefinder: tuple[RangefinderSample, ...] = ()


class EpochQueue:
    """Delays messages by the largest nominal latency of the sensors in ``needs``, and by that of an
    image that is later than that and still to be expected.

    ``late`` counts images and fixes that came after their epoch.
    """

    def __init__(self, rig: SensorRig, needs: SensorNeeds) -> None:
        nav = rig.nav
        self._images = ArrivingStream(
            rig.tick_hz // needs.camera_hz if needs.camera_hz else 0,
            rig.compute_latency_ticks,
            max_delay_ticks(rig),
        )
        sensors = ("gps", "barometer", "magnetometer", "rangefinder")
        latencies = [getattr(nav, name).latency_ticks for name in sensors if getattr(needs, name)]
        self._lag = max([rig.compute_latency_ticks if needs.camera_hz else 0, *latencies])
        self._period = rig.tick_hz // _EPOCH_HZ
        self._last = 0
        self._waiting: dict[str, list[Any]] = {name: [] for name in (*_EVENTS, *_SAMPLES)}
        self.late = 0

    def take(self, obs: Observation) -> list[Epoch]:
        """Adds the arrived messages; returns the epochs that are complete now, oldest first."""
        for image in obs.images:
            self._images.take(image.tick, obs.tick)
        for name, waiting in self._waiting.items():
            arrived = getattr(obs, name)
            waiting += self._in_time(arrived) if name in _EVENTS else arrived
        horizon = obs.tick - self._lag
        ticks = {message.tick for name in _EVENTS for message in self._waiting[name]}
        ticks |= set(
            range((self._last // self._period + 1) * self._period, horizon + 1, self._period)
        )
        complete = []
        for tick in sorted(ticks):
            if tick > horizon or self._images.may_bring(tick + 1, obs.tick):
                break
            complete.append(self._epoch(tick))
        return complete

    def _in_time(self, messages: Sequence[Any]) -> list[Any]:
        kept = [message for message in messages if message.tick > self._last]
        self.late += len(messages) - len(kept)
        return kept

    def _epoch(self, tick: int) -> Epoch:
        self._last = tick
        images, fixes = (_split(self._waiting[name], tick) for name in _EVENTS)
        samples = {name: tuple(_split(self._waiting[name], tick)) for name in _SAMPLES}
        return Epoch(
            tick=tick, image=images[-1] if images else None, fix=fixes[-1] if fixes else None,
            **samples,
        )  # fmt: skip


def _split(messages: list[Any], tick: int) -> list[Any]:
    """Removes and returns those measured at or before ``tick``, oldest first."""
    due = sorted((m for m in messages if m.tick <= tick), key=lambda m: m.tick)
    messages[:] = [m for m in messages if m.tick > tick]
    return due


_DURATION_S = 0.25
_LOOSE_TILT = math.radians(10.0)
"""error of roll and pitch before the alignment"""
_SETTLING_SIGMA = 1e-3
"""rad: wind and slow rotors shake a vehicle on its legs"""
_MINUTE_FACTOR = math.sqrt(600.0)
"""readings of a minute: an error shared by all of them, taken as one of each"""
_UNKNOWN_M2 = 1e4
"""position variance before the first measurement"""


def field_azimuth(params: MagnetometerParams) -> float:
    """Direction of the horizontal part of the earth's field, rad counter-clockwise from east."""
    return 0.5 * math.pi - math.radians(params.declination_deg)


def level_attitude(force_body: Array, field_body: Array, azimuth: float) -> Array:
    """world_from_body (3, 3) of a body at rest that measures ``force_body`` (3,), upward, and the
    field ``field_body`` (3,) whose horizontal part has ``azimuth`` (rad from east). The field
    determines the heading only (Black 1964, "TRIAD")."""
    up = force_body / np.linalg.norm(force_body)
    level = field_body - (field_body @ up) * up
    along = level / np.linalg.norm(level)
    body = np.column_stack([along, np.cross(up, along), up])
    return rotation_from_yaw(azimuth) @ body.T


class Alignment:
    """Attitude at rest from gravity and the earth's field, by the first samples of a stationary
    vehicle."""

    def __init__(self, rig: SensorRig) -> None:
        self._rig = rig
        self._force, self._field = np.zeros(3), np.zeros(3)
        self._forces = self._fields = 0

    def take(self, obs: Observation) -> Pose | None:
        """Returns world_from_body: the attitude found, at the origin of the odometry frame, which
        is the take-off spot by definition. None until there are enough samples."""
        for sample in obs.imu:
            force = self._rig.body_from_imu.rotation @ sample.specific_force
            if np.isfinite(force).all():
                self._force = self._force + force
                self._forces += 1
        for reading in obs.magnetometer:
            if np.isfinite(reading.field_body_ut).all():
                self._field = self._field + reading.field_body_ut
                self._fields += 1
        if obs.time_s < _DURATION_S or self._fields == 0:
            return None
        azimuth = field_azimuth(self._rig.nav.magnetometer)
        attitude = level_attitude(self._force, self._field, azimuth)
        return Pose(attitude, self._rig.world_from_body_start.translation)

    def mean_force(self) -> Array:
        """(3,) m/s^2, body axes."""
        return self._force / max(self._forces, 1)

    def heading_sigma(self) -> float:
        """rad: error of the heading from what remains of the magnetometer's calibration."""
        magnetometer = self._rig.nav.magnetometer
        level_ut = magnetometer.strength_ut * math.cos(math.radians(magnetometer.inclination_deg))
        return magnetometer.hard_iron_sigma_ut / level_ut + 2e-3


class Navigator:
    """``epochs`` takes an observation and yields the epochs at which to correct ``eskf``; heading
    and height by magnetometer and barometer are corrected already. ``estimate`` then returns the
    estimate.

    ``known_start``: the take-off attitude is known. If so, the magnetometer is compared with its
    own reading at the start, which cancels its offsets in the heading. If not, the attitude is
    initialised from gravity and the earth's field. ``priors``: errors of the calibration that are
    estimated online; without images those of the IMU alone, which nothing else shows.
    """

    def __init__(
        self,
        rig: SensorRig,
        needs: SensorNeeds,
        *,
        known_start: bool,
        priors: CalibrationPriors | None = None,
        heading_sigma_deg: float = math.inf,
        baro_sigma_m: float = math.inf,
    ) -> None:
        undistorter = Undistorter(rig)
        self.grey = undistorter.grey
        self.rig, self.needs = undistorter.rig, needs
        self._known_start = known_start
        self._heading_sigma = math.radians(heading_sigma_deg)
        self._guard = InputGuard(rig, needs.camera_hz)
        self._queue = EpochQueue(rig, needs)
        clock_hz = rig.tick_hz // rig.camera_ticks
        self._thinning = ImageThinning(rig, clock_hz // needs.camera_hz if needs.camera_hz else 0)
        self._baro = BaroHeight(rig.tick_hz, baro_sigma_m)
        self._alignment = Alignment(rig)
        self._sigmas = np.zeros(0) if priors is None else prior_sigmas(priors)
        if not needs.camera_hz:
            self._sigmas[:SHARED_DIM] = 0.0
        self._filter: InertialFilter | None = None
        if known_start:
            self._filter = InertialFilter(rig, calibration_sigmas=self._sigmas)
        self._imu_from_body = rig.body_from_imu.inverse()
        self._azimuth: float | None = None if known_start else field_azimuth(rig.nav.magnetometer)
        self._readings = np.zeros(2)
        self._pad_yaw = 0.0
        self.skipped = 0
        self.rate_imu: Array = np.zeros(3)
        """(3,) rad/s at the epoch, bias removed"""
        self.twist_of_clone: Array = np.zeros(6)
        """of the filter where the clone was made, see ``Eskf.twist``"""

    @property
    def filter(self) -> InertialFilter:
        """The inertial filter; RuntimeError before the first epoch."""
        if self._filter is None:
            raise RuntimeError("the attitude is not known before the first epoch")
        return self._filter

    @property
    def eskf(self) -> Eskf:
        """The error-state filter; RuntimeError before the first epoch."""
        return self.filter.eskf

    @property
    def stationary(self) -> bool:
        """True while the vehicle stands on the ground."""
        return self._filter is None or self._filter.stationary

    def renew_clone(self) -> None:
        """Clones the present pose in place of that of the last image."""
        if self.eskf.clones:
            self.eskf.remove_clone(0)
        self.eskf.add_clone()
        self.twist_of_clone = self.eskf.twist

    @property
    def imu_from_camera(self) -> Pose:
        """The camera's mount as estimated."""
        return corrected_camera(self.filter.imu_from_camera, self.eskf.state.calibration)

    @property
    def clock_s(self) -> float:
        """By how much the camera's clock is ahead of the IMU's, as estimated."""
        calibration = self.eskf.state.calibration
        return float(calibration[CLOCK]) if len(calibration) else 0.0

    def camera_twist(self, image: CameraImage) -> CameraTwist:
        """As that of the filter, the delay of ``image`` by the corrected clock."""
        twist = self.filter.camera_twist(image)
        return dataclasses.replace(twist, late_s=twist.late_s - self.clock_s)

    def epochs(self, obs: Observation) -> Iterator[Epoch]:
        """Yields the complete epochs. To be exhausted once per observation: afterwards corrections
        reach the present."""
        obs = self._guard.screen(self._wanted(obs))
        self.skipped += self._guard.refused
        middles = tuple(at_middle_row(image, self.rig) for image in obs.images)
        obs = dataclasses.replace(obs, images=middles)
        epochs = self._queue.take(obs)
        if self._filter is None:
            start = self._alignment.take(obs)
            if start is None:
                return
            self._filter = self._aligned(start)
        self._filter.take_imu(obs)
        for epoch in epochs:
            if epoch.tick < self._filter.tick or epoch.tick > self._filter.present.tick:
                self.skipped += 1
                continue
            self._filter.carry_to(epoch.tick)
            self.rate_imu = self._filter.eskf.rate
            self._take_heading(epoch.magnetometer)
            self._baro.take(self._filter.eskf, epoch.barometer, self._filter.stationary)
            yield epoch
        self._filter.settle(bool(epochs))

    def _wanted(self, obs: Observation) -> Observation:
        """Returns ``obs`` without messages that only other consumers need: a flight must not depend
        on them."""
        needs = self.needs
        return dataclasses.replace(
            obs, scans=(),
            images=tuple(image for image in obs.images if self._thinning.keeps(image)),
            gps=obs.gps if needs.gps else (), barometer=obs.barometer if needs.barometer else (),
            magnetometer=obs.magnetometer if needs.magnetometer else (),
            rangefinder=obs.rangefinder if needs.rangefinder else (),
        )  # fmt: skip

    def _aligned(self, world_from_body: Pose) -> InertialFilter:
        rig = dataclasses.replace(self.rig, world_from_body_start=world_from_body)
        inertial = InertialFilter(rig, attitude_known=False, calibration_sigmas=self._sigmas)
        to_imu = self._imu_from_body.rotation
        spread = np.diag([_LOOSE_TILT, _LOOSE_TILT, self._alignment.heading_sigma()]) ** 2
        inertial.eskf.covariance[ROTATION, ROTATION] = to_imu @ spread @ to_imu.T
        # the attitude is level already: this relates its error to the accelerometer's bias
        force = to_imu @ self._alignment.mean_force()
        align_with_gravity(inertial.eskf, force, GRAVITY_MPS2 * _SETTLING_SIGMA)
        return inertial

    def _take_heading(self, samples: tuple[MagnetometerSample, ...]) -> None:
        if not samples or not np.isfinite(samples[-1].field_body_ut).all():
            return
        field_imu = self._imu_from_body.rotation @ samples[-1].field_body_ut
        if self._known_start and self.stationary:
            azimuth = heading_of(self.eskf.state.rotation, field_imu)
            self._readings = self._readings + [math.cos(azimuth), math.sin(azimuth)]
            self._azimuth = math.atan2(self._readings[1], self._readings[0])
            self._pad_yaw = self._yaw()
        elif self._azimuth is not None:
            update_heading(self.eskf, field_imu, self._azimuth, self._reading_sigma())

    def _yaw(self) -> float:
        return yaw_from_rotation(self.eskf.state.rotation @ self._imu_from_body.rotation)

    def _reading_sigma(self) -> float:
        """rad, of one reading of the heading. The reading on the pad cancels the magnetometer's
        offset at the heading of the pad alone; what a turn leaves of it does not average out."""
        if not self._known_start:
            return self._heading_sigma
        left = 2.0 * abs(math.sin(0.5 * (self._yaw() - self._pad_yaw)))
        lasting = left * self._alignment.heading_sigma()
        return math.hypot(self._heading_sigma, _MINUTE_FACTOR * lasting)

    def estimate(
        self,
        obs: Observation,
        *,
        healthy: bool,
        diagnostics: Mapping[str, float],
        world_from_odom: Pose | None = None,
        covariance: Array | None = None,
        extra_covariance: Array | None = None,
    ) -> Estimate:
        """Returns the estimate at ``obs.time_s``. ``covariance`` (3, 3) m^2, world frame, replaces
        the filter's; ``extra_covariance`` is added."""
        found = dict(diagnostics) | {"skipped": float(self.skipped + self._queue.late)}
        world_from_odom = world_from_odom or Pose.identity()
        if self._filter is None:
            return self._stationary_estimate(obs, world_from_odom, found)
        if self.needs.camera_hz:
            found |= calibration_diagnostics(self.eskf.state.calibration)
        extra = np.zeros((3, 3)) if extra_covariance is None else extra_covariance
        estimate = self._filter.estimate(
            obs, world_from_odom, extra, None, found, self._guard.events
        )
        if covariance is None:
            covariance = estimate.position_covariance
        return dataclasses.replace(estimate, position_covariance=covariance, healthy=healthy)

    def _stationary_estimate(
        self, obs: Observation, world_from_odom: Pose, diagnostics: dict[str, float]
    ) -> Estimate:
        """Returns the estimate on the ground before the attitude is known."""
        return Estimate(
            tick=obs.tick, time_s=obs.time_s, odom_from_body=self.rig.world_from_body_start,
            world_from_odom=world_from_odom, velocity_odom=np.zeros(3),
            angular_velocity_body=np.zeros(3), acceleration_odom=np.zeros(3),
            position_covariance=_UNKNOWN_M2 * np.eye(3), rotation_covariance=np.eye(3),
            healthy=False, diagnostics=diagnostics, events=self._guard.events,
        )  # fmt: skip
