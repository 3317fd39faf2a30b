"""A recording as the observations of a flight: on one clock, with one rig, in order of arrival."""

import dataclasses
import itertools
import math
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from touchdown.experiments.errors import UsageError
from touchdown.experiments.io.sensor_log_reader import SensorLogReader
from touchdown.experiments.recordings.clock import (
    Rest,
    at_rest,
    even_grid,
    level_pose,
    rest_steps,
)
from touchdown.experiments.recordings.contract import (
    ALL,
    RawFrame,
    RawImage,
    RawScan,
    Recording,
    RigParts,
    Span,
)
from touchdown.experiments.recordings.frames import (
    PAIR_S,
    Waiting,
    constant_velocity,
    first_velocity,
    period_s,
    twin_of,
)
from touchdown.experiments.recordings.nav import small_messages
from touchdown.experiments.recordings.pair_depth import pair_scan, pair_sheet
from touchdown.experiments.recordings.pictures import Optics, optics_of
from touchdown.sim.api import (
    GRAVITY_MPS2,
    CameraImage,
    CameraIntrinsics,
    ImuSample,
    ImuSheet,
    LidarScan,
    Observation,
    SensorNeeds,
    SensorRig,
    VehicleModel,
)
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array

_PEEKED = 60
"""frames by which rates are known"""
_BEFORE_S = 0.3
"""by which a replay begins before the first frame"""
_FULL_SWEEP = 0.8
"""fraction of the period that the pulses of a whole sweep span"""
_NO_IMU = ImuSheet(
    gyro_density=0.2, accel_density=1.5, gyro_bias_walk=0.0, accel_bias_walk=0.0,
    gyro_bias_sigma=1e-6, accel_bias_sigma=1e-6,
)  # fmt: skip
"""a constant velocity stands for the samples: a car accelerates by 3 m/s^2 and turns by 0.5 rad/s
for some tenths of a second"""
_START_SPEED_MPS, _FOUND_SPEED_MPS = 15.0, 1.0
"""standard deviation of the velocity at a start in motion, and where two scans have shown it"""
_MOVING_TILT = math.radians(5.0)
_CARRIED = VehicleModel(
    mass_kg=1.0, inertia_kgm2=np.full(3, 0.01), rotor_xy_m=np.zeros((1, 2)),
    rotor_spin=np.ones(1), thrust_coefficient=1e-4, torque_coefficient=1e-6,
    rotor_speed_min=50.0, rotor_speed_max=1000.0, motor_time_constant_s=0.05, linear_drag=0.0,
    leg_height_m=0.0, footprint_radius_m=0.5,
)  # fmt: skip
"""stands for what carries a rig; its one rotor stands still while the rig is at rest at first"""
_CARRYING = 1.5 * math.sqrt(GRAVITY_MPS2 / 1e-4)
"""rad/s of that rotor afterwards"""


class ComposedLog(SensorLogReader):
    """The observations of a recording. An observation is made at each sample of the IMU.

    Raises UsageError for a recording without frames or with a rig that does not fit it.
    """

    remedy = "give another estimator, or a --rig that names the sensor"

    def __init__(
        self, recording: Recording, parts: RigParts, span: Span = ALL,
        moving_ns: int | None = None, *, pair_as_scan: bool = False,
    ) -> None:  # fmt: skip
        """``span``: of the frames that are replayed; ``moving_ns``: where a recording that begins
        in motion is to begin, such as its truth; ``pair_as_scan``: where there is no LIDAR, the
        depths of a stereo pair stand for its scans."""
        self.path = recording.path
        self._recording, self._parts, self._span = recording, parts, span
        peeked = list(itertools.islice(recording.frames(span), _PEEKED))
        self._nav = recording.nav()
        if not peeked and self._nav is None:
            raise UsageError(f"'{self.path}' has neither scans nor images")
        imu = recording.imu()
        whole = parts.whole
        start_ns = min((frame.stamp_ns for frame in peeked), default=0) - round(_BEFORE_S * 1e9)
        if parts.moving and moving_ns is not None:
            start_ns = max(start_ns, moving_ns)
        self._grid = (
            even_grid(imu, None if whole else start_ns, whole.tick_hz if whole else None)
            if imu is not None else constant_velocity(recording, span, peeked)
        )  # fmt: skip
        self._in_g = imu is not None and 0.7 < float(np.linalg.norm(
            np.median(self._grid.force[:200], axis=0))) < 1.3  # fmt: skip
        if imu is not None and self._in_g:
            imu = dataclasses.replace(imu, force=GRAVITY_MPS2 * imu.force)
            self._grid = dataclasses.replace(self._grid, force=GRAVITY_MPS2 * self._grid.force)
        self._has_imu = imu is not None
        self.clock = self._grid.clock
        self._still = 0 if parts.moving or imu is None else rest_steps(self._grid)
        self._rest: Rest | None = None
        if imu is not None and self._still and whole is None:
            self._rest = at_rest(imu, self.clock.start_ns + round(_BEFORE_S * 1e9))
            self._grid = dataclasses.replace(self._grid, gyro=self._grid.gyro - self._rest.rate)
        self._periods = {kind: period_s(peeked, kind) for kind in ("scan", "left")}
        has_right = any(isinstance(one, RawImage) and one.right for one in peeked)
        self._optics = self._optics_of(has_right) if self._periods["left"] else None
        self._check_pairs(peeked)
        stereo = self._optics is not None and has_right and (
            parts.right is not None or whole is not None
        )  # fmt: skip
        self._pair_as_scan = (
            pair_as_scan and stereo and whole is None and not self._periods["scan"]
        )  # fmt: skip
        self._first_velocity = first_velocity(peeked, parts) if not self._still else None
        self.rig = whole or self._rig()
        camera_hz = max(round(1.0 / self._periods["left"]), 1) if self._periods["left"] else 0
        self.sensed = SensorNeeds(
            camera_hz=camera_hz, stereo=stereo,
            lidar=self._periods["scan"] > 0.0 or self._pair_as_scan,
            gps=self._nav is not None and len(self._nav.fix_ns) > 0,
            barometer=self._nav is not None and len(self._nav.pressure_ns) > 0,
            magnetometer=self._nav is not None and len(self._nav.field_ns) > 0,
        )  # fmt: skip
        self.shared = SensorNeeds()
        self._rotors = recording.rotors() if whole is not None else None
        if self._rotors is not None and self._rotors.speeds.shape[1] != len(
            self.rig.vehicle.rotor_spin
        ):
            raise UsageError(f"'{self.path}' and its rig have different numbers of rotors")
        self.counts: Counter[str] = Counter()
        """messages of the last replay by kind, and those that could not be used"""

    @property
    def last_tick(self) -> int:
        """Of the last sample of the IMU."""
        return len(self._grid.gyro) * self.clock.imu_ticks

    @property
    def begins_at_rest(self) -> bool:
        """True where the rig is at rest at first, so that its start is known."""
        return self._still > 0

    def notes(self) -> list[str]:
        """What was done to the data, and what could not be used of them, a sentence each."""
        counts, notes = self.counts, []
        still_s = self._still * self.clock.step_s
        if not self._has_imu:
            notes.append("there is no IMU: a constant velocity stands for its samples")
        elif self._still:
            notes.append(f"at rest for the first {still_s:.2f} s: levelled by gravity")
            if self._rest is not None:
                rate = ", ".join(f"{one:.4f}" for one in self._rest.rate)
                notes.append(f"the mean rate at rest, {rate} rad/s, was taken off the gyroscope")
        else:
            notes.append("begins in motion: roll and pitch from the mean force of the first second")
        if self._in_g:
            notes.append("the IMU states g, as Livox does: its force was taken times 9.81")
        if self._pair_as_scan:
            notes.append("there is no LIDAR: the depths of the stereo pair stand for its scans")
        if self._grid.resampled:
            notes.append(f"the IMU's samples were put on a grid of {1.0 / self.clock.step_s:g} Hz")
        refused = [f"{n} {kind}" for kind, n in counts.items() if kind.endswith("refused") and n]
        if refused:
            notes.append(f"out of order, empty or before the start: {', '.join(refused)}")
        if self.sensed.stereo and counts["images"] > counts["pairs"] > 0:
            notes.append(f"{counts['images'] - counts['pairs']} images have no twin")
        return notes

    # ------------------------------------------------------------------------ the rig

    def _optics_of(self, has_right: bool) -> Optics | None:
        parts = self._parts
        if parts.whole is not None:
            whole = parts.whole
            return Optics(whole.camera, whole.body_from_camera, whole.body_from_camera_right,
                          (None, None))  # fmt: skip
        if parts.camera is None:
            raise UsageError(
                f"'{self.path}' has images, and nothing says how their camera is calibrated: give "
                "--rig, Kalibr's camchain-imucam.yaml or a TOML file with a table camera"
            )
        try:
            return optics_of(parts.camera, parts.right if has_right else None)
        except ValueError as error:
            raise UsageError(f"the rig of '{self.path}': {error}") from error

    def _rig(self) -> SensorRig:
        parts, clock = self._parts, self.clock
        if self._periods["scan"] and parts.body_from_lidar is None:
            raise UsageError(
                f"'{self.path}' has scans, and nothing says where the LIDAR is: give --rig with "
                "body_from_lidar in its table lidar"
            )
        optics = self._optics or Optics(
            CameraIntrinsics(width=64, height=48, fx=50.0, fy=50.0, cx=31.5, cy=23.5),
            Pose.identity(), Pose.identity(), (None, None),
        )  # fmt: skip
        camera_s, scan_s = self._periods["left"] or 0.1, self._periods["scan"] or 0.1
        lidar, body_from_lidar = parts.lidar, parts.body_from_lidar or Pose.identity()
        if self._pair_as_scan:
            lidar = pair_sheet(optics.camera.fx * self._baseline_m)
            body_from_lidar = optics.body_from_camera
            scan_s = camera_s
        start, tilt = self._start()
        found = None if self._still else self._first_velocity
        speed = np.zeros(3) if found is None else start.rotation @ found
        sigma = _START_SPEED_MPS if found is None else _FOUND_SPEED_MPS
        return SensorRig(
            tick_hz=clock.tick_hz, imu_ticks=clock.imu_ticks,
            camera_ticks=clock.tick_hz // max(round(1.0 / camera_s), 1),
            lidar_scan_ticks=max(round(scan_s * clock.tick_hz), 1),
            compute_latency_ticks=round(parts.latency_s * clock.tick_hz),
            body_from_imu=parts.body_from_imu,
            body_from_lidar=body_from_lidar,
            body_from_camera=optics.body_from_camera, camera=optics.camera,
            body_from_camera_right=optics.body_from_right,
            lidar=lidar, imu=self._imu_sheet(),
            nav=parts.nav, world_from_body_start=start, vehicle=_CARRIED, start_tilt_sigma_rad=tilt,
            start_velocity_mps=speed, start_velocity_sigma_mps=0.0 if self._still else sigma,
        )  # fmt: skip

    def _imu_sheet(self) -> ImuSheet:
        sheet = self._parts.imu if self._has_imu else _NO_IMU
        if self._rest is None:
            return sheet
        rest = self._rest
        return dataclasses.replace(
            sheet, gyro_bias_sigma=min(sheet.gyro_bias_sigma, rest.rate_sigma),
            gyro_density=max(sheet.gyro_density, rest.gyro_density),
            accel_density=max(sheet.accel_density, rest.accel_density),
        )  # fmt: skip

    @property
    def _baseline_m(self) -> float:
        assert self._optics is not None
        left, right = self._optics.body_from_camera, self._optics.body_from_right
        return float(np.linalg.norm(right.translation - left.translation))

    def _start(self) -> tuple[Pose, float]:
        """world_from_body at the start from gravity, and the standard deviation of its tilt."""
        if not self._has_imu:
            return Pose.identity(), 0.0
        samples = min(self._still or len(self._grid.force), round(1.0 / self.clock.step_s))
        force = self._grid.force[:samples].mean(axis=0)
        bias = self._parts.imu.accel_bias_sigma / GRAVITY_MPS2
        tilt = max(bias, 2e-3) if self._still else math.hypot(bias, _MOVING_TILT)
        return level_pose(self._parts.body_from_imu.rotation @ force), tilt

    def _check_pairs(self, peeked: list[RawFrame]) -> None:
        """Raises UsageError for images of another size than the camera's, and for two cameras of
        which no images belong together."""
        images = [one for one in peeked if isinstance(one, RawImage)]
        if not images or self._optics is None:
            return
        camera = self._parts.camera.intrinsics if self._parts.camera else self._optics.camera
        try:
            shape = images[0].read().shape
        except ValueError as error:
            raise UsageError(str(error)) from error
        if shape != (camera.height, camera.width, 3):
            raise UsageError(
                f"the rig does not fit '{self.path}': its camera has {camera.width} x "
                f"{camera.height} pixels, the images have {shape[1]} x {shape[0]}"
            )
        rights = [one for one in images if one.right]
        if rights and self._parts.right is not None and not any(
            twin_of(one, rights) for one in images if not one.right
        ):  # fmt: skip
            raise UsageError(
                f"'{self.path}' is not synchronised: no image of the right camera lies within "
                f"{PAIR_S * 1e3:.0f} ms of one of the left"
            )

    # ------------------------------------------------------------------------ observations

    def observations(
        self, images: bool = True, keep: Callable[[Any], bool] | None = None, right: bool = True
    ) -> Iterator[Observation]:
        """Observations from the beginning to the last frame; see `SensorLogReader`."""
        grid, clock = self._grid, self.clock
        self.counts = Counter()
        waiting = Waiting(self._recording.frames(self._span), self._arrival_of)
        newest = {"scan": 0, "image": 0}
        small = small_messages(self._nav, clock)
        for k in range(len(grid.gyro)):
            tick = (k + 1) * clock.imu_ticks
            time_s = tick / clock.tick_hz
            scans, pictures = [], []
            for frame in waiting.until(time_s + 1e-9):
                if isinstance(frame, RawScan):
                    scan = self._scan(frame, newest["scan"])
                    if scan is None:
                        self.counts["scans refused"] += 1
                        continue
                    newest["scan"] = scan.end_tick
                    scans.append(scan)
                elif images and not frame.right:
                    paired = (right and self.sensed.stereo) or self._pair_as_scan
                    twin = waiting.twin(frame) if paired else None
                    image = self._image(frame, twin, newest["image"], keep)
                    if image is None:
                        continue
                    newest["image"] = image.tick
                    pictures.append(image)
                    if self._pair_as_scan and image.right_rgb is not None:
                        scan = self._scan_of_pair(frame, image, newest["scan"])
                        if scan is not None:
                            newest["scan"] = scan.end_tick
                            scans.append(scan)
            self.counts["scans"] += len(scans)
            self.counts["images"] += len(pictures)
            self.counts["pairs"] += sum(one.right_rgb is not None for one in pictures)
            self.counts["imu"] += 1
            yield Observation(
                tick=tick, time_s=time_s, scans=tuple(scans), images=tuple(pictures),
                imu=(ImuSample(tick=tick, time_s=time_s, angular_velocity=grid.gyro[k],
                               specific_force=grid.force[k]),),
                rotor_speed_radps=self._rotor_speeds(k, time_s),
                battery_fraction=1.0, **small(tick),
            )  # fmt: skip
            if waiting.empty and (self._periods["scan"] or self._periods["left"]):
                return

    def _rotor_speeds(self, step: int, time_s: float) -> Array:
        """(R,) of the recording; without them the rotor of the stand-in turns after the rest."""
        table, count = self._rotors, len(self.rig.vehicle.rotor_spin)
        if table is None:
            return np.full(count, _CARRYING if step >= self._still else 0.0)
        stamp = self.clock.start_ns + round(1e9 * time_s) + 1
        row = max(int(np.searchsorted(table.stamps_ns, stamp, side="right")) - 1, 0)
        return np.asarray(table.speeds[row])

    def _arrival_of(self, frame: RawFrame) -> float:
        """When a frame is on board, by the clock of the IMU."""
        if frame.arrives_ns is not None:
            return self.clock.seconds(frame.arrives_ns)
        return self._time_of(frame) + self.rig.compute_latency_ticks / self.rig.tick_hz

    def _time_of(self, frame: RawFrame) -> float:
        """Time of a frame by the clock of the IMU: of a scan its end."""
        if isinstance(frame, RawScan):
            return self._span_of(frame)[1]
        lens = self._parts.right if frame.right else self._parts.camera
        return self.clock.seconds(frame.stamp_ns, lens.offset_s if lens else 0.0)

    def _span_of(self, frame: RawScan) -> tuple[float, float]:
        """First and last instant of a sweep: a whole one lasts for the period of sweeps."""
        start = self.clock.seconds(frame.stamp_ns, self._parts.lidar_offset_s)
        if not len(frame.offsets_s):
            return start, start
        first, last = float(frame.offsets_s.min()), float(frame.offsets_s.max())
        period = self.rig.lidar_scan_ticks / self.rig.tick_hz
        if first < 0.0:
            start, last = start + first, last - first
        if last == 0.0:
            return start - 1.0 / self.rig.tick_hz, start
        return start, start + (period if _FULL_SWEEP * period < last < 1.02 * period else last)

    def _scan(self, frame: RawScan, newest: int) -> LidarScan | None:
        """The scan, None where it has no pulse or lies before the start or the one before."""
        start_s, end_s = self._span_of(frame)
        start, end = (self.clock.tick(one) for one in (start_s, end_s))
        overlap = newest - start
        if 0 < overlap <= self.rig.lidar_scan_ticks // 5:
            start = newest
        if not len(frame.points) or start < newest or end <= start:
            return None
        offsets = frame.offsets_s - min(float(frame.offsets_s.min()), 0.0)
        if not offsets.any():
            offsets = np.full(len(offsets), end_s - start_s, np.float32)
        order = np.argsort(offsets, kind="stable")
        points = frame.points[order]
        with np.errstate(invalid="ignore", over="ignore"):
            ranges = np.linalg.norm(points, axis=1).astype(np.float32)
        good = np.isfinite(ranges) & (ranges > 0.0)
        ranges = np.where(good, ranges, np.float32(0.0))
        directions = np.zeros_like(points)
        directions[:, 2] = 1.0
        directions[good] = points[good] / ranges[good, None]
        return LidarScan(
            start_tick=start, end_tick=end, start_time_s=start_s, end_time_s=end_s,
            directions=directions, ranges=ranges,
            time_offsets=offsets[order].astype(np.float32), intensity=frame.intensity[order],
        )  # fmt: skip

    def _scan_of_pair(self, frame: RawImage, image: CameraImage, newest: int) -> LidarScan | None:
        assert self._optics is not None and image.right_rgb is not None
        found = pair_scan(
            image.rgb, image.right_rgb, self._optics.camera, self._baseline_m, frame.stamp_ns
        )
        return self._scan(found, newest)

    def _image(
        self, frame: RawImage, twin: RawImage | None, newest: int,
        keep: Callable[[Any], bool] | None,
    ) -> CameraImage | None:  # fmt: skip
        time_s = self._time_of(frame)
        blank = np.zeros((0, 0, 3), np.uint8)
        image = CameraImage(tick=self.clock.tick(time_s), time_s=time_s, rgb=blank)
        if image.tick <= newest or time_s < 0.0:
            self.counts["images refused"] += 1
            return None
        if keep is not None and not keep(image):
            return None
        assert self._optics is not None
        try:
            eyes = [self._optics.apply(one.read(), one.right)
                    for one in (frame, twin) if one is not None]  # fmt: skip
        except ValueError as error:
            raise UsageError(f"'{self.path}': {error}") from error
        return dataclasses.replace(image, rgb=eyes[0], right_rgb=eyes[1] if len(eyes) > 1 else None)
