"""Conversions from the simulation's types to ROS 2 messages, through the type store of `rosbags`.

Each function returns a message object of the store; `serialized` encodes it. ``time_ns`` is the
header's stamp in nanoseconds, ``frame`` the header's frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from touchdown.sim.api import CameraIntrinsics, GpsFix, ImuSample, LidarScan, SensorRig
from touchdown.sim.frames import Pose, quat_wxyz_from_matrix
from touchdown.sim.typing import Array, Bytes

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

LOGGED_POINT = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("time", "<f4"), ("intensity", "u1")]
)
"""Fields in sensor logs: 17 bytes, packed."""
VELODYNE_POINT = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "time", "ring"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<f4", "<u2"],
        "offsets": [0, 4, 8, 12, 16, 20],
        "itemsize": 24,
    }
)
"""Fields of a Velodyne driver, which LIDAR odometry reads. ``ring`` is 0: the beams of a scanner
without rows are one row."""
_FIELD_CODES = {"u1": "UINT8", "u2": "UINT16", "f4": "FLOAT32"}
_UNKNOWN = np.zeros(9)
_UNKNOWN_36 = np.zeros(36)
_DIAGONAL = np.eye(3).ravel()


class Link(NamedTuple):
    """One transform between two frames."""

    parent: str
    child: str
    parent_from_child: Pose


@cache
def typestore() -> Typestore:
    """Message types of ROS 2 Humble, which are those of later releases for all types used here."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE)


def definition(message_type: str) -> str:
    """Text of a message type and of all types in it, as bags store it."""
    text, _ = typestore().generate_msgdef(message_type, ros_version=2)
    return text


def serialized(message: Any) -> memoryview:
    """Little-endian CDR of a message."""
    return typestore().serialize_cdr(message, message.__msgtype__)


def deserialized(data: bytes, message_type: str) -> Any:
    """Message that ``data`` encodes. Raises ``rosbags.serde.SerdeError``."""
    return typestore().deserialize_cdr(data, message_type)


def tick_ns(tick: int, tick_hz: int) -> int:
    """Nanoseconds since the start, rounded; not negative."""
    return max(0, (2 * tick * 10**9 + tick_hz) // (2 * tick_hz))


def stamp_ns(tick: int, time_s: float, tick_hz: int) -> int:
    """Nanoseconds of a stamp of ``time_s`` near ``tick``: those of the tick where it is exact."""
    return tick_ns(tick, tick_hz) if time_s == tick / tick_hz else max(0, round(1e9 * time_s))


def _make(message_type: str, *members: Any) -> Any:
    return typestore().types[message_type](*members)


def _header(time_ns: int, frame: str) -> Any:
    stamp = _make("builtin_interfaces/msg/Time", time_ns // 10**9, time_ns % 10**9)
    return _make("std_msgs/msg/Header", stamp, frame)


def _vector(values: Array, kind: str = "Vector3") -> Any:
    return _make(f"geometry_msgs/msg/{kind}", *map(float, values))


def _quaternion(rotation: Array) -> Any:
    w, x, y, z = quat_wxyz_from_matrix(rotation).tolist()
    return _make("geometry_msgs/msg/Quaternion", x, y, z, w)


def text_message(text: str) -> Any:
    """``std_msgs/msg/String``"""
    return _make("std_msgs/msg/String", text)


def bytes_message(data: bytes) -> Any:
    """``std_msgs/msg/UInt8MultiArray`` without dimensions."""
    layout = _make("std_msgs/msg/MultiArrayLayout", [], 0)
    return _make("std_msgs/msg/UInt8MultiArray", layout, np.frombuffer(data, dtype=np.uint8))


def compressed_image_message(time_ns: int, frame: str, png: Bytes) -> Any:
    """``sensor_msgs/msg/CompressedImage`` of the bytes of a PNG file."""
    return _make("sensor_msgs/msg/CompressedImage", _header(time_ns, frame), "png", png)


def raw_image_message(time_ns: int, frame: str, rgb: Bytes) -> Any:
    """``sensor_msgs/msg/Image``, rgb8, of (H, W, 3)."""
    height, width, _ = rgb.shape
    data = np.ascontiguousarray(rgb).ravel()
    return _make(
        "sensor_msgs/msg/Image", _header(time_ns, frame), height, width, "rgb8", 0, 3 * width, data
    )


def imu_message(
    time_ns: int,
    frame: str,
    sample: ImuSample,
    rate_variance: float = 0.0,
    force_variance: float = 0.0,
) -> Any:
    """``sensor_msgs/msg/Imu``; no orientation, which the standard marks by a covariance of -1."""
    no_orientation = _UNKNOWN.copy()
    no_orientation[0] = -1.0
    return _make(
        "sensor_msgs/msg/Imu",
        _header(time_ns, frame),
        _make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0),
        no_orientation,
        _vector(sample.angular_velocity),
        rate_variance * _DIAGONAL,
        _vector(sample.specific_force),
        force_variance * _DIAGONAL,
    )


def cloud_message(
    time_ns: int, frame: str, scan: LidarScan, layout: np.dtype[Any] = LOGGED_POINT
) -> Any:
    """``sensor_msgs/msg/PointCloud2`` of the pulses that came back: x, y, z (m), time (s after the
    stamp), intensity (0..255). Further fields of ``layout`` are 0."""
    came_back = (scan.ranges > 0.0) & np.isfinite(scan.ranges)
    points = np.zeros(int(came_back.sum()), dtype=layout)
    xyz = scan.directions[came_back] * scan.ranges[came_back, None]
    for column, name in enumerate("xyz"):
        points[name] = xyz[:, column]
    points["time"] = scan.time_offsets[came_back]
    points["intensity"] = scan.intensity[came_back]
    return _make(
        "sensor_msgs/msg/PointCloud2",
        _header(time_ns, frame),
        1,
        len(points),
        _point_fields(layout),
        False,
        layout.itemsize,
        points.nbytes,
        points.view(np.uint8),
        True,
    )


def _point_fields(layout: np.dtype[Any]) -> list[Any]:
    field_type: Any = typestore().types["sensor_msgs/msg/PointField"]
    members: dict[str, Any] = dict(layout.fields or {})
    return [
        field_type(name, offset, getattr(field_type, _FIELD_CODES[dtype.str[1:]]), 1)
        for name, (dtype, offset, *_) in members.items()
    ]


def rotors_message(time_ns: int, speeds: Array) -> Any:
    """``sensor_msgs/msg/JointState`` of rotors with ``speeds`` (R,) rad/s."""
    names = [f"rotor_{number}" for number in range(len(speeds))]
    blank = np.zeros(0)
    return _make(
        "sensor_msgs/msg/JointState", _header(time_ns, "base_link"), names, blank,
        np.asarray(speeds, np.float64), blank,
    )  # fmt: skip


def pressure_message(time_ns: int, frame: str, pascal: float) -> Any:
    """``sensor_msgs/msg/FluidPressure``"""
    return _make("sensor_msgs/msg/FluidPressure", _header(time_ns, frame), pascal, 0.0)


def magnetic_field_message(time_ns: int, frame: str, microtesla: Array) -> Any:
    """``sensor_msgs/msg/MagneticField``, whose unit is the tesla."""
    field = _vector(1e-6 * microtesla)
    return _make("sensor_msgs/msg/MagneticField", _header(time_ns, frame), field, _UNKNOWN)


def point_message(time_ns: int, frame: str, point: Array) -> Any:
    """``geometry_msgs/msg/PointStamped``"""
    return _make("geometry_msgs/msg/PointStamped", _header(time_ns, frame), _vector(point, "Point"))


def fix_message(time_ns: int, frame: str, geodetic_deg_m: Array, fix: GpsFix) -> Any:
    """``sensor_msgs/msg/NavSatFix`` at latitude, longitude (degrees) and height (m), with the
    receiver's own standard deviations."""
    status_type: Any = typestore().types["sensor_msgs/msg/NavSatStatus"]
    fix_type: Any = typestore().types["sensor_msgs/msg/NavSatFix"]
    return fix_type(
        _header(time_ns, frame),
        status_type(status_type.STATUS_FIX, status_type.SERVICE_GPS),
        *map(float, geodetic_deg_m),
        np.diag(np.square(fix.sigma_position_m)).ravel(),
        fix_type.COVARIANCE_TYPE_DIAGONAL_KNOWN,
    )


def camera_message(time_ns: int, frame: str, camera: CameraIntrinsics, shift: float = 0.0) -> Any:
    """``sensor_msgs/msg/CameraInfo``; ``shift`` is P[0, 3] of the right camera of a pair."""
    k = camera.matrix()
    p = np.column_stack([k, [shift, 0.0, 0.0]])
    return _make(
        "sensor_msgs/msg/CameraInfo",
        _header(time_ns, frame),
        camera.height,
        camera.width,
        "equidistant" if camera.lens == "fisheye" else "plumb_bob",
        np.asarray(camera.distortion[: 4 if camera.lens == "fisheye" else 5], dtype=np.float64),
        k.ravel(),
        np.eye(3).ravel(),
        p.ravel(),
        0,
        0,
        _make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False),
    )


def right_camera_shift(rig: SensorRig) -> float:
    """P[0, 3] of the right camera of the pair: -fx times the baseline, pixels times metres."""
    offset = (rig.body_from_camera.inverse() @ rig.body_from_camera_right).translation
    return -float(rig.camera.fx * offset[0])


def transforms_message(time_ns: int, links: Sequence[Link]) -> Any:
    """``tf2_msgs/msg/TFMessage``"""
    stamped = [
        _make(
            "geometry_msgs/msg/TransformStamped",
            _header(time_ns, link.parent),
            link.child,
            _make(
                "geometry_msgs/msg/Transform",
                _vector(link.parent_from_child.translation),
                _quaternion(link.parent_from_child.rotation),
            ),
        )
        for link in links
    ]
    return _make("tf2_msgs/msg/TFMessage", stamped)


def odometry_message(time_ns: int, link: Link, velocity: Array, rate: Array) -> Any:
    """``nav_msgs/msg/Odometry``: ``velocity`` (m/s) and ``rate`` (rad/s), both (3,), are in the
    child's axes. Covariances are 0, which means unknown."""
    pose = _make(
        "geometry_msgs/msg/Pose",
        _vector(link.parent_from_child.translation, "Point"),
        _quaternion(link.parent_from_child.rotation),
    )
    twist = _make("geometry_msgs/msg/Twist", _vector(velocity), _vector(rate))
    return _make(
        "nav_msgs/msg/Odometry",
        _header(time_ns, link.parent),
        link.child,
        _make("geometry_msgs/msg/PoseWithCovariance", pose, _UNKNOWN_36),
        _make("geometry_msgs/msg/TwistWithCovariance", twist, _UNKNOWN_36),
    )
