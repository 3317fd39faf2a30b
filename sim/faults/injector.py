"""Injects scheduled faults between the sensors and their readers.

Faults act on messages at the moment of their delivery, so that estimator, mapper, lander and
recorder see the same.
"""

import dataclasses
from collections import deque
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

import numpy as np

from touchdown.sim import api
from touchdown.sim.faults.marks import Marks
from touchdown.sim.faults.types import WORLD_KINDS

_STREAMS = ("scans", "images", "gps")
_OF_THE_LAST = frozenset(("lidar_frozen", "camera_frozen", "gps_frozen", "timestamp_repeat"))
"""Kinds that deliver what was delivered last, or its stamps."""
_STAMPS: dict[type, tuple[str, ...]] = {
    api.LidarScan: ("start_tick", "end_tick", "start_time_s", "end_time_s"),
    api.CameraImage: ("tick", "time_s"),
    api.GpsFix: ("tick", "time_s"),
}


class FaultInjector:
    """Applies a schedule of faults to observations. Call ``apply`` with every observation, in
    order; without a schedule it returns them unchanged. Raises ValueError for an invalid schedule.
    """

    def __init__(self, params: api.FaultParams, tick_hz: int, marks: Marks | None = None) -> None:
        marks = marks or Marks(params.schedule(), tick_hz)
        self._streams = {
            name: _FaultyStream(
                [
                    _Pending(fault, marks)
                    for fault in params.schedule()
                    if name in api.FAULT_KINDS[fault.kind] and fault.kind not in WORLD_KINDS
                ],
                params,
                tick_hz,
            )
            for name in _STREAMS
        }
        self._idle, self._marks = not params.events, marks

    def apply(self, obs: api.Observation) -> api.Observation:
        """The observation with faults; the given messages are not written to."""
        if self._idle:
            return obs
        changed: dict[str, Any] = {
            name: stream.pass_on(getattr(obs, name), obs.tick)
            for name, stream in self._streams.items()
        }
        return dataclasses.replace(obs, **changed)

    def summary(self) -> list[dict[str, Any]]:
        """Effects of every fault: its text, and for each of its streams ``messages``, the number
        that it changed, of ``came``, the number that came while it was active; of a fault of N
        messages from its start to the end of the flight. ``began_s``: None for never."""
        found: dict[str, dict[str, Any]] = {}
        for name, stream in self._streams.items():
            for pending in stream.faults:
                text = pending.fault.text
                entry = found.setdefault(text, {"fault": text, "messages": {}, "came": {}})
                entry["messages"][name] = pending.hit
                entry["came"][name] = pending.came
                entry["began_s"] = self._marks.began_s(pending.fault)
        return list(found.values())


class _Pending:
    """A fault on one stream."""

    def __init__(self, fault: api.Fault, marks: Marks) -> None:
        self.fault, self._marks = fault, marks
        self.came = self.hit = 0

    @property
    def start_tick(self) -> float:
        """Infinite before its mark is reached."""
        return self._marks.span(self.fault)[0]

    def befalls(self, tick: int) -> bool:
        """True for a message at ``tick`` that the fault is to change; it counts as having come."""
        start, end = self._marks.span(self.fault)
        if not start <= tick < end:
            return False
        self.came += 1
        return self.fault.count is None or self.hit < self.fault.count


class _FaultyStream:
    """The messages of one sensor on their way."""

    def __init__(self, faults: list[_Pending], params: api.FaultParams, tick_hz: int) -> None:
        self.faults = faults
        self._params, self._tick_hz = params, tick_hz
        self._late_ticks = round(params.late_s * tick_hz)
        self._last: Any = None
        self._held: Any = None
        self._queue: deque[tuple[int, Any]] = deque()
        self._content: dict[str, Callable[[Any], Any]] = {
            "lidar_nan": _not_a_number,
            "lidar_empty": partial(_pulses, take=slice(0)),
            "lidar_blind": _without_returns,
            "lidar_soiled": partial(_without_returns, sector_deg=params.soiled_deg),
            "camera_black": _black,
            "gps_jump": partial(_moved, offset=np.array(params.gps_jump_m)),
            "lidar_frozen": self._frozen,
            "camera_frozen": self._frozen,
            "gps_frozen": self._frozen,
            "timestamp_repeat": lambda m: _stamped(m, self._last),
        }

    def pass_on(self, messages: Iterable[Any], tick: int) -> tuple[Any, ...]:
        for message in messages:
            self._take(message, tick)
        out = []
        while self._queue and self._queue[0][0] <= tick:
            out.append(self._queue.popleft()[1])
        if out:
            self._last = out[-1]
        return tuple(out)

    def _take(self, message: Any, tick: int) -> None:
        due, swap, lost = tick, self._held is not None, False
        for pending in self.faults:
            kind = pending.fault.kind
            if not pending.befalls(tick) or lost:
                continue
            if self._last is None and kind in _OF_THE_LAST:
                continue  # nothing to repeat yet
            pending.hit += 1
            if kind.endswith("_dropout"):
                lost = True
            elif kind.endswith("_skew"):
                message = self._skewed(message, pending.start_tick)
            elif kind == "gps_spoof":
                message = self._spoofed(message, pending.start_tick)
            elif kind in self._content:
                message = self._content[kind](message)
            elif kind.endswith("_late"):
                due = tick + self._late_ticks
            else:
                swap = True
        if lost:
            return
        if not swap:
            self._enqueue(due, message)
        elif self._held is None:
            self._held = message
        else:
            first, self._held = self._held, None
            self._enqueue(due, _stamped(first, message))
            self._enqueue(due, _stamped(message, first))

    def _enqueue(self, due: int, message: Any) -> None:
        """Queues a message; it overtakes none that is already queued."""
        if self._queue:
            due = max(due, self._queue[-1][0])
        self._queue.append((due, message))

    def _skewed(self, message: Any, start_tick: float) -> Any:
        """The message with the time stamps of a clock that has an offset and a drift."""
        hz, params = self._tick_hz, self._params
        since_s = max(0, _measured(message) - start_tick) / hz
        offset_s = params.skew_s + 1e-6 * params.skew_ppm * since_s
        stamps = {
            # the tick is the one nearest to the time
            n: getattr(message, n) + (round(offset_s * hz) if "tick" in n else offset_s)
            for n in _STAMPS[type(message)]
        }
        return dataclasses.replace(message, **stamps)

    def _spoofed(self, fix: api.GpsFix, start_tick: float) -> api.GpsFix:
        """The fix, displaced at a constant velocity since the spoofing began."""
        velocity = np.array(self._params.gps_spoof_mps)
        since_s = max(0, fix.tick - start_tick) / self._tick_hz
        moved = _moved(fix, velocity * since_s)
        return dataclasses.replace(moved, velocity_world=fix.velocity_world + velocity)

    def _frozen(self, message: Any) -> Any:
        """The message that was delivered last, with the time stamps of this one."""
        return _stamped(self._last, message)


def _measured(message: Any) -> int:
    """Tick at the end of the measurement, as it is stamped."""
    return int(message.end_tick if isinstance(message, api.LidarScan) else message.tick)


def _stamped(message: Any, like: Any) -> Any:
    """``message`` with the time stamps of ``like``."""
    stamps = {name: getattr(like, name) for name in _STAMPS[type(message)]}
    return dataclasses.replace(message, **stamps)


def _not_a_number(scan: api.LidarScan) -> api.LidarScan:
    return dataclasses.replace(
        scan,
        directions=np.full_like(scan.directions, np.nan),
        ranges=np.full_like(scan.ranges, np.nan),
    )


def _without_returns(
    scan: api.LidarScan, sector_deg: tuple[float, float] | None = None
) -> api.LidarScan:
    """The scan without the returns of a sector of azimuths about the boresight; None: of all."""
    keep = np.zeros(len(scan.ranges), bool)
    if sector_deg is not None:
        azimuth = np.degrees(np.arctan2(scan.directions[:, 1], scan.directions[:, 0]))
        keep = (azimuth - sector_deg[0]) % 360.0 > (sector_deg[1] - sector_deg[0]) % 360.0
    return dataclasses.replace(
        scan,
        ranges=np.where(keep, scan.ranges, np.float32(0.0)),
        intensity=np.where(keep, scan.intensity, np.uint8(0)),
    )


def _pulses(scan: api.LidarScan, take: slice) -> api.LidarScan:
    return dataclasses.replace(
        scan,
        directions=scan.directions[take],
        ranges=scan.ranges[take],
        time_offsets=scan.time_offsets[take],
        intensity=scan.intensity[take],
    )


def _black(image: api.CameraImage) -> api.CameraImage:
    right = None if image.right_rgb is None else np.zeros_like(image.right_rgb)
    return dataclasses.replace(image, rgb=np.zeros_like(image.rgb), right_rgb=right)


def _moved(fix: api.GpsFix, offset: Any) -> api.GpsFix:
    return dataclasses.replace(fix, position_world=fix.position_world + offset)
