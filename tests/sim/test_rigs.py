"""Turned mounts, a second LIDAR, spinning patterns, and a fisheye as estimators see it."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import pytest

from touchdown.estimator.filtering.camera_model import Undistorter
from touchdown.estimator.mapping import kernels
from touchdown.estimator.mapping.kernels import Frame, Lens, Pulses
from touchdown.scenes.api import Guests
from touchdown.scenes.compose import load_scene
from touchdown.sim.airframe.vehicle import sensor_mounts
from touchdown.sim.api import LidarParams, LidarScan, SensorRig, WorldParams
from touchdown.sim.frames import Pose, so3_exp
from touchdown.sim.geometry.lens import distorted
from touchdown.sim.lidar.pair import known_pair, merged
from touchdown.sim.lidar.patterns import PATTERNS
from touchdown.sim.moving import BodyTrack
from touchdown.sim.posed_sensors import PosedSensors
from touchdown.sim.typing import Array

from support.livo_flight import make_rig
from support.messages import make_scan


def test_sensors_are_turned_about_the_body_s_axes() -> None:
    turns = ((0.0, -30.0, 0.0), (10.0, 0.0, 90.0))
    scene = load_scene("flat", 0, guests=Guests("quadrotor", 0, (0.0, -20.0, 0.0), turns))
    mounts = sensor_mounts(scene.model)
    sin, cos = np.sin(np.radians(30.0)), np.cos(np.radians(30.0))
    np.testing.assert_allclose(mounts.lidar.rotation[:, 2], [sin, 0.0, -cos], atol=1e-9)
    np.testing.assert_allclose(mounts.lidar.rotation[:, 0], [0.0, -1.0, 0.0], atol=1e-9)
    assert mounts.second_lidar is not None
    # rolled by 10 degrees, down goes to the left, which the yaw turns to the back
    sin, cos = np.sin(np.radians(10.0)), np.cos(np.radians(10.0))
    np.testing.assert_allclose(mounts.second_lidar.rotation[:, 2], [-sin, 0.0, -cos], atol=1e-9)
    np.testing.assert_allclose(mounts.second_lidar.translation, mounts.lidar.translation)
    ahead = [np.sin(np.radians(20.0)), 0.0, -np.cos(np.radians(20.0))]
    np.testing.assert_allclose(mounts.camera.rotation[:, 2], ahead, atol=1e-9)
    np.testing.assert_allclose(mounts.camera_right.rotation[:, 2], ahead, atol=1e-9)
    drawn = scene.model.camera("vehicle/camera")
    back = np.zeros(3)
    mujoco.mju_rotVecQuat(back, np.array([0.0, 0.0, 1.0]), drawn.quat)
    np.testing.assert_allclose(-back, ahead, atol=1e-9)
    assert sensor_mounts(load_scene("flat", 0).model).second_lidar is None


@pytest.mark.parametrize(("guests", "words"), [
    (Guests(camera_turn_deg=(0.0, 70.0, 0.0)), "camera.mount_deg"),
    (Guests(lidar_turns_deg=((0.0, 100.0, 0.0), None)), "lidar.mount_deg"),
    (Guests(lidar_turns_deg=((0.0, 0.0, 0.0), (180.0, 0.0, 0.0))), "lidar.second_mount_deg"),
])  # fmt: skip
def test_sensors_that_look_up_are_refused(guests: Guests, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        load_scene("flat", 0, guests=guests)


def _scan(points: Array, offsets: list[float]) -> LidarScan:
    ranges = np.linalg.norm(points, axis=1)
    directions = points / np.where(ranges > 0.0, ranges, 1.0)[:, None]
    return make_scan(60, directions, ranges, offsets, np.arange(1, len(points) + 1))


def test_two_scans_are_merged_in_the_frame_of_the_first() -> None:
    pair = Pose(so3_exp(np.array([0.0, 0.0, 0.5 * np.pi])), np.array([0.1, 0.0, 0.0]))
    first = _scan(np.array([[0.0, 0.0, 5.0], [1.0, 0.0, 5.0]]), [0.01, 0.05])
    second = _scan(np.array([[0.0, 2.0, 4.0], [3.0, 0.0, 4.0]]), [0.02, 0.08])
    lost = dataclasses.replace(second, ranges=np.array([0.0, 5.0], np.float32))
    scan = merged(first, lost, pair)
    np.testing.assert_allclose(scan.time_offsets, [0.01, 0.02, 0.05, 0.08])
    np.testing.assert_allclose(scan.points[[0, 2]], [[0.0, 0.0, 5.0], [1.0, 0.0, 5.0]], atol=1e-6)
    np.testing.assert_allclose(scan.points[3], [0.1, 3.0, 4.0], atol=1e-6)
    assert scan.ranges[1] == 0.0
    np.testing.assert_allclose(scan.directions[1], np.array([-2.0, 0.0, 4.0]) / 20**0.5, atol=1e-6)
    assert scan.intensity.tolist() == [1, 1, 2, 2]
    np.testing.assert_allclose(np.linalg.norm(scan.directions, axis=1), 1.0, atol=1e-6)


def test_a_pair_is_known_with_its_error_by_seed() -> None:
    params = LidarParams(pair_rotation_sigma_deg=0.5, pair_translation_sigma_m=0.02)
    true = Pose(np.eye(3), np.array([0.0, 0.2, 0.0]))
    known = [known_pair(true, params, seed) for seed in range(400)]
    shifts = np.array([one.translation - true.translation for one in known])
    angles = [np.arccos(min((np.trace(one.rotation) - 1.0) / 2.0, 1.0)) for one in known]
    assert shifts.std(axis=0) == pytest.approx([0.02] * 3, rel=0.15)
    assert np.degrees(np.sqrt(np.mean(np.square(angles)))) == pytest.approx(0.5 * 3**0.5, rel=0.1)
    same = known_pair(true, LidarParams(), 3)
    np.testing.assert_array_equal(same.rotation, np.eye(3))


@pytest.mark.parametrize(("preset", "beams", "columns", "half_deg"), [
    ("os1_16", 16, 2048, 16.6), ("xt16", 16, 2000, 15.0),
])  # fmt: skip
def test_a_spinning_pattern_is_a_column_that_turns(
    preset: str, beams: int, columns: int, half_deg: float
) -> None:
    pattern = PATTERNS[preset]
    turn = pattern.directions(0, beams * columns)
    assert pattern.point_rate_hz == 10 * beams * columns
    elevation = np.degrees(np.arcsin(turn[:, 2])).reshape(columns, beams)
    np.testing.assert_allclose(elevation[0], np.linspace(-half_deg, half_deg, beams), atol=1e-4)
    azimuth = np.unwrap(np.arctan2(turn[::beams, 1], turn[::beams, 0]))
    np.testing.assert_allclose(np.diff(azimuth), 2.0 * np.pi / columns, atol=1e-6)
    again = pattern.directions(beams * columns * 3 + 5, 40)
    np.testing.assert_array_equal(again, turn[5:45])


def _fisheye_rig() -> SensorRig:
    rig = make_rig()
    camera = dataclasses.replace(
        rig.camera, width=640, height=480, fx=333.0, fy=333.0, cx=319.5, cy=239.5,
        distortion=np.array([-0.02, 0.004, -0.001, 0.0, 0.0]), lens="fisheye",
    )  # fmt: skip
    return dataclasses.replace(rig, camera=camera)


def test_estimators_see_a_fisheye_through_a_pinhole() -> None:
    """Bright spots at known directions are where the pinhole projects them, and its image has no
    black edge."""
    rig = _fisheye_rig()
    undistort = Undistorter(rig)
    pinhole = undistort.rig.camera
    assert pinhole.lens == "pinhole" and not pinhole.distortion.any()
    assert 95.0 < np.degrees(2.0 * np.arctan(0.5 * pinhole.width / pinhole.fx)) < 105.0
    for ideal in ([0.0, 0.0], [0.9, 0.4], [-0.7, -0.6]):
        image = np.full((480, 640), 40, np.uint8)
        u, v = distorted(np.array(ideal), rig.camera) * 333.0 + [319.5, 239.5]
        yy, xx = np.mgrid[:480, :640]
        image[np.hypot(xx - u, yy - v) < 5.0] = 255
        flat = undistort(image)
        assert flat.min() >= 40
        rows, cols = np.nonzero(flat > 150)
        expected = np.array(ideal) * pinhole.fx + [pinhole.cx, pinhole.cy]
        np.testing.assert_allclose([cols.mean(), rows.mean()], expected, atol=0.6)


def test_the_mapper_colours_through_a_fisheye() -> None:
    """45 degrees to the right: pi / 4 (1 - 0.02 (pi / 4)^2) times the focal length of 100."""
    image = np.repeat(np.arange(200, dtype=np.uint8)[None, :, None], 3, axis=2).repeat(100, axis=0)
    colours = np.full((1, 3), np.nan, np.float32)
    kernels.sample_colours(
        Pulses(np.zeros((1, 3), np.float32), np.array([[1.0, 0.0, 1.0]], np.float32),
               np.full(1, 7.0, np.float32)),
        (0, 1), (0, 0), image, Frame.of(Pose.identity()),
        Lens(100.0, 100.0, 99.2, 50.0, -0.02, 0.0, 0.0, 0.0, 0.0, True), colours,
    )  # fmt: skip
    angle = 0.25 * np.pi
    assert colours[0].tolist() == [round(99.2 + 100.0 * angle * (1.0 - 0.02 * angle**2))] * 3


def test_posed_sensors_see_with_both_lidars() -> None:
    """One ahead and one behind: what both see of level ground lies on it, on either side."""
    turns = ((0.0, -30.0, 0.0), (0.0, 30.0, 0.0))
    scene = load_scene("flat", 0, guests=Guests(lidar_turns_deg=turns))
    sensors = PosedSensors(scene, WorldParams(), 0)
    pose = Pose(np.eye(3), np.array([0.0, 0.0, 10.0]))
    scan = sensors.scan(BodyTrack.at_rest(pose, sensors.scan_times(0)), 0)
    sensors.close()
    points = pose.apply(sensors.mounts.lidar.apply(scan.points[scan.ranges > 0.0].astype(float)))
    ahead = points[:, 0] > 2.0
    assert 0.4 < ahead.mean() < 0.6 and (points[~ahead, 0] < -2.0).all()
    assert np.median(np.abs(points[:, 2])) < 0.2
