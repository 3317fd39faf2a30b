"""Calibration from end to end, its file, and flights with the estimated rig."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from touchdown.experiments.api import CalibrationErrorParams
from touchdown.experiments.calibration.calibrate import run_calibration
from touchdown.experiments.errors import UsageError
from touchdown.experiments.flight.estimator_calibration import erring_rig, nominal_rig
from touchdown.experiments.flight.wiring import build_flight_stack, build_scene
from touchdown.experiments.io.calibration_file import read_calibration
from touchdown.sim.api import SensorRig
from touchdown.sim.frames import so3_log

from support.command import Says
from support.worlds import load_ideal_config as load_config


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """One calibration of a lens with distortion."""
    folder = tmp_path_factory.mktemp("calibration")
    config = load_config(None, ["camera.distortion=[-0.05,0.02,0.0003,-0.0002,0.0]"], seed=7)
    report = run_calibration(config, 12, folder / "rig.json", folder / "pictures")
    return folder / "rig.json", report


def test_twelve_poses_give_the_rig(calibrated: tuple[Path, dict[str, Any]]) -> None:
    _, report = calibrated
    error = report["error"]
    assert report["views"]["used"] >= 10
    assert error["rotation_deg"] <= 0.1
    assert error["translation_m"] <= 0.01
    assert error["camera_worst_percent"] <= 0.3
    assert report["consistency"]["consistent"]
    assert max(report["stated_sigma"]["rotation_deg"]) < 0.05
    assert max(report["stated_sigma"]["translation_m"]) < 0.005


def test_figures_are_written(calibrated: tuple[Path, dict[str, Any]]) -> None:
    for name in ("boards", "overlay", "cloud"):
        picture = cv2.imread(str(calibrated[0].parent / "pictures" / f"{name}.png"))
        assert picture is not None and picture.std() > 10.0


@pytest.fixture(scope="module")
def rig() -> SensorRig:
    config = load_config(None, [], scene="flat", estimator="oracle")
    flight = build_flight_stack(config, build_scene(config))
    flight.world.close()
    return flight.world.rig


def test_a_flight_uses_the_given_calibration(
    calibrated: tuple[Path, dict[str, Any]], rig: SensorRig
) -> None:
    file, report = calibrated
    nominal = nominal_rig(rig, load_config(None, [], calibration=str(file)))
    true, found = (r.body_from_camera.inverse() @ r.body_from_lidar for r in (rig, nominal))
    turn = np.rad2deg(np.linalg.norm(so3_log(found.rotation @ true.rotation.T)))
    shift = np.linalg.norm(found.translation - true.translation)
    assert turn == pytest.approx(report["error"]["rotation_deg"], abs=1e-9)
    assert shift == pytest.approx(report["error"]["translation_m"], abs=1e-9)
    assert nominal.camera.distortion[0] == pytest.approx(-0.05, abs=0.005)
    np.testing.assert_array_equal(
        nominal.body_from_camera.translation, rig.body_from_camera.translation
    )
    assert rig.camera.distortion[0] == 0.0  # the simulation keeps its own


def test_a_file_of_another_camera_is_refused(
    calibrated: tuple[Path, dict[str, Any]], rig: SensorRig
) -> None:
    small = replace(rig, camera=replace(rig.camera, width=424, height=240))
    with pytest.raises(UsageError, match=r"848 x 480 pixels.*424 x 240"):
        nominal_rig(small, load_config(None, [], calibration=str(calibrated[0])))


def test_stated_errors_are_drawn_from_the_seed(rig: SensorRig) -> None:
    none = CalibrationErrorParams(rotation_sigma_deg=0.0, translation_sigma_m=0.0, focal_sigma=0.0)
    assert erring_rig(rig, none, 3) is rig
    params = CalibrationErrorParams(
        rotation_sigma_deg=0.03, translation_sigma_m=0.003, focal_sigma=5e-4, center_sigma_px=0.2
    )
    true = rig.body_from_camera.inverse() @ rig.body_from_lidar
    turns, shifts, stretches = [], [], []
    for seed in range(300):
        nominal = erring_rig(rig, params, seed)
        found = nominal.body_from_camera.inverse() @ nominal.body_from_lidar
        turns.append(np.rad2deg(so3_log(found.rotation @ true.rotation.T)))
        shifts.append(found.translation - true.translation)
        stretches.append(nominal.camera.fx / rig.camera.fx - 1.0)
    assert np.std(turns) == pytest.approx(0.03, rel=0.1)
    assert np.std(shifts) == pytest.approx(0.003, rel=0.1)
    assert np.std(stretches) == pytest.approx(5e-4, rel=0.15)
    again = erring_rig(rig, params, 299)
    np.testing.assert_array_equal(again.body_from_lidar.rotation, nominal.body_from_lidar.rotation)


@pytest.mark.parametrize(("change", "fragments"), [
    (lambda t: t["camera"].pop("fx"), ["camera.fx: Field required"]),
    (lambda t: t["camera"].update(fxx=3.0), ["camera.fxx", "not permitted"]),
    (lambda t: t["camera"].update(fy=-1.0), ["camera.fy", "greater than 0"]),
    (lambda t: t["camera"].update(distortion=[0.0]), ["camera.distortion"]),
    (
        lambda t: t["camera_from_lidar"].update(rotation_quat_wxyz=[1.0, 1.0, 0.0, 0.0]),
        ["rotation_quat_wxyz", "length 1"],
    ),
])  # fmt: skip
def test_invalid_calibration_files_are_one_line(
    calibrated: tuple[Path, dict[str, Any]], tmp_path: Path, change: Any, fragments: list[str]
) -> None:
    tree, broken = json.loads(calibrated[0].read_text()), tmp_path / "broken.json"
    change(tree)
    broken.write_text(json.dumps(tree))
    with pytest.raises(UsageError) as caught:
        read_calibration(broken)
    message = str(caught.value)
    assert "\n" not in message and "broken.json" in message
    for fragment in fragments:
        assert fragment in message


@pytest.mark.parametrize(("arguments", "fragments"), [
    (("fly", "crossroad", "--calibration", "torn.json"), ["torn.json", "no JSON"]),
    (("calibrate", "--set", "calibration_error.focal_sigma=-1"), ["must be within 0 to 1000"]),
    (("calibrate", "--set", "camera.fov_x_deg=6", "--poses", "3"), ["only", "3 views"]),
])  # fmt: skip
def test_bad_input_is_one_line(
    arguments: tuple[str, ...], fragments: list[str], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, says: Says,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    (tmp_path / "torn.json").write_text("{")
    captured = says(2, *arguments, "--quiet")
    assert captured.err.startswith("touchdown: error: ") and captured.err.count("\n") == 1
    for fragment in fragments:
        assert fragment in captured.err
