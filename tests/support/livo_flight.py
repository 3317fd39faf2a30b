"""A short synthetic flight for `livo`."""

import functools
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from touchdown.estimator.api import Estimate, LivoParams
from touchdown.estimator.livo.estimator import Livo
from touchdown.sim.api import (
    GRAVITY_MPS2,
    CameraImage,
    CameraIntrinsics,
    ImuSample,
    ImuSheet,
    LidarScan,
    LidarSheet,
    Observation,
    SensorRig,
    VehicleModel,
)
from touchdown.sim.frames import BODY_FROM_DOWNWARD_OPTICAL, Pose

from support.messages import HZ, SCAN_TICKS, make_scan

IMU_TICKS, LATENCY = 3, 36


START_Z = 12.0
Motion = Callable[[float], np.ndarray]
"""Position in metres by time in seconds."""
DOWN = BODY_FROM_DOWNWARD_OPTICAL


def make_rig(distortion: float = 0.0) -> SensorRig:
    """Starts at 12 m, so that a second of data is enough; the IMU sits off the centre."""
    return SensorRig(
        tick_hz=HZ, body_from_imu=Pose(np.eye(3), np.array([0.02, 0.0, 0.01])),
        body_from_lidar=Pose(DOWN, np.array([0.0, 0.0, -0.15])),
        body_from_camera=Pose(DOWN, np.array([0.075, 0.025, -0.13])),
        body_from_camera_right=Pose(DOWN, np.array([0.075, -0.025, -0.13])),
        camera=CameraIntrinsics(
            width=212, height=120, fx=154.0, fy=156.0, cx=105.5, cy=59.5,
            distortion=np.array([distortion, 0.0, 0.0, 0.0, 0.0]),
        ),
        lidar=LidarSheet(), imu=ImuSheet(), imu_ticks=IMU_TICKS, camera_ticks=20,
        lidar_scan_ticks=SCAN_TICKS, compute_latency_ticks=LATENCY,
        world_from_body_start=Pose(np.eye(3), np.array([0.0, 0.0, START_Z])),
        vehicle=VehicleModel(
            mass_kg=4.0, inertia_kgm2=np.ones(3), rotor_xy_m=np.zeros((4, 2)),
            rotor_spin=np.array([1.0, -1.0, 1.0, -1.0]), thrust_coefficient=6e-5,
            torque_coefficient=1e-6, rotor_speed_min=80.0, rotor_speed_max=600.0,
            motor_time_constant_s=0.04, linear_drag=0.5, leg_height_m=0.3, footprint_radius_m=0.5,
        ),
    )  # fmt: skip


def position_at(t: float) -> np.ndarray:
    """Accelerates along x at 1 m/s^2, level."""
    return np.array([0.5 * t * t, 0.0, START_Z])


def swaying(t: float) -> np.ndarray:
    """To and fro along x, at up to 4 m/s and 8 m/s^2."""
    return np.array([2.0 * (1.0 - np.cos(2.0 * t)), 0.0, START_Z])


def scan_ending_at(tick: int, motion: Motion = position_at) -> LidarScan:
    """Level ground z = 0 under the moving LIDAR, without noise."""
    rng = np.random.default_rng(tick)
    count, start_s = 4000, (tick - SCAN_TICKS) / HZ
    offsets = np.sort(rng.uniform(0.0, SCAN_TICKS / HZ, count))
    directions = np.column_stack([rng.uniform(-0.8, 0.8, count), rng.uniform(-0.22, 0.22, count)])
    directions = np.column_stack([directions, np.ones(count)])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    heights = np.array([motion(start_s + offset)[2] for offset in offsets])
    return make_scan(tick, directions, (heights - 0.15) / directions[:, 2], offsets)


def ground_grey(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A smooth pattern without repetition, grey levels."""
    waves = sum(
        np.sin(a * x + b * y + c) / k
        for k, (a, b, c) in enumerate(
            [
                (3.1, 0.7, 0.1), (0.9, -2.6, 1.0), (5.3, 4.1, 2.0), (-4.7, 6.1, 0.5),
                (8.9, -7.3, 1.3),
            ],
            start=1,
        )
    )  # fmt: skip
    return np.asarray(128.0 + 45.0 * waves)


def image_at(tick: int, rig: SensorRig, position: np.ndarray | None = None) -> CameraImage:
    """Stamped ``tick``, taken at ``position``; None: where the vehicle then is."""
    camera = rig.camera
    taken = position_at(tick / HZ) if position is None else position
    pose = Pose(np.eye(3), taken) @ rig.body_from_camera
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    pixels = np.stack([u.ravel(), v.ravel()], -1).astype(np.float64)
    if camera.distortion.any():
        pixels = cv2.undistortPoints(pixels, camera.matrix(), camera.distortion, P=camera.matrix())
    slopes = (pixels.reshape(-1, 2) - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    rays = np.column_stack([slopes, np.ones(u.size)]).reshape(*u.shape, 3)
    ground = pose.translation + pose.translation[2] * (rays @ pose.rotation.T)
    grey = np.clip(ground_grey(ground[..., 0], ground[..., 1]), 0, 255).astype(np.uint8)
    return CameraImage(tick=tick, time_s=tick / HZ, rgb=np.repeat(grey[..., None], 3, axis=2))


def inertial(
    tick: int, rate: np.ndarray, force: np.ndarray, rotors_radps: float = 0.0, **messages: Any
) -> Observation:
    """An observation with one sample of the IMU, but for the first of all."""
    sample = ImuSample(
        tick=tick, time_s=tick / HZ, angular_velocity=rate, specific_force=np.asarray(force)
    )
    return Observation(
        tick=tick, time_s=tick / HZ, imu=(sample,) if tick else (), battery_fraction=1.0,
        rotor_speed_radps=np.full(4, rotors_radps), **messages,
    )  # fmt: skip


def observed(
    last_tick: int, motion: Motion, scan_at: Callable[[int], LidarScan],
    image_at: Callable[[int], CameraImage] | None,
) -> list[Observation]:  # fmt: skip
    """What is measured while the rotors spin, scans and images each at ten a second."""
    found, step = [], IMU_TICKS / HZ
    for tick in range(0, last_tick + 1, IMU_TICKS):
        measured = tick - LATENCY
        due = measured > 0 and measured % SCAN_TICKS == 0
        # the mean over the interval that ends now, of a motion whose acceleration hardly changes
        now = motion(tick / HZ - 0.5 * step)
        around = motion(tick / HZ - 1.5 * step) + motion(tick / HZ + 0.5 * step) - 2.0 * now
        force = around / step**2 + np.array([0.0, 0.0, GRAVITY_MPS2])
        scans = (scan_at(measured),) if due else ()
        images = (image_at(measured),) if due and image_at else ()
        found.append(inertial(tick, np.zeros(3), force, 400.0, scans=scans, images=images))
    return found


def observations(
    rig: SensorRig, last_tick: int, motion: Motion = position_at, ahead_ticks: int = 0,
    *, seen: bool = True,
) -> list[Observation]:  # fmt: skip
    """``ahead_ticks``: of the camera's clock; ``seen``: with images."""

    def image(tick: int) -> CameraImage:
        return image_at(tick, rig, motion((tick - ahead_ticks) / HZ))

    return observed(
        last_tick, motion, lambda tick: scan_ending_at(tick, motion), image if seen else None
    )


RIG = make_rig()
FLIGHT = observations(RIG, 780)


@functools.cache
def clean() -> list[Estimate]:
    return fly(FLIGHT)


def fly(flight: list[Observation], rig: SensorRig = RIG) -> list[Estimate]:
    livo = Livo(rig, LivoParams())
    return [livo.update(obs) for obs in flight]


def error(estimate: Estimate) -> float:
    true = position_at(estimate.time_s)
    return float(np.linalg.norm(estimate.world_from_body.translation - true))
