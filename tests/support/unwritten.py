"""A log of ours as a recording without a file between: what the format of an export has room for,
at its resolution."""

import dataclasses
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pymap3d

from touchdown.estimator.filtering.camera_model import Undistorter
from touchdown.experiments.export.datasets import _frames
from touchdown.experiments.export.point_cloud import placed_returns
from touchdown.experiments.io.sensor_log import SensorLog
from touchdown.experiments.io.sensor_log_reader import SensorLogReader, unpack_image
from touchdown.experiments.io.tum import Trajectory
from touchdown.experiments.recordings.contract import (
    ALL,
    ImuTable,
    Lens,
    NavTable,
    PoseTable,
    RawFrame,
    RawImage,
    RawScan,
    RigParts,
    Span,
)
from touchdown.sim.api import CameraImage, ImuSheet, LidarSheet
from touchdown.sim.frames import Pose, quat_wxyz_from_matrix
from touchdown.sim.typing import Array

from support.ulog_support import BOOT_S


@dataclass
class Unwritten:
    """A `Recording` in memory."""

    path: Path
    found: RigParts
    kept: list[RawFrame] = field(default_factory=list)
    samples: ImuTable | None = None
    small: NavTable | None = None
    poses: PoseTable | None = None

    def imu(self) -> ImuTable | None:
        return self.samples

    def nav(self) -> NavTable | None:
        return self.small

    def truth(self) -> PoseTable | None:
        return self.poses

    def rotors(self) -> None:
        return

    def begins_ns(self) -> int:
        return self.kept[0].stamp_ns if self.kept else 0

    def frames(self, span: Span = ALL) -> Iterator[RawFrame]:
        return (one for one in self.kept if span.holds(one.stamp_ns))


def delayed(run: Path, out: Path, single: bool = False) -> Path:
    """A copy of ``run`` whose scans and images arrive up to four observations later, of clocks that
    are 0.123457 ms late. ``single``: with the returns of its scans as points of 32 bits."""
    reader, rng = SensorLogReader(run / "sensors.mcap"), np.random.default_rng(5)
    shutil.copytree(run, out)
    log = SensorLog(out / "sensors.mcap", reader.rig, reader.sensed, reader.shared)
    held: list[tuple[int, str, Any]] = []

    def moved(one: Any) -> Any:
        if isinstance(one, CameraImage):
            return dataclasses.replace(one, time_s=1e-9 * (round(1e9 * one.time_s) + 123_457))
        start_s = 1e-9 * (round(1e9 * one.start_time_s) + 123_457)
        end_s = start_s + (one.end_tick - one.start_tick) / reader.rig.tick_hz
        late = dataclasses.replace(one, start_time_s=start_s, end_time_s=end_s)
        hit = one.ranges > 0.0
        points = one.points[hit].astype(np.float32)
        ranges = np.linalg.norm(points, axis=1)
        return late if not single else dataclasses.replace(
            late, directions=points / ranges[:, None], ranges=ranges,
            time_offsets=one.time_offsets[hit], intensity=one.intensity[hit],
        )  # fmt: skip

    for number, obs in enumerate(reader):
        for name in ("scans", "images"):
            held += [(number + int(rng.integers(5)), name, moved(one))
                     for one in getattr(obs, name)]  # fmt: skip
        due: dict[str, Any] = {name: tuple(one for at, kind, one in held
                               if kind == name and at <= number)
                               for name in ("scans", "images")}  # fmt: skip
        held = [one for one in held if one[0] > number]
        log.add(dataclasses.replace(obs, **due))
    log.close()
    return out


def kitti_unwritten(run: Path) -> Unwritten:
    """Points of 32 bits, moved to the middle of the scan by the truth; stamps in nanoseconds."""
    log, track = SensorLogReader(run / "sensors.mcap"), Trajectory(run / "truth.tum")
    rig, pinhole, kept, cameras = log.rig, Undistorter(log.rig), [], []
    for scan, image in _frames(log):
        time_s = 0.5 * (scan.start_time_s + scan.end_time_s)
        if not track.spans(scan.start_time_s, scan.end_time_s):
            continue
        points, _ = placed_returns(scan, track, rig.body_from_lidar, 1)
        here = (track.pose(time_s) @ rig.body_from_lidar).inverse()
        stamp, picture = round(1e9 * time_s), pinhole(unpack_image(image.png))
        kept += [
            RawScan(
                stamp_ns=stamp, points=here.apply(points).astype(np.float32),
                offsets_s=np.zeros(len(points), np.float32),
                intensity=scan.intensity[scan.ranges > 0.0],
            ),
            RawImage(stamp_ns=stamp, right=False, read=partial(np.copy, picture)),
        ]  # fmt: skip
        cameras.append(track.pose(time_s) @ rig.body_from_camera)
    camera_from_lidar = rig.body_from_camera.inverse() @ rig.body_from_lidar
    found = RigParts(
        camera=Lens(intrinsics=pinhole.rig.camera, body_from_camera=camera_from_lidar.inverse()),
        body_from_lidar=Pose.identity(), lidar=LidarSheet(min_range_m=0.9, max_range_m=120.0),
        moving=True,
    )  # fmt: skip
    true = [cameras[0].inverse() @ camera @ camera_from_lidar for camera in cameras]
    poses = PoseTable(
        stamps_ns=np.array([one.stamp_ns for one in kept[::2]], np.int64),
        positions=np.array([pose.translation for pose in true]),
        quats_wxyz=np.array([quat_wxyz_from_matrix(pose.rotation) for pose in true]),
    )
    return Unwritten(run, found, kept, poses=poses)


def ulog_unwritten(run: Path) -> Unwritten:
    """Stamps in microseconds; values of 32 bits, the magnetic field's in gauss; degrees of 64."""
    rows: dict[str, list[tuple[int, Array]]] = {}

    def add(name: str, time_s: float, values: Array) -> None:
        rows.setdefault(name, []).append((1000 * round(1e6 * (time_s + BOOT_S)), values))

    def single(values: object) -> Array:
        return np.asarray(values, np.float32).astype(np.float64)

    for obs in SensorLogReader(run / "sensors.mcap"):
        for one in obs.imu:
            add("imu", one.time_s, single([one.angular_velocity, one.specific_force]))
        for sample in obs.barometer:
            add("pressure", sample.time_s, single(sample.pressure_pa))
        for seen in obs.magnetometer:
            add("field", seen.time_s, 100.0 * single(0.01 * seen.field_body_ut))
        for fix in obs.gps:
            at = np.array(pymap3d.enu2geodetic(*fix.position_world, 40.0, 116.0, 50.0))
            sigmas = np.append(fix.sigma_position_m, fix.sigma_velocity_mps)
            add("fix", fix.time_s, np.append(at, single([*fix.velocity_world, *sigmas])))
    stamps = {name: np.array([stamp for stamp, _ in table]) for name, table in rows.items()}
    values = {name: np.array([value for _, value in table]) for name, table in rows.items()}
    fixes = values["fix"]
    fixes[:, :3] = np.column_stack(pymap3d.geodetic2enu(*fixes[:, :3].T, *fixes[0, :3]))
    samples = ImuTable(stamps_ns=stamps["imu"], gyro=values["imu"][:, 0], force=values["imu"][:, 1])
    small = NavTable(
        fix_ns=stamps["fix"], fixes=fixes, pressure_ns=stamps["pressure"],
        pressures_pa=values["pressure"], field_ns=stamps["field"], fields_ut=values["field"],
    )  # fmt: skip
    found = RigParts(imu=ImuSheet(gyro_bias_sigma=0.02, accel_bias_sigma=0.2))
    return Unwritten(run, found, samples=samples, small=small)
