"""One LIDAR-inertial odometry over a file of scans and IMU samples, as a program of its own.

It needs numpy and the package of that method alone, and runs in whatever environment has them:

    python runner.py versions     # JSON: version by package that is installed there
    python runner.py JOB          # JOB: JSON with method, setting, log, scans_from_s, imu_from_s

``log``: an NPZ file (see ``logfile.py``). It prints one line for each pose of the body in the
method's own frame: ``t x y z qx qy qz qw``, as in a TUM file, and the CPU seconds so far.
"""

from __future__ import annotations

import importlib.metadata
import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Poses = list[tuple[float, Array]]
"""times, s, and (4, 4) poses of the body"""

PACKAGES = ("rko-lio", "genz-lio", "se3-lio", "evalio")
LEAST_RETURNS = 100
"""Least returns of a scan that is given to a method: near the ground there are few."""
EPOCH_S = 1000.0
"""Added to all times: some take time 0 for unset."""
_NS = 1_000_000_000


@dataclass(frozen=True)
class Scan:
    """All pulses of a scan: points (N, 3) metres, LIDAR frame, 0 without return; seconds (N,) after
    ``start_s``, ascending; intensity (N,) 0 to 255."""

    start_s: float
    end_s: float
    points: Array
    offsets_s: Array
    intensity: Array

    def returns(self) -> tuple[Array, Array, Array]:
        """Points, offsets and intensities of the pulses that came back."""
        back = np.any(self.points != 0.0, axis=1)
        return self.points[back], self.offsets_s[back], self.intensity[back]


class Log:
    """The content of a log file; times include `EPOCH_S`."""

    def __init__(self, path: str) -> None:
        with np.load(path) as file:
            data = {name: file[name] for name in file.files}
        self.imu: Array = data["imu"] + np.array([EPOCH_S, 0, 0, 0, 0, 0, 0])
        self.body_from_imu: Array = data["body_from_imu"]
        self.body_from_lidar: Array = data["body_from_lidar"]
        self.imu_from_lidar: Array = np.linalg.inv(self.body_from_imu) @ self.body_from_lidar
        self.gravity = float(data["gravity"])
        self.imu_hz = float(data["imu_hz"])
        self.lasers = int(data["lasers"])
        self.range_m: tuple[float, float] = tuple(data["range_m"].tolist())
        self.imu_noise: Array = data["imu_noise"]
        self._spans, self._rows = data["scan_span_s"] + EPOCH_S, data["scan_rows"]
        self.pulses = int(np.median(np.diff(self._rows)))
        self.scan_s = float(np.median(np.diff(self._spans[:, 0])))
        self._points, self._offsets = data["points"], data["offsets_s"]
        self._intensity = data["intensity"]

    def scans(self, from_s: float) -> Iterator[Scan]:
        """Scans that begin at ``from_s`` or later."""
        for (start_s, end_s), first, last in zip(
            self._spans.tolist(), self._rows[:-1], self._rows[1:], strict=True
        ):
            if start_s >= from_s - 1e-6:
                part = slice(int(first), int(last))
                points, offsets = self._points[part], self._offsets[part]
                yield Scan(
                    start_s,
                    end_s,
                    points.astype(float),
                    offsets.astype(float),
                    self._intensity[part].astype(float),
                )


class Method(Protocol):
    """An odometry that is fed in the order of arrival."""

    def prepare(self, scan: Scan) -> Any:
        """A scan as the package takes it; the time for it does not count."""
        ...

    def imu(self, row: Array) -> None:
        """Takes (7,) time, specific force (m/s^2) and angular velocity (rad/s), IMU frame."""
        ...

    def scan(self, prepared: Any) -> Poses:
        """Takes a scan, and returns the poses that are new."""
        ...


class RkoLio:
    """RKO-LIO (Malladi et al. 2025). Its base frame is the body."""

    def __init__(self, log: Log, setting: dict[str, Any]) -> None:
        from rko_lio.config import LIOConfig
        from rko_lio.lio import LIO
        from rko_lio.rko_lio_pybind import InputError, RegistrationError

        least, most = log.range_m
        config = LIOConfig(max_num_threads=1, min_range=least, max_range=most, **setting)
        self._odometry, self._log = LIO(config), log
        self._errors = (InputError, RegistrationError)
        self._waiting: list[Array] = []

    def prepare(self, scan: Scan) -> Any:
        points, offsets, _ = scan.returns()
        return points, _ns(scan.start_s + offsets), _ns(scan.start_s), _ns(scan.end_s), scan.end_s

    def imu(self, row: Array) -> None:
        self._waiting.append(row)

    def scan(self, prepared: Any) -> Poses:
        points, times, start, end, end_s = prepared
        for row in self._waiting:
            if row[0] < end_s:
                self._odometry.add_imu_measurement(
                    row[1:4], row[4:7], int(_ns(row[0])), self._log.body_from_imu
                )
        self._waiting = [row for row in self._waiting if row[0] >= end_s]
        mount = self._log.body_from_lidar
        try:
            self._odometry.register_scan(points, times, mount, int(start), int(end))
        except self._errors as error:
            print(error, file=sys.stderr)
            return []
        return [(end_s, self._odometry.pose())]


class GenzLio:
    """GenZ-LIO (Lee et al. 2026). Its frame is the IMU's. ``section.name`` sets a nested value."""

    def __init__(self, log: Log, setting: dict[str, Any]) -> None:
        from genz_lio import Config, GenZLIO, LidarType
        from genz_lio.genz_lio_pybind import _ScanBuffer

        config = Config()
        config.max_threads = 1
        given = config.preprocess
        given.lidar_type, given.scan_line = LidarType.LIVOX, log.lasers
        given.blind_min, given.blind_max = log.range_m
        config.mapping.extrinsic_r = log.imu_from_lidar[:3, :3]
        config.mapping.extrinsic_t = log.imu_from_lidar[:3, 3]
        for key, value in setting.items():
            section, _, name = key.rpartition(".")
            setattr(getattr(config, section), name, value)
        self._buffer, self._odometry = _ScanBuffer(given), GenZLIO(config)
        self._imu_from_body = np.linalg.inv(log.body_from_imu)

    def prepare(self, scan: Scan) -> Any:
        return scan.start_s, *scan.returns()

    def imu(self, row: Array) -> None:
        self._buffer.push_imu(row[None])

    def scan(self, prepared: Any) -> Poses:
        start_s, points, offsets, intensity = prepared
        self._buffer.push_scan(points, start_s, offsets, intensity.astype(np.float32), None)
        found: Poses = []
        while (bundle := self._buffer.pop()) is not None:
            points, begin, end, imu, times, intensities, rings, _ = bundle
            if len(imu) == 0:
                continue
            result = self._odometry.register_scan(
                points, begin, end, imu, times, intensities, rings, True
            )
            if result.valid:
                found.append((result.timestamp, result.pose @ self._imu_from_body))
        return found


class Se3Lio:
    """SE(3)-LIO (2025). Its frame is the IMU's."""

    def __init__(self, log: Log, setting: dict[str, Any]) -> None:
        from se3_lio.config import SE3LIOConfig
        from se3_lio.online_sync import OnlineSynchronizer
        from se3_lio.se3_lio import SE3LIO

        self._sync = OnlineSynchronizer()
        self._odometry = SE3LIO(SE3LIOConfig(**setting), log.imu_from_lidar)
        self._imu_from_body = np.linalg.inv(log.body_from_imu)

    def prepare(self, scan: Scan) -> Any:
        points, offsets, _ = scan.returns()
        return scan.start_s, points, offsets

    def imu(self, row: Array) -> None:
        self._sync.add_imu(row)

    def scan(self, prepared: Any) -> Poses:
        self._sync.add_scan(*prepared)
        found: Poses = []
        for scan, imu in self._sync.drain():
            state, _ = self._odometry.register_frame(
                scan["pts"], scan["offsets"], imu, scan["header_ts"]
            )
            found.append((state.stamp, np.array(state.pose) @ self._imu_from_body))
        return found


_POINT = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("t", "<u4"),
     ("range", "<u4"), ("row", "<u2"), ("col", "<u2")]
)  # fmt: skip
"""as evalio reads it: ``t`` in nanoseconds after the stamp of the cloud, ``range`` in mm"""


class Evalio:
    """A pipeline of evalio (Potokar 2025) by its class; poses are those of the IMU. A scan is a
    grid, one row a laser with its pulses without return, as methods with features expect. Poses
    are stamped with the start of a scan, and are those of ``late`` of its duration later, or of
    its end where a constant velocity undistorts it."""

    def __init__(self, pipeline: str, late: float, log: Log, setting: dict[str, Any]) -> None:
        from evalio import types
        from evalio._cpp import helpers, pipelines

        self._types, self._helpers, self._lasers = types, helpers, log.lasers
        self._pipeline = getattr(pipelines, pipeline)()
        # CT-ICP has no valid values of its own before its defaults are set.
        unknown = self._pipeline.set_params(self._pipeline.default_params() | setting)
        if unknown:
            raise ValueError(f"{pipeline} has no {', '.join(unknown)}")
        gyro, accel, gyro_walk, accel_walk = log.imu_noise.tolist()
        least, most = log.range_m
        imu = types.ImuParams(
            gyro=gyro, accel=accel, gyro_bias=gyro_walk, accel_bias=accel_walk,
            gravity=np.array([0.0, 0.0, -log.gravity]), rate=log.imu_hz,
        )  # fmt: skip
        lidar = types.LidarParams(
            num_rows=log.lasers, num_columns=log.pulses // log.lasers,
            min_range=least, max_range=most, rate=1.0 / log.scan_s,
        )  # fmt: skip
        self._pipeline.set_imu_params(imu)
        self._pipeline.set_lidar_params(lidar)
        self._pipeline.set_imu_T_lidar(types.SE3.from_mat(log.imu_from_lidar))
        self._pipeline.initialize()
        self._imu_from_body = np.linalg.inv(log.body_from_imu)
        undistorted = pipeline != "DLIO" and setting.get("deskew", False)
        self._late_s = log.scan_s * (1.0 if undistorted else late)

    def prepare(self, scan: Scan) -> Any:
        cloud = np.zeros((self._lasers, len(scan.points) // self._lasers), _POINT)

        def by_laser(values: Array) -> Array:
            return values[: cloud.size].reshape(cloud.shape[::-1]).T

        for axis, name in enumerate("xyz"):
            cloud[name] = by_laser(scan.points[:, axis])
        cloud["intensity"] = by_laser(scan.intensity)
        cloud["t"] = by_laser(_ns(scan.offsets_s))
        cloud["range"] = by_laser(1e3 * np.linalg.norm(scan.points, axis=1))
        cloud["row"], cloud["col"] = np.indices(cloud.shape)
        helpers = self._helpers
        kinds = {"f4": "FLOAT32", "u4": "UINT32", "u2": "UINT16"}
        fields = [
            helpers.Field(
                name=name,
                datatype=getattr(helpers.DataType, kinds[place[0].str[1:]]),
                offset=place[1],
            )
            for name, place in (_POINT.fields or {}).items()
        ]
        facts = helpers.PointCloudMetadata(
            stamp=self._types.Stamp.from_nsec(int(_ns(scan.start_s))),
            width=cloud.shape[1], height=cloud.shape[0], point_step=_POINT.itemsize,
            row_step=_POINT.itemsize * cloud.shape[1], is_bigendian=0, is_dense=1,
        )  # fmt: skip
        return helpers.pc2_to_evalio(facts, fields, cloud.tobytes())

    def imu(self, row: Array) -> None:
        stamp = self._types.Stamp.from_nsec(int(_ns(row[0])))
        self._pipeline.add_imu(self._types.ImuMeasurement(stamp, row[4:7], row[1:4]))

    def scan(self, prepared: Any) -> Poses:
        self._pipeline.add_lidar(prepared)
        return [
            (stamp.to_sec() + self._late_s, pose.to_mat() @ self._imu_from_body)
            for stamp, pose in self._pipeline.saved_estimates()
        ]


METHODS: dict[str, Callable[[Log, dict[str, Any]], Method]] = {
    "rko_lio": RkoLio,
    "genz_lio": GenzLio,
    "se3_lio": Se3Lio,
    "lio_sam": partial(Evalio, "LioSAM", -1.5),
    "dlio": partial(Evalio, "DLIO", 0.5),
    "loam": partial(Evalio, "LOAM", 0.5),
    "ct_icp": partial(Evalio, "CTICP", 0.0),
    "mad_icp": partial(Evalio, "MadICP", 0.5),
    "genz_icp": partial(Evalio, "GenZICP", 0.5),
}


def _ns(time_s: Any) -> Any:
    return np.round(np.asarray(time_s) * _NS).astype(np.int64)


# ------------------------------------------------------------------------------------- running


def run(job: dict[str, Any]) -> Iterator[tuple[float, Array, float]]:
    """Yields time, s of the log, ``odom_from_body`` (4, 4) and the CPU seconds so far. Before each
    scan come all IMU samples up to the first one at its end or after."""
    log = Log(job["log"])
    method = METHODS[job["method"]](log, job["setting"])
    rows = log.imu[log.imu[:, 0] >= job["imu_from_s"] + EPOCH_S - 1e-6]
    given, cpu_s = 0, 0.0
    for scan in log.scans(job["scans_from_s"] + EPOCH_S):
        if np.count_nonzero(scan.points.any(axis=1)) < LEAST_RETURNS:
            continue
        until = int(np.searchsorted(rows[:, 0], scan.end_s)) + 1
        prepared = method.prepare(scan)
        began = time.process_time()
        for row in rows[given:until]:
            method.imu(row)
        poses = method.scan(prepared)
        cpu_s += time.process_time() - began
        given = max(given, until)
        for time_s, pose in poses:
            yield time_s - EPOCH_S, pose, cpu_s


def versions() -> dict[str, str]:
    """Version by name of those of `PACKAGES` that are installed."""
    found = {}
    for name in PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def quat_xyzw(rotation: Array) -> Array:
    """(4,) unit quaternion of a (3, 3) rotation: the eigenvector of the largest eigenvalue of the
    symmetric matrix of Bar-Itzhack (2000)."""
    r = rotation
    k = np.zeros((4, 4))
    k[:3, :3] = r + r.T - np.trace(r) * np.eye(3)
    k[3, :3] = k[:3, 3] = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    k[3, 3] = np.trace(r)
    return np.asarray(np.linalg.eigh(k)[1][:, 3])


def main(text: str) -> None:
    """Does what the module says. What the packages print goes to the standard error."""
    with os.fdopen(os.dup(1), "w") as out:
        os.dup2(2, 1)
        if text == "versions":
            out.write(json.dumps(versions()))
            return
        for time_s, pose, cpu_s in run(json.loads(text)):
            if not np.all(np.isfinite(pose)):
                break
            numbers = (time_s, *pose[:3, 3], *quat_xyzw(pose[:3, :3]), cpu_s)
            out.write(" ".join(f"{number:.9f}" for number in numbers) + "\n")
            out.flush()


if __name__ == "__main__":
    main(sys.argv[1])
