"""Rates and deliveries for tests of faults."""

from typing import Any

import numpy as np

from touchdown.sim.api import CameraImage, FaultParams, GpsFix, LidarScan, Observation
from touchdown.sim.faults.injector import FaultInjector

HZ, STEP, PERIOD, LATENCY = 600, 3, 60, 36


COUNT = 8


def scan(end: int) -> LidarScan:
    """The ranges identify the scan."""
    directions = np.tile(np.array([0.0, 0.0, 1.0], np.float32), (COUNT, 1))
    return LidarScan(
        start_tick=end - PERIOD, end_tick=end, start_time_s=(end - PERIOD) / HZ,
        end_time_s=end / HZ, directions=directions,
        ranges=np.full(COUNT, end / HZ, np.float32),
        time_offsets=np.linspace(0.01, 0.1, COUNT, dtype=np.float32),
        intensity=np.full(COUNT, 50, np.uint8),
    )  # fmt: skip


def image(tick: int) -> CameraImage:
    return CameraImage(
        tick=tick, time_s=tick / HZ, rgb=np.full((4, 6, 3), tick // PERIOD % 256, np.uint8)
    )


def fix(tick: int) -> GpsFix:
    return GpsFix(
        tick=tick, time_s=tick / HZ, position_world=np.array([tick / HZ, 0.0, 0.0]),
        velocity_world=np.zeros(3), sigma_position_m=np.ones(3), sigma_velocity_mps=0.1,
    )  # fmt: skip


def world(last: int = 1500) -> list[Observation]:
    """Deliveries without faults: one message of each kind every 60 ticks, 36 ticks late."""
    found = []
    for tick in range(0, last + 1, STEP):
        measured = tick - LATENCY
        due = measured > 0 and measured % PERIOD == 0
        found.append(
            Observation(
                tick=tick, time_s=tick / HZ, scans=(scan(measured),) if due else (),
                images=(image(measured),) if due else (), gps=(fix(measured),) if due else (),
                rotor_speed_radps=np.zeros(4), battery_fraction=1.0,
            )
        )  # fmt: skip
    return found


def delivered(*events: str, stream: str = "scans", **params: Any) -> list[tuple[int, Any]]:
    """(tick of delivery, message) of one stream."""
    injector = FaultInjector(FaultParams(events=events, **params), HZ)
    return [
        (obs.tick, message)
        for obs in map(injector.apply, world())
        for message in getattr(obs, stream)
    ]
