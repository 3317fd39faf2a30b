"""A log of PX4, written as its format says ("ULog File Format" of its guide), from one of ours."""

import struct
from pathlib import Path

import numpy as np
import pymap3d
from scipy.spatial.transform import Rotation

from touchdown.experiments.io.sensor_log_reader import SensorLogReader
from touchdown.experiments.io.tum import Trajectory

FORMATS = {
    "sensor_combined": "uint64_t timestamp;float[3] gyro_rad;float[3] accelerometer_m_s2;",
    "vehicle_attitude": "uint64_t timestamp;float[4] q;",
    "vehicle_local_position": "uint64_t timestamp;float x;float y;float z;",
    "vehicle_air_data": "uint64_t timestamp;float baro_pressure_pa;",
    "vehicle_magnetometer": "uint64_t timestamp;float[3] magnetometer_ga;",
    "sensor_gps": "uint64_t timestamp;double latitude_deg;double longitude_deg;"
    "double altitude_msl_m;float vel_n_m_s;float vel_e_m_s;float vel_d_m_s;float eph;float epv;"
    "float s_variance_m_s;float fix_type;",
}
LAYOUTS = {
    "sensor_combined": "<Q6f", "vehicle_attitude": "<Q4f", "vehicle_local_position": "<Q3f",
    "vehicle_air_data": "<Qf", "vehicle_magnetometer": "<Q3f", "sensor_gps": "<Q3d7f",
}  # fmt: skip
FLIP = np.array([1.0, -1.0, -1.0])
NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
BOOT_S = 40.0
"""from the start of the computer to that of the log"""


def write_ulog(run: Path, out: Path) -> Path:
    """IMU, GPS, barometer, magnetometer and poses of ``run`` in PX4's axes and units."""
    rows: list[tuple[int, str, list[float]]] = []

    def put(time_s: float, topic: str, *values: float) -> None:
        rows.append((round(1e6 * (time_s + BOOT_S)), topic, list(values)))

    for obs in SensorLogReader(run / "sensors.mcap"):
        for imu in obs.imu:
            put(imu.time_s, "sensor_combined", *(FLIP * imu.angular_velocity),
                *(FLIP * imu.specific_force))  # fmt: skip
        for one in obs.barometer:
            put(one.time_s, "vehicle_air_data", one.pressure_pa)
        for field in obs.magnetometer:
            put(field.time_s, "vehicle_magnetometer", *(0.01 * FLIP * field.field_body_ut))
        for fix in obs.gps:
            at = pymap3d.enu2geodetic(*fix.position_world, 40.0, 116.0, 50.0)
            north, east, up = fix.velocity_world[[1, 0, 2]]
            sigma = fix.sigma_position_m
            put(fix.time_s, "sensor_gps", *map(float, at), north, east, -up, sigma[0], sigma[2],
                fix.sigma_velocity_mps, 3.0)  # fmt: skip
    truth = Trajectory(run / "truth.tum")
    for time_s, rotation, position in zip(
        truth.times_s, truth.rotations, truth.positions, strict=True
    ):
        x, y, z, w = Rotation.from_matrix(NED @ rotation @ np.diag(FLIP)).as_quat()
        put(time_s, "vehicle_attitude", w, x, y, z)
        put(time_s, "vehicle_local_position", *(NED @ position))

    def message(kind: bytes, body: bytes) -> bytes:
        return struct.pack("<H", len(body)) + kind + body

    parts = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", round(1e6 * BOOT_S))]
    parts += [message(b"F", f"{name}:{text}".encode()) for name, text in FORMATS.items()]
    numbers = {name: number for number, name in enumerate(FORMATS)}
    parts += [message(b"A", struct.pack("<BH", 0, n) + name.encode())
              for name, n in numbers.items()]  # fmt: skip
    for stamp, topic, values in sorted(rows, key=lambda row: row[0]):
        data = struct.pack(LAYOUTS[topic], stamp, *values)
        parts.append(message(b"D", struct.pack("<H", numbers[topic]) + data))
    out.write_bytes(b"".join(parts))
    return out
