"""A vehicle at rest before a scripted PX4."""

import os
import signal
import time
from pathlib import Path

import numpy as np
import psutil

from touchdown.controller.api import Setpoint
from touchdown.estimator.api import Estimate
from touchdown.experiments.config.loading import load_config
from touchdown.experiments.external.synthetic_stream import synthetic_rig
from touchdown.experiments.px4.autopilot import Px4Autopilot
from touchdown.sim.api import BarometerSample, ImuSample, Observation
from touchdown.sim.frames import Pose

RIG = synthetic_rig()


def autopilot(build: Path, *overrides: str) -> Px4Autopilot:
    config = load_config(None, overrides, scene="flat", controller="px4", px4=str(build))
    return Px4Autopilot(config, RIG)


def observation(tick: int) -> Observation:
    """At rest, at 200 Hz."""
    time_s = tick / 600
    imu = ImuSample(tick=tick, time_s=time_s, angular_velocity=np.zeros(3),
                    specific_force=np.array([0.0, 0.0, 9.81]))  # fmt: skip
    air = BarometerSample(tick=tick, time_s=time_s, pressure_pa=1e5, altitude_m=0.0)
    return Observation(
        tick=tick, time_s=time_s, imu=(imu,) if tick else (), barometer=(air,),
        rotor_speed_radps=np.zeros(4), battery_fraction=1.0,
    )  # fmt: skip


def estimate(tick: int, healthy: bool = True) -> Estimate:
    return Estimate(
        tick=tick, time_s=tick / 600, odom_from_body=Pose.identity(),
        world_from_odom=Pose.identity(), velocity_odom=np.zeros(3),
        angular_velocity_body=np.zeros(3), acceleration_odom=np.zeros(3),
        position_covariance=1e-4 * np.eye(3), rotation_covariance=1e-6 * np.eye(3),
        healthy=healthy,
    )  # fmt: skip


def setpoint(motors_on: bool) -> Setpoint:
    return Setpoint(
        position_odom=np.zeros(3), velocity_odom=np.zeros(3), acceleration_odom=np.zeros(3),
        yaw_odom=0.0, motors_on=motors_on,
    )  # fmt: skip


def rest(
    pilot: Px4Autopilot, steps: int, motors_on: bool = False, lost: range = range(0)
) -> list[str]:
    """Stands still for so many control steps; returns the events. In the steps ``lost`` the
    estimate is not healthy."""
    events: list[str] = []
    for step in range(steps):
        pilot.sense(observation(3 * step))
        known = estimate(3 * step, healthy=step not in lost)
        events += pilot.update(known, setpoint(motors_on)).events
    return events


def running(build: Path) -> list[int]:
    """Processes that were started from a build."""
    found = []
    for process in psutil.process_iter(["cmdline"]):
        if str(build) in " ".join(process.info["cmdline"] or ()):
            found.append(process.pid)
    return found


def all_gone(build: Path, patience_s: float = 20.0) -> bool:
    deadline = time.monotonic() + patience_s
    while running(build):
        if time.monotonic() > deadline:
            return False
        time.sleep(0.05)
    return True


def kill(pid: int) -> None:
    os.kill(pid, signal.SIGKILL)
