"""Exports in the formats of EuRoC and KITTI, compared with the log."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import yaml
from plyfile import PlyData

from touchdown.experiments.export.datasets import write_camera, write_truth
from touchdown.experiments.export.flown_run import ExportOptions, FlownRun
from touchdown.experiments.export.run import export
from touchdown.experiments.external.synthetic_stream import SyntheticStream
from touchdown.experiments.io.sensor_log_reader import SensorLogReader
from touchdown.experiments.io.tum import Trajectory
from touchdown.sim.frames import Pose, matrix_from_quat_wxyz, rotation_from_yaw

from support.command import Says
from support.export_support import ALL, SECONDS


def test_a_flight_in_the_format_of_euroc(run: Path, tmp_path: Path) -> None:
    done = export(run, "euroc", tmp_path / "flown", ExportOptions())
    root, log = done.out / "mav0", SensorLogReader(run / "sensors.mcap")
    rig, stream = log.rig, SyntheticStream(log.rig, ALL, SECONDS)
    observations = list(log)
    samples = [sample for obs in observations for sample in obs.imu]
    table = np.loadtxt(root / "imu0" / "data.csv", delimiter=",")
    assert len(table) == len(samples) == done.counts["imu0"]
    np.testing.assert_allclose(table[:, 0], [1e9 * s.tick / rig.tick_hz for s in samples], atol=1)
    np.testing.assert_array_equal(table[:, 1:4], [s.angular_velocity for s in samples])
    np.testing.assert_array_equal(table[:, 4:], [s.specific_force for s in samples])
    for number, mount in enumerate((rig.body_from_camera, rig.body_from_camera_right)):
        camera = root / f"cam{number}"
        names = [line.split(",")[1] for line in (camera / "data.csv").read_text().split("\n")[1:-1]]
        images = [image for obs in observations for image in obs.images]
        assert len(names) == len(images) == len(list((camera / "data").iterdir())) > 2
        sides = [image.right_rgb if number else image.rgb for image in images]
        picture = cv2.imread(str(camera / "data" / names[1]))
        np.testing.assert_array_equal(picture[..., ::-1], sides[1])
        about = yaml.safe_load((camera / "sensor.yaml").read_text())
        matrix = np.array(about["T_BS"]["data"]).reshape(4, 4)
        np.testing.assert_allclose(matrix, (rig.body_from_imu.inverse() @ mount).matrix())
        assert about["intrinsics"] == [rig.camera.fx, rig.camera.fy, rig.camera.cx, rig.camera.cy]
    states = np.loadtxt(root / "state_groundtruth_estimate0" / "data.csv", delimiter=",")
    row = states[len(states) // 2]
    pose = stream.true_pose(round(1e-9 * row[0] * rig.tick_hz)) @ rig.body_from_imu
    np.testing.assert_allclose(row[1:4], pose.translation, atol=1e-6)
    np.testing.assert_allclose(matrix_from_quat_wxyz(row[4:8]), pose.rotation, atol=1e-6)
    steps = np.diff(states[:, 1:4], axis=0) / (1e-9 * np.diff(states[:, 0])[:, None])
    np.testing.assert_allclose(states[1:-1, 8:11], 0.5 * (steps[1:] + steps[:-1]), atol=1e-3)


def test_the_truth_of_euroc_is_that_of_the_imu(run: Path, tmp_path: Path) -> None:
    flown = FlownRun(run, {})
    lever = Pose(rotation_from_yaw(0.3), np.array([0.1, -0.2, 0.05]))
    rig = dataclasses.replace(SensorLogReader(run / "sensors.mcap").rig, body_from_imu=lever)
    count = write_truth(flown, tmp_path, rig)
    table = np.loadtxt(tmp_path / "state_groundtruth_estimate0" / "data.csv", delimiter=",")
    body = Trajectory(flown.file("truth.tum")).poses
    assert len(table) == count == len(body)
    np.testing.assert_allclose(table[3, 1:4], body[3].apply(lever.translation), atol=1e-8)
    turned = body[3].rotation @ lever.rotation
    np.testing.assert_allclose(matrix_from_quat_wxyz(table[3, 4:8]), turned, atol=1e-8)


def test_a_flight_in_the_format_of_kitti(run: Path, tmp_path: Path) -> None:
    done = export(run, "kitti", tmp_path / "flown", ExportOptions(poses="truth"))
    sequence, rig = done.out / "sequences" / "00", SensorLogReader(run / "sensors.mcap").rig
    rows = np.loadtxt(done.out / "poses" / "00.txt").reshape(-1, 3, 4)
    poses = np.concatenate([rows, np.broadcast_to([[0.0, 0.0, 0.0, 1.0]], (len(rows), 1, 4))], 1)
    times = np.loadtxt(sequence / "times.txt")
    assert len(poses) == len(times) == done.counts["frames"] > 3
    np.testing.assert_allclose(poses[0], np.eye(4), atol=1e-9)
    stream = SyntheticStream(rig, ALL, SECONDS)
    cameras = [stream.true_pose(round(t * rig.tick_hz)) @ rig.body_from_camera for t in times]
    moved = cameras[0].inverse() @ cameras[-1]
    np.testing.assert_allclose(poses[-1], moved.matrix(), atol=1e-4)
    lines = dict(line.split(": ") for line in (sequence / "calib.txt").read_text().splitlines())
    projection = np.array(lines["P2"].split(), dtype=float).reshape(3, 4)
    np.testing.assert_allclose(projection[:, :3], rig.camera.matrix(), rtol=1e-8)
    camera_from_lidar = np.vstack([np.fromstring(lines["Tr"], sep=" ").reshape(3, 4),
                                   [0.0, 0.0, 0.0, 1.0]])  # fmt: skip
    scans = []
    for number, camera in enumerate(cameras):
        cloud = np.fromfile(sequence / "velodyne" / f"{number:06}.bin", "<f4").reshape(-1, 4)
        assert cloud[:, 3].min() >= 0.0 and cloud[:, 3].max() <= 1.0
        homogeneous = np.column_stack([cloud[:, :3], np.ones(len(cloud))])
        scans.append((camera.matrix() @ camera_from_lidar @ homogeneous.T)[:3].T)
        image = cv2.imread(str(sequence / "image_2" / f"{number:06}.png"))
        assert image.shape == (rig.camera.height, rig.camera.width, 3)
    options = ExportOptions(points="scans", poses="truth")
    placed = PlyData.read(export(run, "ply", tmp_path / "s.ply", options).out)["vertex"].data
    world = np.column_stack([placed[axis] for axis in "xyz"])
    np.testing.assert_allclose(np.vstack(scans), world[-sum(map(len, scans)) :], atol=2e-3)


def test_a_data_set_replaces_nothing(run: Path, tmp_path: Path, says: Says) -> None:
    (tmp_path / "own.txt").touch()
    err = says(2, "export", run, "--format", "euroc", "--out", tmp_path).err
    assert "holds something; name a new one" in err
    assert "not euroc" in says(2, "export", run, "--format", "euroc", "--poses",
                                            "truth").err  # fmt: skip
    assert [file.name for file in tmp_path.iterdir()] == ["own.txt"]


def test_mounts_of_euroc_are_on_the_imu(run: Path, tmp_path: Path) -> None:
    rig = SensorLogReader(run / "sensors.mcap").rig
    turned = Pose(rotation_from_yaw(0.3), np.array([0.1, -0.2, 0.05]))
    rig = dataclasses.replace(rig, body_from_imu=turned)
    folder = write_camera(tmp_path / "cam0", rig, rig.body_from_camera)
    about = yaml.safe_load((folder / "sensor.yaml").read_text())
    found = turned.matrix() @ np.array(about["T_BS"]["data"]).reshape(4, 4)
    np.testing.assert_allclose(found, rig.body_from_camera.matrix(), atol=1e-12)
