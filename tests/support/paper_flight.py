"""A short synthetic flight for `paper`."""

import cv2
import numpy as np

from touchdown.estimator.api import Estimate, PaperParams
from touchdown.estimator.paper.estimator import PaperEstimator
from touchdown.sim.api import (
    GRAVITY_MPS2,
    CameraImage,
    CameraIntrinsics,
    ImuParams,
    ImuSample,
    LidarParams,
    LidarScan,
    Observation,
    SensorRig,
    VehicleModel,
)
from touchdown.sim.frames import BODY_FROM_DOWNWARD_OPTICAL, Pose

HZ, IMU_TICKS, SCAN_TICKS, LATENCY, LAST = 600, 3, 60, 36, 960


START_Z = 12.0


TEXEL_M = 0.05


PLAIN = PaperParams(sift_features=150, brisk_features=150)


def make_rig(distortion: float = 0.0) -> SensorRig:
    down = BODY_FROM_DOWNWARD_OPTICAL
    return SensorRig(
        tick_hz=HZ, body_from_imu=Pose(np.eye(3), np.array([0.02, 0.0, 0.01])),
        body_from_lidar=Pose(down, np.array([0.0, 0.0, -0.15])),
        body_from_camera=Pose(down, np.array([0.075, 0.025, -0.13])),
        body_from_camera_right=Pose(down, np.array([0.075, -0.025, -0.13])),
        camera=CameraIntrinsics(
            width=424, height=240, fx=308.0, fy=312.0, cx=211.5, cy=119.5,
            distortion=np.array([distortion, 0.0, 0.0, 0.0, 0.0]),
        ),
        lidar=LidarParams(), imu=ImuParams(), imu_ticks=IMU_TICKS, camera_ticks=20,
        lidar_scan_ticks=SCAN_TICKS, compute_latency_ticks=LATENCY,
        world_from_body_start=Pose(np.eye(3), np.array([0.0, 0.0, START_Z])),
        vehicle=VehicleModel(
            mass_kg=4.0, inertia_kgm2=np.ones(3), rotor_xy_m=np.zeros((4, 2)),
            rotor_spin=np.array([1.0, -1.0, 1.0, -1.0]), thrust_coefficient=6e-5,
            torque_coefficient=1e-6, rotor_speed_min=80.0, rotor_speed_max=600.0,
            motor_time_constant_s=0.04, linear_drag=0.5, leg_height_m=0.3, footprint_radius_m=0.5,
        ),
    )  # fmt: skip


RIG = make_rig()


def position_at(t: float) -> np.ndarray:
    """Accelerates along x at 1 m/s^2, level."""
    return np.array([0.5 * t * t, 0.0, START_Z])


def scan_ending_at(tick: int) -> LidarScan:
    """Level ground z = 0 under the moving LIDAR, without noise."""
    count = 6000
    offsets = (np.arange(count) + 1.0) * (SCAN_TICKS / HZ / count)
    time_s = (tick - SCAN_TICKS) / HZ + offsets
    # six lasers side by side sweep across and, more slowly, along
    across = 0.8 * np.sin(2 * np.pi * 41.0 * time_s)
    along = 0.36 * np.sin(2 * np.pi * 7.3 * time_s) + 0.012 * (np.arange(count) % 6)
    slopes = np.column_stack([across, along])
    directions = np.column_stack([slopes, np.ones(count)])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return LidarScan(
        start_tick=tick - SCAN_TICKS, end_tick=tick, start_time_s=(tick - SCAN_TICKS) / HZ,
        end_time_s=tick / HZ, directions=directions.astype(np.float32),
        ranges=((START_Z - 0.15) / directions[:, 2]).astype(np.float32),
        time_offsets=offsets.astype(np.float32), intensity=np.full(count, 40, dtype=np.uint8),
    )  # fmt: skip


def _ground() -> np.ndarray:
    """40 m x 40 m of blobs of many sizes."""
    rng, side = np.random.default_rng(11), int(40 / TEXEL_M)
    total = np.zeros((side, side), np.float32)
    for cells in (40, 90, 200):
        grid = rng.uniform(-1, 1, (cells, cells)).astype(np.float32)
        total += cv2.resize(grid, (side, side), interpolation=cv2.INTER_CUBIC)
    return np.clip(128 + 45 * total, 0, 255).astype(np.uint8)


GROUND = _ground()


def ground_seen(pose: Pose, rig: SensorRig = RIG) -> np.ndarray:
    """(H, W, 3) points of the ground z = 0 at the pixels of the camera of a body at ``pose``."""
    camera, eye = rig.camera, pose @ rig.body_from_camera
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = np.stack(
        [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], -1
    )
    ways = rays @ eye.rotation.T
    return eye.translation - eye.translation[2] / ways[..., 2:] * ways


def image_from(pose: Pose, tick: int, rig: SensorRig = RIG) -> CameraImage:
    at = ((ground_seen(pose, rig)[..., :2] + 20.0) / TEXEL_M).astype(np.float32)
    grey = cv2.remap(GROUND, at[..., 0], at[..., 1], cv2.INTER_LINEAR)
    return CameraImage(tick=tick, time_s=tick / HZ, rgb=np.repeat(grey[..., None], 3, axis=2))


def image_at(tick: int, rig: SensorRig = RIG) -> CameraImage:
    return image_from(Pose(np.eye(3), position_at(tick / HZ)), tick, rig)


def observations() -> list[Observation]:
    found = []
    for tick in range(0, LAST + 1, IMU_TICKS):
        measured = tick - LATENCY
        due = measured > 0 and measured % SCAN_TICKS == 0
        imu = ImuSample(
            tick=tick, time_s=tick / HZ, angular_velocity=np.zeros(3),
            specific_force=np.array([1.0, 0.0, GRAVITY_MPS2]),
        )  # fmt: skip
        found.append(
            Observation(
                tick=tick, time_s=tick / HZ, imu=(imu,) if tick else (),
                scans=(scan_ending_at(measured),) if due else (),
                images=(image_at(measured),) if due else (), rotor_speed_radps=np.full(4, 400.0),
                battery_fraction=1.0,
            )
        )  # fmt: skip
    return found


FLIGHT = observations()


def fly(
    flight: list[Observation], params: PaperParams = PLAIN, rig: SensorRig = RIG
) -> list[Estimate]:
    estimator = PaperEstimator(rig, params)
    return [estimator.update(obs) for obs in flight]


def error(estimate: Estimate) -> float:
    true = position_at(estimate.time_s)
    return float(np.linalg.norm(estimate.world_from_body.translation - true))
