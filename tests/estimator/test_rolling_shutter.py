"""Pixels of a rolling shutter moved to one instant, the middle row's stamp, and poses of the trail.

Points are projected into a camera that turns and flies while its rows are exposed, each from the
pose of its own row, by iteration; no function under test takes part in it.
"""

from dataclasses import replace

import numpy as np
import pytest

from touchdown.estimator.api import FlownImuParams
from touchdown.estimator.baselines.optical_flow import HybridFlowEstimator
from touchdown.estimator.filtering.camera_model import (
    CameraTwist,
    ShutterModel,
    at_middle_row,
    ground_depths,
)
from touchdown.estimator.filtering.inertial_filter import InertialFilter, with_flown_noise
from touchdown.sim.api import CameraImage
from touchdown.sim.frames import BODY_FROM_DOWNWARD_OPTICAL, Pose, so3_exp, so3_log

from support.livo_flight import inertial
from support.zou2024_flight import make_rig

READOUT_S = 0.015
RIG = replace(make_rig(), camera_readout_s=READOUT_S)
RATE, VELOCITY = np.array([0.6, -0.5, 0.7]), np.array([6.0, -4.0, 2.0])
HEIGHT_M = 20.0
CAMERA = Pose(
    so3_exp(np.array([0.1, -0.05, 0.4])) @ BODY_FROM_DOWNWARD_OPTICAL,
    np.array([0.0, 0.0, HEIGHT_M + 3.0]),
)


def pixel_of(point: np.ndarray) -> np.ndarray:
    camera = RIG.camera
    return point[:2] / point[2] * [camera.fx, camera.fy] + [camera.cx, camera.cy]


def seen_by_row(point: np.ndarray, late_s: float) -> np.ndarray:
    """Where a point of the camera's frame at the instant appears in the rolling image."""
    pixel = pixel_of(point)
    for _ in range(20):
        delay = late_s + READOUT_S * (pixel[1] / (RIG.camera.height - 1) - 0.5)
        turn = so3_exp(delay * RATE)
        pixel = pixel_of(turn.T @ (point - delay * VELOCITY))
    return pixel


def ground_points() -> np.ndarray:
    """(N, 3) of the ground 20 m below in the camera's frame."""
    x, y = np.meshgrid(np.linspace(-5.0, 5.0, 7), np.linspace(-2.0, 2.0, 7))
    world = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 3.0)])
    return CAMERA.inverse().apply(world)


@pytest.mark.parametrize("late_s", [0.0, 0.004, -0.002])
def test_pixels_of_rows_are_those_of_one_instant(late_s: float) -> None:
    points = ground_points()
    true = np.array([pixel_of(p) for p in points])
    rolling = np.array([seen_by_row(p, late_s) for p in points])
    assert np.abs(rolling - true).max() > 1.0
    model, twist = ShutterModel(RIG), CameraTwist(RATE, VELOCITY, late_s)
    depths = ground_depths(rolling, RIG.camera, CAMERA, 3.0)
    np.testing.assert_allclose(model.to_instant(rolling, depths, twist), true, atol=0.03)
    np.testing.assert_allclose(model.to_rows(true, points[:, 2], twist), rolling, atol=0.03)


def test_a_global_shutter_on_time_changes_nothing() -> None:
    pixels = np.array([[10.0, 20.0]])
    model = ShutterModel(make_rig())
    twist = CameraTwist(RATE, VELOCITY, 0.0)
    assert model.idle(twist) and model.to_instant(pixels, np.ones(1), twist) is pixels
    assert model.to_rows(pixels, np.ones(1), twist) is pixels
    image = CameraImage(tick=60, time_s=0.1, rgb=np.zeros((2, 2, 3), np.uint8))
    assert at_middle_row(image, make_rig()) is image


def test_the_stamp_moves_to_the_middle_row() -> None:
    image = CameraImage(tick=60, time_s=0.1004, rgb=np.zeros((2, 2, 3), np.uint8))
    moved = at_middle_row(image, RIG)
    assert moved.time_s == pytest.approx(0.0929)
    assert moved.tick == 56  # 55.74


def flown(rate: np.ndarray, ticks: int) -> InertialFilter:
    """A filter after samples of constant angular rate, free of load but for gravity's reaction."""
    flying = InertialFilter(RIG)
    rotation = flying.eskf.state.rotation
    for tick in range(3, ticks + 1, 3):
        up = rotation @ so3_exp((tick - 1.5) / 600 * rate)
        flying.take_imu(inertial(tick, rate, up.T @ [3.0, 0.0, 9.80665], 400.0))
    flying.carry_to(ticks)
    return flying


def test_poses_of_the_trail_lie_between_its_steps() -> None:
    rate = np.array([0.0, 0.0, 0.5])
    flying = flown(rate, 240)
    start = flying.rig.world_from_body_start @ flying.rig.body_from_imu
    for tick in (181, 200, 238, 240):
        pose = flying.trail.pose_at(tick)
        turned = so3_log(start.rotation.T @ pose.rotation)
        np.testing.assert_allclose(turned, tick / 600 * rate, atol=1e-9)
        travelled = pose.translation - start.translation
        np.testing.assert_allclose(travelled, [1.5 * (tick / 600) ** 2, 0.0, 0.0], atol=1e-3)
    now = flying.eskf.state.pose
    np.testing.assert_allclose(flying.trail.pose_at(300).translation, now.translation)


def test_the_motion_is_that_at_the_filter_time() -> None:
    flying = flown(np.array([0.0, 0.0, 0.5]), 240)
    image = CameraImage(tick=242, time_s=242.2 / 600, rgb=np.zeros((2, 2, 3), np.uint8))
    twist = flying.camera_twist(image)
    assert twist.late_s == pytest.approx(2.2 / 600)
    to_camera = flying.imu_from_camera.rotation.T
    np.testing.assert_allclose(twist.rate, to_camera @ [0.0, 0.0, 0.5], atol=1e-9)
    state = flying.eskf.state
    swing = np.cross([0.0, 0.0, 0.5], flying.imu_from_camera.translation)
    expected = to_camera @ (state.rotation.T @ state.velocity + swing)
    np.testing.assert_allclose(twist.velocity, expected, atol=1e-9)


def test_the_levelled_image_gives_directions_of_one_instant() -> None:
    estimator = HybridFlowEstimator(RIG)
    attitude = CAMERA.rotation
    twist = CameraTwist(RATE, VELOCITY, 0.002)
    world = np.array([[4.0, 2.0, 3.0], [-3.0, 1.0, 3.0]])
    rolling = np.array([seen_by_row(p, 0.002) for p in CAMERA.inverse().apply(world)])
    camera = RIG.camera
    rays = np.column_stack(
        [(rolling - [camera.cx, camera.cy]) / [camera.fx, camera.fy], np.ones(2)]
    )
    level = rays @ attitude.T
    turn = BODY_FROM_DOWNWARD_OPTICAL[:2, :2]
    pixels = (level[:, :2] / -level[:, 2:]) @ turn * estimator._view.focal + 127.5
    found = estimator._directions(pixels, attitude, twist, HEIGHT_M)
    plain = estimator._view.directions(pixels)
    true = world[:, :2] / HEIGHT_M
    assert np.abs(plain - true).max() > 2e-3
    np.testing.assert_allclose(found, true, atol=2e-4)


def test_the_noise_of_flight_is_never_below_the_data_sheet() -> None:
    rig = make_rig()
    imu = with_flown_noise(rig, FlownImuParams(gyro_density=1e-6, accel_density=0.5)).imu
    assert imu.gyro_density == rig.imu.gyro_density and imu.accel_density == 0.5
    assert with_flown_noise(rig, FlownImuParams()) == rig


def test_ground_is_nowhere_endlessly_deep() -> None:
    level = Pose(np.eye(3), np.array([0.0, 0.0, 4.0]))  # looks up
    depths = ground_depths(np.array([[100.0, 50.0]]), RIG.camera, level, 0.0)
    np.testing.assert_allclose(depths, 20.0)
