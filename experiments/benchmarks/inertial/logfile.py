"""The scans and IMU samples of a log as an NPZ file, which a program without Touchdown reads.

| array | content |
|---|---|
| ``imu`` (M, 7) | time (s), specific force (m/s^2, +g upwards at rest), angular velocity (rad/s) |
| ``scan_span_s`` (S, 2), ``scan_rows`` (S + 1,) | start and end of each scan, and its rows below |
| ``points`` (N, 3), ``offsets_s`` (N,), ``intensity`` (N,) | pulses, LIDAR frame; 0: no return |
| ``body_from_imu``, ``body_from_lidar`` (4, 4) | nominal mounts |
| ``imu_noise`` (4,), ``imu_hz`` | densities: gyroscope, accelerometer, walks of their biases |
| ``gravity``, ``lasers``, ``range_m`` (2,) | m/s^2; pulse k is of laser k % lasers; its limits |

An IMU sample is a mean over an interval; its time is the middle of it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from touchdown.experiments.flight.replay import LoggedRun
from touchdown.sim.api import GRAVITY_MPS2, ImuSample, LidarScan, SensorRig

LASERS = {"horizon": 6, "avia": 6, "mid360": 4}
"""by preset of the LIDAR"""


def write_log(logged: LoggedRun, end_s: float, path: Path) -> None:
    """Writes all IMU samples and scans of a run that end before ``end_s`` or the end of its survey,
    those before the lift-off too."""
    until = min(end_s, logged.to_s)
    scans: list[LidarScan] = []
    imu: list[ImuSample] = []
    for obs in logged.sensors.observations(images=False):
        scans += [scan for scan in obs.scans if scan.end_time_s < until]
        imu += obs.imu
        if obs.time_s > until + 1.0:
            break
    write_arrays(logged.sensors.rig, imu, scans, path)


def write_arrays(rig: SensorRig, imu: list[ImuSample], scans: list[LidarScan], path: Path) -> None:
    """Writes these messages and the calibration of ``rig``."""
    half_s = 0.5 * rig.imu_ticks / rig.tick_hz
    rows = [(s.time_s - half_s, *s.specific_force, *s.angular_velocity) for s in imu]
    noise = rig.imu
    np.savez(
        path,
        imu=np.array(rows, dtype=float).reshape(-1, 7),
        scan_span_s=np.array([(s.start_time_s, s.end_time_s) for s in scans]).reshape(-1, 2),
        scan_rows=np.cumsum([0, *(len(s.ranges) for s in scans)]),
        points=np.concatenate([s.points for s in scans]),
        offsets_s=np.concatenate([s.time_offsets for s in scans]),
        intensity=np.concatenate([s.intensity for s in scans]),
        body_from_imu=rig.body_from_imu.matrix(),
        body_from_lidar=rig.body_from_lidar.matrix(),
        imu_noise=np.array(
            [
                noise.gyro_density,
                noise.accel_density,
                noise.gyro_bias_walk,
                noise.accel_bias_walk,
            ]
        ),
        imu_hz=np.array(rig.tick_hz / rig.imu_ticks),
        gravity=np.array(GRAVITY_MPS2),
        lasers=np.array(LASERS[rig.lidar.preset]),
        range_m=np.array([rig.lidar.min_range_m, rig.lidar.max_range_m]),
    )
