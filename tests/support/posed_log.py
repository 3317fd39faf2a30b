"""Short sensor logs without a flight: the vehicle's camera and LIDAR along a true path, and an IMU
with noise and biases that moves along it. Cheap, because nothing is simulated but the sensors."""

from __future__ import annotations

import dataclasses
import fcntl
import pickle
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.api import Estimate, Estimator
from touchdown.sim.api import (
    GRAVITY_MPS2,
    CameraParams,
    ImuSample,
    Observation,
    SensorNeeds,
    SensorRig,
    WorldParams,
)
from touchdown.sim.frames import Pose, quat_wxyz_from_matrix, so3_exp, so3_log
from touchdown.sim.moving import BodyTrack
from touchdown.sim.posed_sensors import PosedSensors
from touchdown.sim.world import MujocoWorld

from support.places import cached_scene

Array = NDArray[np.float64]

PARAMS = WorldParams(camera=CameraParams(width=424, height=240))
NEEDS = SensorNeeds(camera_hz=10, lidar=True)
SECONDS = 8.0
_HEIGHT_M = 20.0


@dataclass(frozen=True)
class PosedLog:
    """Observations at the rate of the IMU, and the true odom_from_body at each."""

    rig: SensorRig
    observations: list[Observation]
    truths: list[Pose]

    def errors(self, make: Callable[[SensorRig], Estimator]) -> tuple[Array, list[Estimate]]:
        """Position errors (N, 3) m and estimates of an estimator over the log."""
        estimator = make(self.rig)
        estimates = [estimator.update(obs) for obs in self.observations]
        errors = [
            e.world_from_body.translation - truth.translation
            for e, truth in zip(estimates, self.truths, strict=True)
        ]
        return np.array(errors), estimates


def _path(start: Array, t: float) -> Pose:
    """Out and back by 12 m within eight seconds, with a bow aside, a climb and a turn; the thrust
    gives the acceleration."""
    rate = 2.0 * np.pi / SECONDS
    shares = np.array([6.0, 2.0, 1.5])
    rates = rate * np.array([1.0, 2.0, 1.0])
    place = shares * (1.0 - np.cos(rates * t))
    up = shares * rates**2 * np.cos(rates * t) + [0.0, 0.0, GRAVITY_MPS2]
    up /= np.linalg.norm(up)
    yaw = 0.4 * np.sin(rate * t)
    left = np.cross(up, [np.cos(yaw), np.sin(yaw), 0.0])
    left /= np.linalg.norm(left)
    return Pose(np.column_stack([np.cross(left, up), left, up]), start + place)


def make_log(scene: str, seed: int) -> PosedLog:
    """The same log each time for a scene and a seed."""
    loaded = cached_scene(scene, seed)
    world = MujocoWorld(loaded, PARAMS, seed, NEEDS)
    rig = world.rig
    world.close()
    start = rig.world_from_body_start.translation + [0.0, 0.0, _HEIGHT_M]
    rig = dataclasses.replace(rig, world_from_body_start=_path(start, 0.0))
    ticks = np.arange(0, round(SECONDS * rig.tick_hz) + 1)
    poses = [_path(start, tick / rig.tick_hz) for tick in ticks]
    track = BodyTrack(
        times_s=ticks / rig.tick_hz,
        positions=np.array([pose.translation for pose in poses]),
        quats_wxyz=np.array([quat_wxyz_from_matrix(pose.rotation) for pose in poses]),
    )
    samples = _imu_samples(rig, poses, np.random.default_rng([seed, crc32(b"posed log")]))
    sensors = PosedSensors(loaded, PARAMS, seed)
    found = []
    step, period = rig.imu_ticks, rig.lidar_scan_ticks
    for tick in ticks[::step]:
        measured = int(tick) - rig.compute_latency_ticks
        due = measured > 0 and measured % period == 0
        first = measured - period
        scan = dataclasses.replace(track, **_part(track, first, measured)) if due else None
        found.append(
            Observation(
                tick=int(tick),
                time_s=tick / rig.tick_hz,
                imu=(samples[tick // step - 1],) if tick else (),
                scans=(sensors.scan(scan, first),) if scan is not None else (),
                images=(sensors.image(track, measured),) if due else (),
                rotor_speed_radps=np.full(4, 0.7 * rig.vehicle.rotor_speed_max),
                battery_fraction=1.0,
            )
        )
    sensors.close()
    return PosedLog(rig, found, poses[::step])


def _part(track: BodyTrack, first: int, last: int) -> dict[str, Array]:
    rows = slice(first, last + 1)
    return {
        "times_s": track.times_s[rows],
        "positions": track.positions[rows],
        "quats_wxyz": track.quats_wxyz[rows],
    }


def _imu_samples(rig: SensorRig, poses: list[Pose], rng: np.random.Generator) -> list[ImuSample]:
    """Mean rates and specific forces over each step, with biases and white noise."""
    step = rig.imu_ticks
    step_s, imu = step / rig.tick_hz, rig.imu
    seats = [pose @ rig.body_from_imu for pose in poses]
    biases = rng.standard_normal((2, 3)) * [[imu.gyro_bias_sigma], [imu.accel_bias_sigma]]
    noise = np.array([imu.gyro_density, imu.accel_density]) / np.sqrt(step_s)
    places = np.array([seat.translation for seat in seats])
    velocities = np.gradient(places, 1.0 / rig.tick_hz, axis=0, edge_order=2)
    samples = []
    for tick in range(step, len(seats), step):
        before, after = seats[tick - step], seats[tick]
        rate = so3_log(before.rotation.T @ after.rotation) / step_s
        mean = (velocities[tick] - velocities[tick - step]) / step_s
        middle = before.rotation @ so3_exp(0.5 * step_s * rate)
        force = middle.T @ (mean + [0.0, 0.0, GRAVITY_MPS2])
        white = noise[:, None] * rng.standard_normal((2, 3)) + biases
        samples.append(
            ImuSample(
                tick=tick,
                time_s=tick / rig.tick_hz,
                angular_velocity=rate + white[0],
                specific_force=force + white[1],
            )
        )
    return samples


def cached_log(folder: Path, scene: str, seed: int) -> PosedLog:
    """As ``make_log``, made once for all processes that share ``folder``."""
    folder.mkdir(exist_ok=True)
    path = folder / f"{scene}-{seed}.pickle"
    with (folder / f"{scene}-{seed}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not path.exists():
            path.write_bytes(pickle.dumps(make_log(scene, seed)))
        log: PosedLog = pickle.loads(path.read_bytes())
    return log
