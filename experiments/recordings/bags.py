"""Bags of ROS 1 and ROS 2 (SQLite, MCAP), read by `rosbags` without ROS."""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from touchdown.experiments.errors import UsageError
from touchdown.experiments.recordings.clock import poses_of
from touchdown.experiments.recordings.contract import (
    ALL,
    ImuTable,
    Lens,
    PoseTable,
    RawFrame,
    RawImage,
    RawScan,
    Recording,
    RigParts,
    RotorTable,
    Span,
)
from touchdown.experiments.recordings.pictures import decoded
from touchdown.experiments.recordings.point_clouds import scan_of_cloud, scan_of_livox
from touchdown.experiments.recordings.rig_files import intrinsics_of, pose_of, read_yaml, whole_rig
from touchdown.sim.api import SensorRig
from touchdown.sim.files.child import limited_memory
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Bytes

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

RIG_KEY = "rig"
"""key of a bag's own data under which our exports keep the rig"""
_LIVOX = ("livox_ros_driver/msg/CustomMsg", "livox_ros_driver2/msg/CustomMsg")
_PARTS = (".mcap", ".db3")
_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_TYPES = {
    "imu": ("sensor_msgs/msg/Imu",),
    "lidar": ("sensor_msgs/msg/PointCloud2", *_LIVOX),
    "camera": _IMAGES,
    "camera_right": _IMAGES,
    "truth": (
        "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped",
        "geometry_msgs/msg/PoseWithCovarianceStamped", "geometry_msgs/msg/TransformStamped",
    ),
    "rotors": ("sensor_msgs/msg/JointState",),
}  # fmt: skip
_RIGHT, _TRUE = ("right", "cam1", "camera1", "cam_1"), ("truth", "/gt", "vicon", "leica")
_MEMORY = 4 << 30
"""bytes that a process may take beyond what it has while a bag is read: chunks say how large they
are, and decompressors do not ask"""
_FIXED = ("map", "odom", "world", "earth")
"""frames that are no part of a rig"""
_BAYER = {
    "bayer_rggb8": cv2.COLOR_BayerRGGB2RGB, "bayer_bggr8": cv2.COLOR_BayerBGGR2RGB,
    "bayer_gbrg8": cv2.COLOR_BayerGBRG2RGB, "bayer_grbg8": cv2.COLOR_BayerGRBG2RGB,
}  # fmt: skip
_CHANNELS = {"mono8": 1, "8UC1": 1, "rgb8": 3, "bgr8": 3, "8UC3": 3, "rgba8": 4, "bgra8": 4,
             **dict.fromkeys(_BAYER, 1)}  # fmt: skip


class RosBag(Recording):
    """A ``.bag`` file, or a folder with ``metadata.yaml``. The body is the root of the static
    transforms above the IMU, or the IMU."""

    @limited_memory(_MEMORY)
    def __init__(self, path: Path, given: RigParts) -> None:
        """``path``: also a file of the folder. ``given``: what a rig file says; its ``topics``
        choose where a bag has several."""
        self.path = path.parent if path.suffix in _PARTS else path
        with self._opened() as reader:
            by_topic = {one.topic: one.msgtype for one in reader.connections}
            self._topics = self._chosen(by_topic, given.topics)
            infos, links = self._statics(reader, by_topic)
            frames = {name: self._frame(reader, topic) for name, topic in self._topics.items()}
        whole = self._own_rig()
        self.found = self._rig(infos, links, frames) if whole is None else RigParts(whole=whole)

    @staticmethod
    def holds(path: Path) -> bool:
        """True if ``path`` looks like one."""
        folder = path.parent if path.suffix in _PARTS else path
        return path.suffix == ".bag" or (folder / "metadata.yaml").is_file()

    @contextmanager
    def _opened(self) -> Iterator[AnyReader]:
        """The bag; whatever is wrong in it becomes one line."""
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore

        try:
            store = get_typestore(Stores.ROS2_HUMBLE)
            with AnyReader([self.path], default_typestore=store) as reader:
                yield reader
        except (UsageError, GeneratorExit, KeyboardInterrupt):
            raise
        except MemoryError as error:
            raise UsageError(
                f"'{self.path}' takes more than {_MEMORY >> 30} GiB to read: give a part of it"
            ) from error
        except Exception as error:  # of rosbags, of SQLite, of decompressors
            why = " ".join(str(error).split())[:160] or type(error).__name__
            raise UsageError(f"'{self.path}' is damaged or no bag: {why}") from error

    def _messages(self, *names: str) -> Iterator[tuple[str, int, Any, Callable[[], Any]]]:
        """Name, time in the bag, type and reader of each message of the topics of ``names`` that
        there are."""
        wanted = {self._topics[name]: name for name in names if name in self._topics}
        if not wanted:
            return
        with self._opened() as reader:
            chosen = [one for one in reader.connections if one.topic in wanted]
            for connection, at_ns, raw in reader.messages(chosen):
                read = functools.partial(reader.deserialize, raw, connection.msgtype)
                yield wanted[connection.topic], at_ns, connection.msgtype, read

    def _chosen(self, by_topic: dict[str, str], given: dict[str, str]) -> dict[str, str]:
        """Topic of each kind: the one given, or the only one."""
        found = {}
        for name, types in _TYPES.items():
            if name in given:
                topic = given[name]
                if topic not in by_topic or by_topic[topic] not in types:
                    what = by_topic.get(topic, "not in it")
                    raise UsageError(f"'{self.path}': topic {topic} for {name} is {what}")
                found[name] = topic
                continue
            those = sorted(t for t, kind in by_topic.items() if kind in types)
            those = _likely(name, [t for t in those if t not in given.values()])
            if len(those) > 1:
                raise UsageError(
                    f"'{self.path}' has several topics for {name}: {', '.join(those[:4])}; choose "
                    f"one in the table topics of --rig"
                )
            found |= {name: those[0]} if those else {}
        return found

    def _frame(self, reader: AnyReader, topic: str) -> str:
        """The frame of the first message of a topic."""
        chosen = [one for one in reader.connections if one.topic == topic]
        for connection, _, raw in reader.messages(chosen):
            message: Any = reader.deserialize(raw, connection.msgtype)
            return str(getattr(message, "child_frame_id", "") or message.header.frame_id)
        return ""

    # ------------------------------------------------------------------------ the rig

    def _statics(
        self, reader: AnyReader, by_topic: dict[str, str]
    ) -> tuple[dict[str, Any], dict[str, tuple[str, Pose]]]:
        """The first ``CameraInfo`` of each frame, and parent and pose of each static frame."""
        infos: dict[str, Any] = {}
        links: dict[str, tuple[str, Pose]] = {}
        cameras = {t for t, kind in by_topic.items() if kind == "sensor_msgs/msg/CameraInfo"}
        for topic in [*cameras, *(t for t in by_topic if t.endswith("tf_static"))]:
            chosen = [one for one in reader.connections if one.topic == topic]
            for connection, _, raw in reader.messages(chosen):
                message: Any = reader.deserialize(raw, connection.msgtype)
                if topic in cameras:
                    infos[message.header.frame_id] = message
                    break
                for one in message.transforms:
                    t, q = one.transform.translation, one.transform.rotation
                    numbers = [t.x, t.y, t.z, q.x, q.y, q.z, q.w]
                    parent = one.header.frame_id.strip("/")
                    if parent not in _FIXED:
                        pose = pose_of(numbers, "a static transform")
                        links[one.child_frame_id.strip("/")] = parent, pose
        return infos, links

    def _own_rig(self) -> SensorRig | None:
        """The rig in a bag of ours; None in one of others."""
        if not self.path.is_dir():
            return None
        try:
            told = read_yaml(self.path / "metadata.yaml")["rosbag2_bagfile_information"]
            text = (told.get("custom_data") or {}).get(RIG_KEY)
            return None if text is None else whole_rig(json.loads(text))
        except (ValueError, TypeError, LookupError, AttributeError, OSError) as error:
            raise UsageError(f"'{self.path}': its metadata.yaml is damaged") from error

    def _rig(
        self, infos: dict[str, Any], links: dict[str, tuple[str, Pose]], frames: dict[str, str]
    ) -> RigParts:
        def mount(name: str) -> Pose | None:
            """root_from_frame of a topic's frame; None where no transform tells it."""
            frame, pose = frames.get(name, "").strip("/"), Pose.identity()
            if frame not in links:
                return Pose.identity() if name == "imu" else None
            for _ in range(len(links)):
                if frame not in links:
                    break
                frame, step = links[frame]
                pose = step @ pose
            return pose

        def lens(name: str) -> Lens | None:
            info, pose = infos.get(frames.get(name, "")), mount(name)
            if info is None or pose is None:
                return None
            k = np.asarray(info.k if hasattr(info, "k") else info.K).reshape(3, 3)
            d = np.asarray(info.d if hasattr(info, "d") else info.D)  # ROS 1 has capitals
            try:
                camera = intrinsics_of(
                    info.distortion_model or "none", [info.width, info.height],
                    [k[0, 0], k[1, 1], k[0, 2], k[1, 2]], d.tolist(), name,
                )  # fmt: skip
            except ValueError:
                return None
            return Lens(intrinsics=camera, body_from_camera=pose)

        return RigParts(
            camera=lens("camera"), right=lens("camera_right"),
            body_from_imu=mount("imu") or Pose.identity(), body_from_lidar=mount("lidar"),
        )  # fmt: skip

    # ------------------------------------------------------------------------ messages

    @limited_memory(_MEMORY)
    def imu(self) -> ImuTable | None:
        """The samples, in the order of their stamps, each once."""
        rows = []
        for *_, read in self._messages("imu"):
            m = read()
            w, a = m.angular_velocity, m.linear_acceleration
            rows.append((_stamp(m), w.x, w.y, w.z, a.x, a.y, a.z))
        if not rows:
            return None
        stamps, order = np.unique(np.array([row[0] for row in rows], np.int64), return_index=True)
        values = np.array([row[1:] for row in rows])[order]
        if not np.isfinite(values).all():
            raise UsageError(f"'{self.path}': the IMU has samples that are no numbers")
        return ImuTable(stamps_ns=stamps, gyro=values[:, :3], force=values[:, 3:])

    @limited_memory(_MEMORY)
    def truth(self) -> PoseTable | None:
        """The poses of the topic of the truth."""
        rows = []
        for *_, read in self._messages("truth"):
            m = read()
            pose = getattr(m, "pose", None) or m.transform
            pose = getattr(pose, "pose", pose)
            p = getattr(pose, "position", None) or pose.translation
            q = getattr(pose, "orientation", None) or pose.rotation
            rows.append((_stamp(m), p.x, p.y, p.z, q.w, q.x, q.y, q.z))
        values = np.array([row[1:] for row in rows]).reshape(-1, 7)
        good = np.isfinite(values).all(axis=1) & (np.linalg.norm(values[:, 3:], axis=1) > 0.5)
        if good.sum() < 2:
            return None
        stamps = np.array([row[0] for row in rows], np.int64)
        return poses_of(stamps[good], values[good, :3], values[good, 3:])

    @limited_memory(_MEMORY)
    def rotors(self) -> RotorTable | None:
        """The velocities of the joints, which our exports write."""
        rows = [(_stamp(m), np.array(m.velocity)) for m in
                (read() for *_, read in self._messages("rotors"))]  # fmt: skip
        if not rows or len({len(speeds) for _, speeds in rows}) != 1:
            return None
        stamps = np.array([stamp for stamp, _ in rows], np.int64)
        return RotorTable(stamps_ns=stamps, speeds=np.array([speeds for _, speeds in rows]))

    def frames(self, span: Span = ALL) -> Iterator[RawFrame]:
        """Scans and images in the order of the bag; a message that contradicts itself ends it."""
        found = self._frames(span)
        while True:
            with limited_memory(_MEMORY):
                frame = next(found, None)
            if frame is None:
                return
            yield frame

    def _frames(self, span: Span) -> Iterator[RawFrame]:
        ours = self.found.whole is not None  # the time of arrival; others' is that of writing
        for name, at_ns, kind, read in self._messages("lidar", "camera", "camera_right"):
            message = read()
            arrives = at_ns if ours else None
            stamp = _stamp(message)
            if not span.holds(stamp):
                continue
            if name == "lidar":
                scan = self._scan(message, kind, stamp)
                yield dataclasses.replace(scan, arrives_ns=arrives)
            else:
                of = functools.partial(_picture, message, kind)
                right = name == "camera_right"
                yield RawImage(stamp_ns=stamp, right=right, read=of, arrives_ns=arrives)

    def _scan(self, message: Any, kind: str, stamp: int) -> RawScan:
        try:
            return (scan_of_livox if kind in _LIVOX else scan_of_cloud)(message, stamp)
        except ValueError as error:
            raise UsageError(f"'{self.path}': {error} (at {stamp * 1e-9:.3f} s)") from error


def _likely(name: str, topics: Collection[str]) -> list[str]:
    """Those of ``topics`` whose names fit what they are wanted for."""
    if name in ("camera", "camera_right"):
        right = [t for t in topics if any(word in t.lower() for word in _RIGHT)]
        return right if name == "camera_right" else [t for t in topics if t not in right]
    if name == "truth":
        return [t for t in topics if any(word in t.lower() for word in _TRUE)]
    return list(topics)


def _stamp(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def _picture(message: Any, kind: str) -> Bytes:
    if kind.endswith("CompressedImage"):
        return decoded(np.asarray(message.data, np.uint8).tobytes())
    coding, height, width = message.encoding, int(message.height), int(message.width)
    channels = _CHANNELS.get(coding)
    step = int(message.step) or width * (channels or 0)
    data = np.asarray(message.data, np.uint8)
    if channels is None or not 0 < height * step == len(data) or step < width * channels:
        raise ValueError(f"an image is {coding!a} of {width} x {height}, which cannot be read")
    pixels = data.reshape(height, step)[:, : width * channels].reshape(height, width, channels)
    if coding in _BAYER:
        return np.asarray(cv2.cvtColor(np.ascontiguousarray(pixels), _BAYER[coding]), np.uint8)
    if channels == 1:
        return np.repeat(pixels, 3, axis=2)
    order = [2, 1, 0] if coding in ("bgr8", "8UC3", "bgra8") else [0, 1, 2]
    return np.ascontiguousarray(pixels[..., order])
