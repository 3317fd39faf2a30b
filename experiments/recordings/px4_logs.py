"""Logs of PX4 (``.ulg``): IMU, GPS, barometer and magnetometer, and the truth of a simulation or
what PX4's own estimator found. Read by `pyulog`, extra ``ulog``."""

from pathlib import Path
from typing import Any

import numpy as np
import pymap3d
from scipy.spatial.transform import Rotation, Slerp

from touchdown.experiments.errors import UsageError
from touchdown.experiments.recordings.clock import poses_of
from touchdown.experiments.recordings.contract import (
    ImuTable,
    NavTable,
    PoseTable,
    Recording,
    RigParts,
    Stamps,
)
from touchdown.sim.api import ImuSheet
from touchdown.sim.files.opening import check_file
from touchdown.sim.typing import Array

_MAX_BYTES = 1 << 32
_FLIP = np.array([1.0, -1.0, -1.0])
"""forward, right, down to forward, left, up; also of its inverse"""
_ENU_FROM_NED = Rotation.from_matrix([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_TOPICS = (
    "sensor_combined", "vehicle_attitude_groundtruth", "vehicle_local_position_groundtruth",
    "vehicle_attitude", "vehicle_local_position", "vehicle_gps_position", "sensor_gps",
    "vehicle_air_data", "vehicle_magnetometer",
)  # fmt: skip
_UT_PER_GAUSS = 100.0


class Px4Log(Recording):
    """A ``.ulg`` file. The body is PX4's, turned to forward, left, up; its IMU is at its origin.
    Positions are east, north, up of the first fix."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.found = RigParts(imu=ImuSheet(gyro_bias_sigma=0.02, accel_bias_sigma=0.2))
        try:
            from pyulog import ULog
        except ImportError:
            raise UsageError("a .ulg needs pyulog: pip install pyulog") from None
        try:
            check_file(path, "log", _MAX_BYTES)
            log = ULog(str(path), list(_TOPICS))
            self._tables: dict[str, Any] = {}
            for one in log.data_list:
                self._tables.setdefault(one.name, one.data)
        except Exception as error:  # what a damaged log makes pyulog raise is of any kind
            raise UsageError(f"'{path}' is no log of PX4, or damaged") from error

    @staticmethod
    def holds(path: Path) -> bool:
        """True if ``path`` looks like one."""
        return path.suffix == ".ulg"

    def _columns(self, topic: str, *names: str) -> tuple[Stamps, Array] | None:
        """Stamps (N,) and columns (N, M) of a topic, ascending, each time once; None without."""
        table = self._tables.get(topic)
        if table is None or any(name not in table for name in names):
            return None
        stamps = 1000 * np.asarray(table["timestamp"], np.int64)
        values = np.column_stack([np.asarray(table[name], np.float64) for name in names])
        good = np.isfinite(values).all(axis=1)
        stamps, rows = np.unique(stamps[good], return_index=True)
        return (stamps, values[good][rows]) if len(stamps) else None

    def imu(self) -> ImuTable:
        """``sensor_combined``."""
        found = self._columns(
            "sensor_combined", *(f"gyro_rad[{k}]" for k in range(3)),
            *(f"accelerometer_m_s2[{k}]" for k in range(3)),
        )  # fmt: skip
        if found is None:
            raise UsageError(f"'{self.path}' has no sensor_combined")
        stamps, values = found
        return ImuTable(stamps_ns=stamps, gyro=values[:, :3] * _FLIP, force=values[:, 3:] * _FLIP)

    def truth(self) -> PoseTable | None:
        """Poses of a simulation; of a flight, what PX4's estimator found."""
        for ending in ("_groundtruth", ""):
            turns = self._columns(f"vehicle_attitude{ending}", *(f"q[{k}]" for k in range(4)))
            places = self._columns(f"vehicle_local_position{ending}", "x", "y", "z")
            if turns is None or places is None or min(len(turns[0]), len(places[0])) < 2:
                continue
            first, last = max(turns[0][0], places[0][0]), min(turns[0][-1], places[0][-1])
            stamps = places[0][(places[0] >= first) & (places[0] <= last)]
            if len(stamps) < 2:
                continue
            between = Slerp(turns[0] - first, Rotation.from_quat(turns[1][:, [1, 2, 3, 0]]))
            turned = _ENU_FROM_NED * between(stamps - first) * Rotation.from_matrix(np.diag(_FLIP))
            rows = np.isin(places[0], stamps)
            return poses_of(
                stamps, _ENU_FROM_NED.apply(places[1][rows]), turned.as_quat()[:, [3, 0, 1, 2]]
            )
        return None

    def nav(self) -> NavTable | None:
        """Fixes, pressures and fields."""
        fixes = self._fixes()
        pressure = self._columns("vehicle_air_data", "baro_pressure_pa")
        field = self._columns("vehicle_magnetometer", *(f"magnetometer_ga[{k}]" for k in range(3)))
        none = np.zeros(0, np.int64)
        return NavTable(
            fix_ns=none if fixes is None else fixes[0],
            fixes=np.zeros((0, 10)) if fixes is None else fixes[1],
            pressure_ns=none if pressure is None else pressure[0],
            pressures_pa=np.zeros(0) if pressure is None else pressure[1][:, 0],
            field_ns=none if field is None else field[0],
            fields_ut=np.zeros((0, 3)) if field is None else _UT_PER_GAUSS * field[1] * _FLIP,
        )

    def _fixes(self) -> tuple[Stamps, Array] | None:
        """Stamps and (N, 10): position and velocity east, north, up, their standard deviations."""
        speeds = ("vel_n_m_s", "vel_e_m_s", "vel_d_m_s", "eph", "epv", "s_variance_m_s", "fix_type")
        for topic in ("vehicle_gps_position", "sensor_gps"):
            for place, scale in (
                (("latitude_deg", "longitude_deg", "altitude_msl_m"), (1.0, 1.0, 1.0)),
                (("lat", "lon", "alt"), (1e-7, 1e-7, 1e-3)),
            ):
                found = self._columns(topic, *place, *speeds)
                if found is None:
                    continue
                stamps, values = found
                good = values[:, 9] >= 3.0
                if not good.any():
                    continue
                stamps, values = stamps[good], values[good]
                at = values[:, :3] * scale
                local = np.column_stack(pymap3d.geodetic2enu(*at.T, *at[0]))
                velocity = values[:, [4, 3, 5]] * [1.0, 1.0, -1.0]
                sigmas = values[:, [6, 6, 7, 8]]
                return stamps, np.column_stack([local, velocity, sigmas])
        return None

    def begins_ns(self) -> int:
        """The first stamp of the IMU."""
        return int(self.imu().stamps_ns[0])
