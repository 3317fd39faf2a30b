"""Synthetic sensor messages of a few seconds, without a simulator: a take-off over rolling ground.

For checks that need plausible input. Rates, delays and mounts are those of the
vehicle; the ground is a sum of waves, its texture a random mosaic, and the vehicle stays level.
"""

import math
from collections import defaultdict
from collections.abc import Callable, Iterator
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.sim.api import (
    GRAVITY_MPS2,
    BarometerSample,
    CameraImage,
    CameraIntrinsics,
    GpsFix,
    ImuSample,
    ImuSheet,
    LidarScan,
    LidarSheet,
    MagnetometerSample,
    NavSheet,
    Observation,
    RangefinderSample,
    SensorNeeds,
    SensorRig,
    VehicleModel,
)
from touchdown.sim.frames import BODY_FROM_DOWNWARD_OPTICAL, Pose, rotation_from_yaw
from touchdown.sim.navigation.sensors import earth_field_world, pressure_at
from touchdown.sim.typing import Array

Reals = NDArray[np.floating[Any]]

CONTROL_TICKS = 3
REST_S = 0.6
"""time on the ground before the take-off"""
_CLIMB_M, _ASIDE_M, _CLIMB_S = 2.5, 1.0, 2.4
_PULSES = 6000
_TILE_M = 0.05


def synthetic_rig() -> SensorRig:
    """Vehicle of 4 kg with downward camera and LIDAR, without calibration error."""
    down = BODY_FROM_DOWNWARD_OPTICAL
    side = 0.24
    return SensorRig(
        tick_hz=600,
        body_from_imu=Pose(np.eye(3), np.zeros(3)),
        body_from_lidar=Pose(down, np.array([0.0, 0.0, -0.135])),
        body_from_camera=Pose(down, np.array([0.075, 0.025, -0.12])),
        body_from_camera_right=Pose(down, np.array([0.075, -0.025, -0.12])),
        camera=CameraIntrinsics(width=424, height=240, fx=308.0, fy=312.0, cx=211.5, cy=119.5),
        lidar=LidarSheet(min_range_m=0.1),
        imu=ImuSheet(),
        imu_ticks=3,
        camera_ticks=20,
        lidar_scan_ticks=60,
        compute_latency_ticks=36,
        world_from_body_start=Pose(rotation_from_yaw(0.3), np.array([4.0, -2.0, 0.31])),
        vehicle=VehicleModel(
            mass_kg=4.0,
            inertia_kgm2=np.array([0.08, 0.08, 0.1]),
            rotor_xy_m=side * np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]]),
            rotor_spin=np.array([1.0, -1.0, 1.0, -1.0]),
            thrust_coefficient=6.5e-5,
            torque_coefficient=1.6e-6,
            rotor_speed_min=80.0,
            rotor_speed_max=565.0,
            motor_time_constant_s=0.04,
            linear_drag=0.65,
            leg_height_m=0.31,
            footprint_radius_m=0.53,
        ),
        nav=NavSheet(),
    )


class SyntheticStream:
    """Observations of ``seconds`` with the sensors of ``needs``, the same in every iteration.

    ``turn_rad``: change of the heading during the climb.
    """

    def __init__(
        self,
        rig: SensorRig,
        needs: SensorNeeds,
        seconds: float,
        turn_rad: float = 0.0,
    ) -> None:
        self._rig, self._needs = rig, needs
        self._seconds, self._turn_rad = seconds, turn_rad
        self._start = rig.world_from_body_start
        tiles = np.random.default_rng([0, 1]).integers(30, 226, (256, 256, 3))
        self._tiles = tiles.astype(np.float32)

    def __iter__(self) -> Iterator[Observation]:
        rng = np.random.default_rng([0, 2])
        arriving: defaultdict[int, defaultdict[str, list[Any]]]
        arriving = defaultdict(lambda: defaultdict(list))
        sensors = self._sensors()
        for tick in range(round(self._seconds * self._rig.tick_hz) + 1):
            for name, period, latency, measure in sensors:
                if tick and tick % period == 0:
                    steps = -(-(tick + latency) // CONTROL_TICKS)
                    arriving[steps][name].append(measure(tick, rng))
            if tick % CONTROL_TICKS == 0:
                yield self._observation(tick, arriving.pop(tick // CONTROL_TICKS, {}))

    def true_pose(self, tick: int) -> Pose:
        """``world_from_body``; level."""
        times = np.array([tick / self._rig.tick_hz])
        heading = rotation_from_yaw(float(self._headings(times)[0]))
        return Pose(self._start.rotation @ heading, self._points(times, np.zeros(3))[0])

    def _sensors(self) -> list[tuple[str, int, int, Callable[..., Any]]]:
        """(field, period and latency in ticks, measuring function) of the sensors that are
        needed."""
        rig, needs, late = self._rig, self._needs, self._rig.compute_latency_ticks
        image_ticks = rig.tick_hz // max(1, needs.camera_hz)
        found: list[tuple[str, int, int, Callable[..., Any]]] = [
            ("imu", rig.imu_ticks, 0, self._imu)
        ]
        found += [("scans", rig.lidar_scan_ticks, late, self._scan)] if needs.lidar else []
        found += [("images", image_ticks, late, self._image)] if needs.camera_hz else []
        for name in ("gps", "barometer", "magnetometer", "rangefinder"):
            if getattr(needs, name):
                sheet = getattr(rig.nav, name)
                found.append(
                    (name, sheet.period_ticks, sheet.latency_ticks, getattr(self, f"_{name}"))
                )
        return found

    # ------------------------------------------------------------------------ the flight

    def _progress(self, times_s: Array) -> Array:
        """(N,) 0 at rest, then of minimum jerk to at most 1."""
        span_s = max(self._seconds - REST_S, 0.1)
        smooth = minimum_jerk((times_s - REST_S) / span_s)[0]
        return np.asarray(smooth * min(1.0, span_s / _CLIMB_S) ** 2)  # as it can accelerate

    def _headings(self, times_s: Array) -> Array:
        """(N,) change of the heading since the start, rad."""
        return np.asarray(self._turn_rad * self._progress(times_s))

    def _points(self, times_s: Array, offset_body: Array) -> Array:
        """(N, 3) world positions of what is mounted at ``offset_body`` (3,)."""
        offsets = np.broadcast_to(offset_body, (len(times_s), 3))
        aside = self._start.rotation @ np.array([0.6, 0.8, 0.0])
        way = _ASIDE_M * aside + np.array([0.0, 0.0, _CLIMB_M])
        positions = self._start.translation + self._progress(times_s)[:, None] * way
        return np.asarray(positions + self._in_world(times_s, offsets))

    def _in_world(self, times_s: Array, vectors: Array) -> Array:
        """(N, 3) in the world, of (N, 3) in the body at these times."""
        heading = self._headings(times_s)
        cos, sin, (x, y, z) = np.cos(heading), np.sin(heading), vectors.T
        about_z = np.column_stack([cos * x - sin * y, sin * x + cos * y, z])
        return np.asarray(about_z @ self._start.rotation.T)

    def _mean_acceleration(
        self, tick: int, over_ticks: int, offset_body: Array | float = 0.0
    ) -> Array:
        """(3,) over the ticks before ``tick``, from velocities by central differences."""
        hz, half = self._rig.tick_hz, 0.5
        edges = np.array([tick - over_ticks - half, tick - over_ticks + half, tick - half])
        at = self._points(np.append(edges, tick + half) / hz, np.asarray(offset_body))
        return np.asarray(((at[3] - at[2]) - (at[1] - at[0])) * hz * hz / over_ticks)

    def _observation(self, tick: int, arrived: dict[str, list[Any]]) -> Observation:
        vehicle = self._rig.vehicle
        up = self._mean_acceleration(max(tick, 4), 3)[2] + GRAVITY_MPS2
        speed = math.sqrt(vehicle.mass_kg * up / (4.0 * vehicle.thrust_coefficient))
        if tick < 0.5 * REST_S * self._rig.tick_hz:
            speed = 0.0
        return Observation(
            tick=tick,
            time_s=tick / self._rig.tick_hz,
            rotor_speed_radps=np.full(4, speed),
            battery_fraction=1.0 - 1e-5 * tick,
            **{name: tuple(messages) for name, messages in arrived.items()},
        )

    # ------------------------------------------------------------------------ the sensors

    def _time(self, tick: int) -> dict[str, Any]:
        return {"tick": tick, "time_s": tick / self._rig.tick_hz}

    def _imu(self, tick: int, rng: np.random.Generator) -> ImuSample:
        rig, mount = self._rig, self._rig.body_from_imu
        force = self._mean_acceleration(tick, rig.imu_ticks, mount.translation)
        force = force + np.array([0.0, 0.0, GRAVITY_MPS2])
        before, middle, now = self._headings(np.arange(tick - rig.imu_ticks, tick + 1.0,
                                                    0.5 * rig.imu_ticks) / rig.tick_hz)  # fmt: skip
        turn_rate = np.array([0.0, 0.0, (now - before) * rig.tick_hz / rig.imu_ticks])
        world_from_imu = self._start.rotation @ rotation_from_yaw(float(middle)) @ mount.rotation
        noise = math.sqrt(rig.tick_hz / rig.imu_ticks)
        return ImuSample(
            **self._time(tick),
            angular_velocity=mount.rotation.T @ turn_rate
            + rig.imu.gyro_density * noise * rng.standard_normal(3),
            specific_force=world_from_imu.T @ force
            + rig.imu.accel_density * noise * rng.standard_normal(3),
        )

    def _scan(self, tick: int, rng: np.random.Generator) -> LidarScan:
        rig = self._rig
        start = tick - rig.lidar_scan_ticks
        span_s = rig.lidar_scan_ticks / rig.tick_hz
        offsets: Array = np.arange(1.0, _PULSES + 1.0) * (span_s / _PULSES)
        phase: Array = start / rig.tick_hz + offsets
        across = np.radians(38.0) * np.sin(2.0 * np.pi * 97.3 * phase)
        along = np.radians(12.0) * np.sin(2.0 * np.pi * 71.9 * phase)
        rays = np.column_stack([np.tan(across), np.tan(along), np.ones(_PULSES)])
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        origins = self._points(phase, rig.body_from_lidar.translation)
        aimed = self._in_world(phase, rays @ rig.body_from_lidar.rotation.T)
        ranges = _ranges_to_ground(origins, aimed)
        ranges += 0.01 * rng.standard_normal(_PULSES)
        return LidarScan(
            start_tick=start,
            end_tick=tick,
            start_time_s=start / rig.tick_hz,
            end_time_s=tick / rig.tick_hz,
            directions=rays.astype(np.float32),
            ranges=np.where(ranges > rig.lidar.min_range_m, ranges, 0.0).astype(np.float32),
            time_offsets=offsets.astype(np.float32),
            intensity=np.full(_PULSES, 60, np.uint8),
        )

    def _image(self, tick: int, rng: np.random.Generator) -> CameraImage:
        rig = self._rig
        right = rig.body_from_camera_right if self._needs.stereo else None
        return CameraImage(
            **self._time(tick),
            rgb=self._render(tick, rig.body_from_camera, rng),
            right_rgb=None if right is None else self._render(tick, right, rng),
        )

    def _render(self, tick: int, mount: Pose, rng: np.random.Generator) -> NDArray[np.uint8]:
        k = self._rig.camera
        columns, rows = np.meshgrid(np.arange(k.width), np.arange(k.height))
        rays = np.stack([(columns - k.cx) / k.fx, (rows - k.cy) / k.fy, np.ones_like(rows)], -1)
        camera = self.true_pose(tick) @ mount
        # Single precision and three steps leave less than a thousandth of a pixel.
        rays = rays.reshape(-1, 3).astype(np.float32) @ camera.rotation.T.astype(np.float32)
        eye = camera.translation.astype(np.float32)
        distances = _ranges_to_ground(eye, rays, steps=3)
        places = (eye + distances[:, None] * rays)[:, :2] / np.float32(_TILE_M)
        x, y = places.T.reshape(2, k.height, k.width)
        levels = cv2.remap(self._tiles, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        noise = rng.standard_normal(levels.shape, np.float32)
        levels = levels + np.float32(1.5) * noise
        return np.clip(np.rint(levels), 0, 255).astype(np.uint8)

    def _gps(self, tick: int, rng: np.random.Generator) -> GpsFix:
        hz = self._rig.tick_hz
        antenna = np.array(self._rig.nav.gps.antenna_body_m)
        around = self._points(np.array([tick - 1.0, tick, tick + 1.0]) / hz, antenna)
        sigma = np.array([0.5, 0.5, 0.75])
        return GpsFix(
            **self._time(tick),
            position_world=around[1] + 0.2 * sigma * rng.standard_normal(3),
            velocity_world=(around[2] - around[0]) * 0.5 * hz + 0.05 * rng.standard_normal(3),
            sigma_position_m=sigma,
            sigma_velocity_mps=0.05,
        )

    def _barometer(self, tick: int, rng: np.random.Generator) -> BarometerSample:
        site = self._rig.nav.barometer.site_elevation_m
        height = float(self.true_pose(tick).translation[2] + 0.1 * rng.standard_normal())
        pressure = pressure_at(site + height)
        return BarometerSample(**self._time(tick), pressure_pa=pressure, altitude_m=height)

    def _magnetometer(self, tick: int, rng: np.random.Generator) -> MagnetometerSample:
        params = self._rig.nav.magnetometer
        field = self.true_pose(tick).rotation.T @ earth_field_world(params)
        noise = params.noise_sigma_ut * rng.standard_normal(3)
        return MagnetometerSample(**self._time(tick), field_body_ut=field + noise)

    def _rangefinder(self, tick: int, rng: np.random.Generator) -> RangefinderSample:
        start = self.true_pose(tick).apply(np.array(self._rig.nav.rangefinder.position_body_m))
        distance = _ranges_to_ground(start, np.array([[0.0, 0.0, -1.0]]))[0]
        return RangefinderSample(
            **self._time(tick), range_m=float(max(0.0, distance + 0.02 * rng.standard_normal()))
        )


def minimum_jerk(fraction: Array) -> Array:
    """Place of a motion from 0 to 1 at a fraction of its time, and its first two derivatives."""
    s = np.clip(fraction, 0.0, 1.0)
    place = s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
    return np.array([place, 30.0 * s**2 * (1.0 - s) ** 2, 60.0 * s * (1.0 - s) * (1.0 - 2.0 * s)])


def ground_height(xy: Reals) -> Reals:
    """(N,) heights of the synthetic ground under (N, 2), world frame."""
    x, y = xy[:, 0], xy[:, 1]
    return np.asarray(0.06 * np.sin(0.9 * x + 0.3) * np.cos(0.7 * y) - 0.06)


def _ranges_to_ground(origins: Reals, rays: Reals, steps: int = 6) -> Reals:
    """(N,) along downward ``rays`` (N, 3), in their length, by fixed-point steps: the slopes are
    gentle."""
    height = np.broadcast_to(origins, rays.shape)[:, 2]
    distances = -height / rays[:, 2]
    for _ in range(steps):
        at = origins + distances[:, None] * rays
        distances = (ground_height(at[:, :2]) - height) / rays[:, 2]
    return np.asarray(distances)
