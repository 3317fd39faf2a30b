"""The paper's estimator as a whole on a short made-up flight, and against broken input."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from touchdown.estimator.api import Zou2024Params
from touchdown.estimator.zou2024.estimator import Zou2024Estimator
from touchdown.sim.api import GRAVITY_MPS2, CameraImage, ImuSample, LidarScan, Observation

from support.livo_flight import HZ, IMU_TICKS, LATENCY, SCAN_TICKS, START_Z, error
from support.zou2024_flight import FLIGHT, PLAIN, RIG, clean, fly, image_at, scan_ending_at


def test_a_clean_flight_is_followed() -> None:
    estimates = clean()
    last = estimates[-1]
    assert max(map(error, estimates)) < 0.03
    np.testing.assert_allclose(last.velocity_odom, [last.time_s, 0.0, 0.0], atol=0.03)
    assert last.diagnostics["landmarks_used"] >= 15 and last.diagnostics["lidar_planes"] > 60
    assert last.diagnostics["keyframes"] >= 2 and last.healthy


@pytest.mark.parametrize("part", ["lidar_pose", "camera_pose", "colour_smoothness", "bundle"])
def test_every_part_can_be_left_out(part: str) -> None:
    estimates = fly(FLIGHT, left_out(part))
    assert max(map(error, estimates)) < 0.06


def left_out(part: str) -> Zou2024Params:
    switches: dict[str, Any] = {f"use_{part}": False}
    return dataclasses.replace(PLAIN, **switches)


def test_standing_without_returns_it_does_not_drift() -> None:
    """On the pad the ground is nearer than the LIDAR's smallest range and the image never changes:
    an unknown bias of 0.05 m/s^2 would move the estimate by 0.22 m in 3 s without zero-velocity
    updates."""
    bias = np.array([0.05, 0.0, 0.0])
    force = np.array([0.0, 0.0, GRAVITY_MPS2]) + bias
    image = image_at(0)
    estimator = Zou2024Estimator(RIG, PLAIN)
    worst = 0.0
    for tick in range(IMU_TICKS, 3 * HZ + 1, IMU_TICKS):
        imu = ImuSample(
            tick=tick, time_s=tick / HZ, angular_velocity=np.zeros(3), specific_force=force
        )
        made = tick - LATENCY
        scans: tuple[LidarScan, ...] = ()
        images: tuple[CameraImage, ...] = ()
        if made >= SCAN_TICKS and made % SCAN_TICKS == 0:
            scan = scan_ending_at(made)
            scans = (dataclasses.replace(scan, ranges=np.zeros_like(scan.ranges)),)
            images = (dataclasses.replace(image, tick=made, time_s=made / HZ),)
        obs = Observation(
            tick=tick, time_s=tick / HZ, imu=(imu,), scans=scans, images=images,
            rotor_speed_radps=np.zeros(4), battery_fraction=1.0,
        )  # fmt: skip
        off = estimator.update(obs).world_from_body.translation - [0.0, 0.0, START_Z]
        worst = max(worst, float(np.linalg.norm(off)))
    assert worst < 0.01
