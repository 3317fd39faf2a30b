"""Rates and deliveries for tests of faults."""

from typing import Any

import numpy as np

from touchdown.sim.api import CameraImage, FaultParams, GpsFix, LidarScan, Observation
from touchdown.sim.faults.injector import FaultInjector

from support.landing_support import make_obs
from support.messages import make_scan

HZ, STEP, PERIOD, LATENCY = 600, 3, 60, 36
COUNT = 8


def scan(end: int) -> LidarScan:
    """The ranges identify the scan."""
    down = np.tile([0.0, 0.0, 1.0], (COUNT, 1))
    return make_scan(end, down, np.full(COUNT, end / HZ), np.linspace(0.01, 0.1, COUNT), 50)


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
        messages = {"scans": scan, "images": image, "gps": fix} if due else {}
        found.append(make_obs(tick, **{name: (of(measured),) for name, of in messages.items()}))
    return found


def delivered(*events: str, stream: str = "scans", **params: Any) -> list[tuple[int, Any]]:
    """(tick of delivery, message) of one stream."""
    injector = FaultInjector(FaultParams(events=events, **params), HZ)
    return [
        (obs.tick, message)
        for obs in map(injector.apply, world())
        for message in getattr(obs, stream)
    ]
