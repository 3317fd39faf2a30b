"""The few ROS 2 messages in which sensor logs are readable to other tools: definitions and CDR.

Written by hand because the layouts are few and fixed, and a log should need no ROS to be written.
The encoding is the plain little-endian CDR of OMG's DDS-XTypes: members in order, each aligned to
its size, counted from after the four bytes of the encapsulation header.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.sim.api import CameraIntrinsics, ImuSample, LidarScan, SensorRig
from touchdown.sim.frames import Pose, quat_wxyz_from_matrix

Array = NDArray[np.float64]

_PARTS = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec\n",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "std_msgs/MultiArrayDimension": "string label\nuint32 size\nuint32 stride\n",
    "std_msgs/MultiArrayLayout": "std_msgs/MultiArrayDimension[] dim\nuint32 data_offset\n",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
    "geometry_msgs/Transform": (
        "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n"
    ),
    "geometry_msgs/TransformStamped": (
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n"
    ),
    "geometry_msgs/Pose": ("geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n"),
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance\n",
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n",
    "geometry_msgs/TwistWithCovariance": "geometry_msgs/Twist twist\nfloat64[36] covariance\n",
    "sensor_msgs/NavSatStatus": (
        "int8 STATUS_NO_FIX=-1\nint8 STATUS_FIX=0\nint8 STATUS_SBAS_FIX=1\n"
        "int8 STATUS_GBAS_FIX=2\nuint16 SERVICE_GPS=1\nuint16 SERVICE_GLONASS=2\n"
        "uint16 SERVICE_COMPASS=4\nuint16 SERVICE_GALILEO=8\nint8 status\nuint16 service\n"
    ),
    "sensor_msgs/PointField": (
        "uint8 INT8=1\nuint8 UINT8=2\nuint8 INT16=3\nuint8 UINT16=4\nuint8 INT32=5\n"
        "uint8 UINT32=6\nuint8 FLOAT32=7\nuint8 FLOAT64=8\n"
        "string name\nuint32 offset\nuint8 datatype\nuint32 count\n"
    ),
    "sensor_msgs/RegionOfInterest": (
        "uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify\n"
    ),
}
_MESSAGES = {
    "std_msgs/msg/String": "string data\n",
    "std_msgs/msg/UInt8MultiArray": "std_msgs/MultiArrayLayout layout\nuint8[] data\n",
    "sensor_msgs/msg/CompressedImage": "std_msgs/Header header\nstring format\nuint8[] data\n",
    "sensor_msgs/msg/Imu": (
        "std_msgs/Header header\n"
        "geometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\n"
        "geometry_msgs/Vector3 angular_velocity\nfloat64[9] angular_velocity_covariance\n"
        "geometry_msgs/Vector3 linear_acceleration\nfloat64[9] linear_acceleration_covariance\n"
    ),
    "sensor_msgs/msg/PointCloud2": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nsensor_msgs/PointField[] fields\n"
        "bool is_bigendian\nuint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense\n"
    ),
    "sensor_msgs/msg/FluidPressure": (
        "std_msgs/Header header\nfloat64 fluid_pressure\nfloat64 variance\n"
    ),
    "sensor_msgs/msg/MagneticField": (
        "std_msgs/Header header\ngeometry_msgs/Vector3 magnetic_field\n"
        "float64[9] magnetic_field_covariance\n"
    ),
    "geometry_msgs/msg/PointStamped": "std_msgs/Header header\ngeometry_msgs/Point point\n",
    "sensor_msgs/msg/CameraInfo": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\n"
        "float64[] d\nfloat64[9] k\nfloat64[9] r\nfloat64[12] p\nuint32 binning_x\n"
        "uint32 binning_y\nsensor_msgs/RegionOfInterest roi\n"
    ),
    "nav_msgs/msg/Odometry": (
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n"
        "geometry_msgs/TwistWithCovariance twist\n"
    ),
    "sensor_msgs/msg/Image": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\n"
        "uint8 is_bigendian\nuint32 step\nuint8[] data\n"
    ),
    "sensor_msgs/msg/NavSatFix": (
        "uint8 COVARIANCE_TYPE_UNKNOWN=0\nuint8 COVARIANCE_TYPE_APPROXIMATED=1\n"
        "uint8 COVARIANCE_TYPE_DIAGONAL_KNOWN=2\nuint8 COVARIANCE_TYPE_KNOWN=3\n"
        "std_msgs/Header header\nsensor_msgs/NavSatStatus status\nfloat64 latitude\n"
        "float64 longitude\nfloat64 altitude\nfloat64[9] position_covariance\n"
        "uint8 position_covariance_type\n"
    ),
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms\n",
}

_POINT = np.dtype(
    [("xyz", "<f4", (3,)), ("time", "<f4"), ("intensity", "u1")]  # 17 bytes, packed
)
_POINT_FIELDS = (("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("time", 12, 7), ("intensity", 16, 2))
"""name, byte offset, PointField's number of the type (7: float32, 2: uint8)"""
_UNKNOWN = np.zeros(9)
_DIAGONAL = np.eye(3).ravel()


def definition(message: str) -> str:
    """The text of a message type and of all types in it, as bags store it. KeyError: unknown."""
    text = _MESSAGES[message]
    waiting, done = _members(text), set()
    parts = [text]
    while waiting:
        name = waiting.pop(0)
        if name not in done:
            done.add(name)
            parts.append(f"MSG: {name}\n{_PARTS[name]}")
            waiting += _members(_PARTS[name])
    return f"{'=' * 80}\n".join(parts)


def _members(text: str) -> list[str]:
    kinds = [line.split()[0].partition("[")[0] for line in text.splitlines()]
    return [kind for kind in kinds if "/" in kind]


class Cdr:
    """Collects the members of one message."""

    def __init__(self) -> None:
        self._data = bytearray(b"\x00\x01\x00\x00")

    def add(self, form: str, *values: float) -> Cdr:
        """Values of one kind: a letter of `struct`."""
        size = struct.calcsize(form)
        self._data += bytes(-(len(self._data) - 4) % size)
        self._data += struct.pack(f"<{len(values)}{form}", *values)
        return self

    def floats(self, values: Array) -> Cdr:
        """A fixed-size array of float64."""
        self._data += bytes(-(len(self._data) - 4) % 8)
        self._data += np.ascontiguousarray(values, dtype="<f8").tobytes()
        return self

    def text(self, value: str) -> Cdr:
        raw = value.encode() + b"\x00"
        self.add("I", len(raw))
        self._data += raw
        return self

    def blob(self, value: bytes | memoryview) -> Cdr:
        """A sequence of uint8."""
        self.add("I", len(value))
        self._data += value
        return self

    def header(self, time_ns: int, frame: str) -> Cdr:
        return self.add("i", time_ns // 10**9).add("I", time_ns % 10**9).text(frame)

    def pose(self, pose: Pose) -> Cdr:
        """Translation, then rotation as x, y, z, w."""
        w, x, y, z = quat_wxyz_from_matrix(pose.rotation)
        return self.floats(pose.translation).floats(np.array([x, y, z, w]))

    def done(self) -> bytes:
        return bytes(self._data)


def text_message(text: str) -> bytes:
    """``std_msgs/msg/String``"""
    return Cdr().text(text).done()


def text_of(message: bytes) -> str:
    """What `text_message` packed."""
    (length,) = struct.unpack_from("<I", message, 4)
    return message[8 : 8 + length - 1].decode()


def bytes_message(data: bytes) -> bytes:
    """``std_msgs/msg/UInt8MultiArray`` without dimensions."""
    return Cdr().add("I", 0, 0).blob(data).done()


def bytes_of(message: bytes) -> memoryview:
    """What `bytes_message` packed."""
    return memoryview(message)[16:]


def image_message(time_ns: int, frame: str, png: bytes | memoryview) -> bytes:
    """``sensor_msgs/msg/CompressedImage``"""
    return Cdr().header(time_ns, frame).text("png").blob(png).done()


def image_data(message: bytes) -> memoryview:
    """The file in a message of `image_message`."""
    at = 12
    for _ in range(2):  # frame and format
        (length,) = struct.unpack_from("<I", message, at)
        at += 4 + length
        at += -(at - 4) % 4
    return memoryview(message)[at + 4 :]


def imu_message(
    time_ns: int,
    frame: str,
    sample: ImuSample,
    rate_variance: float = 0.0,
    force_variance: float = 0.0,
) -> bytes:
    """``sensor_msgs/msg/Imu``; no orientation, which the standard marks by a covariance of -1."""
    no_orientation = _UNKNOWN.copy()
    no_orientation[0] = -1.0
    body = Cdr().header(time_ns, frame).floats(np.array([0.0, 0.0, 0.0, 1.0]))
    body.floats(no_orientation).floats(sample.angular_velocity).floats(rate_variance * _DIAGONAL)
    return body.floats(sample.specific_force).floats(force_variance * _DIAGONAL).done()


def cloud_message(
    time_ns: int,
    frame: str,
    scan: LidarScan,
    point: np.dtype[Any] = _POINT,
    fields: tuple[tuple[str, int, int], ...] = _POINT_FIELDS,
) -> bytes:
    """``sensor_msgs/msg/PointCloud2`` of the pulses that came back: x, y, z (m), time (s after the
    stamp), intensity. Fields of another layout than ``_POINT`` that a scan has not are 0."""
    came_back = (scan.ranges > 0.0) & np.isfinite(scan.ranges)
    points = np.zeros(int(came_back.sum()), dtype=point)
    points["xyz"] = scan.directions[came_back] * scan.ranges[came_back, None]
    points["time"] = scan.time_offsets[came_back]
    points["intensity"] = scan.intensity[came_back]
    body = Cdr().header(time_ns, frame).add("I", 1, len(points)).add("I", len(fields))
    for name, offset, kind in fields:
        body.text(name).add("I", offset).add("B", kind).add("I", 1)
    body.add("B", 0).add("I", point.itemsize, points.nbytes).blob(points.tobytes())
    return body.add("B", 1).done()


def pressure_message(time_ns: int, frame: str, pascal: float) -> bytes:
    """``sensor_msgs/msg/FluidPressure``"""
    return Cdr().header(time_ns, frame).add("d", pascal, 0.0).done()


def field_message(time_ns: int, frame: str, microtesla: Array) -> bytes:
    """``sensor_msgs/msg/MagneticField``, whose unit is the tesla."""
    return Cdr().header(time_ns, frame).floats(1e-6 * microtesla).floats(_UNKNOWN).done()


def point_message(time_ns: int, frame: str, point: Array) -> bytes:
    """``geometry_msgs/msg/PointStamped``"""
    return Cdr().header(time_ns, frame).floats(point).done()


def camera_message(time_ns: int, frame: str, camera: CameraIntrinsics, shift: float = 0.0) -> bytes:
    """``sensor_msgs/msg/CameraInfo``; ``shift`` is P[0, 3] of the right camera of a pair."""
    k = camera.matrix()
    p = np.column_stack([k, [shift, 0.0, 0.0]])
    body = Cdr().header(time_ns, frame).add("I", camera.height, camera.width).text("plumb_bob")
    body.add("I", len(camera.distortion)).floats(camera.distortion)
    return body.floats(k).floats(np.eye(3)).floats(p).add("I", 0, 0, 0, 0, 0, 0).add("B", 0).done()


def mounts_message(time_ns: int, body: str, mounts: dict[str, Pose]) -> bytes:
    """``tf2_msgs/msg/TFMessage`` of ``body_from_sensor`` by the sensor's frame."""
    return transforms_message(time_ns, [(body, frame, pose) for frame, pose in mounts.items()])


def transforms_message(time_ns: int, links: Sequence[tuple[str, str, Pose]]) -> bytes:
    """``tf2_msgs/msg/TFMessage`` of (parent, child, ``parent_from_child``)."""
    message = Cdr().add("I", len(links))
    for parent, child, pose in links:
        message.header(time_ns, parent).text(child).pose(pose)
    return message.done()


def right_camera_shift(rig: SensorRig) -> float:
    """P[0, 3] of the right camera of the pair: -fx times the baseline, pixels times metres."""
    offset = (rig.body_from_camera.inverse() @ rig.body_from_camera_right).translation
    return -float(rig.camera.fx * offset[0])
