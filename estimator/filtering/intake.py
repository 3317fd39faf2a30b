"""Arrival of scans and images: screened, in the order of their stamps, the filter carried along."""

from __future__ import annotations

import dataclasses

from touchdown.estimator.filtering.inertial_filter import InertialFilter
from touchdown.estimator.filtering.message_order import Message, MessageOrder, stamp_of
from touchdown.estimator.filtering.rolling_shutter import at_middle_row
from touchdown.estimator.guard import InputGuard
from touchdown.sim.api import LidarScan, Observation, SensorRig

_PATIENCE_S = 0.3
"""longest delay of a scan or image that is waited for"""


class Intake:
    """Takes observations in three steps: ``ready`` gives the scans and images that may be used now,
    ``admit`` carries the filter to one of them, and ``finish`` brings what they corrected to the
    present.

    ``camera_hz`` 0: no images. ``middle_rows``: images are stamped with the exposure of their
    middle row, and used before a scan of the same instant.
    """

    def __init__(
        self, rig: SensorRig, inertial: InertialFilter, camera_hz: int, *, middle_rows: bool = False
    ) -> None:
        self._rig, self._filter, self._middle_rows = rig, inertial, middle_rows
        self._guard = InputGuard(rig, camera_hz)
        periods = {"scans": rig.lidar_scan_ticks}
        if camera_hz:
            periods["images"] = rig.tick_hz // camera_hz
        patience = max(rig.compute_latency_ticks, round(_PATIENCE_S * rig.tick_hz))
        self._order = MessageOrder(rig, periods, patience, scans_follow_images=middle_rows)
        self._changed = False
        self.skipped = 0
        """messages refused since the start"""
        self.events: list[str] = []
        """of this observation"""

    def ready(self, obs: Observation) -> list[Message]:
        """Takes the IMU samples; returns the scans and images to be used now, oldest first."""
        obs = self._guard.screen(obs)
        self.events = list(self._guard.events)
        self.skipped += self._guard.refused
        if self._middle_rows:
            middles = tuple(at_middle_row(image, self._rig) for image in obs.images)
            obs = dataclasses.replace(obs, images=middles)
        self._filter.take_imu(obs)
        return self._order.push(obs)

    def admit(self, message: Message) -> bool:
        """Carries the filter to the message; False if it came too late."""
        tick = stamp_of(message)
        if not self._filter.tick <= tick <= self._filter.propagated_tick:
            self.skipped += 1
            name = "scan" if isinstance(message, LidarScan) else "image"
            self.events.append(f"{name} {tick} refused: it came too late")
            return False
        self._filter.carry_to(tick)
        self._changed = True
        return True

    def finish(self, obs: Observation) -> None:
        """Carries a filter that has waited too long; brings its corrections to the present."""
        scan = self._rig.lidar_scan_ticks
        lag = scan + max(self._rig.compute_latency_ticks, self._order.longest_wait_ticks)
        if obs.tick - self._filter.tick > lag + scan:
            # zero-velocity updates correct the filter, too, without a message
            self._filter.carry_to(obs.tick - lag)
            self._changed = True
        self._filter.settle(self._changed)
        self._changed = False
