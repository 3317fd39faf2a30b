"""Clock, rest and rig of a recording, by known answers."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from touchdown.experiments.errors import UsageError
from touchdown.experiments.recordings.clock import (
    at_rest,
    even_grid,
    level_pose,
    poses_of,
    rest_steps,
    truth_at_ticks,
)
from touchdown.experiments.recordings.contract import ImuTable, Lens, RigParts
from touchdown.experiments.recordings.pictures import decoded, optics_of
from touchdown.experiments.recordings.rig_files import pose_of, read_rig
from touchdown.experiments.recordings.run import fitted
from touchdown.sim.api import GRAVITY_MPS2, CameraIntrinsics
from touchdown.sim.frames import Pose, rotation_from_yaw, so3_exp

EPOCH = 1_403_715_273_000_000_000


def _table(times_s: Any, gyro: Any = None, force: Any = None) -> ImuTable:
    times = np.asarray(times_s)
    still = np.tile([0.0, 0.0, GRAVITY_MPS2], (len(times), 1))
    return ImuTable(
        stamps_ns=EPOCH + np.rint(times * 1e9).astype(np.int64),
        gyro=np.zeros((len(times), 3)) if gyro is None else gyro,
        force=still if force is None else force,
    )


def test_even_samples_stay_as_they_are() -> None:
    gyro = np.random.default_rng(0).normal(size=(50, 3))
    jitter = 2e-4 * np.sin(np.arange(50))
    grid = even_grid(_table(np.arange(50) / 200.0 + jitter, gyro))
    assert (grid.clock.tick_hz, grid.clock.imu_ticks) == (600, 3) and not grid.resampled
    np.testing.assert_array_equal(grid.gyro, gyro)
    assert grid.clock.seconds(int(EPOCH)) == grid.clock.step_s == 1 / 200  # before the first sample
    assert grid.clock.seconds(grid.clock.start_ns + 1_666_667) == 1 / 600  # a tick in nanoseconds


def test_other_samples_become_means_on_a_grid() -> None:
    """Every tenth sample is lost, and the clock runs fast: means of a ramp are its values."""
    times = np.delete(np.arange(200) / 201.0, slice(5, None, 10))
    ramp = np.column_stack([times, -2.0 * times, 3.0 * np.ones_like(times)])
    grid = even_grid(_table(times, ramp))
    assert grid.resampled and grid.clock.tick_hz == 603
    at = np.arange(len(grid.gyro)) / 201.0
    expected = np.column_stack([at, -2.0 * at, 3.0 * np.ones_like(at)])
    np.testing.assert_allclose(grid.gyro[1:-1], expected[1:-1], atol=1e-9)


@pytest.mark.parametrize(("times", "words"), [
    (np.arange(10) / 200.0, "too few"),
    (np.r_[np.arange(30), 180 + np.arange(30)] / 200.0, "a gap of 0.76 s"),
    (np.arange(40) * 2.0, "can be replayed"),
])  # fmt: skip
def test_an_imu_that_cannot_be_replayed_is_told(times: Any, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        even_grid(_table(times))


def test_rest_ends_with_the_first_turn_and_shaking_is_rest() -> None:
    rng = np.random.default_rng(1)
    count = 800
    gyro, force = rng.normal(0.0, 0.02, (count, 3)), rng.normal(0.0, 0.3, (count, 3))
    gyro, force = gyro + [0.08, 0.0, 0.0], force + [0.0, 0.0, GRAVITY_MPS2]
    still = _table(np.arange(count) / 200.0, gyro, force)
    assert rest_steps(even_grid(still)) == count
    gyro[500:, 2] += 0.2
    assert rest_steps(even_grid(_table(np.arange(count) / 200.0, gyro, force))) == 500
    rest = at_rest(still, int(still.stamps_ns[400]))
    np.testing.assert_allclose(rest.rate, gyro[:400].mean(axis=0))
    assert rest.rate_sigma == pytest.approx(2 * 0.02 / np.sqrt(400), rel=0.1)
    assert rest.accel_density == pytest.approx(0.3 / np.sqrt(200.0), rel=0.35)


@pytest.mark.parametrize("turn", [[0.3, -0.2, 0.0], [0.0, 1.55, 0.0], [np.pi, 0.0, 0.0]])
def test_gravity_levels_any_attitude(turn: Any) -> None:
    true = so3_exp(np.array(turn))
    found = level_pose(true.T @ [0.0, 0.0, GRAVITY_MPS2]).rotation
    np.testing.assert_allclose(found[2], true[2], atol=1e-9)
    np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-12)
    with pytest.raises(UsageError, match="not gravity's"):
        level_pose(np.array([0.0, 0.0, 1.0]))  # in g


def test_truth_is_read_between_its_stamps() -> None:
    clock = even_grid(_table(np.arange(400) / 200.0)).clock
    times = np.arange(0.003, 2.0, 0.1)
    quats = [[np.cos(0.1 * t), 0.0, 0.0, np.sin(0.1 * t)] for t in times]
    truth = poses_of(
        EPOCH + np.rint(times * 1e9).astype(np.int64),
        np.column_stack([3.0 * times, 0.0 * times, 0.0 * times]), np.array(quats),
    )  # fmt: skip
    found = truth_at_ticks(truth, clock, 1200)
    assert len(found) == len(times) and all(tick % clock.imu_ticks == 0 for tick in found)
    for tick, pose in found.items():
        time_s = tick / 600 - clock.step_s  # the clock begins a step before the first sample
        np.testing.assert_allclose(pose.translation, [3.0 * time_s, 0.0, 0.0], atol=1e-6)
        np.testing.assert_allclose(pose.rotation, rotation_from_yaw(0.2 * time_s), atol=1e-6)
    with pytest.raises(UsageError, match="does not span"):
        truth_at_ticks(poses_of(truth.stamps_ns + 10**12, truth.positions, np.array(quats)), clock,
                       1200)  # fmt: skip


def test_a_fit_of_points_is_the_motion_between_them() -> None:
    points = np.random.default_rng(2).normal(size=(20, 3))
    true = Pose(so3_exp(np.array([0.4, -0.3, 2.0])), np.array([1.0, 2.0, -3.0]))
    found = fitted(points, true.apply(points))
    np.testing.assert_allclose(found.matrix(), true.matrix(), atol=1e-12)
    flat = points * [1.0, 1.0, 0.0]  # a mirror fits as well, and is no motion
    assert np.linalg.det(fitted(flat, true.apply(flat)).rotation) > 0.0


LENS = {"width": 640, "height": 480, "fx": 400.0, "fy": 405.0, "cx": 322.0, "cy": 238.0}


def fisheye_of(lens: Lens) -> bool:
    return lens.intrinsics.lens == "fisheye"


@pytest.mark.parametrize("fisheye", [False, True])
def test_a_rectified_pair_has_points_in_one_row(fisheye: bool) -> None:
    left = Lens(
        intrinsics=CameraIntrinsics(
            **LENS,
            distortion=np.array([-0.2, 0.05, 1e-3, 0.0, 0.0]),
            lens="fisheye" if fisheye else "pinhole",
        ),
        body_from_camera=Pose(so3_exp(np.array([0.02, -0.01, 0.03])), np.array([0.1, 0.0, 0.0])),
    )
    right = Lens(
        intrinsics=CameraIntrinsics(**{**LENS, "fx": 410.0, "cx": 318.0}),
        body_from_camera=Pose(so3_exp(np.array([-0.01, 0.02, 0.0])), np.array([0.21, 0.004, 0.0])),
    )
    optics = optics_of(left, right)
    point = np.array([0.3, -0.2, 4.0])
    seen = []
    for number, lens in enumerate((left, right)):
        image = np.zeros((480, 640, 3), np.uint8)
        project = cv2.fisheye.projectPoints if fisheye_of(lens) else cv2.projectPoints
        model = lens.intrinsics.distortion[: 4 if fisheye_of(lens) else 5]
        inside = lens.body_from_camera.inverse().apply(point).reshape(1, 1, 3)
        at = project(inside, np.zeros(3), np.zeros(3), lens.intrinsics.matrix(), model)[0].ravel()
        cv2.circle(image, np.rint(16 * at).astype(int).tolist(), 48, (255, 255, 255), -1, shift=4)
        flat = optics.apply(image, bool(number))[..., 0].astype(float)
        rows, cols = np.indices(flat.shape)
        seen.append([(flat * cols).sum() / flat.sum(), (flat * rows).sum() / flat.sum()])
        mount = optics.body_from_right if number else optics.body_from_camera
        x, y, z = mount.inverse().apply(point)
        camera = optics.camera
        expected = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        np.testing.assert_allclose(seen[-1], expected, atol=0.3)
    assert abs(seen[0][1] - seen[1][1]) < 0.4 and seen[0][0] > seen[1][0]
    assert not optics.camera.distortion.any()


def test_a_pair_the_wrong_way_round_is_told() -> None:
    lens = Lens(intrinsics=CameraIntrinsics(**LENS), body_from_camera=Pose.identity())
    shifted = Lens(
        intrinsics=lens.intrinsics, body_from_camera=Pose(np.eye(3), np.array([-0.1, 0.0, 0.0]))
    )
    with pytest.raises(ValueError, match="not right of the left"):
        optics_of(lens, shifted)


KALIBR = """
cam0:
  T_cam_imu: [[0,-1,0,0.1],[0,0,-1,0.2],[1,0,0,0.3],[0,0,0,1]]
  camera_model: pinhole
  distortion_model: equidistant
  distortion_coeffs: [0.1, 0.0, 0.0, 0.0]
  intrinsics: [400.0, 401.0, 320.0, 240.0]
  resolution: [640, 480]
  timeshift_cam_imu: -0.092
  rostopic: /left
cam1:
  T_cn_cnm1: [[1,0,0,-0.11],[0,1,0,0],[0,0,1,0],[0,0,0,1]]
  camera_model: pinhole
  distortion_model: radtan
  distortion_coeffs: [0.1, 0.0, 0.0, 0.0]
  intrinsics: [400.0, 401.0, 320.0, 240.0]
  resolution: [640, 480]
"""


def test_a_rig_of_kalibr(tmp_path: Path) -> None:
    file = tmp_path / "camchain-imucam.yaml"
    file.write_text(KALIBR)
    rig = read_rig(file)
    assert rig.camera is not None and rig.right is not None
    assert fisheye_of(rig.camera) and not fisheye_of(rig.right) and rig.camera.offset_s == -0.092
    assert rig.topics == {"camera": "/left"}
    np.testing.assert_allclose(rig.camera.body_from_camera.translation, [-0.3, 0.1, 0.2])
    np.testing.assert_allclose(
        rig.camera.body_from_camera.inverse().apply(rig.right.body_from_camera.translation),
        [0.11, 0.0, 0.0], atol=1e-12,
    )  # fmt: skip


TOML = """
latency_s = 0.06
[topics]
lidar = "/points"
[imu]
gyro_density = 1e-3
[lidar]
body_from_lidar = [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0]
max_range_m = 80.0
time_offset_s = 0.01
"""


def test_a_rig_of_toml_and_what_the_data_say_besides(tmp_path: Path) -> None:
    file = tmp_path / "rig.toml"
    file.write_text(TOML)
    rig = RigParts(moving=True).with_more(read_rig(file))
    assert rig.moving and rig.latency_s == 0.06 and rig.lidar_offset_s == 0.01
    assert rig.body_from_lidar is not None and rig.lidar.max_range_m == 80.0
    np.testing.assert_array_equal(rig.body_from_lidar.translation, [1.0, 2.0, 3.0])
    assert rig.imu.gyro_density == 1e-3 and rig.topics == {"lidar": "/points"}


@pytest.mark.parametrize(("name", "text", "words"), [
    ("a.yaml", "cam0: {T_cam_imu: [1, 2]}", "16 finite numbers"),
    ("a.yaml", "just: text", "no cam0"),
    ("a.yaml", "[1, 2", "no YAML"),
    ("a.yaml", KALIBR.replace("T_cam_imu", "T_imu_cam"), "no T_cam_imu"),
    ("a.yaml", KALIBR.replace("pinhole", "omni"), "not pinhole"),
    ("a.yaml", KALIBR.replace("resolution", "size"), "lacks 'resolution'"),
    ("a.yaml", KALIBR.replace("radtan", "wavy"), "is none of"),
    ("a.yaml", KALIBR.replace("0,-1,0,0.1", "0,-2,0,0.1"), "no rotation"),
    ("a.toml", "speed = 1", "'speed' is none of"),
    ("a.toml", "[lidar]\nrings = 64", "rings"),
    ("a.toml", "latency_s = -1.0", "negative"),
    ("a.toml", "[camera]\nlens = 1", "camera.lens is none of"),
    ("a.json", "{}", "lacks|missing"),
])  # fmt: skip
def test_a_rig_that_is_none_is_one_line(tmp_path: Path, name: str, text: str, words: str) -> None:
    file = tmp_path / name
    file.write_text(text)
    with pytest.raises(UsageError, match=words) as told:
        read_rig(file)
    assert "\n" not in str(told.value)


def test_poses_of_few_digits_are_rotations_all_the_same() -> None:
    turn = rotation_from_yaw(0.7).round(4)
    pose = pose_of(np.column_stack([turn, [1.0, 2.0, 3.0]]).ravel().tolist(), "it")
    np.testing.assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-12)


def test_an_image_that_is_none_is_told() -> None:
    with pytest.raises(ValueError, match="cannot be decoded"):
        decoded(b"\x89PNG and no more")
