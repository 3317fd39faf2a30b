"""The paper's estimator as a whole on a short made-up flight, and against broken input."""

from __future__ import annotations

import dataclasses
import itertools
from typing import Any

import cv2
import numpy as np
import pytest

from estimator.api import Estimate, PaperParams
from estimator.paper.estimator import PaperEstimator
from sim.api import (
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
from sim.frames import BODY_FROM_DOWNWARD_OPTICAL, Pose

HZ, IMU_TICKS, SCAN_TICKS, LATENCY, LAST = 600, 3, 60, 36, 960
START_Z = 12.0
TEXEL_M = 0.05
PLAIN = PaperParams(sift_features=150, brisk_features=150)


def make_rig(distortion: float = 0.0) -> SensorRig:
    down = BODY_FROM_DOWNWARD_OPTICAL
    return SensorRig(
        tick_hz=HZ,
        body_from_imu=Pose(np.eye(3), np.array([0.02, 0.0, 0.01])),
        body_from_lidar=Pose(down, np.array([0.0, 0.0, -0.15])),
        body_from_camera=Pose(down, np.array([0.075, 0.025, -0.13])),
        body_from_camera_right=Pose(down, np.array([0.075, -0.025, -0.13])),
        camera=CameraIntrinsics(
            width=424, height=240, fx=308.0, fy=312.0, cx=211.5, cy=119.5,
            distortion=np.array([distortion, 0.0, 0.0, 0.0, 0.0]),
        ),
        lidar=LidarParams(),
        imu=ImuParams(),
        imu_ticks=IMU_TICKS,
        camera_ticks=20,
        lidar_scan_ticks=SCAN_TICKS,
        compute_latency_ticks=LATENCY,
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
        start_tick=tick - SCAN_TICKS,
        end_tick=tick,
        start_time_s=(tick - SCAN_TICKS) / HZ,
        end_time_s=tick / HZ,
        directions=directions.astype(np.float32),
        ranges=((START_Z - 0.15) / directions[:, 2]).astype(np.float32),
        time_offsets=offsets.astype(np.float32),
        intensity=np.full(count, 40, dtype=np.uint8),
    )


def _ground() -> np.ndarray:
    """40 m x 40 m of blobs of many sizes."""
    rng, side = np.random.default_rng(11), int(40 / TEXEL_M)
    total = np.zeros((side, side), np.float32)
    for cells in (40, 90, 200):
        grid = rng.uniform(-1, 1, (cells, cells)).astype(np.float32)
        total += cv2.resize(grid, (side, side), interpolation=cv2.INTER_CUBIC)
    return np.clip(128 + 45 * total, 0, 255).astype(np.uint8)


GROUND = _ground()


def image_at(tick: int, rig: SensorRig = RIG) -> CameraImage:
    camera = rig.camera
    pose = Pose(np.eye(3), position_at(tick / HZ)) @ rig.body_from_camera
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = np.stack(
        [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], -1
    )
    ground = pose.translation + pose.translation[2] * (rays @ pose.rotation.T)
    at = ((ground[..., :2] + 20.0) / TEXEL_M).astype(np.float32)
    grey = cv2.remap(GROUND, at[..., 0], at[..., 1], cv2.INTER_LINEAR)
    return CameraImage(tick=tick, time_s=tick / HZ, rgb=np.repeat(grey[..., None], 3, axis=2))


def observations() -> list[Observation]:
    found = []
    for tick in range(0, LAST + 1, IMU_TICKS):
        measured = tick - LATENCY
        due = measured > 0 and measured % SCAN_TICKS == 0
        imu = ImuSample(
            tick=tick,
            time_s=tick / HZ,
            angular_velocity=np.zeros(3),
            specific_force=np.array([1.0, 0.0, GRAVITY_MPS2]),
        )
        found.append(
            Observation(
                tick=tick,
                time_s=tick / HZ,
                imu=(imu,) if tick else (),
                scans=(scan_ending_at(measured),) if due else (),
                images=(image_at(measured),) if due else (),
                rotor_speed_radps=np.full(4, 400.0),
                battery_fraction=1.0,
            )
        )
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


def test_a_clean_flight_is_followed() -> None:
    estimates = fly(FLIGHT)
    last = estimates[-1]
    assert max(map(error, estimates)) < 0.03
    np.testing.assert_allclose(last.velocity_odom, [last.time_s, 0.0, 0.0], atol=0.03)
    assert last.diagnostics["landmarks_used"] >= 15
    assert last.diagnostics["lidar_planes"] > 60
    assert last.diagnostics["keyframes"] >= 2
    assert last.healthy
    for a, b in itertools.pairwise(estimates):
        step = b.odom_from_body.translation - a.odom_from_body.translation
        expected = 0.5 * (a.velocity_odom + b.velocity_odom) * (b.time_s - a.time_s)
        assert np.linalg.norm(step - expected) < 2e-3


def test_same_input_same_output_to_the_bit() -> None:
    for a, b in zip(fly(FLIGHT), fly(FLIGHT), strict=True):
        np.testing.assert_array_equal(a.world_from_body.translation, b.world_from_body.translation)
        np.testing.assert_array_equal(a.odom_from_body.rotation, b.odom_from_body.rotation)
        assert a.diagnostics == b.diagnostics


@pytest.mark.parametrize("part", ["lidar_pose", "camera_pose", "colour_smoothness", "bundle"])
def test_every_part_can_be_left_out(part: str) -> None:
    estimates = fly(FLIGHT, left_out(part))
    assert max(map(error, estimates)) < 0.06


def left_out(part: str) -> PaperParams:
    switches: dict[str, Any] = {f"use_{part}": False}
    return dataclasses.replace(PLAIN, **switches)


def broken(kind: str) -> list[Observation]:
    flight = list(FLIGHT)
    k = max(i for i, obs in enumerate(flight) if obs.scans and obs.tick < 700)
    scan, image = flight[k].scans[0], flight[k].images[0]
    if kind == "nan ranges":
        ranges = np.where(np.arange(len(scan.ranges)) % 2 == 0, np.nan, scan.ranges)
        worse = dataclasses.replace(scan, ranges=ranges.astype(np.float32))
        flight[k] = dataclasses.replace(flight[k], scans=(worse,))
    elif kind == "all nan":
        worse = dataclasses.replace(scan, ranges=np.full_like(scan.ranges, np.nan))
        flight[k] = dataclasses.replace(flight[k], scans=(worse,))
    elif kind == "empty scan":
        none = dataclasses.replace(
            scan,
            directions=scan.directions[:0],
            ranges=scan.ranges[:0],
            time_offsets=scan.time_offsets[:0],
            intensity=scan.intensity[:0],
        )
        flight[k] = dataclasses.replace(flight[k], scans=(none,))
    elif kind == "black images":
        for i in range(k, len(flight)):
            black = tuple(
                dataclasses.replace(im, rgb=np.zeros_like(im.rgb)) for im in flight[i].images
            )
            flight[i] = dataclasses.replace(flight[i], images=black)
    elif kind == "late":
        flight[k + 30] = dataclasses.replace(flight[k + 30], scans=(scan,), images=(image,))
    elif kind == "no lidar":
        flight[k:] = [dataclasses.replace(obs, scans=()) for obs in flight[k:]]
    elif kind == "no camera":
        flight[k:] = [dataclasses.replace(obs, images=()) for obs in flight[k:]]
    elif kind == "nan imu":
        sample = dataclasses.replace(flight[k].imu[0], angular_velocity=np.full(3, np.nan))
        flight[k] = dataclasses.replace(flight[k], imu=(sample,))
    return flight


@pytest.mark.parametrize(
    "kind",
    ["nan ranges", "all nan", "empty scan", "black images", "late", "no lidar", "no camera",
     "nan imu"],
)  # fmt: skip
def test_broken_input_costs_centimetres_at_most(kind: str) -> None:
    estimates = fly(broken(kind))
    assert max(map(error, estimates)) < 0.06
    for estimate in estimates:
        assert np.isfinite(estimate.position_covariance).all()
    if kind in ("black images", "late", "nan imu"):
        assert estimates[-1].diagnostics["skipped"] >= 1.0


def test_a_distorted_lens_is_accepted() -> None:
    assert fly(FLIGHT[:150], rig=make_rig(-0.01))[-1].healthy


def test_memory_is_bounded_by_the_keyframes_kept() -> None:
    few = dataclasses.replace(PLAIN, max_keyframes=4, recent_keyframes=2, keyframe_period_s=0.1)
    estimates = fly(FLIGHT, few)
    assert estimates[-1].diagnostics["keyframes"] <= 4
    assert max(map(error, estimates)) < 0.05


def test_a_missing_edge_model_is_named() -> None:
    with pytest.raises(FileNotFoundError, match="nowhere"):
        PaperEstimator(RIG, PaperParams(edge_model="nowhere.yml.gz"))


def test_standing_without_returns_it_does_not_drift() -> None:
    """On the pad the ground is nearer than the LIDAR's reach and the picture never changes: an
    unknown bias of 0.05 m/s^2 would carry the belief 0.22 m off in 3 s, were it not held."""
    bias = np.array([0.05, 0.0, 0.0])
    force = np.array([0.0, 0.0, GRAVITY_MPS2]) + bias
    picture = image_at(0)
    estimator = PaperEstimator(RIG, PLAIN)
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
            images = (dataclasses.replace(picture, tick=made, time_s=made / HZ),)
        obs = Observation(
            tick=tick, time_s=tick / HZ, imu=(imu,), scans=scans, images=images,
            rotor_speed_radps=np.zeros(4), battery_fraction=1.0,
        )  # fmt: skip
        off = estimator.update(obs).world_from_body.translation - [0.0, 0.0, START_Z]
        worst = max(worst, float(np.linalg.norm(off)))
    assert worst < 0.01
