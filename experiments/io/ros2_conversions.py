"""The ROS 2 messages of exported bags that sensor logs have no use for."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.io.ros2_messages import Cdr, cloud_message
from touchdown.sim.api import GpsFix, LidarScan
from touchdown.sim.frames import Pose

Array = NDArray[np.float64]

_POINT = np.dtype(
    {
        "names": ["xyz", "intensity", "time", "ring"],
        "formats": [("<f4", (3,)), "<f4", "<f4", "<u2"],
        "offsets": [0, 12, 16, 20],
        "itemsize": 24,
    }
)
_FIELDS = (("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 12, 7), ("time", 16, 7),
           ("ring", 20, 4))  # fmt: skip
"""name, byte offset, PointField's number of the type (7: float32, 4: uint16)"""
_STATUS_FIX, _SERVICE_GPS, _DIAGONAL_KNOWN = 0, 1, 2
_UNKNOWN_36 = np.zeros(36)


def timed_cloud_message(time_ns: int, frame: str, scan: LidarScan) -> bytes:
    """``sensor_msgs/msg/PointCloud2`` of the pulses that came back, in the fields of a Velodyne
    driver, which LIDAR odometry reads: x, y, z (m), intensity (0..255), time (s after the stamp),
    all float32, and ring, which is 0: the beams of a scanner without rows are one row."""
    return cloud_message(time_ns, frame, scan, _POINT, _FIELDS)


def raw_image_message(time_ns: int, frame: str, rgb: NDArray[np.uint8]) -> bytes:
    """``sensor_msgs/msg/Image``, rgb8."""
    height, width, _ = rgb.shape
    body = Cdr().header(time_ns, frame).add("I", height, width).text("rgb8")
    return body.add("B", 0).add("I", 3 * width).blob(np.ascontiguousarray(rgb).tobytes()).done()


def odometry_message(
    time_ns: int, frame: str, child: str, pose: Pose, velocity: Array, rate: Array
) -> bytes:
    """``nav_msgs/msg/Odometry``: ``pose`` is ``frame_from_child``; ``velocity`` (m/s) and ``rate``
    (rad/s), both (3,), are in the child's axes. Covariances are 0, which means unknown."""
    body = Cdr().header(time_ns, frame).text(child).pose(pose).floats(_UNKNOWN_36)
    return body.floats(velocity).floats(rate).floats(_UNKNOWN_36).done()


def fix_message(time_ns: int, frame: str, geodetic_deg_m: Array, fix: GpsFix) -> bytes:
    """``sensor_msgs/msg/NavSatFix`` at latitude, longitude (degrees) and height (m), with the
    receiver's own standard deviations."""
    body = Cdr().header(time_ns, frame).add("b", _STATUS_FIX).add("H", _SERVICE_GPS)
    body.floats(geodetic_deg_m).floats(np.diag(np.square(fix.sigma_position_m)).ravel())
    return body.add("B", _DIAGONAL_KNOWN).done()
