"""Bags as the drivers of others write them, from a log of ours."""

from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from touchdown.experiments.io.sensor_log_reader import SensorLogReader
from touchdown.experiments.io.tum import read_tum

EPOCH = 1_700_000_000
POINT = (
    "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line"
)
MESSAGE = """std_msgs/Header header
uint64 timebase
uint32 point_num
uint8 lidar_id
uint8[3] rsvd
livox_ros_driver/CustomPoint[] points"""


def _store() -> Any:
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(POINT, "livox_ros_driver/msg/CustomPoint"))
    store.register(get_types_from_msg(MESSAGE, "livox_ros_driver/msg/CustomMsg"))
    return store


def write_livox_bag(run: Path, out: Path, images: str = "bgr8") -> Path:
    """A ROS 1 bag with ``CustomMsg``, ``Imu``, ``Image`` and the true poses, on the clock of a
    computer; ``images``: their encoding."""
    store, log = _store(), SensorLogReader(run / "sensors.mcap")
    types = store.types

    def header(time_s: float) -> Any:
        ns = EPOCH * 10**9 + round(time_s * 1e9)
        stamp = types["builtin_interfaces/msg/Time"](ns // 10**9, ns % 10**9)
        return types["std_msgs/msg/Header"](0, stamp, "any")

    with Writer(out) as bag:
        topics: dict[str, Any] = {}

        def put(topic: str, time_s: float, message: Any) -> None:
            kind = message.__msgtype__
            if topic not in topics:
                topics[topic] = bag.add_connection(topic, kind, typestore=store)
            ns = EPOCH * 10**9 + round(time_s * 1e9)
            bag.write(topics[topic], ns, store.serialize_ros1(message, kind))

        quat = types["geometry_msgs/msg/Quaternion"]
        vector, blank = types["geometry_msgs/msg/Vector3"], np.zeros(9)
        for obs in log:
            for one in obs.imu:
                put("/livox/imu", obs.time_s, types["sensor_msgs/msg/Imu"](
                    header(one.time_s), quat(0.0, 0.0, 0.0, 1.0), blank,
                    vector(*one.angular_velocity.tolist()), blank,
                    vector(*one.specific_force.tolist()), blank,
                ))  # fmt: skip
            for scan in obs.scans:
                points = [
                    types["livox_ros_driver/msg/CustomPoint"](
                        round(1e9 * float(t)), *map(float, p), int(level), 0, 0
                    )
                    for t, p, level in zip(
                        scan.time_offsets, scan.points, scan.intensity, strict=True
                    )
                ]
                put("/livox/lidar", obs.time_s, types["livox_ros_driver/msg/CustomMsg"](
                    header(scan.start_time_s), 0, len(points), 0, np.zeros(3, np.uint8), points
                ))  # fmt: skip
            for image in obs.images:
                rgb = image.rgb if images == "rgb8" else image.rgb[..., ::-1]
                height, width = rgb.shape[:2]
                put("/left_camera/image", obs.time_s, types["sensor_msgs/msg/Image"](
                    header(image.time_s), height, width, images, 0, 3 * width,
                    np.ascontiguousarray(rgb).ravel(),
                ))  # fmt: skip
        times, positions, quats = read_tum(run / "truth.tum")
        for time_s, p, (w, x, y, z) in zip(times, positions, quats, strict=True):
            pose = types["geometry_msgs/msg/Pose"](
                types["geometry_msgs/msg/Point"](*map(float, p)), quat(x, y, z, w)
            )
            message = types["geometry_msgs/msg/PoseStamped"](header(time_s), pose)
            put("/ground_truth", time_s, message)
    return out
