"""Flight in the folder formats of the EuRoC MAV and KITTI odometry data sets.

EuRoC: Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR 2016. KITTI: Geiger, Lenz and
Urtasun, "Are we ready for autonomous driving?", CVPR 2012, and its odometry development kit.
"""

import json
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TextIO

import cv2
import numpy as np

from touchdown.estimator.filtering.camera_model import Undistorter
from touchdown.experiments.errors import UsageError
from touchdown.experiments.export.flown_run import Exported, ExportOptions, FlownRun
from touchdown.experiments.export.point_cloud import placed_returns
from touchdown.experiments.export.tables import velocities
from touchdown.experiments.io import ros2_messages as ros
from touchdown.experiments.io.dataclass_json import to_plain
from touchdown.experiments.io.sensor_log_reader import (
    PackedImage,
    SensorLogReader,
    unpack_image,
)
from touchdown.experiments.io.tum import Trajectory
from touchdown.sim.api import LidarScan, SensorRig
from touchdown.sim.frames import Pose, quat_wxyz_from_matrix
from touchdown.sim.typing import Array

SEQUENCE = "00"
ARRIVALS = "arrivals.csv"
RIG_FILE = "rig.json"
"""the rig as `touchdown replay` reads it"""
_KEPT_IMAGES = 4
_IMU_HEAD = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]\n"
)
_TRUTH_HEAD = (
    "#timestamp,p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z [],"
    "v_RS_R_x [m s^-1],v_RS_R_y [m s^-1],v_RS_R_z [m s^-1],b_w_RS_S_x [rad s^-1],"
    "b_w_RS_S_y [rad s^-1],b_w_RS_S_z [rad s^-1],b_a_RS_S_x [m s^-2],b_a_RS_S_y [m s^-2],"
    "b_a_RS_S_z [m s^-2]\n"
)
_NO_BIAS = ",0" * 6


def write_euroc(flown: FlownRun, folder: Path, _options: ExportOptions) -> Exported:
    """``mav0/``: cameras, IMU and the true state of the IMU, which is the body of this format;
    beside it, for `touchdown replay`, speeds of the rotors, times of arrival and ``rig.json``.

    Stamps are nanoseconds of the flight. Images are PNG as logged, with the nominal distortion.
    Biases of the true state are unknown to a log and stand as 0.
    """
    log = SensorLogReader(flown.sensors())
    rig, sensed = log.rig, log.sensed
    root = folder / "mav0"
    imu_folder = _sensor(root / "imu0", {
        "sensor_type": "imu",
        "rate_hz": rig.tick_hz / rig.imu_ticks,
        "gyroscope_noise_density": rig.imu.gyro_density,
        "gyroscope_random_walk": rig.imu.gyro_bias_walk,
        "accelerometer_noise_density": rig.imu.accel_density,
        "accelerometer_random_walk": rig.imu.accel_bias_walk,
    })  # fmt: skip
    (root / RIG_FILE).write_text(json.dumps(to_plain(rig)), encoding="ascii")
    rotor_folder = _sensor(root / "rotors0", {"sensor_type": "rotors"})
    rotor_head = ",".join(f"w_{n} [rad s^-1]" for n in range(len(rig.vehicle.rotor_spin)))
    cameras = [rig.body_from_camera, rig.body_from_camera_right]
    cameras = cameras[: (1 + sensed.stereo) if sensed.camera_hz else 0]
    done = Exported(folder, {"imu0": 0} | {f"cam{n}": 0 for n in range(len(cameras))})
    with ExitStack() as opened:
        imu = _opened(opened, imu_folder / "data.csv", _IMU_HEAD)
        rotors = _opened(opened, rotor_folder / "data.csv", f"#timestamp [ns],{rotor_head}\n")
        lists = [
            _opened(opened, write_camera(root / f"cam{n}", rig, mount) / "data.csv",
                    "#timestamp [ns],filename\n")
            for n, mount in enumerate(cameras)
        ]  # fmt: skip
        arrivals = _opened(opened, root / ARRIVALS, "#timestamp [ns],arrival [ns]\n")
        for obs, images in log.packed():
            rotors.write(_line(ros.tick_ns(obs.tick, rig.tick_hz), obs.rotor_speed_radps))
            for sample in obs.imu:
                stamp = ros.tick_ns(sample.tick, rig.tick_hz)
                imu.write(_line(stamp, np.append(sample.angular_velocity, sample.specific_force)))
                done.counts["imu0"] += 1
            for image in images:
                arrival = ros.tick_ns(obs.tick, rig.tick_hz)
                stamp = ros.stamp_ns(image.tick, image.time_s, rig.tick_hz)
                arrivals.write(f"{stamp},{arrival}\n")
                for n, (listing, png) in enumerate(zip(lists, image.pngs, strict=False)):
                    (root / f"cam{n}" / "data" / f"{stamp}.png").write_bytes(png.tobytes())
                    listing.write(f"{stamp},{stamp}.png\n")
                    done.counts[f"cam{n}"] += 1
    done.counts["state_groundtruth_estimate0"] = write_truth(flown, root, rig)
    return done


def _line(stamp: int, values: Array) -> str:
    """A row of a table, with every digit."""
    return f"{stamp},{','.join(map(repr, values.tolist()))}\n"


def write_truth(flown: FlownRun, root: Path, rig: SensorRig) -> int:
    """Writes the true states of the IMU into a folder below ``root``; returns their number."""
    folder = _sensor(root / "state_groundtruth_estimate0", {"sensor_type": "visual-inertial"})
    truth = Trajectory(flown.file("truth.tum"))
    poses = [pose @ rig.body_from_imu for pose in truth.poses]
    rows = zip(truth.times_s, poses, velocities(truth.times_s, poses)[0], strict=True)
    with (folder / "data.csv").open("w", encoding="ascii") as file:
        file.write(_TRUTH_HEAD)
        for time_s, pose, velocity in rows:
            values = (*pose.translation, *quat_wxyz_from_matrix(pose.rotation), *velocity)
            text = ",".join(f"{value:.9f}" for value in values)
            file.write(f"{round(1e9 * time_s)},{text}{_NO_BIAS}\n")
    return len(poses)


def write_camera(folder: Path, rig: SensorRig, body_from_camera: Pose) -> Path:
    """Makes the folder of a camera with its ``sensor.yaml``; returns it."""
    camera = rig.camera
    fisheye = camera.lens == "fisheye"
    terms = camera.distortion.tolist()
    (folder / "data").mkdir(parents=True)
    about: dict[str, object] = {
        "sensor_type": "camera", "rate_hz": rig.tick_hz / rig.camera_ticks,
        "resolution": [camera.width, camera.height],
        "camera_model": "pinhole", "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy],
        "distortion_model": "equidistant" if fisheye else "radial-tangential",
        "distortion_coefficients": terms[:4] if fisheye else terms,
    }  # fmt: skip
    return _sensor(folder, about, rig.body_from_imu.inverse() @ body_from_camera)


def _sensor(folder: Path, about: dict[str, object], mount: Pose | None = None) -> Path:
    """Writes ``sensor.yaml`` with the mount on the IMU into a folder of a sensor; returns the
    folder."""
    folder.mkdir(parents=True, exist_ok=True)
    whole = np.eye(4)
    if mount is not None:
        whole[:3, :3], whole[:3, 3] = mount.rotation, mount.translation
    lines = [f"sensor_type: {about.pop('sensor_type')}", "T_BS:", "  cols: 4", "  rows: 4"]
    lines.append(f"  data: {json.dumps(whole.ravel().tolist())}")
    lines += [f"{key}: {json.dumps(value)}" for key, value in about.items()]  # JSON is YAML
    (folder / "sensor.yaml").write_text("\n".join(lines) + "\n", encoding="ascii")
    return folder


def _opened(stack: ExitStack, path: Path, head: str) -> TextIO:
    file = stack.enter_context(path.open("w", encoding="ascii"))
    file.write(head)
    return file


def write_kitti(flown: FlownRun, folder: Path, options: ExportOptions) -> Exported:
    """``sequences/00/`` and ``poses/00.txt``. A frame is a scan, at its middle, with the image
    nearest in time.

    Images are rectified by the nominal lens, as the format has no distortion. The returns of a
    scan are moved to the instant of the frame by the trajectory ``options.poses``. Poses are those
    of the left camera, relative to that of the first frame, by the truth.
    """
    log = SensorLogReader(flown.sensors())
    rig = log.rig
    pinhole = Undistorter(rig)
    if not (log.sensed.lidar and log.sensed.camera_hz):
        raise UsageError(
            f"'{flown.path}' was not flown with camera and LIDAR, which --format kitti needs"
        )
    sequence = folder / "sequences" / SEQUENCE
    for name in ("image_2", "velodyne"):
        (sequence / name).mkdir(parents=True)
    (folder / "poses").mkdir()
    _write_calibration(sequence / "calib.txt", rig)
    moving, truth = (Trajectory(flown.file(f"{name}.tum")) for name in (options.poses, "truth"))
    first: Pose | None = None
    count, late = 0, 0
    with (
        (folder / "poses" / f"{SEQUENCE}.txt").open("w", encoding="ascii") as poses,
        (sequence / "times.txt").open("w", encoding="ascii") as times,
    ):
        for scan, image in _frames(log):
            time_s = 0.5 * (scan.start_time_s + scan.end_time_s)
            spanned = moving.spans(scan.start_time_s, scan.end_time_s)
            if not (spanned and truth.spans(time_s, time_s)):
                late += 1
                continue
            points, intensity = placed_returns(scan, moving, rig.body_from_lidar, 1)
            here = moving.pose(time_s) @ rig.body_from_lidar
            cloud = np.column_stack([here.inverse().apply(points), intensity / 255.0])
            cloud.astype("<f4").tofile(sequence / "velodyne" / f"{count:06}.bin")
            rectified = pinhole(unpack_image(image.png))
            cv2.imwrite(str(sequence / "image_2" / f"{count:06}.png"), rectified[..., ::-1])
            camera = truth.pose(time_s) @ rig.body_from_camera
            first = first or camera
            moved = first.inverse() @ camera
            poses.write(_row(moved.rotation, moved.translation) + "\n")
            times.write(f"{time_s:.9f}\n")
            count += 1
    done = Exported(folder, {"frames": count})
    if late:
        done.notes.append(f"left out {late} scans that the trajectory does not span")
    return done


def _frames(log: SensorLogReader) -> Iterator[tuple[LidarScan, PackedImage]]:
    """Each scan with the image that is nearest to its middle, of those that have arrived."""
    images: deque[PackedImage] = deque(maxlen=_KEPT_IMAGES)
    for obs, packed in log.packed():
        images.extend(packed)
        for scan in obs.scans:
            middle = 0.5 * (scan.start_time_s + scan.end_time_s)
            if images:
                yield scan, min(images, key=lambda image: abs(image.time_s - middle))


def _write_calibration(file: Path, rig: SensorRig) -> None:
    """P0 to P3, of which all are the one camera, and Tr, camera from LIDAR."""
    projection = _row(Undistorter(rig).rig.camera.matrix(), np.zeros(3))
    lines = [f"P{number}: {projection}\n" for number in range(4)]
    mount = rig.body_from_camera.inverse() @ rig.body_from_lidar
    lines.append(f"Tr: {_row(mount.rotation, mount.translation)}\n")
    file.write_text("".join(lines), encoding="ascii")


def _row(left: Array, right: Array) -> str:
    """The twelve numbers of the 3 x 4 matrix of ``left`` (3, 3) and ``right`` (3,), every digit."""
    whole = np.column_stack([left, right])
    return " ".join(map(repr, whole.ravel().tolist()))
