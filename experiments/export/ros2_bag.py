"""A flight as a ROS 2 bag: sensors under the names that Foxglove, FAST-LIO and RTAB-Map look for.

Frames follow REP 103 and REP 105: ``map`` and ``odom`` east, north, up; ``base_link`` forward,
left, up; cameras optical. A header's stamp is the time of measurement in seconds of the flight, of
a scan that of its beginning; the time of the log is when the message arrived on board, so that a
player plays everything in the order of the flight.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.errors import UsageError
from touchdown.experiments.export.flown_run import (
    LIBRARY,
    SAME_TIME_S,
    Exported,
    ExportOptions,
    FlownRun,
)
from touchdown.experiments.export.tables import PosesAt, with_neighbours
from touchdown.experiments.io import ros2_conversions as more
from touchdown.experiments.io import ros2_messages as ros
from touchdown.experiments.io.geodesy import LocalFrame
from touchdown.experiments.io.ros2_bag import RosBag, tick_ns
from touchdown.experiments.io.sensor_log_reader import PackedImage, SensorLogReader, unpack_image
from touchdown.experiments.io.tum import tum_rows
from touchdown.sim.api import Observation, SensorNeeds, SensorRig
from touchdown.sim.frames import Pose, so3_log

Array = NDArray[np.float64]

MAP, ODOM, BODY, TRUE_BODY = "map", "odom", "base_link", "base_link_gt"
IMU, LIDAR, GPS, RANGEFINDER = "imu_link", "lidar_link", "gps_link", "rangefinder_link"
CAMERAS = ("camera_optical_frame", "camera_right_optical_frame")
SITE_DEG = (40.0, 116.0)
"""latitude and longitude of the world's origin by default: the place of the simulated magnetic
field"""

_CAMERA_TOPICS = ("/camera", "/camera_right")
_STATIC = "/tf_static"
_TYPES = {
    "/lidar/points": "sensor_msgs/msg/PointCloud2",
    "/imu/data_raw": "sensor_msgs/msg/Imu",
    "/imu/mag": "sensor_msgs/msg/MagneticField",
    "/imu/pressure": "sensor_msgs/msg/FluidPressure",
    "/gps/fix": "sensor_msgs/msg/NavSatFix",
    "/rangefinder/point": "geometry_msgs/msg/PointStamped",
    "/odom": "nav_msgs/msg/Odometry",
    "/ground_truth/odom": "nav_msgs/msg/Odometry",
    "/tf": "tf2_msgs/msg/TFMessage",
    _STATIC: "tf2_msgs/msg/TFMessage",
    **{f"{name}/camera_info": "sensor_msgs/msg/CameraInfo" for name in _CAMERA_TOPICS},
    **{f"{name}/image_raw": "sensor_msgs/msg/Image" for name in _CAMERA_TOPICS},
    **{
        f"{name}/image_raw/compressed": "sensor_msgs/msg/CompressedImage" for name in _CAMERA_TOPICS
    },
}
_BEAM_DOWN = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
"""body_from_rangefinder: x, along the beam, points down"""


def write_bag(flown: FlownRun, path: Path, options: ExportOptions) -> Exported:
    """All that the run's sensors said, its trajectories as odometry, and the transforms. Memory
    does not grow with the flight but for the file's index."""
    log = SensorLogReader(flown.sensors())
    bag = RosBag(path, _TYPES, LIBRARY, latched=frozenset({_STATIC}))
    try:
        sensors = _Sensors(bag, log.rig, log.sensed, options)
        path_rows = _trajectories(flown, options, bag)
        waiting = next(path_rows, None)
        for obs, images in log.packed():
            sensors.add(obs, images)
            while waiting is not None and waiting <= obs.time_s + SAME_TIME_S:
                waiting = next(path_rows, None)
        while waiting is not None:
            waiting = next(path_rows, None)
    except ValueError as error:
        raise error if isinstance(error, UsageError) else UsageError(str(error)) from error
    finally:
        bag.close()
    done = Exported(path, dict(sorted(bag.counts.items())))
    done.facts["imu_from_lidar"] = _plain(log.rig.body_from_imu.inverse() @ log.rig.body_from_lidar)
    if not (flown.path / "odometry.tum").is_file():
        done.notes.append("the run does not tell odom from map: the two are the same here")
    return done


def _plain(pose: Pose) -> dict[str, list[float]]:
    return {
        "translation_m": pose.translation.tolist(),
        "rotation_row_major": pose.rotation.ravel().tolist(),
    }


# ------------------------------------------------------------------------------------------ sensors


class _Sensors:
    """Puts what arrived into the bag, and before all else the mounts."""

    def __init__(
        self, bag: RosBag, rig: SensorRig, sensed: SensorNeeds, options: ExportOptions
    ) -> None:
        self._bag = bag
        self._rig = rig
        self._images = options.images
        origin = options.origin or (*SITE_DEG, rig.nav.barometer.site_elevation_m)
        self._place = LocalFrame(*origin)
        hz = rig.tick_hz / rig.imu_ticks
        self._imu_variances = (rig.imu.gyro_density**2 * hz, rig.imu.accel_density**2 * hz)
        self._shifts = (0.0, ros.right_camera_shift(rig))
        self._put(_STATIC, 0, 0, ros.mounts_message(0, BODY, mounts(rig, sensed)))

    def add(self, obs: Observation, images: tuple[PackedImage, ...]) -> None:
        """What has arrived."""
        for scan in obs.scans:
            start = scan.start_tick
            message = more.timed_cloud_message(self._ns(start), LIDAR, scan)
            self._put("/lidar/points", obs.tick, start, message)
        for image in images if self._images != "none" else ():
            self._add_image(obs.tick, image)
        for sample in obs.imu:
            message = ros.imu_message(self._ns(sample.tick), IMU, sample, *self._imu_variances)
            self._put("/imu/data_raw", obs.tick, sample.tick, message)
        self._add_navigation(obs)

    def _add_image(self, arrival: int, image: PackedImage) -> None:
        stamp = self._ns(image.tick)
        for number, png in enumerate((image.png, image.right_png)):
            if png is None:
                continue
            topic, frame = _CAMERA_TOPICS[number], CAMERAS[number]
            info = ros.camera_message(stamp, frame, self._rig.camera, self._shifts[number])
            self._put(f"{topic}/camera_info", arrival, image.tick, info)
            if self._images == "raw":
                message = more.raw_image_message(stamp, frame, unpack_image(png))
                self._put(f"{topic}/image_raw", arrival, image.tick, message)
            else:
                message = ros.image_message(stamp, frame, png)
                self._put(f"{topic}/image_raw/compressed", arrival, image.tick, message)

    def _add_navigation(self, obs: Observation) -> None:
        for fix in obs.gps:
            place = self._place.geodetic(fix.position_world)
            message = more.fix_message(self._ns(fix.tick), GPS, place, fix)
            self._put("/gps/fix", obs.tick, fix.tick, message)
        for air in obs.barometer:
            message = ros.pressure_message(self._ns(air.tick), BODY, air.pressure_pa)
            self._put("/imu/pressure", obs.tick, air.tick, message)
        for north in obs.magnetometer:
            message = ros.field_message(self._ns(north.tick), BODY, north.field_body_ut)
            self._put("/imu/mag", obs.tick, north.tick, message)
        for echo in obs.rangefinder:
            if echo.range_m > 0.0:
                at = np.array([echo.range_m, 0.0, 0.0])
                message = ros.point_message(self._ns(echo.tick), RANGEFINDER, at)
                self._put("/rangefinder/point", obs.tick, echo.tick, message)

    def _put(self, topic: str, arrival_tick: int, measured_tick: int, data: bytes) -> None:
        self._bag.put(topic, self._ns(arrival_tick), self._ns(measured_tick), data)

    def _ns(self, tick: int) -> int:
        return tick_ns(tick, self._rig.tick_hz)


def mounts(rig: SensorRig, sensed: SensorNeeds) -> dict[str, Pose]:
    """``body_from_sensor`` of what was sensed, by frame."""
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


# ------------------------------------------------------------------------------------- trajectories


def _trajectories(flown: FlownRun, options: ExportOptions, bag: RosBag) -> Iterator[float]:
    """Puts odometry, true and believed, and moving transforms into the bag, row by row. Yields the
    time of the row that comes next, before it is put there."""
    chosen = with_neighbours(tum_rows(flown.file(f"{options.poses}.tum")))
    truth = with_neighbours(tum_rows(flown.file("truth.tum")))
    drift = _Drift(flown, options.poses)
    here, true = next(chosen, None), next(truth, None)
    while here is not None or true is not None:
        times = [row[1][0] for row in (here, true) if row is not None]
        time_s = min(times)
        yield time_s
        stamp = round(1e9 * time_s)
        links: list[tuple[str, str, Pose]] = []
        if here is not None and here[1][0] == time_s:
            local = [(at, drift.odom_from_body(at, pose)) for at, pose in here]
            _put_odometry(bag, "/odom", stamp, (ODOM, BODY), local)
            map_from_odom = here[1][1] @ local[1][1].inverse()
            links += [(MAP, ODOM, map_from_odom)] if options.tf == "all" else []
            links.append((ODOM, BODY, local[1][1]))
            here = next(chosen, None)
        if true is not None and true[1][0] == time_s:
            _put_odometry(bag, "/ground_truth/odom", stamp, (MAP, TRUE_BODY), list(true))
            links.append((MAP, TRUE_BODY, true[1][1]))
            true = next(truth, None)
        if options.tf != "none":
            bag.put("/tf", stamp, stamp, ros.transforms_message(stamp, links))


class _Drift:
    """What the estimator, closing loops, moved the odometry's frame by, where a run tells."""

    def __init__(self, flown: FlownRun, poses: str) -> None:
        file = flown.path / "odometry.tum"
        told = poses == "estimate" and file.is_file()
        self._odometry = PosesAt(tum_rows(file)) if told else None
        self._known: dict[float, Pose] = {}

    def odom_from_body(self, time_s: float, map_from_body: Pose) -> Pose:
        """At a row of the trajectory or a neighbour of it; the same as in the map where unknown."""
        if self._odometry is None:
            return map_from_body
        if time_s not in self._known:
            found = self._odometry.at(time_s)
            self._known[time_s] = map_from_body if found is None else found
            while len(self._known) > 3:
                del self._known[next(iter(self._known))]
        return self._known[time_s]


def _put_odometry(
    bag: RosBag,
    topic: str,
    stamp: int,
    frames: tuple[str, str],
    rows: list[tuple[float, Pose]],
) -> None:
    """``rows``: the present one between its neighbours, which give its velocity."""
    (before_s, before), (_, here), (after_s, after) = rows
    span = after_s - before_s
    velocity = rate = np.zeros(3)
    if span > 0.0:
        velocity = here.rotation.T @ (after.translation - before.translation) / span
        rate = so3_log(before.rotation.T @ after.rotation) / span
    message = more.odometry_message(stamp, *frames, here, velocity, rate)
    bag.put(topic, stamp, stamp, message)
