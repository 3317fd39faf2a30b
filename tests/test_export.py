"""Exports hold what the run holds, and other people's readers get it out again."""

from __future__ import annotations

import json
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from landing_support import make_estimate
from replay_support import LIFT_OFF_S, make_run, shifted

from estimator.api import MapperParams
from estimator.mapper import GridMapper
from experiments import cli
from experiments.export import ExportOptions, export
from experiments.export_cloud import project
from experiments.export_mcap import mounts
from experiments.export_messages import timed_cloud_message
from experiments.flight import PhaseLog
from experiments.geodesy import LocalFrame
from experiments.pictures import map_points, write_ply
from experiments.ros_bag import RosBag
from experiments.ros_messages import camera_message, right_camera_shift
from experiments.sensor_log_reader import SensorLogReader
from experiments.synthetic_stream import SyntheticStream, synthetic_rig
from experiments.tum import TumWriter, read_tum
from sim.api import CameraIntrinsics, LidarScan, Observation, SensorNeeds
from sim.frames import (
    Pose,
    interpolate_pose,
    matrix_from_quat_wxyz,
    rotation_from_yaw,
)

SECONDS = 2.4
ALL = SensorNeeds(
    camera_hz=3, stereo=True, lidar=True, gps=True, barometer=True, magnetometer=True,
    rangefinder=True,
)  # fmt: skip
OFFSET = np.array([0.3, -0.4, 0.0])
PHASES = [{"time_s": 0.0, "phase": "INIT"}, {"time_s": 0.7, "phase": "TAKEOFF"}]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Believed 0.5 m away from where it is, and with a map of the true path."""
    made = make_run(
        tmp_path_factory.mktemp("runs") / "flown",
        seconds=SECONDS,
        needs=ALL,
        shared=ALL,
        estimate=shifted(OFFSET),
        phases=PHASES,
    )
    truth = SyntheticStream(synthetic_rig(), ALL, SECONDS)
    mapper = GridMapper(synthetic_rig(), MapperParams(extent_m=40.0))
    for obs in SensorLogReader(made / "sensors.mcap"):
        view = mapper.update(obs, make_estimate(obs.tick, truth.true_pose(obs.tick)))
    write_ply(made / "map.ply", *map_points(view.coarse))
    return made


@pytest.fixture(scope="module")
def stream(run: Path) -> list[Observation]:
    """What the run's sensors said."""
    return list(SensorLogReader(run / "sensors.mcap"))


@pytest.fixture(scope="module")
def bag(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("bags") / "flown.mcap"
    return export(run, "mcap", out, ExportOptions()).out


def _read(path: Path) -> dict[str, list[Any]]:
    """(log time, message) by topic, by the readers of rosbags."""
    highlevel = pytest.importorskip("rosbags.highlevel")
    found: dict[str, list[Any]] = defaultdict(list)
    with highlevel.AnyReader([path]) as reader:
        for connection, time_ns, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            found[connection.topic].append((time_ns, message))
    return found


@pytest.fixture(scope="module")
def messages(bag: Path) -> dict[str, list[Any]]:
    return _read(bag)


def _stamp(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def _ns(tick: int) -> int:
    return round(tick * 10**9 / 600)


def _vector(v: Any) -> np.ndarray:
    return np.array([v.x, v.y, v.z])


def _pose(position: Any, q: Any) -> Pose:
    return Pose(matrix_from_quat_wxyz(np.array([q.w, q.x, q.y, q.z])), _vector(position))


def _links(message: Any) -> dict[tuple[str, str], Pose]:
    return {
        (link.header.frame_id, link.child_frame_id): _pose(
            link.transform.translation, link.transform.rotation
        )
        for link in message.transforms
    }


def _points(cloud: Any) -> Any:
    kinds = {7: "<f4", 4: "<u2"}
    dtype = np.dtype(
        {
            "names": [field.name for field in cloud.fields],
            "formats": [kinds[field.datatype] for field in cloud.fields],
            "offsets": [field.offset for field in cloud.fields],
            "itemsize": cloud.point_step,
        }
    )
    return np.frombuffer(cloud.data.tobytes(), dtype)


def _same_pose(one: Pose, other: Pose, tolerance: float = 1e-8) -> None:
    np.testing.assert_allclose(one.matrix(), other.matrix(), rtol=0.0, atol=tolerance)


# ---------------------------------------------------------------------------------------------- bag


def test_counts_and_times_are_the_runs(
    run: Path, messages: dict[str, list[Any]], stream: list[Observation]
) -> None:
    measured = {
        "/lidar/points": [scan.start_tick for obs in stream for scan in obs.scans],
        "/imu/data_raw": [each.tick for obs in stream for each in obs.imu],
        "/imu/mag": [each.tick for obs in stream for each in obs.magnetometer],
        "/imu/pressure": [each.tick for obs in stream for each in obs.barometer],
        "/gps/fix": [each.tick for obs in stream for each in obs.gps],
        "/rangefinder/point": [
            each.tick for obs in stream for each in obs.rangefinder if each.range_m > 0.0
        ],
    }
    for name in ("camera", "camera_right"):
        pictures = [image.tick for obs in stream for image in obs.images]
        measured[f"/{name}/image_raw/compressed"] = measured[f"/{name}/camera_info"] = pictures
    for topic, ticks in measured.items():
        assert len(ticks) > 3, topic
        assert [_stamp(message) for _, message in messages[topic]] == list(map(_ns, ticks)), topic
    times, _, _ = read_tum(run / "truth.tum")
    rows = [round(1e9 * time_s) for time_s in times]
    for topic in ("/odom", "/ground_truth/odom"):
        assert [_stamp(message) for _, message in messages[topic]] == rows
    assert [time_ns for time_ns, _ in messages["/tf"]] == rows
    assert set(messages) == {*measured, "/odom", "/ground_truth/odom", "/tf", "/tf_static"}


def test_messages_are_logged_as_they_arrived(bag: Path, stream: list[Observation]) -> None:
    """In the order of the file, which is that of a player."""
    from mcap.stream_reader import StreamReader

    with bag.open("rb") as file:
        records = [r for r in StreamReader(file).records if type(r).__name__ == "Message"]
    times = [record.log_time for record in records]
    assert times == sorted(times)
    assert all(record.publish_time <= record.log_time for record in records)
    arrived = {_ns(obs.tick) for obs in stream if obs.scans}
    cloud = next(record for record in records if len(record.data) > 50_000)
    assert cloud.log_time in arrived and cloud.log_time > cloud.publish_time


def test_the_reader_of_mcap_decodes_every_message(bag: Path, messages: Any) -> None:
    decoder = pytest.importorskip("mcap_ros2.decoder")
    reader = pytest.importorskip("mcap.reader")
    counts: dict[str, int] = defaultdict(int)
    with bag.open("rb") as file:
        opened = reader.make_reader(file, decoder_factories=[decoder.DecoderFactory()])
        assert opened.get_header().profile == "ros2"
        for schema, channel, _message, decoded in opened.iter_decoded_messages():
            assert (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr")
            assert decoded is not None
            counts[channel.topic] += 1
    assert counts == {topic: len(found) for topic, found in messages.items()}


def test_definitions_are_those_of_current_ros() -> None:
    """A bag is of no use to a node whose messages look otherwise."""
    typesys = pytest.importorskip("rosbags.typesys")
    from experiments import ros_messages as ros
    from experiments.export_mcap import _TYPES

    for version in (typesys.Stores.ROS2_HUMBLE, typesys.Stores.ROS2_JAZZY):
        store = typesys.get_typestore(version)
        for name in set(_TYPES.values()):
            ours = typesys.get_types_from_msg(ros.definition(name), name)[name][1]
            assert ours == store.fielddefs[name][1], name


def test_definitions_name_the_codes_of_fields() -> None:
    """Some readers tell float32 from uint16 by the constants of the definition."""
    typesys = pytest.importorskip("rosbags.typesys")
    from experiments import ros_messages as ros

    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    for outer, inner in (
        ("PointCloud2", "PointField"), ("NavSatFix", "NavSatStatus"), ("NavSatFix", "NavSatFix"),
    ):  # fmt: skip
        name = f"sensor_msgs/msg/{outer}"
        ours = typesys.get_types_from_msg(ros.definition(name), name)
        codes, _ = ours[f"sensor_msgs/msg/{inner}"]
        assert codes and codes == store.fielddefs[f"sensor_msgs/msg/{inner}"][0]


def test_static_transforms_wait_for_those_who_come_later(bag: Path) -> None:
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    with rosbag2.Reader(bag) as reader:
        offered = {c.topic: c.ext.offered_qos_profiles for c in reader.connections}
    (profile,) = offered.pop("/tf_static")
    assert profile.durability.name == "TRANSIENT_LOCAL"
    assert profile.reliability.name == "RELIABLE"
    assert all(profiles == [] for profiles in offered.values())


def test_clouds_hold_what_lidar_odometry_reads(
    messages: dict[str, list[Any]], stream: list[Observation]
) -> None:
    scans = [scan for obs in stream for scan in obs.scans]
    _, cloud = messages["/lidar/points"][5]
    scan = scans[5]
    hits = scan.ranges > 0.0
    table = [(field.name, field.offset, field.datatype) for field in cloud.fields]
    assert table == [
        ("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 12, 7), ("time", 16, 7),
        ("ring", 20, 4),
    ]  # fmt: skip
    points = _points(cloud)
    assert len(points) == cloud.width == hits.sum()
    xyz = np.column_stack([points["x"], points["y"], points["z"]])
    assert np.array_equal(xyz, scan.points[hits])
    assert np.array_equal(points["time"], scan.time_offsets[hits])
    assert set(points["intensity"]) == {60.0} and not points["ring"].any()
    # stamp and time add up to the moment of the pulse
    assert _stamp(cloud) == round(1e9 * scan.start_time_s)
    assert 1e-9 * _stamp(cloud) + points["time"].max() == pytest.approx(scan.end_time_s)


def test_pulses_without_return_are_no_points() -> None:
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    forward = np.array([[0.0, 0.0, 1.0]] * 4, np.float32)
    scan = LidarScan(
        start_tick=60, end_tick=120, start_time_s=0.1, end_time_s=0.2, directions=forward,
        ranges=np.array([0.0, 2.0, np.inf, 3.0], np.float32),
        time_offsets=np.array([0.01, 0.02, 0.03, 0.04], np.float32),
        intensity=np.array([0, 7, 0, 200], np.uint8),
    )  # fmt: skip
    raw = timed_cloud_message(100_000_000, "lidar_link", scan)
    cloud = store.deserialize_cdr(raw, "sensor_msgs/msg/PointCloud2")
    assert (cloud.height, cloud.width, cloud.point_step, cloud.row_step) == (1, 2, 24, 48)
    points = _points(cloud)
    assert points["z"].tolist() == [2.0, 3.0] and points["intensity"].tolist() == [7.0, 200.0]
    assert points["time"].tolist() == scan.time_offsets[[1, 3]].tolist()


def test_imu_tells_its_noise_and_no_orientation(messages: dict[str, list[Any]]) -> None:
    _, message = messages["/imu/data_raw"][7]
    assert message.header.frame_id == "imu_link"
    assert message.orientation_covariance[0] == -1.0
    # 200 samples a second: density squared times 200
    assert message.angular_velocity_covariance[0] == pytest.approx(2.44e-4**2 * 200.0)
    assert message.linear_acceleration_covariance[8] == pytest.approx(1.72e-3**2 * 200.0)
    assert message.linear_acceleration_covariance[1] == 0.0


def test_camera_info_by_hand(messages: dict[str, list[Any]]) -> None:
    _, info = messages["/camera/camera_info"][0]
    assert (info.width, info.height, info.distortion_model) == (424, 240, "plumb_bob")
    assert info.header.frame_id == "camera_optical_frame"
    assert info.k.tolist() == [308.0, 0.0, 211.5, 0.0, 312.0, 119.5, 0.0, 0.0, 1.0]
    assert info.p.tolist() == [308, 0, 211.5, 0, 0, 312, 119.5, 0, 0, 0, 1, 0]
    assert info.r.tolist() == np.eye(3).ravel().tolist() and info.d.tolist() == [0.0] * 5
    _, right = messages["/camera_right/camera_info"][0]
    assert right.header.frame_id == "camera_right_optical_frame"
    assert right.p[3] == pytest.approx(-308.0 * 0.05)  # 5 cm to the right
    assert right_camera_shift(synthetic_rig()) == pytest.approx(-15.4)


def test_a_distorting_lens_is_told_in_the_order_of_opencv() -> None:
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    lens = CameraIntrinsics(
        width=8, height=6, fx=4.0, fy=5.0, cx=3.5, cy=2.5,
        distortion=np.array([0.1, -0.2, 0.01, 0.02, 0.3]),
    )  # fmt: skip
    info = store.deserialize_cdr(camera_message(5, "c", lens), "sensor_msgs/msg/CameraInfo")
    assert info.d.tolist() == [0.1, -0.2, 0.01, 0.02, 0.3]


def test_mounts_by_hand(messages: dict[str, list[Any]]) -> None:
    ((_, message),) = messages["/tf_static"]
    links = _links(message)
    assert {child for _, child in links} == {
        "imu_link", "lidar_link", "camera_optical_frame", "camera_right_optical_frame", "gps_link",
        "rangefinder_link",
    }  # fmt: skip
    assert {parent for parent, _ in links} == {"base_link"}
    # A camera that looks down: half a turn about the axis between forward and right.
    (camera,) = [t for t in message.transforms if t.child_frame_id == "camera_optical_frame"]
    q, half = camera.transform.rotation, np.sqrt(0.5)
    assert [q.x, q.y, q.z, q.w] == pytest.approx([half, -half, 0.0, 0.0], abs=1e-12)
    assert _vector(camera.transform.translation).tolist() == [0.075, 0.025, -0.12]
    below = links["base_link", "camera_optical_frame"].apply(np.array([0.0, 0.0, 2.0]))
    np.testing.assert_allclose(below, [0.075, 0.025, -2.12])
    assert links["base_link", "gps_link"].translation.tolist() == [0.0, 0.0, 0.14]
    # 2 m along the beam of the rangefinder are 2 m down
    beam = links["base_link", "rangefinder_link"].apply(np.array([2.0, 0.0, 0.0]))
    np.testing.assert_allclose(beam, [-0.06, 0.0, -2.13])
    assert np.linalg.det(links["base_link", "rangefinder_link"].rotation) == pytest.approx(1.0)


def test_only_what_was_sensed_is_mounted() -> None:
    assert set(mounts(synthetic_rig(), SensorNeeds(lidar=True))) == {"imu_link", "lidar_link"}


def test_transforms_and_odometry_are_the_trajectories(
    run: Path, messages: dict[str, list[Any]]
) -> None:
    truth = SyntheticStream(synthetic_rig(), ALL, SECONDS)
    for number, (time_ns, message) in enumerate(messages["/tf"]):
        true = truth.true_pose(round(time_ns * 600 / 1e9))
        links = _links(message)
        assert set(links) == {("map", "odom"), ("odom", "base_link"), ("map", "base_link_gt")}
        _same_pose(links["map", "odom"], Pose.identity())
        _same_pose(links["odom", "base_link"], shifted(OFFSET)(true), 2e-8)
        _same_pose(links["map", "base_link_gt"], true, 2e-8)
        _, odometry = messages["/odom"][number]
        assert (odometry.header.frame_id, odometry.child_frame_id) == ("odom", "base_link")
        pose = odometry.pose.pose
        _same_pose(_pose(pose.position, pose.orientation), links["odom", "base_link"])
    _, judge = messages["/ground_truth/odom"][-1]
    assert (judge.header.frame_id, judge.child_frame_id) == ("map", "base_link_gt")


def test_speeds_are_in_the_vehicles_axes(messages: dict[str, list[Any]]) -> None:
    """The vehicle heads 0.3 rad from east, flies 0.6 ahead and 0.8 to the left, and climbs."""
    truth = SyntheticStream(synthetic_rig(), ALL, SECONDS)
    _, message = messages["/ground_truth/odom"][50]  # 1.0 s
    velocity = _vector(message.twist.twist.linear)
    span = truth.true_pose(612).translation - truth.true_pose(588).translation
    assert velocity[0] / velocity[1] == pytest.approx(0.75, rel=1e-5)
    assert np.linalg.norm(velocity) == pytest.approx(np.linalg.norm(span) / 0.04, rel=1e-6)
    assert velocity[2] == pytest.approx(span[2] / 0.04, rel=1e-6)
    np.testing.assert_allclose(_vector(message.twist.twist.angular), 0.0, atol=1e-6)


def test_a_drifting_odometry_stays_apart_from_the_map(run: Path, tmp_path: Path) -> None:
    """Where a run tells the odometry's frame from the world's, map to odom is between them."""
    drifted = tmp_path / "run"
    drifted.mkdir()
    for name in ("sensors.mcap", "truth.tum", "estimate.tum", "result.json"):
        (drifted / name).symlink_to(run / name)
    world_from_odom = Pose(rotation_from_yaw(0.2), np.array([1.0, 2.0, 3.0]))
    times, positions, quats = read_tum(run / "estimate.tum")
    writer = TumWriter(drifted / "odometry.tum")
    believed = [Pose(matrix_from_quat_wxyz(q), p) for p, q in zip(positions, quats, strict=True)]
    for time_s, pose in zip(times, believed, strict=True):
        writer.add(time_s, world_from_odom.inverse() @ pose)
    writer.close()
    done = export(drifted, "mcap", tmp_path / "b.mcap", ExportOptions(images="none"))
    assert done.notes == []
    found = _read(done.out)
    assert not any("camera" in topic for topic in found)
    for (_, message), pose in zip(found["/tf"], believed, strict=True):
        links = _links(message)
        _same_pose(links["map", "odom"], world_from_odom, 1e-7)
        _same_pose(links["map", "odom"] @ links["odom", "base_link"], pose, 1e-7)


def test_transforms_may_be_left_out(run: Path, tmp_path: Path) -> None:
    for tf, expected in (
        ("odom", {("odom", "base_link"), ("map", "base_link_gt")}),
        ("none", None),
    ):
        options = ExportOptions(images="none", tf=tf, poses="truth")
        found = _read(export(run, "mcap", tmp_path / f"{tf}.mcap", options).out)
        assert len(found["/tf_static"]) == 1
        assert (set(_links(found["/tf"][0][1])) if found["/tf"] else None) == expected
        here, true = (found[topic][9][1].pose.pose for topic in ("/odom", "/ground_truth/odom"))
        assert _vector(here.position).tolist() == _vector(true.position).tolist()


def test_raw_images_are_the_pictures(run: Path, tmp_path: Path, stream: list[Observation]) -> None:
    found = _read(export(run, "mcap", tmp_path / "raw.mcap", ExportOptions(images="raw")).out)
    image = next(image for obs in stream for image in obs.images)
    for name, rgb in (("camera", image.rgb), ("camera_right", image.right_rgb)):
        _, message = found[f"/{name}/image_raw"][0]
        assert rgb is not None
        assert (message.height, message.width, message.step) == (240, 424, 1272)
        assert message.encoding == "rgb8" and message.data.tobytes() == rgb.tobytes()


def test_compressed_images_are_the_logs_own(
    messages: dict[str, list[Any]], stream: list[Observation]
) -> None:
    import cv2

    image = next(image for obs in stream for image in obs.images)
    _, message = messages["/camera_right/image_raw/compressed"][0]
    bgr = cv2.imdecode(np.frombuffer(message.data.tobytes(), np.uint8), cv2.IMREAD_COLOR)
    assert message.format == "png" and np.array_equal(bgr[..., ::-1], image.right_rgb)


def test_fixes_are_where_the_antenna_is(
    run: Path, messages: dict[str, list[Any]], stream: list[Observation], tmp_path: Path
) -> None:
    fix = next(fix for obs in stream for fix in obs.gps)
    _, message = messages["/gps/fix"][0]
    assert message.header.frame_id == "gps_link"
    expected = LocalFrame(40.0, 116.0, 50.0).geodetic(fix.position_world)
    assert [message.latitude, message.longitude, message.altitude] == expected.tolist()
    assert message.position_covariance.tolist() == [0.25, 0, 0, 0, 0.25, 0, 0, 0, 0.5625]
    assert (message.position_covariance_type, message.status.status) == (2, 0)
    options = ExportOptions(images="none", origin=(-33.0, 151.0, 0.0))
    _, other = _read(export(run, "mcap", tmp_path / "s.mcap", options).out)["/gps/fix"][0]
    assert (round(other.latitude, 2), round(other.longitude, 2)) == (-33.0, 151.0)


def test_the_ellipsoid_by_hand() -> None:
    np.testing.assert_allclose(LocalFrame(47.5, 8.5, 432.0).geodetic(np.zeros(3)), [47.5, 8.5, 432])
    equator = LocalFrame(0.0, 0.0, 0.0)
    a, e2 = 6378137.0, 0.00669437999014
    # 1 km along the tangent: an angle of atan(1 km / a), and a little above the ground
    east = [0.0, np.degrees(np.arctan2(1000.0, a)), np.hypot(a, 1000.0) - a]
    np.testing.assert_allclose(equator.geodetic(np.array([1000.0, 0.0, 0.0])), east, atol=1e-9)
    # the meridian's radius of curvature at the equator is a (1 - e^2)
    north = equator.geodetic(np.array([0.0, 1.0, 0.0]))
    assert north[0] == pytest.approx(np.degrees(1.0 / (a * (1.0 - e2))), rel=1e-6)
    up = LocalFrame(-60.0, 179.0, 10.0).geodetic(np.array([0.0, 0.0, 25.0]))
    np.testing.assert_allclose(up, [-60.0, 179.0, 35.0], atol=1e-8)


def test_messages_are_written_as_they_come(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).bytes(1 << 20)
    path = tmp_path / "b.mcap"
    bag = RosBag(path, {"/s": "std_msgs/msg/String"})
    for second in range(12):
        bag.put("/s", second, second, noise)
    written = path.stat().st_size
    bag.close()
    assert written > 0.5 * path.stat().st_size


# -------------------------------------------------------------------------------------------- cloud


def _mean_heights(points: np.ndarray, origin: np.ndarray) -> dict[tuple[int, int], np.ndarray]:
    """Heights by cells of 0.2 m."""
    cells = np.floor((points[:, :2] - origin) / 0.2).astype(int)
    found: dict[tuple[int, int], list[float]] = defaultdict(list)
    for cell, height in zip(map(tuple, cells.tolist()), points[:, 2].tolist(), strict=True):
        found[cell].append(height)
    return {cell: np.array(heights) for cell, heights in found.items()}


def _read_ply(path: Path) -> Any:
    head, _, body = path.read_bytes().partition(b"end_header\n")
    kinds = {"float": "<f4", "uchar": "u1"}
    words = [line.split() for line in head.decode().splitlines()]
    dtype = np.dtype([(w[2], kinds[w[1]]) for w in words if w[0] == "property"])
    rows = np.frombuffer(body, dtype)
    assert [int(w[2]) for w in words if w[:2] == ["element", "vertex"]] == [len(rows)]
    return rows


def _xyz(rows: Any) -> np.ndarray:
    return np.column_stack([rows["x"], rows["y"], rows["z"]]).astype(np.float64)


def _placed(messages: dict[str, list[Any]], body: str) -> np.ndarray:
    """Every point of every cloud in the map's frame, as a user of the transforms would do it."""
    times = np.array([time_ns for time_ns, _ in messages["/tf"]]) * 1e-9
    poses = []
    for _, message in messages["/tf"]:
        links = _links(message)
        believed = links["map", "odom"] @ links["odom", "base_link"]
        poses.append(links["map", body] if body == "base_link_gt" else believed)
    mount = _links(messages["/tf_static"][0][1])["base_link", "lidar_link"]
    placed = []
    for _, cloud in messages["/lidar/points"]:
        points = _points(cloud)
        at = 1e-9 * _stamp(cloud) + points["time"].astype(np.float64)
        rows = np.clip(np.searchsorted(times, at), 1, len(times) - 1)
        xyz = mount.apply(np.column_stack([points["x"], points["y"], points["z"]]).astype(float))
        for row in np.unique(rows):
            share = (at[rows == row] - times[row - 1]) / (times[row] - times[row - 1])
            # level flight: what turns is nothing, so one rotation does for the span
            rotation = interpolate_pose(poses[row - 1], poses[row], 0.5).rotation
            way = poses[row].translation - poses[row - 1].translation
            origin = poses[row - 1].translation + share[:, None] * way
            placed.append(xyz[rows == row] @ rotation.T + origin)
    return np.vstack(placed)


def test_cloud_and_transforms_reproduce_the_map(run: Path, messages: Any) -> None:
    cloud = _placed(messages, "base_link_gt")
    rows = _read_ply(run / "map.ply")
    heights = _mean_heights(cloud, np.array([4.0, -2.0]) - 20.0)
    mapped = _mean_heights(_xyz(rows), np.array([4.0, -2.0]) - 20.0)
    # the map leaves out the vehicle's own returns and the like, and has nothing of its own
    assert len(mapped) > 30 and set(mapped) <= set(heights)
    well_seen = [cell for cell in mapped if len(heights[cell]) >= 20]
    assert len(well_seen) > 30
    errors = [float(mapped[cell][0] - heights[cell].mean()) for cell in well_seen]
    assert abs(np.median(errors)) < 1e-3 and np.percentile(np.abs(errors), 90) < 5e-3


def test_the_fused_cloud_is_the_bag_seen_through_its_transforms(
    run: Path, messages: Any, tmp_path: Path
) -> None:
    for poses, body in (("truth", "base_link_gt"), ("estimate", "base_link")):
        options = ExportOptions(points="scans", poses=poses)
        rows = _read_ply(export(run, "ply", tmp_path / f"{poses}.ply", options).out)
        expected = _placed(messages, body)
        assert len(rows) == len(expected)
        # the same points, in the order of the scans
        ours = _xyz(rows)
        assert np.abs(np.sort(ours, axis=0) - np.sort(expected, axis=0)).max() < 1e-5
    assert set(rows["intensity"]) == {60.0}


def test_returns_have_the_colour_of_the_ground_under_them(run: Path, tmp_path: Path) -> None:
    """The ground is a mosaic of coloured tiles, blurred between their middles."""
    options = ExportOptions(points="scans", poses="truth")
    rows = _read_ply(export(run, "ply", tmp_path / "c.ply", options).out)[-15000:]
    grey = (rows["red"] == 120) & (rows["green"] == 120) & (rows["blue"] == 120)
    assert 0.02 < grey.mean() < 0.9  # the LIDAR sees more than the camera does
    tiles = SyntheticStream(synthetic_rig(), ALL, SECONDS)._tiles
    places = _xyz(rows)[~grey][:, :2] / 0.05
    middle = np.abs(places - np.rint(places)).max(axis=1) < 0.1
    col, row = np.rint(places[middle]).astype(int).T & 255
    seen = np.column_stack([rows[name][~grey][middle] for name in ("red", "green", "blue")])
    assert len(seen) > 30
    assert np.median(np.abs(seen - tiles[row, col])) < 12.0


def test_open3d_reads_both_clouds(run: Path, tmp_path: Path) -> None:
    open3d = pytest.importorskip("open3d")
    for points, every in (("map", 1), ("scans", 7)):
        options = ExportOptions(points=points, every=every)
        done = export(run, "ply", tmp_path / f"{points}.ply", options)
        cloud = open3d.io.read_point_cloud(str(done.out))
        rows = _read_ply(done.out)
        assert len(cloud.points) == done.counts["points"] == len(rows) > 50
        np.testing.assert_allclose(np.asarray(cloud.points), _xyz(rows))
        assert cloud.has_colors()
    own = _xyz(_read_ply(run / "map.ply"))
    np.testing.assert_array_equal(_xyz(_read_ply(tmp_path / "map.ply")), own)


def test_projection_by_hand() -> None:
    lens = CameraIntrinsics(width=100, height=80, fx=50.0, fy=40.0, cx=49.5, cy=39.5)
    points = np.array([[0.0, 0.0, 2.0], [1.0, -1.0, 2.0], [0.0, 0.0, -2.0], [3.0, 0.0, 2.0]])
    pixels, seen = project(points, lens)
    np.testing.assert_allclose(pixels[:2], [[49.5, 39.5], [74.5, 19.5]])
    assert seen.tolist() == [True, True, False, False]


# ------------------------------------------------------------------------------------------- tables


def test_trajectories_are_copied_whole_or_judged(run: Path, tmp_path: Path) -> None:
    whole = export(run, "tum", tmp_path / "t.tum", ExportOptions(poses="truth")).out
    assert whole.read_bytes() == (run / "truth.tum").read_bytes()
    judged = export(run, "tum", tmp_path / "e.tum", ExportOptions(judged=True)).out
    times, positions, _ = read_tum(judged)
    all_times, all_positions, _ = read_tum(run / "estimate.tum")
    keep = all_times >= LIFT_OFF_S
    assert np.array_equal(times, all_times[keep])
    assert np.array_equal(positions, all_positions[keep])


def test_evo_measures_what_the_table_says(run: Path, tmp_path: Path) -> None:
    pytest.importorskip("evo")
    pandas = pytest.importorskip("pandas")
    from evo.core import metrics, sync
    from evo.tools import file_interface

    read = [
        file_interface.read_tum_trajectory_file(
            str(export(run, "tum", tmp_path / f"{p}.tum", ExportOptions(poses=p, judged=True)).out)
        )
        for p in ("truth", "estimate")
    ]
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data(sync.associate_trajectories(*read))
    out = export(run, "csv", tmp_path / "t.csv", ExportOptions(judged=True)).out
    mean = pandas.read_csv(out).error_m.mean()
    assert mean == pytest.approx(0.5, abs=1e-8)
    assert ape.get_statistic(metrics.StatisticsType.mean) == pytest.approx(mean, abs=1e-8)


def test_the_table_by_hand(run: Path, tmp_path: Path) -> None:
    pandas = pytest.importorskip("pandas")
    table = pandas.read_csv(export(run, "csv", tmp_path / "t.csv", ExportOptions()).out)
    times, positions, quats = read_tum(run / "truth.tum")
    assert np.array_equal(table.time_s, times)
    assert np.array_equal(table[["truth_x_m", "truth_y_m", "truth_z_m"]], positions)
    assert np.allclose(table[[f"truth_q{axis}" for axis in "wxyz"]], quats, atol=1e-9)
    assert np.allclose(table.truth_yaw_deg, np.degrees(0.3), atol=1e-6)
    assert np.allclose(table[["error_x_m", "error_y_m", "error_z_m"]], OFFSET, atol=2e-9)
    assert np.allclose(table.error_yaw_deg, 0.0, atol=1e-6)
    assert table.judged.dtype == bool
    assert np.array_equal(table.judged, times >= LIFT_OFF_S)
    assert np.array_equal(table.phase, np.where(times < 0.7, "INIT", "TAKEOFF"))
    assert table.reference_x_m.isna().all() and table.deviation_m.isna().all()


def test_phases_are_noted_as_they_change() -> None:
    log = PhaseLog()
    for step, phase in enumerate(["INIT", "INIT", "TAKEOFF", "SURVEY", "SURVEY"]):
        log.add(0.5 * step, phase)
    assert log.kept == [
        {"time_s": 0.0, "phase": "INIT"},
        {"time_s": 1.0, "phase": "TAKEOFF"},
        {"time_s": 1.5, "phase": "SURVEY"},
    ]


def test_rows_meet_by_time_and_gaps_stay_empty(run: Path, tmp_path: Path) -> None:
    """As of a replay that was broken off, and of a run of an earlier version."""
    pandas = pytest.importorskip("pandas")
    short = tmp_path / "short"
    short.mkdir()
    (short / "truth.tum").write_bytes((run / "truth.tum").read_bytes())
    (short / "result.json").write_text(json.dumps({"replay_of": str(run)}))
    rows = (run / "estimate.tum").read_text().splitlines(keepends=True)
    (short / "estimate.tum").write_text("".join(rows[5:20]))
    (short / "reference.tum").write_bytes((run / "truth.tum").read_bytes())
    table = pandas.read_csv(export(short, "csv", tmp_path / "t.csv", ExportOptions()).out)
    known = table.estimate_x_m.notna()
    assert known.tolist() == [5 <= number < 20 for number in range(len(table))]
    assert np.allclose(table.error_m[known], 0.5) and table.error_m[~known].isna().all()
    assert np.allclose(table.deviation_m, 0.0) and table.phase.isna().all()
    # and its bag holds the sensors of the flight, with the trajectory of the replay
    found = _read(export(short, "mcap", tmp_path / "b.mcap", ExportOptions(images="none")).out)
    assert len(found["/odom"]) == 15 and len(found["/ground_truth/odom"]) == len(table)
    assert len(found["/tf"]) == len(table) and len(found["/lidar/points"]) > 5


# ------------------------------------------------------------------------------------- command line


def _cli(capsys: pytest.CaptureFixture[str], *arguments: Any) -> tuple[int, str, str]:
    code = cli.main([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def test_the_command_prints_what_it_wrote(
    run: Path, bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "new" / "b.mcap"
    code, printed, _ = _cli(capsys, "export", run, "--format", "mcap", "--out", out, "--json")
    told = json.loads(printed)
    assert code == 0 and told["file"] == str(out) and told["bytes"] == out.stat().st_size
    assert told["counts"]["/lidar/points"] == 23 and told["counts"]["/tf_static"] == 1
    rig = synthetic_rig()
    pose = rig.body_from_imu.inverse() @ rig.body_from_lidar
    assert told["imu_from_lidar"]["rotation_row_major"] == pose.rotation.ravel().tolist()
    assert out.read_bytes() == bag.read_bytes()  # equal runs, equal files
    code, printed, _ = _cli(capsys, "export", run, "--format", "tum", "--out", tmp_path / "e.tum")
    assert code == 0 and printed.splitlines()[-1].startswith(f"written: {tmp_path / 'e.tum'}")


def test_by_default_beside_the_run_and_again(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for _ in range(2):  # an earlier export is replaced
        for kind, name in (
            ("tum", "flown-estimate.tum"),
            ("csv", "flown.csv"),
            ("ply", "flown.ply"),
        ):
            assert _cli(capsys, "export", run, "--format", kind)[0] == 0
            assert (run.parent / name).is_file()
    names = {path.name for path in run.parent.iterdir()}
    assert names == {"flown", "flown-estimate.tum", "flown.csv", "flown.ply"}


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["nowhere", "--format", "csv"], "no run directory"),
        (["{run}", "--format", "bag"], "bag"),
        (["{run}"], "--format"),
        (["{run}", "--format", "csv", "--tf", "odom"], "--tf is for --format mcap, not csv"),
        (["{run}", "--format", "mcap", "--judged"], "--judged is for --format tum or csv"),
        (["{run}", "--format", "ply", "--every", "0"], "--every"),
        (["{run}", "--format", "ply", "--every", "3"], "--points scans"),
        (["{run}", "--format", "ply", "--poses", "truth"], "--points scans"),
        (["{run}", "--format", "csv", "--poses", "truth"], "all trajectories"),
        (["{run}", "--format", "mcap", "--poses", "reference"], "reference"),
        (["{run}", "--format", "tum", "--poses", "reference"], "no reference.tum"),
        (["{run}", "--format", "mcap", "--origin", "here"], "LAT,LON,HEIGHT"),
        (["{run}", "--format", "mcap", "--origin", "91,0,0"], "no place on Earth"),
        (["{run}", "--format", "mcap", "--origin", "nan,0,0"], "no place on Earth"),
        (["{blind}", "--format", "mcap"], "--log-sensors"),
        (["{blind}", "--format", "ply", "--points", "scans"], "--log-sensors"),
        (["{blind}", "--format", "ply"], "no map.ply"),
        (["{run}", "--format", "csv", "--out", "{tmp}"], "is a directory"),
        (["{run}", "--format", "csv", "--out", "{tmp}/note.txt"], "no earlier export"),
        (["{run}", "--format", "tum", "--out", "{tmp}/note.tum"], "no earlier export"),
        (["{run}", "--format", "mcap", "--out", "{run}/sensors.mcap"], "file of the run itself"),
        (["{run}", "--format", "csv", "--out", "{tmp}/note.txt/x.csv"], "cannot be written"),
        (["{broken}", "--format", "csv"], "no trajectory"),
        (["{broken}", "--format", "mcap"], "no trajectory"),
        (["{cut}", "--format", "mcap"], "no complete MCAP"),
        (["{broken}", "--format", "ply"], "no map"),
    ],
)  # fmt: skip
def test_bad_input_is_one_line_and_leaves_nothing(
    run: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    says: str,
) -> None:
    (tmp_path / "note.txt").write_text("mine")
    (tmp_path / "note.tum").write_text("a line of exactly eight words is no trajectory")
    blind, broken, cut = (tmp_path / name for name in ("blind", "broken", "cut"))
    for folder in (blind, broken, cut):
        folder.mkdir()
        (folder / "result.json").write_text("{}")
        (folder / "truth.tum").write_text("0 0 0 0 0 0 0 1\n")
        (folder / "estimate.tum").write_text("0 0 0 0 0 0 0 1\n")
    (broken / "truth.tum").write_text("0 0 0 0 0 0 0 1\n1 2 3\n")
    for folder in (broken, cut):
        (folder / "sensors.mcap").write_bytes((run / "sensors.mcap").read_bytes()[:300_000])
    (broken / "map.ply").write_text("ply\n")
    before = sorted(path for path in tmp_path.rglob("*"))
    names = {"run": run, "blind": blind, "broken": broken, "cut": cut, "tmp": tmp_path}
    code, printed, errors = _cli(capsys, "export", *[a.format(**names) for a in arguments])
    assert code == 2 and printed == ""
    assert errors.count("\n") == 1 and says in errors
    assert sorted(path for path in tmp_path.rglob("*")) == before
    assert (tmp_path / "note.txt").read_text() == "mine"


def test_a_log_is_read_without_unpacking_its_pictures(run: Path, stream: list[Observation]) -> None:
    from experiments.sensor_log_reader import unpack_image

    for (obs, images), expected in zip(
        SensorLogReader(run / "sensors.mcap").packed(), stream, strict=True
    ):
        assert (obs.tick, len(obs.scans), obs.images) == (expected.tick, len(expected.scans), ())
        assert [image.tick for image in images] == [image.tick for image in expected.images]
        for image, other in zip(images, expected.images, strict=True):
            assert np.array_equal(unpack_image(image.png), other.rgb)
