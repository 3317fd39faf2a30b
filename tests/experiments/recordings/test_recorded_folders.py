"""Folders of EuRoC and KITTI: those of our exports, damaged ones, and real ones where they are."""

import dataclasses
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from touchdown.experiments.errors import UsageError
from touchdown.experiments.export.datasets import write_truth
from touchdown.experiments.export.flown_run import ExportOptions, FlownRun
from touchdown.experiments.export.run import export
from touchdown.experiments.flight.replay import replay, replay_config
from touchdown.experiments.io.dataclass_json import to_plain
from touchdown.experiments.io.results import RunResult
from touchdown.experiments.io.sensor_log_reader import SensorLogReader
from touchdown.experiments.io.tum import read_tum
from touchdown.experiments.recordings.compose import ComposedLog
from touchdown.experiments.recordings.contract import RawScan, Span
from touchdown.experiments.recordings.folders import EurocFolder, KittiFolder
from touchdown.experiments.recordings.pair_depth import pair_scan, pair_sheet
from touchdown.experiments.recordings.registration import registered, registered_path
from touchdown.experiments.recordings.run import (
    REGISTRATION,
    ReplayOptions,
    open_run,
    replay_recording,
)
from touchdown.sim.api import CameraIntrinsics, SensorNeeds
from touchdown.sim.frames import Pose, matrices_from_quats_wxyz, so3_exp

from support.command import Says
from support.recorded_data import assert_estimates_equal, recorded
from support.replay_support import make_run
from support.unwritten import delayed, kitti_unwritten

ALL = SensorNeeds(camera_hz=10, stereo=True, lidar=True)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flown") / "run"
    return make_run(folder, seconds=2.6, needs=ALL, shared=ALL)


@pytest.fixture(scope="module")
def euroc(flown: Path) -> Path:
    """As of others: without our rig."""
    folder = export(flown, "euroc", flown.parent / "euroc", ExportOptions()).out
    (folder / "mav0" / "rig.json").unlink()
    return folder


@pytest.fixture(scope="module")
def kitti(flown: Path) -> Path:
    return export(flown, "kitti", flown.parent / "kitti", ExportOptions(poses="truth")).out


def _said(result: RunResult) -> str:
    return " | ".join(event.text for event in result.events if event.time_s == 0.0)


def test_an_exported_flight_of_euroc_is_replayed(euroc: Path, tmp_path: Path) -> None:
    asked = ReplayOptions(estimator="stereo", log_sensors=True)
    result = replay_recording(euroc, tmp_path / "run", asked)
    assert result.position_error_m is not None and result.position_error_m.mean < 0.05
    assert "at rest" in _said(result) and "--align_origin" in _said(result)
    assert re.search(r"camera's clock -?\d+\.\d+ ms ahead", _said(result))
    assert result.replay_of == str(euroc) and result.scene == "euroc" and result.wind_kmh is None
    again = tmp_path / "again"
    replay(tmp_path / "run", replay_config(tmp_path / "run"), again)
    assert (again / "estimate.tum").read_bytes() == (tmp_path / "run/estimate.tum").read_bytes()


def test_a_folder_of_euroc_of_ours_gives_the_estimate_of_the_log(
    flown: Path, tmp_path: Path
) -> None:
    """To the digit: of the IMU, of the images and when they arrived, of the rotors, of the rig."""
    run = delayed(flown, tmp_path / "flown")
    ours = export(run, "euroc", tmp_path / "euroc", ExportOptions()).out
    replay(run, replay_config(run, "stereo"), tmp_path / "log")
    asked = ReplayOptions(estimator="stereo", overrides=("profile=ideal",))
    result = replay_recording(ours, tmp_path / "folder", asked)
    assert_estimates_equal(tmp_path / "log", tmp_path / "folder")
    assert result.position_error_m is not None and result.position_error_m.mean < 0.02


def test_the_truth_in_a_folder_of_ours_is_that_of_the_body(flown: Path, tmp_path: Path) -> None:
    lever = Pose(so3_exp(np.array([0.1, -0.2, 0.3])), np.array([0.1, -0.2, 0.05]))
    rig = dataclasses.replace(SensorLogReader(flown / "sensors.mcap").rig, body_from_imu=lever)
    write_truth(FlownRun(flown, {}), tmp_path / "mav0", rig)
    (tmp_path / "mav0" / "rig.json").write_text(json.dumps(to_plain(rig)))
    truth, (_, positions, quats) = EurocFolder(tmp_path).truth(), read_tum(flown / "truth.tum")
    assert truth is not None
    np.testing.assert_allclose(truth.positions, positions, atol=1e-8)
    np.testing.assert_allclose(truth.quats_wxyz, quats, atol=1e-8)


def test_an_alignment_over_all_positions_leaves_less(euroc: Path, tmp_path: Path) -> None:
    errors = []
    for align in ("origin", "se3"):
        asked = ReplayOptions(estimator="stereo", align=align)
        result = replay_recording(euroc, tmp_path / align, asked)
        assert result.position_error_m is not None
        errors.append(result.position_error_m.rmse)
    assert errors[1] < errors[0] and result.nees is None and "evo: --align)" in _said(result)
    estimate, truth = (read_tum(tmp_path / "se3" / f"{n}.tum")[1] for n in ("estimate", "truth"))
    np.testing.assert_allclose(estimate.mean(axis=0), truth[: len(estimate)].mean(axis=0), atol=0.1)


def test_an_exported_flight_of_kitti_is_replayed(kitti: Path, tmp_path: Path) -> None:
    """Without an IMU it cannot follow a steep climb close above the ground; it says what it did."""
    result = replay_recording(kitti, tmp_path / "run", ReplayOptions(estimator="livo", from_s=1.2))
    times, positions, _ = read_tum(tmp_path / "run" / "truth.tum")
    assert times[0] < 0.05 and times[-1] == pytest.approx(1.22, abs=0.1)
    assert positions[0, 2] - positions[-1, 2] == pytest.approx(1.39, abs=0.15)  # z is down
    assert "no IMU" in _said(result) and result.outcome == "COMPLETED"


@pytest.mark.parametrize("estimator", ["livo", "zou2024"])
def test_a_sequence_of_ours_gives_the_estimate_of_what_was_written(
    flown: Path, estimator: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To the digit, the truth too, of a LIDAR whose clock is 0.123457 ms late: points have 32 bits,
    all else what the log has."""
    run = delayed(flown, tmp_path / "flown")
    kitti = export(run, "kitti", tmp_path / "kitti", ExportOptions(poses="truth")).out
    asked, unwritten = ReplayOptions(estimator=estimator, from_s=1.2), kitti_unwritten(run)
    replay_recording(kitti, tmp_path / "folder", asked)
    for one, frame in zip(unwritten.frames(), KittiFolder(kitti).frames(), strict=True):
        assert one.stamp_ns == frame.stamp_ns
        if isinstance(one, RawScan) and isinstance(frame, RawScan):
            np.testing.assert_array_equal(one.intensity, frame.intensity)
    monkeypatch.setattr(
        "touchdown.experiments.recordings.run.open_recording", lambda _path, _parts: unwritten
    )
    replay_recording(kitti, tmp_path / "log", asked)
    for name in ("estimate.tum", "truth.tum"):
        own, read = ((tmp_path / run / name).read_text() for run in ("log", "folder"))
        assert own == read and len(own.splitlines()) > 10


def test_scans_and_images_come_with_their_stamps(kitti: Path) -> None:
    recording = KittiFolder(kitti)
    log = ComposedLog(recording, recording.found)
    assert log.sensed == SensorNeeds(camera_hz=10, lidar=True)
    seen = [(scan, image) for obs in log.observations() for scan in obs.scans
            for image in obs.images]  # fmt: skip
    frames = [f for f in recording.frames() if isinstance(f, RawScan)]
    assert len(seen) == len(frames) > 10
    for (scan, image), frame in zip(seen, frames, strict=True):
        assert scan.end_tick == image.tick == scan.start_tick + 1
        time_s = (frame.stamp_ns - frames[0].stamp_ns) * 1e-9 + 0.01
        assert image.time_s == pytest.approx(time_s, abs=1e-9)
        np.testing.assert_allclose(scan.points, frame.points, rtol=1e-6)
        np.testing.assert_array_equal(scan.time_offsets, np.float32(1 / 600))


def test_a_span_and_frames_out_of_order(euroc: Path, tmp_path: Path) -> None:
    shuffled = tmp_path / "euroc"
    shutil.copytree(euroc, shuffled)
    listing = shuffled / "mav0" / "cam0" / "data.csv"
    head, *rows = listing.read_text().splitlines()
    rows[3], rows[5] = rows[5], rows[3]
    rows[0], rows[-1] = rows[-1], rows[0]  # too far to be put in order
    listing.write_text("\n".join([head, *rows]))
    recording = EurocFolder(shuffled)
    span = Span(recording.begins_ns(), 1 << 62)
    log = ComposedLog(recording, recording.found, span)
    ticks = [image.tick for obs in log.observations() for image in obs.images]
    assert ticks == sorted(ticks) and len(ticks) == len(rows) - 1
    assert "1 images refused" in " ".join(log.notes())


def test_a_pair_gives_the_depths_of_a_wall() -> None:
    """A random texture, 20 pixels apart in the two images."""
    texture = np.random.default_rng(3).integers(0, 256, (240, 360, 1), np.uint8).repeat(3, axis=2)
    left, right = texture[:, :320], texture[:, 20:340]
    camera = CameraIntrinsics(width=320, height=240, fx=300.0, fy=300.0, cx=160.0, cy=120.0)
    scan = pair_scan(left, right, camera, 0.1, 7)
    assert scan.stamp_ns == 7 and len(scan.points) > 2000
    np.testing.assert_allclose(np.median(scan.points[:, 2]), 300.0 * 0.1 / 20.0, rtol=0.01)
    depth = scan.points[:, 2]
    assert np.quantile(np.abs(depth - 1.5), 0.9) < 0.02
    sheet = pair_sheet(30.0)
    assert sheet.min_range_m < 1.5 < sheet.max_range_m


def test_two_scans_show_the_motion_between_them() -> None:
    rng = np.random.default_rng(4)
    walls = rng.uniform(-15.0, 15.0, (6000, 3))
    walls[:2000, 0], walls[2000:4000, 1], walls[4000:, 2] = 15.0, -12.0, -2.0
    true = Pose(so3_exp(np.array([0.0, 0.01, 0.03])), np.array([0.8, 0.05, -0.02]))
    found = registered(walls, true.inverse().apply(walls))
    assert found is not None
    np.testing.assert_allclose(found.matrix(), true.matrix(), atol=0.01)
    assert registered(walls, walls + 500.0) is None


def test_scans_of_a_street_show_the_way_through_it(tmp_path: Path) -> None:
    """A street of 70 m, of which a scan sees 15 m: the last shares nothing with the first."""
    rng = np.random.default_rng(4)
    street = rng.uniform([-20.0, -8.0, -2.0], [50.0, 8.0, 4.0], (120_000, 3))
    street[:30_000, 2] = -2.0
    street[30_000:90_000, 1] = np.where(street[30_000:90_000, 0] % 7.0 < 4.0, 8.0, 6.0)
    street[90_000:, 0] = 7.0 * np.floor(street[90_000:, 0] / 7.0)
    street[90_000:, 1] = np.where(street[90_000:, 1] > 0.0, 6.0, -8.0) + 0.2 * street[90_000:, 1]
    mount = Pose(so3_exp(np.array([0.0, 0.2, 0.0])), np.array([0.3, 0.0, 0.5]))
    true = [Pose(so3_exp(np.array([0.0, 0.0, 0.02 * k])), np.array([1.6 * k, 0.03 * k, 0.0]))
            for k in range(22)]  # fmt: skip
    scans, velodyne = [], tmp_path / "velodyne"
    velodyne.mkdir()
    (tmp_path / "calib.txt").write_text("Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    np.savetxt(tmp_path / "times.txt", 0.1 * np.arange(len(true)))
    for k, pose in enumerate(true):
        points = (pose @ mount).inverse().apply(street)
        points = points[np.linalg.norm(points, axis=1) < 15.0].astype(np.float32)
        scans.append(RawScan(stamp_ns=k, points=points, intensity=np.zeros(len(points), np.uint8),
                             offsets_s=np.zeros(len(points), np.float32)))  # fmt: skip
        table = np.column_stack([points, np.zeros(len(points), np.float32)])
        table.tofile(velodyne / f"{k:06}.bin")
    found = registered_path(scans, mount)
    np.testing.assert_array_equal(found.stamps_ns, range(22))
    np.testing.assert_allclose(found.positions, [p.translation for p in true], atol=0.05)
    turns = matrices_from_quats_wxyz(found.quats_wxyz)
    np.testing.assert_allclose(turns, [p.rotation for p in true], atol=0.005)
    run = open_run(tmp_path, ReplayOptions(truth=REGISTRATION, from_s=0.1))
    ticks = sorted(run.truth)
    ends = [run.truth[tick] @ mount.inverse() for tick in (ticks[0], ticks[-1])]
    moved = ends[0].inverse() @ ends[1]
    np.testing.assert_allclose(moved.matrix(), (true[1].inverse() @ true[-1]).matrix(), atol=0.05)
    far = dataclasses.replace(scans[0], points=scans[0].points + np.float32(500.0))
    with pytest.raises(ValueError, match="fits no other"):
        registered_path([scans[0], far], mount)
    swept = dataclasses.replace(scans[0], offsets_s=scans[0].offsets_s + np.float32(0.1))
    with pytest.raises(ValueError, match="not moved to one instant"):
        registered_path([swept], mount)


def _cut(file: Path, size: int) -> None:
    file.write_bytes(file.read_bytes()[:size])


@pytest.mark.parametrize(("break_it", "words"), [
    (lambda d: (d / "mav0/imu0/data.csv").unlink(), "imu0/data.csv' does not exist"),
    (lambda d: (d / "mav0/imu0/data.csv").write_text("#t\n"), "data.csv' is empty"),
    (lambda d: _cut(d / "mav0/imu0/data.csv", 5000), r"line \d+ is not a stamp"),
    (lambda d: next((d / "mav0/cam0/data").iterdir()).unlink(), "names '.*png', which does not"),
    (lambda d: (d / "mav0/cam1/data.csv").write_text("1,../../x.png\n"), "no name of a file"),
    (lambda d: (d / "mav0/cam0/sensor.yaml").write_text("rate_hz: 3\n"), "lacks 'T_BS'"),
    (lambda d: [shutil.rmtree(d / f"mav0/cam{n}") for n in (0, 1)], "neither scans nor images"),
    (lambda d: (d / "mav0/imu0/data.csv").write_text("2,0,0,0,0,0,9\n1,0,0,0,0,0,9\n"),
     "not later than the one before"),
])  # fmt: skip
def test_a_damaged_folder_is_one_line(
    euroc: Path, tmp_path: Path, says: Says, break_it: object, words: str
) -> None:
    broken = tmp_path / "euroc"
    shutil.copytree(euroc, broken)
    break_it(broken)  # type: ignore[operator]
    out = tmp_path / "out"
    found = says(2, "replay", str(broken), "--out", str(out), "--quiet")
    assert re.search(words, found.err) and found.err.count("\n") == 1 and not out.exists()


def test_data_and_rigs_that_do_not_fit(
    euroc: Path, kitti: Path, tmp_path: Path, says: Says
) -> None:
    rig = tmp_path / "rig.toml"
    rig.write_text(
        "[camera]\nresolution = [64, 48]\nintrinsics = [50.0, 50.0, 32.0, 24.0]\n"
        "body_from_camera = [0, 0, 0, 0, 0, 0, 1]\n"
    )
    told = says(2, "replay", str(kitti), "--rig", str(rig), "--out", str(tmp_path / "a")).err
    assert "has 64 x 48 pixels, the images have 424 x 240" in told
    told = says(2, "replay", str(euroc), "--rig", str(rig), "--out", str(tmp_path / "a")).err
    assert "two cameras have images of different sizes" in told
    assert "is no recording" in says(2, "replay", str(tmp_path), "--out", str(tmp_path / "a")).err
    (tmp_path / "run").mkdir()
    (tmp_path / "run/sensors.mcap").touch()
    assert "`touchdown fly --replay " in says(2, "replay", str(tmp_path / "run")).err
    assert "does not exist" in says(2, "replay", str(tmp_path / "x")).err
    scan = next((kitti / "sequences/00/velodyne").iterdir())
    whole = scan.read_bytes()
    try:
        _cut(scan, 101)
        assert "is cut short" in says(2, "replay", str(kitti), "--out", str(tmp_path / "a")).err
    finally:
        scan.write_bytes(whole)
    assert (
        "lacks what livo needs"
        not in says(0, "replay", str(kitti), "--out", str(tmp_path / "b"), "--quiet", "--json").err
    )
    told = says(2, "replay", str(kitti), "--estimator", "stereo", "--out", str(tmp_path / "c")).err
    assert "lacks what stereo needs: stereo" in told and "--rig" in told


def test_a_second_camera_of_another_time_is_told(euroc: Path, tmp_path: Path) -> None:
    late = tmp_path / "euroc"
    shutil.copytree(euroc, late)
    listing = late / "mav0" / "cam1" / "data.csv"
    rows = [line.partition(",") for line in listing.read_text().splitlines()[1:]]
    listing.write_text("".join(f"{int(t) + 40_000_000},{name}\n" for t, _, name in rows))
    with pytest.raises(UsageError, match="not synchronised"):
        ComposedLog(EurocFolder(late), EurocFolder(late).found)


@pytest.mark.parametrize("estimator", ["stereo", "livo", "zou2024"])
def test_the_real_euroc_stands_still(estimator: str, tmp_path: Path) -> None:
    """30 pairs in front of shaking rotors, the cameras ahead: 2.4, 3.4 and 3.3 mm."""
    data = recorded("euroc_v101")
    asked = ReplayOptions(estimator=estimator)
    result = replay_recording(data, tmp_path / "run", asked)
    assert result.position_error_m is not None and result.position_error_m.max < 0.005


@pytest.mark.slow
@pytest.mark.parametrize(("estimator", "overrides", "percent"), [
    ("livo", ("livo.camera_hz=10",), 1.0),
    ("zou2024", ("zou2024.planar_cells=[180,56]", "zou2024.keyframe_period_s=0.1",
                 "zou2024.camera_hz=10"), 0.6),
])  # fmt: skip
def test_the_real_kitti_is_driven(
    estimator: str, overrides: tuple[str, ...], percent: float, tmp_path: Path
) -> None:
    """Against the registration of each scan with the first: its own truth is interpolated."""
    asked = ReplayOptions(
        estimator=estimator, truth=REGISTRATION, from_s=0.1, overrides=overrides
    )  # fmt: skip
    replay_recording(recorded("kitti_00"), tmp_path / "run", asked)
    ends = [read_tum(tmp_path / "run" / f"{name}.tum")[1][-1] for name in ("estimate", "truth")]
    way = np.linalg.norm(ends[1] - read_tum(tmp_path / "run" / "truth.tum")[1][0])
    assert 6.7 < way < 6.95
    assert 100.0 * np.linalg.norm(ends[0] - ends[1]) / way < percent
