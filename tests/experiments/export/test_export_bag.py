"""Bags hold the data of the run, and external readers decode them."""

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import Reader

from touchdown.experiments.export.flown_run import ExportOptions, GeodeticPoint
from touchdown.experiments.export.ros2_bag import geodetic, mounts
from touchdown.experiments.export.run import export
from touchdown.experiments.external.synthetic_stream import SyntheticStream, synthetic_rig
from touchdown.experiments.io import ros2_messages as ros
from touchdown.experiments.io.sensor_log_reader import SensorLogReader
from touchdown.experiments.io.tum import TumWriter, read_tum
from touchdown.sim.api import CameraIntrinsics, Observation, SensorNeeds
from touchdown.sim.frames import Pose, matrix_from_quat_wxyz, rotation_from_yaw

from support.export_support import (
    ALL,
    OFFSET,
    SECONDS,
    links_of,
    points_of,
    pose_of,
    read_bag,
    stamp_of,
    vector,
)
from support.messages import make_scan
from support.replay_support import shifted


@pytest.fixture(scope="module")
def stream(run: Path) -> list[Observation]:
    """The observations of the run."""
    return list(SensorLogReader(run / "sensors.mcap"))


def _ns(tick: int) -> int:
    return round(tick * 10**9 / 600)


def _same_pose(one: Pose, other: Pose, tolerance: float = 1e-8) -> None:
    np.testing.assert_allclose(one.matrix(), other.matrix(), rtol=0.0, atol=tolerance)


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
        images = [image.tick for obs in stream for image in obs.images]
        measured[f"/{name}/image_raw/compressed"] = measured[f"/{name}/camera_info"] = images
    for topic, ticks in measured.items():
        assert len(ticks) > 3, topic
        assert [stamp_of(message) for _, message in messages[topic]] == list(map(_ns, ticks)), topic
    times, _, _ = read_tum(run / "truth.tum")
    rows = [round(1e9 * time_s) for time_s in times]
    for topic in ("/odom", "/ground_truth/odom"):
        assert [stamp_of(message) for _, message in messages[topic]] == rows
    assert [time_ns for time_ns, _ in messages["/tf"]] == rows
    assert set(messages) == {
        *measured, "/odom", "/ground_truth/odom", "/rotors", "/tf", "/tf_static"
    }  # fmt: skip
    speeds = [obs.rotor_speed_radps.tolist() for obs in stream]
    assert [message.velocity.tolist() for _, message in messages["/rotors"]] == speeds


def test_messages_are_logged_as_they_arrived(bag: Path, stream: list[Observation]) -> None:
    """The order of the file is the order of playback."""
    with Reader(bag) as reader:
        records = [(connection.topic, time_ns) for connection, time_ns, _ in reader.messages()]
    times = [time_ns for _, time_ns in records]
    assert times == sorted(times)
    arrivals = [_ns(obs.tick) for obs in stream for _ in obs.scans]
    assert [time_ns for topic, time_ns in records if topic == "/lidar/points"] == arrivals


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
    points = points_of(cloud)
    assert len(points) == cloud.width == hits.sum()
    xyz = np.column_stack([points["x"], points["y"], points["z"]])
    assert np.array_equal(xyz, scan.points[hits])
    assert np.array_equal(points["time"], scan.time_offsets[hits])
    assert set(points["intensity"]) == {60.0} and not points["ring"].any()
    # stamp and time add up to the moment of the pulse
    assert stamp_of(cloud) == round(1e9 * scan.start_time_s)
    assert 1e-9 * stamp_of(cloud) + points["time"].max() == pytest.approx(scan.end_time_s)


def test_imu_states_its_noise_and_no_orientation(messages: dict[str, list[Any]]) -> None:
    _, message = messages["/imu/data_raw"][7]
    assert message.header.frame_id == "imu_link" and message.orientation_covariance[0] == -1.0
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
    assert ros.right_camera_shift(synthetic_rig()) == pytest.approx(-15.4)


def test_mounts_by_hand(messages: dict[str, list[Any]]) -> None:
    ((_, message),) = messages["/tf_static"]
    links = links_of(message)
    assert {child for _, child in links} == {
        "imu_link", "lidar_link", "camera_optical_frame", "camera_right_optical_frame", "gps_link",
        "rangefinder_link",
    }  # fmt: skip
    assert {parent for parent, _ in links} == {"base_link"}
    # A camera that looks down: half a turn about the axis between forward and right.
    (camera,) = [t for t in message.transforms if t.child_frame_id == "camera_optical_frame"]
    q, half = camera.transform.rotation, np.sqrt(0.5)
    assert [q.x, q.y, q.z, q.w] == pytest.approx([half, -half, 0.0, 0.0], abs=1e-12)
    assert vector(camera.transform.translation).tolist() == [0.075, 0.025, -0.12]
    below = links["base_link", "camera_optical_frame"].apply(np.array([0.0, 0.0, 2.0]))
    np.testing.assert_allclose(below, [0.075, 0.025, -2.12])
    assert links["base_link", "gps_link"].translation.tolist() == [0.0, 0.0, 0.14]
    # 2 m along the beam of the rangefinder are 2 m down
    beam = links["base_link", "rangefinder_link"].apply(np.array([2.0, 0.0, 0.0]))
    np.testing.assert_allclose(beam, [-0.06, 0.0, -2.13])
    assert np.linalg.det(links["base_link", "rangefinder_link"].rotation) == pytest.approx(1.0)


def test_transforms_and_odometry_are_the_trajectories(
    run: Path, messages: dict[str, list[Any]]
) -> None:
    truth = SyntheticStream(synthetic_rig(), ALL, SECONDS)
    for number, (time_ns, message) in enumerate(messages["/tf"]):
        true = truth.true_pose(round(time_ns * 600 / 1e9))
        links = links_of(message)
        assert set(links) == {("map", "odom"), ("odom", "base_link"), ("map", "base_link_gt")}
        _same_pose(links["map", "odom"], Pose.identity())
        _same_pose(links["odom", "base_link"], shifted(OFFSET)(true), 2e-8)
        _same_pose(links["map", "base_link_gt"], true, 2e-8)
        _, odometry = messages["/odom"][number]
        assert (odometry.header.frame_id, odometry.child_frame_id) == ("odom", "base_link")
        pose = odometry.pose.pose
        _same_pose(pose_of(pose.position, pose.orientation), links["odom", "base_link"])
    _, judge = messages["/ground_truth/odom"][-1]
    assert (judge.header.frame_id, judge.child_frame_id) == ("map", "base_link_gt")


def test_speeds_are_in_the_vehicles_axes(messages: dict[str, list[Any]]) -> None:
    """The vehicle heads 0.3 rad from east, flies 0.6 ahead and 0.8 to the left, and climbs."""
    truth = SyntheticStream(synthetic_rig(), ALL, SECONDS)
    _, message = messages["/ground_truth/odom"][50]  # 1.0 s
    velocity = vector(message.twist.twist.linear)
    span = truth.true_pose(612).translation - truth.true_pose(588).translation
    assert velocity[0] / velocity[1] == pytest.approx(0.75, rel=1e-5)
    assert np.linalg.norm(velocity) == pytest.approx(np.linalg.norm(span) / 0.04, rel=1e-6)
    assert velocity[2] == pytest.approx(span[2] / 0.04, rel=1e-6)
    np.testing.assert_allclose(vector(message.twist.twist.angular), 0.0, atol=1e-6)


def test_a_drifting_odometry_stays_apart_from_the_map(run: Path, tmp_path: Path) -> None:
    """If a run records separate odometry, map to odom is the difference."""
    drifted = tmp_path / "run"
    drifted.mkdir()
    for name in ("sensors.mcap", "truth.tum", "estimate.tum", "result.json"):
        (drifted / name).symlink_to(run / name)
    world_from_odom = Pose(rotation_from_yaw(0.2), np.array([1.0, 2.0, 3.0]))
    times, positions, quats = read_tum(run / "estimate.tum")
    writer = TumWriter(drifted / "odometry.tum")
    estimated = [Pose(matrix_from_quat_wxyz(q), p) for p, q in zip(positions, quats, strict=True)]
    for time_s, pose in zip(times, estimated, strict=True):
        writer.add(time_s, world_from_odom.inverse() @ pose)
    writer.close()
    done = export(drifted, "mcap", tmp_path / "bag", ExportOptions(images="none"))
    assert done.notes == []
    found = read_bag(done.out)
    assert not any("camera" in topic for topic in found)
    for (_, message), pose in zip(found["/tf"], estimated, strict=True):
        links = links_of(message)
        _same_pose(links["map", "odom"], world_from_odom, 1e-7)
        _same_pose(links["map", "odom"] @ links["odom", "base_link"], pose, 1e-7)


def test_raw_images_are_those_of_the_log(
    run: Path, tmp_path: Path, stream: list[Observation]
) -> None:
    found = read_bag(export(run, "mcap", tmp_path / "raw", ExportOptions(images="raw")).out)
    image = next(image for obs in stream for image in obs.images)
    for name, rgb in (("camera", image.rgb), ("camera_right", image.right_rgb)):
        _, message = found[f"/{name}/image_raw"][0]
        assert rgb is not None and (message.height, message.width, message.step) == (240, 424, 1272)
        assert message.encoding == "rgb8" and message.data.tobytes() == rgb.tobytes()


def test_fixes_are_where_the_antenna_is(
    run: Path, messages: dict[str, list[Any]], stream: list[Observation], tmp_path: Path
) -> None:
    fix = next(fix for obs in stream for fix in obs.gps)
    _, message = messages["/gps/fix"][0]
    assert message.header.frame_id == "gps_link"
    expected = geodetic(GeodeticPoint(40.0, 116.0, 50.0), fix.position_world)
    assert [message.latitude, message.longitude, message.altitude] == expected.tolist()
    assert message.position_covariance.tolist() == [0.25, 0, 0, 0, 0.25, 0, 0, 0, 0.5625]
    assert (message.position_covariance_type, message.status.status) == (2, 0)
    options = ExportOptions(images="none", origin=GeodeticPoint(-33.0, 151.0, 0.0))
    _, other = read_bag(export(run, "mcap", tmp_path / "south", options).out)["/gps/fix"][0]
    assert (round(other.latitude, 2), round(other.longitude, 2)) == (-33.0, 151.0)


def test_the_reader_of_mcap_decodes_every_message(bag: Path, messages: Any) -> None:
    decoder = pytest.importorskip("mcap_ros2.decoder")
    reader = pytest.importorskip("mcap.reader")
    counts: dict[str, int] = defaultdict(int)
    with (bag / "flown-bag.mcap").open("rb") as file:
        opened = reader.make_reader(file, decoder_factories=[decoder.DecoderFactory()])
        assert opened.get_header().profile == "ros2"
        for schema, channel, _message, decoded in opened.iter_decoded_messages():
            assert (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr")
            assert decoded is not None
            counts[channel.topic] += 1
    assert counts == {topic: len(found) for topic, found in messages.items()}


def test_pulses_without_return_are_no_points() -> None:
    forward = np.array([[0.0, 0.0, 1.0]] * 4, np.float32)
    offsets, levels = [0.01, 0.02, 0.03, 0.04], [0, 7, 0, 200]
    scan = make_scan(120, forward, [0.0, 2.0, np.inf, 3.0], offsets, levels)
    cloud = again(ros.cloud_message(100_000_000, "lidar_link", scan, ros.VELODYNE_POINT))
    assert (cloud.height, cloud.width, cloud.point_step, cloud.row_step) == (1, 2, 24, 48)
    points = points_of(cloud)
    assert points["z"].tolist() == [2.0, 3.0] and points["intensity"].tolist() == [7.0, 200.0]
    assert points["time"].tolist() == scan.time_offsets[[1, 3]].tolist()


def test_distortion_is_in_the_order_of_opencv() -> None:
    lens = CameraIntrinsics(
        width=8, height=6, fx=4.0, fy=5.0, cx=3.5, cy=2.5,
        distortion=np.array([0.1, -0.2, 0.01, 0.02, 0.3]),
    )  # fmt: skip
    info = again(ros.camera_message(5, "c", lens))
    assert info.d.tolist() == [0.1, -0.2, 0.01, 0.02, 0.3]


def test_only_sensors_in_use_are_mounted() -> None:
    assert set(mounts(synthetic_rig(), SensorNeeds(lidar=True))) == {"imu_link", "lidar_link"}


def test_the_ellipsoid_by_hand() -> None:
    """The meridian's radius of curvature at the equator is a (1 - e^2)."""
    north = geodetic(GeodeticPoint(0.0, 0.0, 0.0), np.array([0.0, 1.0, 0.0]))
    radius_m = 6378137.0 * (1.0 - 0.00669437999014)
    assert north[0] == pytest.approx(np.degrees(1.0 / radius_m), rel=1e-6)
    up = geodetic(GeodeticPoint(-60.0, 179.0, 10.0), np.array([0.0, 0.0, 25.0]))
    np.testing.assert_allclose(up, [-60.0, 179.0, 35.0], atol=1e-8)


def again(message: Any) -> Any:
    """Returns the message as a reader decodes it."""
    return ros.deserialized(bytes(ros.serialized(message)), message.__msgtype__)
