"""Bags: our own to the digit, those of other drivers, damaged ones."""

import re
import resource
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from touchdown.experiments.errors import UsageError
from touchdown.experiments.export.flown_run import ExportOptions
from touchdown.experiments.export.run import export
from touchdown.experiments.flight.replay import replay, replay_config
from touchdown.experiments.io.sensor_log_reader import SensorLogReader
from touchdown.experiments.recordings import bags
from touchdown.experiments.recordings.bags import RosBag, _picture
from touchdown.experiments.recordings.contract import RawImage, RawScan, RigParts
from touchdown.experiments.recordings.point_clouds import scan_of_cloud, seconds_after
from touchdown.experiments.recordings.run import ReplayOptions, replay_recording
from touchdown.sim.api import SensorNeeds

from support.bag_support import write_livox_bag
from support.command import Says
from support.recorded_data import assert_estimates_equal
from support.replay_support import make_run
from support.unwritten import delayed

ALL = SensorNeeds(camera_hz=10, stereo=True, lidar=True)
IDEAL = ("profile=ideal",)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flown") / "run"
    return make_run(folder, seconds=2.6, needs=ALL, shared=SensorNeeds())


@pytest.fixture(scope="module")
def bag(flown: Path) -> Path:
    """Of messages that arrive as they may."""
    run = delayed(flown, flown.parent / "delayed")
    return export(run, "mcap", flown.parent / "bag", ExportOptions()).out


@pytest.fixture(scope="module")
def livox(flown: Path) -> Path:
    return write_livox_bag(flown, flown.parent / "livox.bag")


@pytest.fixture(scope="module")
def rig(flown: Path) -> Path:
    """What the Livox bag does not say, as a user would write it."""
    log = SensorLogReader(flown / "sensors.mcap").rig
    camera = log.camera
    rows = {name: pose.matrix().ravel().tolist() for name, pose in (
        ("camera", log.body_from_camera), ("lidar", log.body_from_lidar))}  # fmt: skip
    file = flown.parent / "rig.toml"
    file.write_text(
        f"latency_s = 0.06\n[lidar]\nbody_from_lidar = {rows['lidar']}\nmin_range_m = 0.1\n"
        f"[camera]\nbody_from_camera = {rows['camera']}\nresolution = [424, 240]\n"
        f"intrinsics = [{camera.fx}, {camera.fy}, {camera.cx}, {camera.cy}]\n"
    )
    return file


@pytest.mark.parametrize("estimator", ["stereo", "livo", "zou2024"])
def test_a_bag_of_ours_gives_the_estimate_of_the_log(
    flown: Path, bag: Path, estimator: str, tmp_path: Path
) -> None:
    """To the digit, of a log with points of 32 bits and stamps of whole nanoseconds."""
    run = delayed(flown, tmp_path / "rounded", single=True)
    replay(run, replay_config(run, estimator), tmp_path / "log")
    asked = ReplayOptions(estimator=estimator, overrides=IDEAL)
    result = replay_recording(bag, tmp_path / "bag", asked)
    assert_estimates_equal(tmp_path / "log", tmp_path / "bag")
    assert result.position_error_m is not None and result.position_error_m.mean < 0.02


def test_a_bag_of_livox_is_replayed(flown: Path, livox: Path, rig: Path, tmp_path: Path) -> None:
    asked = ReplayOptions(estimator="livo", rig=rig, overrides=IDEAL)
    result = replay_recording(livox, tmp_path / "run", asked)
    assert result.position_error_m is not None and result.position_error_m.mean < 0.02
    names = {one.name for one in (tmp_path / "run").iterdir()}
    assert {"map.ply", "costmap.png"} <= names  # the ground is rolling, and the map is small
    assert any("no ground on the map is safe" in event.text for event in result.events)
    recording = RosBag(livox, RigParts())
    frames = list(recording.frames())
    log = SensorLogReader(flown / "sensors.mcap")
    scans = [scan for obs in log for scan in obs.scans]
    found = [frame for frame in frames if isinstance(frame, RawScan)]
    assert len(found) == len(scans)
    for one, scan in zip(found, scans, strict=True):
        assert (one.stamp_ns - found[0].stamp_ns) * 1e-9 == pytest.approx(
            scan.start_time_s - scans[0].start_time_s, abs=1e-6
        )
        np.testing.assert_allclose(one.points, scan.points, atol=1e-6)
        np.testing.assert_allclose(one.offsets_s, scan.time_offsets, atol=1e-8)
        np.testing.assert_array_equal(one.intensity, scan.intensity)
    image = next(frame for frame in frames if isinstance(frame, RawImage))
    first = next(one for obs in SensorLogReader(flown / "sensors.mcap") for one in obs.images)
    np.testing.assert_array_equal(image.read(), first.rgb)


def test_a_bag_without_our_rig_has_that_of_its_frames(
    bag: Path, flown: Path, tmp_path: Path
) -> None:
    """In SQLite, too: intrinsics of ``CameraInfo``, mounts of ``tf_static``."""
    from rosbags.convert import convert

    plain = tmp_path / "plain"
    convert([bag], plain, dst_storage="sqlite3", dst_version=8, compress=None,
            compress_mode="storage", default_typestore=None, typestore=None,
            exclude_topics=["/rotors"], include_topics=[], exclude_msgtypes=[],
            include_msgtypes=[])  # fmt: skip
    (part,) = plain.glob("*.db3")
    recording = RosBag(part, RigParts())
    assert RosBag.holds(part) and RosBag.holds(plain) and not RosBag.holds(flown)
    log, found = SensorLogReader(flown / "sensors.mcap").rig, recording.found
    assert found.whole is None and found.camera is not None and found.right is not None
    assert found.camera.intrinsics.fx == log.camera.fx
    for pose, own in (
        (found.camera.body_from_camera, log.body_from_camera),
        (found.right.body_from_camera, log.body_from_camera_right),
        (found.body_from_lidar, log.body_from_lidar), (found.body_from_imu, log.body_from_imu),
    ):  # fmt: skip
        assert pose is not None
        np.testing.assert_allclose(pose.matrix(), own.matrix(), atol=1e-9)
    result = replay_recording(plain, tmp_path / "run", ReplayOptions(estimator="zou2024"))
    assert result.position_error_m is not None and result.position_error_m.mean < 0.05


@pytest.mark.parametrize(("times", "expected"), [
    ([0.0, 0.05, 0.1], [0.0, 0.05, 0.1]),  # Velodyne
    ([-0.1, -0.05, 0.0], [-0.1, -0.05, 0.0]),  # the stamp is the end
    ([0, 5e7, 1e8], [0.0, 0.05, 0.1]),  # Ouster, ns
    ([0.0, 50.0, 100.0], [0.0, 0.05, 0.1]),  # ms
    ([10.0, 10.05, 10.1], [0.0, 0.05, 0.1]),  # Hesai, s
    ([10.1e9, 10.15e9, 10.2e9], [0.1, 0.15, 0.2]),  # Livox, ns
    ([3.0, 3.0, 3.0], [0.0, 0.0, 0.0]),  # moved to one instant
    ([500.0, 500.05, 500.1], [0.0, 0.05, 0.1]),  # a clock of its own
])  # fmt: skip
def test_times_of_any_driver(times: Any, expected: Any) -> None:
    found = seconds_after(10 * 10**9, np.array(times, np.float64))
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_times_that_are_none_are_told() -> None:
    with pytest.raises(ValueError, match="no sweep"):
        seconds_after(0, np.array([0.0, 1e13]))
    with pytest.raises(ValueError, match="not finite"):
        seconds_after(0, np.array([0.0, np.nan]))


def _cloud(**changes: Any) -> Any:
    table = np.zeros(3, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"),
                         ("t", "<u4")])  # fmt: skip
    table["x"], table["intensity"], table["t"] = [1, 2, 3], [0.0, 0.5, 1.0], [0, 5e7, 1e8]
    fields = [SimpleNamespace(name=name, offset=4 * n, datatype=6 if name == "t" else 7)
              for n, name in enumerate(table.dtype.names or ())]  # fmt: skip
    whole: dict[str, Any] = {
        "width": 3, "height": 1, "fields": fields, "point_step": 20, "is_bigendian": False,
        "data": table.view(np.uint8),
    }  # fmt: skip
    return SimpleNamespace(**{**whole, **changes})


def test_a_cloud_and_clouds_that_contradict_themselves() -> None:
    scan = scan_of_cloud(_cloud(), 0)
    np.testing.assert_array_equal(scan.points[:, 0], [1, 2, 3])
    np.testing.assert_array_equal(scan.intensity, [0, 127, 255])
    np.testing.assert_allclose(scan.offsets_s, [0.0, 0.05, 0.1])
    nothing = scan_of_cloud(_cloud(width=0, data=np.zeros(0, np.uint8)), 0)
    assert len(nothing.points) == len(nothing.offsets_s) == len(nothing.intensity) == 0
    for changes in (
        {"width": 4},
        {"width": -1},
        {"point_step": 8},
        {"fields": _cloud().fields[1:]},
    ):
        with pytest.raises(ValueError, match="cloud"):
            scan_of_cloud(_cloud(**changes), 0)


@pytest.mark.parametrize(("coding", "pixel", "expected"), [
    ("rgb8", [9, 5, 1], [9, 5, 1]), ("bgr8", [9, 5, 1], [1, 5, 9]), ("mono8", [7], [7, 7, 7]),
    ("rgba8", [9, 5, 1, 0], [9, 5, 1]), ("bgra8", [9, 5, 1, 0], [1, 5, 9]),
])  # fmt: skip
def test_images_of_any_coding(coding: str, pixel: Any, expected: Any) -> None:
    """Rows are padded by a byte."""
    row = np.array([*pixel, *pixel, 77], np.uint8)
    message = SimpleNamespace(
        encoding=coding, width=2, height=4, step=len(row), data=np.tile(row, 4)
    )
    found = _picture(message, "sensor_msgs/msg/Image")
    np.testing.assert_array_equal(found, np.broadcast_to(expected, (4, 2, 3)))
    message.height = 5
    with pytest.raises(ValueError, match="cannot be read"):
        _picture(message, "sensor_msgs/msg/Image")


def _edited(file: Path, change: Any) -> None:
    file.write_bytes(change(file.read_bytes()))


@pytest.mark.parametrize(("kind", "change", "words"), [
    ("livox", lambda data: data[: len(data) // 2], "damaged or no bag"),
    ("livox", lambda data: b"", "damaged or no bag"),
    ("mcap", lambda data: data[: len(data) // 2], "damaged or no bag"),
    ("metadata", lambda data: data.replace(b"tick_hz", b"tock_hz"), "metadata.yaml is damaged"),
    ("metadata", lambda data: data[:300], "damaged"),
])  # fmt: skip
def test_a_damaged_bag_is_one_line(
    livox: Path, bag: Path, rig: Path, tmp_path: Path, says: Says, kind: str, change: Any,
    words: str,
) -> None:  # fmt: skip
    if kind == "livox":
        data = tmp_path / "a.bag"
        shutil.copy(livox, data)
        _edited(data, change)
    else:
        data = tmp_path / "bag"
        shutil.copytree(bag, data)
        _edited(data / "metadata.yaml" if kind == "metadata" else data / "bag.mcap", change)
    out = tmp_path / "out"
    found = (
        says(2, "replay", str(data), "--rig", str(rig), "--out", str(out), "--quiet")
        if kind == "livox"
        else says(2, "replay", str(data), "--out", str(out), "--quiet")
    )
    assert words in found.err and found.err.count("\n") == 1 and not out.exists()


def test_topics_are_chosen_or_asked_for(livox: Path, rig: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="/livox/imu for lidar is sensor_msgs/msg/Imu"):
        RosBag(livox, RigParts(topics={"lidar": "/livox/imu"}))
    with pytest.raises(UsageError, match="/none for imu is not in it"):
        RosBag(livox, RigParts(topics={"imu": "/none"}))
    asked = ReplayOptions(estimator="livo")
    with pytest.raises(UsageError, match=re.escape("nothing says how their camera is calibrated")):
        replay_recording(livox, tmp_path / "out", asked)


def test_a_bag_that_inflates_without_end_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store, file = get_typestore(Stores.ROS1_NOETIC), tmp_path / "small.bag"
    writer = Writer(file)
    writer.set_compression(Writer.CompressionFormat.LZ4)
    with writer:
        kind = "sensor_msgs/msg/CompressedImage"
        line, made = writer.add_connection("/camera", kind, typestore=store), store.types
        stamp = made["builtin_interfaces/msg/Time"](sec=0, nanosec=0)
        header = made["std_msgs/msg/Header"](seq=0, stamp=stamp, frame_id="")
        image = made[kind](header=header, format="png", data=np.zeros(256 << 20, np.uint8))
        writer.write(line, 0, store.serialize_ros1(image, kind))
    assert file.stat().st_size < 2 << 20
    monkeypatch.setattr("touchdown.experiments.recordings.bags._MEMORY", 64 << 20)
    before = resource.getrlimit(resource.RLIMIT_DATA)
    with pytest.raises(UsageError, match="takes more than 0 GiB to read"):
        list(RosBag(file, RigParts()).frames())
    assert resource.getrlimit(resource.RLIMIT_DATA) == before


def test_memory_is_limited_while_a_bag_is_read_alone(
    bag: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not while an estimator works on what it gave, nor after a reader was left in the middle."""
    seen, stamp = [], bags._stamp

    def noted(message: Any) -> int:
        seen.append(resource.getrlimit(resource.RLIMIT_DATA))
        return stamp(message)

    monkeypatch.setattr(bags, "_stamp", noted)
    before = resource.getrlimit(resource.RLIMIT_DATA)
    recording = RosBag(bag, RigParts())
    frames = recording.frames()
    for _ in range(3):
        next(frames)
        assert resource.getrlimit(resource.RLIMIT_DATA) == before
    assert recording.imu() is not None and recording.truth() is not None
    assert recording.rotors() is not None
    assert resource.getrlimit(resource.RLIMIT_DATA) == before
    assert before not in seen and len(seen) > 600
