"""A short synthetic flight for `zou2024`: that for `livo` with finer images and a regular LIDAR."""

import dataclasses
import functools
from typing import Any

import cv2
import numpy as np

from touchdown.estimator.api import Estimate, Zou2024Params
from touchdown.estimator.zou2024.estimator import Zou2024Estimator
from touchdown.estimator.zou2024.visual_map import Features
from touchdown.sim.api import CameraImage, CameraIntrinsics, LidarScan, Observation, SensorRig
from touchdown.sim.frames import Pose

from support import livo_flight
from support.livo_flight import HZ, SCAN_TICKS, START_Z, position_at
from support.messages import make_scan

LAST = 960
NOTHING = np.zeros((0, 3))
TEXEL_M = 0.05
PLAIN = Zou2024Params(sift_features=150, brisk_features=150)


def make_rig(distortion: float = 0.0) -> SensorRig:
    """That of `livo`'s flight with a camera of twice the resolution."""
    rig = livo_flight.make_rig(distortion)
    camera = CameraIntrinsics(
        width=424, height=240, fx=308.0, fy=312.0, cx=211.5, cy=119.5,
        distortion=rig.camera.distortion,
    )  # fmt: skip
    return dataclasses.replace(rig, camera=camera)


RIG = make_rig()
IMU_FROM_CAMERA = RIG.body_from_imu.inverse() @ RIG.body_from_camera


def params(**changes: Any) -> Zou2024Params:
    """Those of the flight with edges from gradients."""
    return dataclasses.replace(PLAIN, edge_model="gradient", **changes)


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
    return make_scan(tick, directions, (START_Z - 0.15) / directions[:, 2], offsets)


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


def features_of(descriptors: np.ndarray) -> Features:
    return Features(np.zeros((len(descriptors), 2)), descriptors.astype(np.uint8))


FLIGHT = livo_flight.observed(LAST, position_at, scan_ending_at, image_at)


@functools.cache
def clean() -> list[Estimate]:
    return fly(FLIGHT)


def fly(
    flight: list[Observation], params: Zou2024Params = PLAIN, rig: SensorRig = RIG
) -> list[Estimate]:
    estimator = Zou2024Estimator(rig, params)
    return [estimator.update(obs) for obs in flight]
