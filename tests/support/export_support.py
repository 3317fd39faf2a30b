"""A run for the tests of exports, and a reader of its bag."""

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader

from touchdown.estimator.api import MapperParams
from touchdown.estimator.mapping.mapper import GridMapper
from touchdown.experiments.drawing.map_images import map_points, write_ply
from touchdown.experiments.external.synthetic_stream import SyntheticStream, synthetic_rig
from touchdown.experiments.io.sensor_log_reader import SensorLogReader
from touchdown.sim.api import SensorNeeds
from touchdown.sim.frames import Pose, matrix_from_quat_wxyz

from support.landing_support import make_estimate
from support.replay_support import make_run, shifted

SECONDS = 2.4
ALL = SensorNeeds(
    camera_hz=3, stereo=True, lidar=True, gps=True, barometer=True, magnetometer=True,
    rangefinder=True,
)  # fmt: skip
OFFSET = np.array([0.3, -0.4, 0.0])
PHASES = [{"time_s": 0.0, "phase": "INIT"}, {"time_s": 0.7, "phase": "TAKEOFF"}]


def make_flown(folder: Path) -> Path:
    """A run whose estimate is 0.5 m off, with a map of the true path."""
    made = make_run(
        folder, seconds=SECONDS, needs=ALL, shared=ALL, estimate=shifted(OFFSET), phases=PHASES
    )
    truth = SyntheticStream(synthetic_rig(), ALL, SECONDS)
    mapper = GridMapper(synthetic_rig(), MapperParams(extent_m=40.0))
    for obs in SensorLogReader(made / "sensors.mcap"):
        view = mapper.update(obs, make_estimate(obs.tick, truth.true_pose(obs.tick)))
    write_ply(made / "map.ply", *map_points(view.coarse))
    return made


def read_bag(path: Path) -> dict[str, list[Any]]:
    """(log time, message) by topic, read by rosbags."""
    found: dict[str, list[Any]] = defaultdict(list)
    with AnyReader([path]) as reader:
        for connection, time_ns, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            found[connection.topic].append((time_ns, message))
    return found


def stamp_of(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def vector(v: Any) -> np.ndarray:
    return np.array([v.x, v.y, v.z])


def pose_of(position: Any, q: Any) -> Pose:
    return Pose(matrix_from_quat_wxyz(np.array([q.w, q.x, q.y, q.z])), vector(position))


def links_of(message: Any) -> dict[tuple[str, str], Pose]:
    return {
        (link.header.frame_id, link.child_frame_id): pose_of(
            link.transform.translation, link.transform.rotation
        )
        for link in message.transforms
    }


def points_of(cloud: Any) -> Any:
    kinds = {7: "<f4", 4: "<u2"}
    dtype = np.dtype(
        {
            "names": [field.name for field in cloud.fields],
            "formats": [kinds[field.datatype] for field in cloud.fields],
            "offsets": [field.offset for field in cloud.fields],
            "itemsize": cloud.point_step,
        }
    )
    return np.frombuffer(cloud.data.tobytes(), dtype)
