"""The nominal rig: errors against the IMU, of the lens, and of the start."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from touchdown.experiments.api import CalibrationErrorParams, StartParams
from touchdown.experiments.flight.estimator_calibration import (
    corner_displacement_px,
    erring_rig,
    known_start,
    nominal_rig,
)
from touchdown.sim.api import ImuSheet
from touchdown.sim.frames import (
    Pose,
    quat_wxyz_from_matrix,
    so3_exp,
    so3_log,
    tilt_from_rotation,
    yaw_from_rotation,
)
from touchdown.sim.typing import Array

from support.livo_flight import make_rig
from support.worlds import load_ideal_config as load_config

NONE = CalibrationErrorParams(rotation_sigma_deg=0.0, translation_sigma_m=0.0, focal_sigma=0.0)
AGAINST_IMU = replace(
    NONE, imu_camera_rotation_sigma_deg=0.1, imu_camera_translation_sigma_m=0.003,
    imu_lidar_rotation_sigma_deg=0.1, imu_lidar_translation_sigma_m=0.005,
)  # fmt: skip
SEEDS = 300


def errors(name: str) -> Array:
    """(SEEDS, 6) rotation, rad, and translation, m, of a mount's error in the IMU's axes."""
    rig = make_rig()
    true = rig.body_from_imu.inverse() @ getattr(rig, name)
    rows = []
    for seed in range(SEEDS):
        nominal = erring_rig(rig, AGAINST_IMU, seed)
        mount = nominal.body_from_imu.inverse() @ getattr(nominal, name)
        turn = so3_log(mount.rotation @ true.rotation.T)
        rows.append([*turn, *(mount.translation - true.translation)])
    return np.array(rows)


def test_mounts_err_against_the_imu_with_their_sigmas_and_independently() -> None:
    camera, lidar = errors("body_from_camera"), errors("body_from_lidar")
    degree = np.radians(0.1)
    np.testing.assert_allclose(camera.std(axis=0), np.repeat([degree, 0.003], 3), rtol=0.15)
    np.testing.assert_allclose(lidar.std(axis=0), np.repeat([degree, 0.005], 3), rtol=0.15)
    np.testing.assert_allclose(np.corrcoef(camera.T, lidar.T), np.eye(12), atol=0.25)


def test_errors_against_the_imu_leave_those_of_the_pair_as_they_were() -> None:
    """The draws of camera_from_lidar and of the lens do not change."""
    rig = make_rig()
    before = erring_rig(rig, CalibrationErrorParams(center_sigma_px=0.5), 7)
    params = CalibrationErrorParams(center_sigma_px=0.5, imu_lidar_rotation_sigma_deg=0.1)
    after = erring_rig(rig, params, 7)
    np.testing.assert_array_equal(after.camera.matrix(), before.camera.matrix())
    lidar = rig.body_from_camera.inverse() @ rig.body_from_lidar
    pair = before.body_from_camera.inverse() @ before.body_from_lidar
    assert 0.0 < np.linalg.norm(so3_log(pair.rotation @ lidar.rotation.T)) < np.radians(0.2)
    np.testing.assert_array_equal(after.body_from_camera.matrix(), before.body_from_camera.matrix())
    assert not np.allclose(after.body_from_lidar.rotation, before.body_from_lidar.rotation)


def test_distortion_displaces_the_corners_by_its_sigma() -> None:
    """The largest displacement within the image, by OpenCV's own lens, root mean square over
    seeds."""
    rig = make_rig()
    k = rig.camera
    params = replace(NONE, distortion_sigma_px=0.5)
    u, v = np.meshgrid(np.linspace(0, k.width - 1, 33), np.linspace(0, k.height - 1, 25))
    x, y = (u.ravel() - k.cx) / k.fx, (v.ravel() - k.cy) / k.fy
    points = np.column_stack([x, y, np.ones_like(x)])
    maximum = []
    for seed in range(200):
        lens = erring_rig(rig, params, seed).camera.distortion
        seen, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), k.matrix(), lens)
        off = seen[:, 0] - np.column_stack([u.ravel(), v.ravel()])
        maximum.append(np.linalg.norm(off, axis=1).max())
    assert float(np.sqrt(np.mean(np.square(maximum)))) == pytest.approx(0.5, rel=0.1)
    assert corner_displacement_px(k).shape == (4,)


def test_calibration_file_says_the_pair_and_both_err_against_the_imu(tmp_path: Path) -> None:
    rig = make_rig()
    k = rig.camera
    lidar = rig.body_from_camera.inverse() @ rig.body_from_lidar
    path = tmp_path / "calibration.json"
    content = {
        "camera": {
            "width": k.width, "height": k.height, "fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy,
            "distortion": [0.0] * 5,
        },
        "camera_from_lidar": {
            "rotation_quat_wxyz": quat_wxyz_from_matrix(lidar.rotation).tolist(),
            "translation_m": lidar.translation.tolist(),
        },
    }  # fmt: skip
    path.write_text(json.dumps(content))
    values = {
        "imu_camera_rotation_sigma_deg": 0.1,
        "imu_camera_translation_sigma_m": 0.003,
        "imu_lidar_rotation_sigma_deg": 0.1,
    }
    sets = [f"calibration_error.{key}={value}" for key, value in values.items()]
    config = load_config(None, sets, seed=4, calibration=str(path))
    nominal = nominal_rig(rig, config)
    pair = nominal.body_from_camera.inverse() @ nominal.body_from_lidar
    np.testing.assert_allclose(pair.matrix(), lidar.matrix(), atol=1e-9)
    alone = erring_rig(rig, config.calibration_error, config.world_seed)
    np.testing.assert_allclose(
        nominal.body_from_camera.matrix(), alone.body_from_camera.matrix(), atol=1e-12
    )
    assert not np.allclose(nominal.body_from_camera.matrix(), rig.body_from_camera.matrix())


def test_readout_and_lever_arms_err_by_their_sigmas() -> None:
    """Each by itself, drawn from the seed."""
    rig = replace(make_rig(), camera_readout_s=0.015)
    params = CalibrationErrorParams(readout_fraction=0.01, lever_sigma_m=0.005)
    config = load_config().model_copy(update={"calibration_error": params})
    found = [nominal_rig(rig, config.model_copy(update={"seed": seed})) for seed in range(400)]
    off = np.array(
        [
            [
                0.5 * (nominal.camera_readout_s / 0.015 - 1.0),
                *np.subtract(nominal.nav.gps.antenna_body_m, rig.nav.gps.antenna_body_m),
                *np.subtract(
                    nominal.nav.rangefinder.position_body_m, rig.nav.rangefinder.position_body_m
                ),
            ]
            for nominal in found
        ]
    )
    np.testing.assert_allclose(off.std(axis=0), 0.005, rtol=0.15)
    assert np.abs(np.corrcoef(off.T) - np.eye(7)).max() < 0.2
    exact = nominal_rig(rig, load_config())
    assert exact.nav == rig.nav and exact.camera_readout_s == rig.camera_readout_s


def test_the_start_may_be_known_by_heading_only() -> None:
    tilted = so3_exp(np.array([0.0, 0.0, 0.8])) @ so3_exp(np.array([0.05, -0.03, 0.0]))
    start = Pose(tilted, np.array([1.0, 2.0, 3.0]))
    rig = replace(make_rig(), world_from_body_start=start)
    assert known_start(rig, StartParams()) is rig and rig.start_tilt_sigma_rad == 0.0
    known = known_start(rig, StartParams(attitude_known=False, tilt_sigma_deg=4.0))
    assert known.start_tilt_sigma_rad == pytest.approx(np.radians(4.0))
    found = known.world_from_body_start
    np.testing.assert_array_equal(found.translation, start.translation)
    assert tilt_from_rotation(found.rotation) == pytest.approx(0.0, abs=1e-9)
    assert yaw_from_rotation(found.rotation) == pytest.approx(yaw_from_rotation(tilted))


def test_an_imu_worse_than_its_sheet_is_known_by_the_sheet() -> None:
    worse = replace(make_rig().imu, gyro_density=9.0, gyro_range=1.0, scale_sigma=0.5)
    rig = replace(make_rig(), imu=worse)
    assert nominal_rig(rig, load_config()).imu == worse
    told = ["calibration_error.imu_sheet_of_profile=true"]
    assert nominal_rig(rig, load_config(None, told)).imu == ImuSheet()
    field = nominal_rig(rig, load_config(None, told, profile="field")).imu
    assert (field.gyro_density, field.scale_sigma) == (ImuSheet().gyro_density, 0.003)
