"""Single messages of bags: fields by hand, geodetic positions, atomic writing."""

from typing import Any

import numpy as np
import pytest

from touchdown.experiments.export.flown_run import GeodeticPoint
from touchdown.experiments.export.ros2_bag import geodetic, mounts
from touchdown.experiments.external.synthetic_stream import synthetic_rig
from touchdown.experiments.io import ros2_messages as ros
from touchdown.sim.api import CameraIntrinsics, LidarScan, SensorNeeds

from support.export_support import points_of


def test_pulses_without_return_are_no_points() -> None:
    forward = np.array([[0.0, 0.0, 1.0]] * 4, np.float32)
    scan = LidarScan(
        start_tick=60, end_tick=120, start_time_s=0.1, end_time_s=0.2, directions=forward,
        ranges=np.array([0.0, 2.0, np.inf, 3.0], np.float32),
        time_offsets=np.array([0.01, 0.02, 0.03, 0.04], np.float32),
        intensity=np.array([0, 7, 0, 200], np.uint8),
    )  # fmt: skip
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
