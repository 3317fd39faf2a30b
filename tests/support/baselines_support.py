"""A rig, a texture and a short flight for the tests of the baselines."""

import cv2
import numpy as np

from touchdown.experiments.config.schema import Config
from touchdown.sim.api import CameraIntrinsics, ImuSheet, LidarSheet, SensorRig, VehicleModel
from touchdown.sim.frames import BODY_FROM_DOWNWARD_OPTICAL, Pose

from support.worlds import load_ideal_config as load_config

HZ = 600


def make_rig() -> SensorRig:
    here = Pose.identity()
    return SensorRig(
        tick_hz=HZ,
        body_from_imu=here,
        body_from_lidar=here,
        body_from_camera=Pose(BODY_FROM_DOWNWARD_OPTICAL, np.zeros(3)),
        body_from_camera_right=Pose(BODY_FROM_DOWNWARD_OPTICAL, np.array([0.0, -0.05, 0.0])),
        camera=CameraIntrinsics(width=64, height=48, fx=60.0, fy=60.0, cx=31.5, cy=23.5),
        lidar=LidarSheet(),
        imu=ImuSheet(),
        imu_ticks=3,
        camera_ticks=20,
        lidar_scan_ticks=60,
        compute_latency_ticks=36,
        world_from_body_start=Pose(np.eye(3), np.array([0.0, 0.0, 0.3])),
        vehicle=VehicleModel(
            mass_kg=4.0, inertia_kgm2=np.ones(3), rotor_xy_m=np.zeros((4, 2)),
            rotor_spin=np.ones(4), thrust_coefficient=1e-5, torque_coefficient=1e-7,
            rotor_speed_min=100.0, rotor_speed_max=1000.0, motor_time_constant_s=0.02,
            linear_drag=0.1, leg_height_m=0.3, footprint_radius_m=0.4,
        ),
    )  # fmt: skip


def texture(side: int, seed: int = 3) -> np.ndarray:
    """Blobs of several sizes, (side, side) uint8."""
    rng = np.random.default_rng(seed)
    total = np.zeros((side, side), np.float32)
    for blur in (1.5, 3.0, 8.0):
        layer = cv2.GaussianBlur(rng.standard_normal((side, side)).astype(np.float32), (0, 0), blur)
        total += layer / layer.std()
    return np.clip(128.0 + 30.0 * total, 0, 255).astype(np.uint8)


TINY = (
    "scene_seed=0", "sim.threads=1", "mapper.enabled=false", "survey.height_m=5", "survey.legs=1",
    "survey.leg_length_m=8", "survey.duration_s=4", "camera.width=424", "camera.height=240",
)  # fmt: skip
"""About 10 s in the air."""


def tiny(estimator: str, *more: str) -> Config:
    return load_config(
        None, (*TINY, *more), scene="flat", estimator=estimator, seed=103, survey_only=True
    )
