"""LIDAR-inertial odometry of others: conversions, and motion in a room that all must follow."""

import dataclasses
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from touchdown.experiments.benchmarks.inertial import comparison, logfile, methods, runner
from touchdown.experiments.errors import UsageError
from touchdown.experiments.external.synthetic_stream import synthetic_rig
from touchdown.sim.api import ImuSample, LidarScan
from touchdown.sim.frames import Pose, quat_wxyz_from_matrix, rotation_from_yaw, so3_exp, so3_log

Array = np.ndarray[Any, np.dtype[np.float64]]

PYTHON = os.environ.get("TOUCHDOWN_LIO_PYTHON", sys.executable)
"""interpreter of an environment with the extra ``lio``"""
REST_S, END_S, SCAN_S, PULSES = 3.0, 7.0, 0.1, 12000
LIDAR = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.1, 0.0, -0.2]))
IMU = Pose(rotation_from_yaw(0.5), np.array([0.05, -0.03, 0.04]))
RIG = dataclasses.replace(synthetic_rig(), body_from_lidar=LIDAR, body_from_imu=IMU)
IMU_S = RIG.imu_ticks / RIG.tick_hz


def _pose(time_s: float) -> Pose:
    """At rest, then metres to and fro with turns of some degrees."""
    t = max(time_s - REST_S, 0.0)
    grown = 1.0 - np.exp(-t * t)
    place = np.array([2.0 * np.sin(0.9 * t), 1.5 * np.sin(0.7 * t), 0.6 * np.sin(1.1 * t)])
    turn = np.array([0.05 * np.sin(1.3 * t), 0.06 * np.sin(0.8 * t), 0.4 * np.sin(0.5 * t)])
    return Pose(so3_exp(grown * turn), grown * place)


def _sample(number: int) -> ImuSample:
    middle_s, h = (number - 0.5) * IMU_S, 1e-4
    before, here, after = (_pose(middle_s + k * h) @ IMU for k in (-1.0, 0.0, 1.0))
    acceleration = (before.translation - 2.0 * here.translation + after.translation) / h**2
    force = here.rotation.T @ (acceleration + np.array([0.0, 0.0, 9.81]))
    rate = so3_log(before.rotation.T @ after.rotation) / (2.0 * h)
    ticks = number * RIG.imu_ticks
    return ImuSample(tick=ticks, time_s=number * IMU_S, angular_velocity=rate, specific_force=force)


def _beams(number: int, rings: int) -> Array:
    """(N, 3) directions: at random all round, or 64 lasers that go round once."""
    if not rings:
        beams = np.random.default_rng(number).normal(size=(PULSES, 3))
        return beams / np.linalg.norm(beams, axis=1, keepdims=True)
    pulse = np.arange(600 * rings)
    azimuth = 2.0 * np.pi * (pulse // rings + 0.37) / 600
    height = np.radians(np.linspace(-40.0, 40.0, rings))[pulse % rings]
    level = np.cos(height)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(height)], axis=1)


def _scan(number: int, rings: int = 0) -> LidarScan:
    """Returns from the inside of a box of 24 x 16 x 10 m; every 60 pulses have a pose."""
    beams, start_s = _beams(number, rings), number * SCAN_S
    count = len(beams)
    offsets = (np.arange(count) + 1.0) / count * SCAN_S
    ranges = np.empty(count)
    for first in range(0, count, 60):
        lidar = _pose(start_s + offsets[first + 30]) @ LIDAR
        rays = beams[first : first + 60] @ lidar.rotation.T
        with np.errstate(divide="ignore"):
            walls = (np.sign(rays) * np.array([12.0, 8.0, 5.0]) - lidar.translation) / rays
        ranges[first : first + 60] = walls.min(axis=1)
    return LidarScan(
        start_tick=0, end_tick=0, start_time_s=start_s, end_time_s=start_s + SCAN_S,
        directions=beams.astype(np.float32), time_offsets=offsets.astype(np.float32),
        ranges=(ranges + np.random.default_rng(number).normal(scale=0.01, size=count)).astype("f4"),
        intensity=np.full(count, 60, np.uint8),
    )  # fmt: skip


def _write(path: Path, rings: int = 0) -> Path:
    scans = [_scan(number, rings) for number in range(round(END_S / SCAN_S))]
    imu = [_sample(number) for number in range(1, round(END_S / IMU_S) + 2)]
    logfile.write_arrays(RIG, imu, scans, path)
    if rings:
        with np.load(path) as file:
            np.savez(path, **{**file, "lasers": np.array(rings)})
    return path


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _write(tmp_path_factory.mktemp("lio") / "log.npz")


def test_a_log_file_holds_units_frames_and_times(log: Path) -> None:
    read = runner.Log(str(log))
    times = read.imu[:, 0] - runner.EPOCH_S
    assert times[:2] == pytest.approx([0.5 * IMU_S, 1.5 * IMU_S])
    assert read.imu[0, 1:] == pytest.approx([0, 0, 9.81, 0, 0, 0], abs=1e-6)  # force, then rate
    moving = _sample(1000)
    assert read.imu[999, 1:4] == pytest.approx(moving.specific_force)
    assert read.imu[999, 4:] == pytest.approx(moving.angular_velocity)
    assert read.imu_from_lidar == pytest.approx((IMU.inverse() @ LIDAR).matrix())
    assert (read.lasers, read.pulses, read.gravity) == (6, PULSES, 9.81)
    assert read.scan_s == pytest.approx(0.1) and read.imu_hz == pytest.approx(1.0 / IMU_S)
    noise = RIG.imu
    assert read.imu_noise.tolist() == [
        noise.gyro_density, noise.accel_density, noise.gyro_bias_walk, noise.accel_bias_walk
    ]  # fmt: skip
    scans = list(read.scans(runner.EPOCH_S + 0.3))
    assert len(scans) == 67 and scans[0].start_s == pytest.approx(1000.3)
    points, offsets, intensity = scans[0].returns()
    assert points == pytest.approx(_scan(3).points)
    assert offsets[[0, -1]] == pytest.approx([0.1 / PULSES, 0.1]) and set(intensity) == {60.0}


def test_samples_come_before_the_scan_that_they_span(
    log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Up to the first at the end of the scan or after, each once."""
    heard: list[float] = []

    class Listener:
        def __init__(self, _log: runner.Log, setting: dict[str, Any]) -> None:
            assert setting == {"gain": 2}

        def prepare(self, scan: runner.Scan) -> runner.Scan:
            return scan

        def imu(self, row: Array) -> None:
            heard.append(float(row[0]))

        def scan(self, scan: runner.Scan) -> runner.Poses:
            assert heard[-2] < scan.end_s <= heard[-1]
            return [(scan.end_s, np.eye(4))]

    monkeypatch.setitem(runner.METHODS, "listener", Listener)
    job = {
        "method": "listener", "setting": {"gain": 2}, "log": str(log),
        "scans_from_s": 1.0, "imu_from_s": 0.5,
    }  # fmt: skip
    times = [time_s for time_s, _, _ in runner.run(job)]
    assert times == pytest.approx(np.arange(11, 71) * 0.1)
    assert heard == pytest.approx(1000.5 + IMU_S * (0.5 + np.arange(len(heard))))


def test_runs_start_at_the_true_pose_and_end_when_lost() -> None:
    """A frame of its own that is turned and moved, from which it drifts by 1 m/s from 3.05 s on."""
    own = Pose(rotation_from_yaw(2.0), np.array([5.0, -3.0, 1.0]))

    def lines(step_s: float = 0.1, until_s: float = 20.0) -> Iterator[str]:
        for time_s in np.arange(0.1, until_s, step_s):
            drift = np.array([max(time_s - 3.05, 0.0), 0.0, 0.0])
            pose = own @ Pose(np.eye(3), drift) @ _pose(time_s)
            w, x, y, z = quat_wxyz_from_matrix(pose.rotation)
            numbers = (time_s, *pose.translation, x, y, z, w, 0.25 * time_s)
            yield " ".join(f"{number:.9f}" for number in numbers) + "\n"

    def followed(*args: float) -> comparison.InertialTrack:
        track = comparison.InertialTrack({}, [], [])
        comparison.follow(lines(*args), track, _pose, begin_s=1.0)
        return track

    track = followed()
    at_5 = track.times_s.index(pytest.approx(5.0))
    assert track.times_s[0] == pytest.approx(1.0)
    assert track.positions[0] == pytest.approx(_pose(1.0).translation, abs=1e-6)
    assert track.positions[at_5] - _pose(5.0).translation == pytest.approx([1.95, 0, 0], abs=1e-6)
    assert track.lost_s == pytest.approx(13.1) and track.cpu_s == pytest.approx(0.25 * 13.1)
    assert followed(0.1, 12.0).lost_s is None
    assert followed(1.5).lost_s == pytest.approx(1.6)  # silent for longer than a second
    assert len(list(comparison.poses([*lines(0.1, 1.05), "1 2 3"]))) == 10


@pytest.mark.parametrize("yaw", [0.0, 1.0, np.pi, -2.0])
def test_quaternions_are_those_of_tum(yaw: float) -> None:
    rotation = so3_exp(np.array([0.1, -0.2, 0.0])) @ rotation_from_yaw(yaw)
    w, *xyz = quat_wxyz_from_matrix(rotation)
    found = runner.quat_xyzw(rotation)
    assert found * np.sign(found @ [*xyz, w]) == pytest.approx([*xyz, w])


def test_missing_packages_are_named_with_their_extra() -> None:
    assert comparison.missing_line("rko_lio") == (
        "rko_lio is not installed; pip install -c constraints.txt -e '.[lio]' installs rko-lio"
    )
    with pytest.raises(UsageError, match="LIO_PYTHON: '/no/python' is no Python interpreter"):
        comparison.installed("/no/python")
    assert methods.METHODS.keys() <= runner.METHODS.keys()
    assert {facts.package for facts in methods.METHODS.values()} <= set(runner.PACKAGES)


THERE = comparison.installed(PYTHON)
ROOM: dict[str, tuple[int, dict[str, Any]]] = {
    "rko_lio": (0, {"voxel_size": 0.5}),
    "genz_lio": (0, {}),
    "se3_lio": (0, {}),
    "dlio": (0, {"gravity": 9.81, "imu_calib_time": 2.5}),
    "lio_sam": (64, {"start": "survey", "mappingProcessInterval": 0.0}),
    "loam": (64, {}),
    "ct_icp": (0, {"ls_num_threads": 1}),
    "mad_icp": (0, {"realtime": False, "num_threads": 1}),
    "genz_icp": (0, {"deskew": True}),
}
"""Rings of the LIDAR, which methods with features need, and settings for a room; those of the grids
are for ground below. LIO-SAM needs IMU samples before its first scan."""


@pytest.mark.parametrize("method", methods.METHODS)
def test_methods_follow_motion_in_a_room(method: str, log: Path, tmp_path: Path) -> None:
    """Times, units, mounts and gravity are right: a wrong one costs a decimetre or more."""
    package = methods.METHODS[method].package
    if package not in THERE:
        pytest.skip(f"{package} of the extra 'lio' is not installed")
    rings, setting = ROOM[method]
    read = _write(tmp_path / "rings.npz", rings) if rings else log
    span = (0.0, REST_S, END_S)
    track = comparison.run_setting(method, setting, read, _pose, span, PYTHON)
    assert track.failure == "" and track.lost_s is None
    true = np.array([_pose(time_s).translation for time_s in track.times_s])
    assert np.linalg.norm(np.array(track.positions) - true, axis=1).max() < 0.07
    assert track.times_s[-1] > END_S - 0.3 and track.cpu_s > 0.0
