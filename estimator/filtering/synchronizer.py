"""Arrival of scans and images: screened, in the order of their stamps, the filter carried along.

Each sensor delivers in order, but computing takes now longer and now shorter, so that a scan may
overtake an older image. A filter that moved on to the scan could not use the image any more. A
message is held back while an older one of another sensor is still to be expected: by the period of
a stream and the delays of its last messages. With constant delays nothing is held back, not even
where messages are lost.
"""

import dataclasses
from collections import deque
from collections.abc import Mapping

from touchdown.estimator.filtering.camera_model import at_middle_row
from touchdown.estimator.filtering.inertial_filter import InertialFilter
from touchdown.estimator.guard import InputGuard
from touchdown.sim.api import CameraImage, LidarScan, Observation, SensorRig

Message = LidarScan | CameraImage

_REMEMBERED = 64
"""messages by which the delay of a stream is bounded"""
_MARGIN = 0.5
"""fraction of the spread of those delays, beyond the longest"""
_GAPS = 8
"""intervals between stamps by which the period of a stream is known"""
_LOST_PERIODS = 3.0
"""a stream that has missed so many of its periods is not awaited until it delivers again"""
_MAX_DELAY_S = 0.3
"""longest delay of a scan or image that is waited for"""


def max_delay_ticks(rig: SensorRig) -> int:
    """Longest delay of a scan or image that is waited for."""
    return max(rig.compute_latency_ticks, round(_MAX_DELAY_S * rig.tick_hz))


def stamp_of(message: Message) -> int:
    """Returns the tick of measurement: the end of a scan, the exposure of an image."""
    return message.end_tick if isinstance(message, LidarScan) else message.tick


class ArrivingStream:
    """Stamps and delays of one sensor, by which the next message is expected. ``period_ticks`` 0:
    none is ever expected.

    ``longest_ticks``: longest delay to be expected, learnt from the last messages;
    ``nominal_ticks`` holds until one has arrived, ``max_ticks`` bounds it.
    """

    def __init__(self, period_ticks: int, nominal_ticks: int, max_ticks: int) -> None:
        self._nominal, self._max = period_ticks, max_ticks
        self._delays: deque[int] = deque(maxlen=_REMEMBERED)
        self.longest_ticks = min(nominal_ticks, max_ticks)
        self._gaps: deque[int] = deque(maxlen=_GAPS)
        self._newest = 0

    def take(self, stamp: int, now: int) -> None:
        """Adds a message of this stamp that arrives now."""
        if stamp > self._newest:
            self._gaps.append(stamp - self._newest)
            self._newest = stamp
        self._delays.append(now - stamp)
        longest = max(self._delays)
        margin = _MARGIN * (longest - min(self._delays))
        self.longest_ticks = min(round(longest + margin), self._max)

    def may_bring(self, before: int, now: int) -> bool:
        """True if a message of a stamp below ``before`` may still arrive after ``now``."""
        if not self._nominal:
            return False
        if self._newest + min([self._nominal, *self._gaps]) >= before:
            return False
        if now > self._newest + _LOST_PERIODS * self._nominal + self.longest_ticks:
            return False
        return now < before - 1 + self.longest_ticks


class MessageOrder:
    """Hands out scans and images in the order of their stamps; of a scan and an image of one
    instant the scan first.

    ``streams``: period in ticks of each stream to be ordered, by the name of its field in
    `Observation` (``scans``, ``images``); 0: it is never waited for. Fields that are not named are
    left out. A message is held back for ``patience_ticks`` after its stamp at most. With
    ``scans_follow_images`` a scan is held back for an image of the same instant, too.
    """

    def __init__(
        self,
        rig: SensorRig,
        streams: Mapping[str, int],
        patience_ticks: int,
        *,
        scans_follow_images: bool = False,
    ) -> None:
        nominal = rig.compute_latency_ticks
        self._streams = {
            name: ArrivingStream(period, nominal, patience_ticks)
            for name, period in streams.items()
        }
        self._tie = int(scans_follow_images)
        self._held: list[Message] = []

    @property
    def longest_wait_ticks(self) -> int:
        """Delay after which a message of any of the streams is not expected any more."""
        return max((stream.longest_ticks for stream in self._streams.values()), default=0)

    def push(self, obs: Observation) -> list[Message]:
        """Adds the messages of ``obs``; returns those that may be used now, oldest first. One that
        arrives after all patience is handed out at once, after newer ones."""
        for name, stream in self._streams.items():
            arrived: tuple[Message, ...] = getattr(obs, name)
            for message in arrived:
                stream.take(stamp_of(message), obs.tick)
            self._held += arrived
        self._held.sort(key=lambda m: (stamp_of(m), isinstance(m, CameraImage)))
        ready = 0
        while ready < len(self._held) and not self._awaited_before(self._held[ready], obs.tick):
            ready += 1
        out, self._held = self._held[:ready], self._held[ready:]
        return out

    def _awaited_before(self, message: Message, now: int) -> bool:
        """True if another stream may bring a message that is to be used before this one."""
        scan = isinstance(message, LidarScan)
        other = self._streams.get("images" if scan else "scans")
        # of one instant, the scan is used first: an image waits for it
        before = stamp_of(message) + (self._tie if scan else 1)
        return other is not None and other.may_bring(before, now)


class MessageSynchronizer:
    """Takes observations in three steps: ``push`` gives the scans and images that may be used now,
    ``advance`` carries the filter to one of them, and ``flush`` brings what they corrected to the
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
        self._order = MessageOrder(
            rig, periods, max_delay_ticks(rig), scans_follow_images=middle_rows
        )
        self._changed = False
        self.skipped = 0
        """messages refused since the start"""
        self.events: list[str] = []
        """events of this observation"""

    def push(self, obs: Observation) -> list[Message]:
        """Takes the IMU samples; returns the scans and images to be used now, oldest first."""
        obs = self._guard.screen(obs)
        self.events = list(self._guard.events)
        self.skipped += self._guard.refused
        if self._middle_rows:
            middles = tuple(at_middle_row(image, self._rig) for image in obs.images)
            obs = dataclasses.replace(obs, images=middles)
        self._filter.take_imu(obs)
        return self._order.push(obs)

    def advance(self, message: Message) -> bool:
        """Carries the filter to the message; False if it came too late."""
        tick = stamp_of(message)
        if not self._filter.tick <= tick <= self._filter.present.tick:
            self.skipped += 1
            name = "scan" if isinstance(message, LidarScan) else "image"
            self.events.append(f"{name} {tick} refused: it came too late")
            return False
        self._filter.carry_to(tick)
        self._changed = True
        return True

    def flush(self, obs: Observation) -> None:
        """Carries a filter that has waited too long; brings its corrections to the present."""
        scan = self._rig.lidar_scan_ticks
        lag = scan + max(self._rig.compute_latency_ticks, self._order.longest_wait_ticks)
        if obs.tick - self._filter.tick > lag + scan:
            # zero-velocity updates correct the filter, too, without a message
            self._filter.carry_to(obs.tick - lag)
            self._changed = True
        self._filter.settle(self._changed)
        self._changed = False
