"""Flight as a rosbag2 folder, with the topic names of Foxglove, FAST-LIO and RTAB-Map.

Frames follow REP 103 and REP 105: ``map`` and ``odom`` east, north, up; ``base_link`` forward,
left, up; cameras optical. A header's stamp is the time of measurement in seconds of the flight (for
a scan, of its beginning). The time in the bag is that of the arrival on board, so that a player
sends all messages in the order of the flight.
"""

import json
from collections import Counter, deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pymap3d
from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from touchdown.experiments.errors import UsageError
from touchdown.experiments.export.flown_run import (
    LIBRARY,
    SAME_TIME_S,
    Exported,
    ExportOptions,
    FlownRun,
    GeodeticPoint,
)
from touchdown.experiments.export.tables import velocities
from touchdown.experiments.io import ros2_messages as ros
from touchdown.experiments.io.dataclass_json import to_plain
from touchdown.experiments.io.ros2_messages import Link
from touchdown.experiments.io.sensor_log_reader import PackedImage, SensorLogReader, unpack_image
from touchdown.experiments.io.tum import Trajectory
from touchdown.sim.api import GpsFix, Observation, RangefinderSample, SensorNeeds, SensorRig
from touchdown.sim.files.opening import no_file
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array

MAP, ODOM, BODY, TRUE_BODY = "map", "odom", "base_link", "base_link_gt"
IMU, LIDAR, GPS, RANGEFINDER = "imu_link", "lidar_link", "gps_link", "rangefinder_link"
CAMERAS = ("camera_optical_frame", "camera_right_optical_frame")
SITE_DEG = (40.0, 116.0)
"""latitude and longitude of the world's origin by default: where the simulated magnetic field is"""

_CAMERA_TOPICS = ("/camera", "/camera_right")
_STATIC = "/tf_static"
_FOREVER = QosTime(9223372036, 854775807)
_LATCHED = Qos(
    history=QosHistory.KEEP_LAST,
    depth=1,
    reliability=QosReliability.RELIABLE,
    durability=QosDurability.TRANSIENT_LOCAL,
    deadline=_FOREVER,
    lifespan=_FOREVER,
    liveliness=QosLiveliness.AUTOMATIC,
    liveliness_lease_duration=_FOREVER,
    avoid_ros_namespace_conventions=False,
)
"""of static transforms: a player offers the last message to nodes that start late"""
WRITTEN_BY, RIG = "written_by", "rig"
"""keys of the bag's metadata: its writer, and the rig as `touchdown replay` reads it"""
_BEAM_DOWN = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
"""body_from_rangefinder: x, along the beam, points down"""


class Bag(Writer):
    """A rosbag2 folder with MCAP storage, complete when the context ends without an error.

    Memory does not grow with the number of messages but for the file's index. Version 8 of the
    metadata is the newest that ROS 2 Humble reads.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__(folder, version=8, storage_plugin=StoragePlugin.MCAP)
        self.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        self.set_custom_data(WRITTEN_BY, LIBRARY)
        self._by_topic: dict[str, Connection] = {}
        self.messages: Counter[str] = Counter()
        """messages so far, by topic"""

    def put(self, topic: str, time_ns: int, message: Any) -> None:
        """Appends a message of `ros2_messages`. All messages of a topic have one type."""
        if topic not in self._by_topic:
            self._by_topic[topic] = self.add_connection(
                topic,
                message.__msgtype__,
                typestore=ros.typestore(),
                offered_qos_profiles=[_LATCHED] if topic == _STATIC else [],
            )
        self.write(self._by_topic[topic], time_ns, ros.serialized(message))
        self.messages[topic] += 1


def write_bag(flown: FlownRun, folder: Path, options: ExportOptions) -> Exported:
    """Writes all sensor messages of the run, its trajectories as odometry, and the transforms, to
    the new ``folder``."""
    log = SensorLogReader(flown.sensors())
    try:
        bag = _fill(log, flown, folder, options)
    except ValueError as error:
        raise error if isinstance(error, UsageError) else UsageError(str(error)) from error
    done = Exported(folder, dict(sorted(bag.messages.items())))
    done.facts["imu_from_lidar"] = _plain(log.rig.body_from_imu.inverse() @ log.rig.body_from_lidar)
    if not (flown.path / "odometry.tum").is_file():
        done.notes.append("the run has no odometry.tum: odom and map are the same frame here")
    return done


def _fill(log: SensorLogReader, flown: FlownRun, folder: Path, options: ExportOptions) -> Bag:
    with Bag(folder) as bag:
        bag.set_custom_data(RIG, json.dumps(to_plain(log.rig)))
        sensors = _Sensors(bag, log.rig, log.sensed, options)
        rows = _trajectories(flown, options, bag)
        waiting = next(rows, np.inf)
        for obs, images in log.packed():
            sensors.add(obs, images)
            while waiting <= obs.time_s + SAME_TIME_S:
                waiting = next(rows, np.inf)
        deque(rows, maxlen=0)  # writes those that are left
    return bag


def _plain(pose: Pose) -> dict[str, list[float]]:
    return {
        "translation_m": pose.translation.tolist(),
        "rotation_row_major": pose.rotation.ravel().tolist(),
    }


class _Sensors:
    """Writes sensor messages to the bag; the mounts are the first message."""

    def __init__(
        self, bag: Bag, rig: SensorRig, sensed: SensorNeeds, options: ExportOptions
    ) -> None:
        self._bag = bag
        self._rig = rig
        self._images = options.images
        self._origin = options.origin or GeodeticPoint(
            *SITE_DEG, rig.nav.barometer.site_elevation_m
        )
        hz = rig.tick_hz / rig.imu_ticks
        variances = rig.imu.gyro_density**2 * hz, rig.imu.accel_density**2 * hz
        self._channels: dict[str, tuple[str, Callable[[int, Any], Any]]] = {
            "imu": ("/imu/data_raw", lambda ns, one: ros.imu_message(ns, IMU, one, *variances)),
            "gps": ("/gps/fix", self._fix),
            "barometer": (
                "/imu/pressure", lambda ns, one: ros.pressure_message(ns, BODY, one.pressure_pa)
            ),
            "magnetometer": (
                "/imu/mag", lambda ns, one: ros.magnetic_field_message(ns, BODY, one.field_body_ut)
            ),
            "rangefinder": ("/rangefinder/point", _echo_message),
        }  # fmt: skip
        self._shifts = (0.0, ros.right_camera_shift(rig))
        links = [Link(BODY, frame, pose) for frame, pose in mounts(rig, sensed).items()]
        bag.put(_STATIC, 0, ros.transforms_message(0, links))

    def add(self, obs: Observation, images: tuple[PackedImage, ...]) -> None:
        """Writes one observation, with its images as they were logged."""
        arrival_ns = self._ns(obs.tick)
        for scan in obs.scans:
            start_ns = ros.stamp_ns(scan.start_tick, scan.start_time_s, self._rig.tick_hz)
            message = ros.cloud_message(start_ns, LIDAR, scan, ros.VELODYNE_POINT)
            self._bag.put("/lidar/points", arrival_ns, message)
        for image in images if self._images != "none" else ():
            self._add_image(arrival_ns, image)
        self._bag.put("/rotors", arrival_ns, ros.rotors_message(arrival_ns, obs.rotor_speed_radps))
        for name, (topic, message_of) in self._channels.items():
            for one in getattr(obs, name):
                if (message := message_of(self._ns(one.tick), one)) is not None:
                    self._bag.put(topic, arrival_ns, message)

    def _add_image(self, arrival_ns: int, image: PackedImage) -> None:
        stamp = ros.stamp_ns(image.tick, image.time_s, self._rig.tick_hz)
        for number, png in enumerate(image.pngs):
            topic, frame = _CAMERA_TOPICS[number], CAMERAS[number]
            info = ros.camera_message(stamp, frame, self._rig.camera, self._shifts[number])
            self._bag.put(f"{topic}/camera_info", arrival_ns, info)
            if self._images == "raw":
                message = ros.raw_image_message(stamp, frame, unpack_image(png))
                self._bag.put(f"{topic}/image_raw", arrival_ns, message)
            else:
                message = ros.compressed_image_message(stamp, frame, png)
                self._bag.put(f"{topic}/image_raw/compressed", arrival_ns, message)

    def _fix(self, stamp: int, fix: GpsFix) -> Any:
        return ros.fix_message(stamp, GPS, geodetic(self._origin, fix.position_world), fix)

    def _ns(self, tick: int) -> int:
        return ros.tick_ns(tick, self._rig.tick_hz)


def _echo_message(stamp: int, echo: RangefinderSample) -> Any:
    """The point that the beam meets; None without an echo."""
    at = np.array([echo.range_m, 0.0, 0.0])
    return ros.point_message(stamp, RANGEFINDER, at) if echo.range_m > 0.0 else None


def geodetic(origin: GeodeticPoint, local: Array) -> Array:
    """(3,) latitude, longitude (degrees) and height (m) on WGS 84 of ``local``, (3,) metres east,
    north and up of ``origin``."""
    return np.array(pymap3d.enu2geodetic(*local.tolist(), *origin))


def mounts(rig: SensorRig, sensed: SensorNeeds) -> dict[str, Pose]:
    """``body_from_sensor`` of the sensors in use, by frame."""
    level = np.eye(3)
    nav = rig.nav
    table = (
        (True, IMU, rig.body_from_imu),
        (sensed.lidar, LIDAR, rig.body_from_lidar),
        (sensed.camera_hz > 0, CAMERAS[0], rig.body_from_camera),
        (sensed.camera_hz > 0 and sensed.stereo, CAMERAS[1], rig.body_from_camera_right),
        (sensed.gps, GPS, Pose(level, np.array(nav.gps.antenna_body_m))),
        (
            sensed.rangefinder,
            RANGEFINDER,
            Pose(_BEAM_DOWN, np.array(nav.rangefinder.position_body_m)),
        ),
    )
    return {frame: pose for wanted, frame, pose in table if wanted}


def _trajectories(flown: FlownRun, options: ExportOptions, bag: Bag) -> Iterator[float]:
    """Writes true and estimated odometry and the moving transforms to the bag, row by row. Yields
    the time of each row before it is written."""
    chosen = Trajectory(flown.file(f"{options.poses}.tum"))
    truth = Trajectory(flown.file("truth.tum"))
    drifting = options.poses == "estimate" and not no_file(flown.path / "odometry.tum")
    local = _local_poses(flown, chosen) if drifting else chosen.poses
    odometry = _Odometry(ODOM, BODY, chosen.times_s, local)
    judge = _Odometry(MAP, TRUE_BODY, truth.times_s, truth.poses)
    map_from_odom = {
        time_s: Link(MAP, ODOM, pose @ link.inverse())
        for time_s, pose, link in zip(chosen.times_s, chosen.poses, local, strict=True)
    }
    for time_s in np.union1d(chosen.times_s, truth.times_s).tolist():
        yield time_s
        stamp, links = round(1e9 * time_s), []
        if time_s in map_from_odom:
            links += [map_from_odom[time_s]] if options.tf == "all" else []
            links.append(odometry.put(bag, "/odom", time_s))
        if time_s in judge.rows:
            links.append(judge.put(bag, "/ground_truth/odom", time_s))
        if options.tf != "none":
            bag.put("/tf", stamp, ros.transforms_message(stamp, links))


def _local_poses(flown: FlownRun, chosen: Trajectory) -> list[Pose]:
    """Poses in the odometry frame at the times of a trajectory, where the run records them; its
    own where it does not."""
    odometry = Trajectory(flown.path / "odometry.tum")
    poses, own = odometry.poses, chosen.poses
    near = np.searchsorted(odometry.times_s, chosen.times_s - SAME_TIME_S)
    near = np.minimum(near, len(poses) - 1)
    known = np.abs(odometry.times_s[near] - chosen.times_s) <= SAME_TIME_S
    return [poses[near[k]] if known[k] else own[k] for k in range(len(own))]


class _Odometry:
    """Poses of a child frame as odometry, with the velocity between their neighbours."""

    def __init__(self, parent: str, child: str, times_s: Array, poses: list[Pose]) -> None:
        self._links = [Link(parent, child, pose) for pose in poses]
        self._velocity, self._rate = velocities(times_s, poses)
        self.rows = {time_s: row for row, time_s in enumerate(times_s.tolist())}
        """number of the pose by its time"""

    def put(self, bag: Bag, topic: str, time_s: float) -> Link:
        """Writes the message of a time and returns its transform."""
        row = self.rows[time_s]
        link = self._links[row]
        velocity = link.parent_from_child.rotation.T @ self._velocity[row]
        stamp = round(1e9 * time_s)
        bag.put(topic, stamp, ros.odometry_message(stamp, link, velocity, self._rate[row]))
        return link
