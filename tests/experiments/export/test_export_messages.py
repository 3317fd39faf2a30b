"""Messages of bags one by one: their definitions, fields by hand, places on Earth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from touchdown.experiments.export.ros2_bag import mounts
from touchdown.experiments.external.synthetic_stream import synthetic_rig
from touchdown.experiments.io.geodesy import LocalFrame
from touchdown.experiments.io.ros2_bag import RosBag
from touchdown.experiments.io.ros2_conversions import timed_cloud_message
from touchdown.experiments.io.ros2_messages import camera_message
from touchdown.sim.api import CameraIntrinsics, LidarScan, SensorNeeds

from support.export_support import points_of


def test_definitions_are_those_of_current_ros() -> None:
    """A bag is of no use to a node whose messages look otherwise."""
    typesys = pytest.importorskip("rosbags.typesys")
    from touchdown.experiments.export.ros2_bag import _TYPES
    from touchdown.experiments.io import ros2_messages as ros

    for version in (typesys.Stores.ROS2_HUMBLE, typesys.Stores.ROS2_JAZZY):
        store = typesys.get_typestore(version)
        for name in set(_TYPES.values()):
            ours = typesys.get_types_from_msg(ros.definition(name), name)[name][1]
            assert ours == store.fielddefs[name][1], name


def test_definitions_name_the_codes_of_fields() -> None:
    """Some readers tell float32 from uint16 by the constants of the definition."""
    typesys = pytest.importorskip("rosbags.typesys")
    from touchdown.experiments.io import ros2_messages as ros

    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    for outer, inner in (
        ("PointCloud2", "PointField"), ("NavSatFix", "NavSatStatus"), ("NavSatFix", "NavSatFix"),
    ):  # fmt: skip
        name = f"sensor_msgs/msg/{outer}"
        ours = typesys.get_types_from_msg(ros.definition(name), name)
        codes, _ = ours[f"sensor_msgs/msg/{inner}"]
        assert codes and codes == store.fielddefs[f"sensor_msgs/msg/{inner}"][0]


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
    points = points_of(cloud)
    assert points["z"].tolist() == [2.0, 3.0] and points["intensity"].tolist() == [7.0, 200.0]
    assert points["time"].tolist() == scan.time_offsets[[1, 3]].tolist()


def test_a_distorting_lens_is_told_in_the_order_of_opencv() -> None:
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    lens = CameraIntrinsics(
        width=8, height=6, fx=4.0, fy=5.0, cx=3.5, cy=2.5,
        distortion=np.array([0.1, -0.2, 0.01, 0.02, 0.3]),
    )  # fmt: skip
    info = store.deserialize_cdr(camera_message(5, "c", lens), "sensor_msgs/msg/CameraInfo")
    assert info.d.tolist() == [0.1, -0.2, 0.01, 0.02, 0.3]


def test_only_what_was_sensed_is_mounted() -> None:
    assert set(mounts(synthetic_rig(), SensorNeeds(lidar=True))) == {"imu_link", "lidar_link"}


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
