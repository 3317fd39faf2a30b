"""Sensor log: writes all observations of a flight to an MCAP file, from which it is replayed.

Each control step ends with one JSON text on ``/touchdown/observation``. It holds the small messages
with every digit, and the number of scans and images that precede it. Scans are packed on
``/touchdown/scan``, images are PNG. The same data is stored beside it as the usual ROS 2 messages
(``/lidar/points``, ``/imu``, ``/camera/image/compressed``, ...), for other tools. The log time of a
message is that of its arrival, the publish time that of its measurement.
"""

import json
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from touchdown.experiments.io import ros2_messages as ros
from touchdown.experiments.io.dataclass_json import to_plain
from touchdown.sim.api import CameraImage, LidarScan, Observation, SensorNeeds, SensorRig

FORMAT = "1"
METADATA = "touchdown"
"""name of the record that holds the rig and what was sensed"""
OBSERVATION_TOPIC = "/touchdown/observation"
SCAN_TOPIC = "/touchdown/scan"
IMAGE_TOPICS = ("/camera/image/compressed", "/camera_right/image/compressed")
BODY, IMU, LIDAR, CAMERA, CAMERA_RIGHT = "body", "imu", "lidar", "camera", "camera_right"
"""frames of the ROS messages"""

_CHUNK_BYTES = 4 << 20
_PNG = (
    (cv2.IMWRITE_PNG_COMPRESSION, 1),
    (cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY),
    (cv2.IMWRITE_PNG_FILTER, 0x40),  # the mean of the left and the upper neighbour
)
"""Sensor noise does not repeat: prediction and Huffman codes take a third of the time of a search
for repetitions, and 8 % more space."""


_CHANNELS: Mapping[str, tuple[str, Callable[[int, Any], Any]]] = {
    "imu": ("/imu", lambda ns, one: ros.imu_message(ns, IMU, one)),
    "gps": ("/gps/position", lambda ns, one: ros.point_message(ns, "world", one.position_world)),
    "barometer": ("/pressure", lambda ns, one: ros.pressure_message(ns, BODY, one.pressure_pa)),
    "magnetometer": (
        "/magnetic_field", lambda ns, one: ros.magnetic_field_message(ns, BODY, one.field_body_ut)
    ),
}  # fmt: skip
"""Topic of each kind of small message of an observation, and its ROS message at a stamp (ns)."""


class SensorLog:
    """Appends observations to ``path``; complete after ``close``. Memory does not grow with the
    flight but for the file's index (a kilobyte a second).

    ``rig``: the nominal calibration. ``sensed``: all data that was requested from the simulation;
    ``shared``: the part that components other than the estimator requested.
    """

    def __init__(
        self, path: Path, rig: SensorRig, sensed: SensorNeeds, shared: SensorNeeds | None = None
    ) -> None:
        self._tick_hz = rig.tick_hz
        self._file = path.open("wb")
        # By `mcap`, not `rosbags`: it stores the time of measurement beside that of arrival, and a
        # record ahead of all messages. Checksums cost more than packing.
        self._writer = Writer(
            self._file, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD, enable_crcs=False
        )
        self._writer.start(profile="ros2", library="touchdown")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._counts: Counter[str] = Counter()
        self._writer.add_metadata(
            METADATA,
            {
                "format": FORMAT,
                "rig": json.dumps(to_plain(rig)),
                "sensed": json.dumps(to_plain(sensed)),
                "shared": json.dumps(to_plain(shared or SensorNeeds())),
            },
        )
        self._write_rig(rig, sensed)

    def add(self, obs: Observation) -> None:
        """Appends one observation."""
        for scan in obs.scans:
            self._put(SCAN_TOPIC, obs.tick, scan.end_tick, ros.bytes_message(pack_scan(scan)))
            start_ns = self._ns(scan.start_tick)
            message = ros.cloud_message(start_ns, LIDAR, scan)
            self._put("/lidar/points", obs.tick, scan.start_tick, message)
        for image in obs.images:
            self._add_image(obs.tick, image)
        for name, (topic, message_of) in _CHANNELS.items():
            for one in getattr(obs, name):
                self._put(topic, obs.tick, one.tick, message_of(self._ns(one.tick), one))
        text = json.dumps(plain_observation(obs), separators=(",", ":"))
        self._put(OBSERVATION_TOPIC, obs.tick, obs.tick, ros.text_message(text))

    def close(self) -> None:
        """Writes the index and closes the file."""
        try:
            self._writer.finish()
        finally:
            self._file.close()

    def _add_image(self, arrival: int, image: CameraImage) -> None:
        eyes = (image.rgb, image.right_rgb)
        for topic, frame, rgb in zip(IMAGE_TOPICS, (CAMERA, CAMERA_RIGHT), eyes, strict=True):
            if rgb is not None:
                stamp = ros.stamp_ns(image.tick, image.time_s, self._tick_hz)
                png = pack_image(rgb)
                message = ros.compressed_image_message(stamp, frame, png)
                self._put(topic, arrival, image.tick, message)

    def _write_rig(self, rig: SensorRig, sensed: SensorNeeds) -> None:
        mounts = (IMU, LIDAR, CAMERA, *([CAMERA_RIGHT] if sensed.stereo else []))
        links = [ros.Link(BODY, name, getattr(rig, f"body_from_{name}")) for name in mounts]
        self._put("/tf_static", 0, 0, ros.transforms_message(0, links))
        if sensed.camera_hz:
            message = ros.camera_message(0, CAMERA, rig.camera)
            self._put("/camera/camera_info", 0, 0, message)
        if sensed.camera_hz and sensed.stereo:
            shift = ros.right_camera_shift(rig)
            message = ros.camera_message(0, CAMERA_RIGHT, rig.camera, shift)
            self._put("/camera_right/camera_info", 0, 0, message)

    def _put(self, topic: str, arrival_tick: int, measured_tick: int, message: Any) -> None:
        if topic not in self._channels:
            self._channels[topic] = self._register(topic, message.__msgtype__)
        self._writer.add_message(
            self._channels[topic],
            log_time=self._ns(arrival_tick),
            data=bytes(ros.serialized(message)),
            publish_time=self._ns(measured_tick),
            sequence=self._counts[topic],
        )
        self._counts[topic] += 1

    def _register(self, topic: str, kind: str) -> int:
        if kind not in self._schemas:
            text = ros.definition(kind).encode()
            self._schemas[kind] = self._writer.register_schema(kind, "ros2msg", text)
        return self._writer.register_channel(
            topic, "cdr", self._schemas[kind], {"offered_qos_profiles": ""}
        )

    def _ns(self, tick: int) -> int:
        return ros.tick_ns(tick, self._tick_hz)


def plain_observation(obs: Observation) -> dict[str, Any]:
    """JSON values of an observation, without the arrays of scans and images."""
    plain: dict[str, Any] = {
        name: to_plain(getattr(obs, name))
        for name in type(obs).__dataclass_fields__
        if name not in ("scans", "images")
    }
    plain["scans"] = [[s.start_tick, s.end_tick, s.start_time_s, s.end_time_s] for s in obs.scans]
    plain["images"] = [[i.tick, i.time_s, i.right_rgb is not None] for i in obs.images]
    return {name: value for name, value in plain.items() if value != []}


def pack_scan(scan: LidarScan) -> bytes:
    """Arrays of a scan as planes of bytes: like bytes side by side compress twofold."""
    columns = [*scan.directions.T, scan.ranges, scan.time_offsets]
    count = np.array([len(scan.ranges)], dtype="<u4").tobytes()
    table = np.array(columns, dtype="<f4").view(np.uint8).reshape(len(columns), -1, 4)
    planes = np.ascontiguousarray(table.transpose(0, 2, 1))
    return b"".join([count, planes.tobytes(), scan.intensity.tobytes()])


def pack_image(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """PNG file, (N,) bytes, of an (H, W, 3) image."""
    options = [number for pair in _PNG for number in pair]
    done, data = cv2.imencode(".png", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), options)
    if not done:
        raise RuntimeError(f"an image of shape {rgb.shape} cannot be packed")
    return np.asarray(data, dtype=np.uint8).ravel()
