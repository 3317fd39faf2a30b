"""Validity checks of sensor messages for estimators and the mapper.

The guard rejects a message that is invalid by itself: values that are not finite, no returns, an
impossible time stamp, repeated content. A rejection costs no more than the loss of the message, and
is reported as an event. Plausible outliers are left to the filters' innovation tests.
``filtering.deskew.screen_scan`` then selects the returns within the sensor's limits.
"""

import dataclasses
import math
import re
from collections.abc import Callable
from typing import TypeVar

import numpy as np

from touchdown.estimator.api import image_defect, some_pixels
from touchdown.sim.api import CameraImage, ImuSample, LidarScan, Observation, SensorRig
from touchdown.sim.typing import Array, Bytes, Float32, Mask

_CLUTTER_M = 10.0
"""range within which echoes may come from rain or fog"""
_CLUTTER_LEVEL, _ISOLATED_LEVEL = 6, 15
"""largest intensity of an echo of rain or fog, and of an isolated one"""
_MIN_CLUTTER, _CLUTTER_FRACTION = 10, 0.8
"""weak isolated echoes in a scan, and the fraction of weak ones among all near echoes, from which
the scan counts as taken in rain or fog: other near echoes are mostly strong"""
_CLUTTER_SCANS, _CLUTTER_MEMORY_S = 3, 30.0
"""consecutive scans before rain or fog is assumed, and the duration of this state: near the ground
all returns are near"""
_MIN_RETURNS_FRACTION = 1e-3
"""fraction of pulses that must remain after the removal of those echoes"""
_ISOLATED_GAP_M = 1.0
_NOWHERE = np.float32(np.inf)
_DROPOUT_PERIODS = 3.5
"""a sensor that has delivered once is in dropout after so many of its periods"""
_AHEAD_S = 5.0
"""for how long no message of a stream is used after two with stamps from the future: those whose
latency hides it are as wrong"""
_SECTORS = 12
_SECTOR_PULSES, _BLIND_RETURNS, _BLIND_SCANS = 20, 0.02, 10
"""pulses of a sector about the boresight from which its returns tell something, the fraction of
returns below which it is blind, and the scans in a row before this is said"""

Message = TypeVar("Message", LidarScan, CameraImage)


class InputGuard:
    """Screens observations, in order. ``events`` are those of the last call of ``screen``.

    ``camera_hz``: expected images a second; 0: no expectation. ``inertial``: IMU samples are
    checked, too.
    """

    def __init__(self, rig: SensorRig, camera_hz: int = 0, *, inertial: bool = True) -> None:
        self._inertial = inertial
        self._shape = (rig.camera.height, rig.camera.width, 3)
        self._scans = _Stream("scan", rig.lidar_scan_ticks, rig.tick_hz)
        period = round(rig.tick_hz / camera_hz) if camera_hz else 0
        self._images = _Stream("image", period, rig.tick_hz)
        self._ranges: Float32 = np.zeros(0, np.float32)
        self._pixels: Bytes = np.zeros(0, np.uint8)
        self._had_returns = False
        """True once a scan had a return"""
        self._clutter_ticks = round(_CLUTTER_MEMORY_S * rig.tick_hz)
        self._clutter_until = -1
        self._cluttered = 0
        """consecutive scans with signs of rain or fog"""
        self._blind: Array = np.zeros(_SECTORS)
        """(12,) scans in a row for which each sector about the boresight was blind"""
        self._imu: ImuSample | None = None
        self._repaired = 0
        self.events: tuple[str, ...] = ()
        self.refused = 0
        """messages rejected or repaired in the last call"""

    def screen(self, obs: Observation) -> Observation:
        """Returns ``obs`` without the rejected messages. Invalid pulses keep their position, with
        range NaN. An invalid IMU sample is replaced by the previous one, because filters expect one
        sample for every step."""
        events: list[str] = []
        imu = self._finite_samples(obs.imu, events) if self._inertial else obs.imu
        scans = self._scans.screen(obs.scans, obs.tick, self._judge_scan, events)
        images = self._images.screen(obs.images, obs.tick, self._judge_image, events)
        for scan in scans:
            self._watch_sectors(scan, events)
        self.events = tuple(events)
        arrived = len(obs.scans) + len(obs.images)
        self.refused = arrived - len(scans) - len(images) + self._repaired
        if imu is obs.imu and scans is obs.scans and images is obs.images:
            return obs
        return dataclasses.replace(obs, imu=imu, scans=scans, images=images)

    # ------------------------------------------------------------------------ inertial samples

    def _finite_samples(
        self, samples: tuple[ImuSample, ...], events: list[str]
    ) -> tuple[ImuSample, ...]:
        """Returns the samples, invalid ones replaced by the previous sample."""
        out: list[ImuSample] = []
        self._repaired = 0
        for sample in samples:
            # one infinity or NaN among the six numbers makes their sum so
            numbers = sample.angular_velocity.tolist() + sample.specific_force.tolist()
            if math.isfinite(sum(numbers)):
                self._imu = sample
                out.append(sample)
                continue
            self._repaired += 1
            if self._imu is None:
                events.append(f"IMU sample {sample.tick} refused: not a number")
                continue
            events.append(f"IMU sample {sample.tick} replaced by {self._imu.tick}: not a number")
            out.append(dataclasses.replace(self._imu, tick=sample.tick, time_s=sample.time_s))
        return tuple(out) if self._repaired else samples

    # ------------------------------------------------------------------------ scans

    def _judge_scan(self, scan: LidarScan) -> tuple[LidarScan | None, str]:
        """Returns the scan to use, or None, and the reason for a change or a rejection; "" for
        none."""
        count = len(scan.ranges)
        if scan.directions.shape != (count, 3) or not (
            len(scan.time_offsets) == len(scan.intensity) == count
        ):
            return None, "its arrays differ in length"
        if count == 0:
            return None, "no pulses"
        ranges = scan.ranges
        total = float(ranges.sum() + scan.directions.sum() + scan.time_offsets.sum())
        bad: Mask | None = None
        if not np.isfinite(total):
            bad = ~(
                np.isfinite(ranges)
                & np.isfinite(scan.directions).all(axis=1)
                & np.isfinite(scan.time_offsets)
            )
            if bad.all():
                return None, "not a number"
        if not (ranges > 0.0).any():
            # on the ground everything is nearer than the smallest range
            return None, "no returns" if self._had_returns else ""
        self._had_returns = True
        floating = self._clutter(scan)
        if floating is not None:
            bad = floating if bad is None else bad | floating
            if np.count_nonzero(ranges[~bad] > 0.0) < _MIN_RETURNS_FRACTION * count:
                return None, "nothing but echoes of rain or fog"
        if np.array_equal(ranges, self._ranges, equal_nan=True):
            return None, "the same as the one before"
        self._ranges = ranges
        if bad is None:
            return scan, ""
        what = "not a number" if floating is None else "echoes of rain or fog"
        return _without_pulses(scan, bad), f"{int(bad.sum())} of {count} pulses {what}"

    def _clutter(self, scan: LidarScan) -> Mask | None:
        """Returns the mask (N,) of echoes of rain or fog; None if there is neither."""
        shows, floating = clutter_of(scan)
        self._cluttered = self._cluttered + 1 if shows else 0
        if self._cluttered >= _CLUTTER_SCANS:
            self._clutter_until = scan.end_tick + self._clutter_ticks
        if scan.end_tick > self._clutter_until or not floating.any():
            return None
        return floating

    def _watch_sectors(self, scan: LidarScan, events: list[str]) -> None:
        """Appends an event where a sector about the boresight has become blind beside others that
        see, as behind dirt on the window, and where it sees again."""
        azimuth = np.arctan2(scan.directions[:, 1], scan.directions[:, 0])
        sector = ((azimuth / (2.0 * np.pi) + 1.0) * _SECTORS).astype(int) % _SECTORS
        pulses = np.bincount(sector, minlength=_SECTORS)
        returns = np.bincount(sector, scan.ranges > 0.0, minlength=_SECTORS)
        told = pulses >= _SECTOR_PULSES
        blind = told & (returns < _BLIND_RETURNS * pulses)
        if 2 * np.count_nonzero(blind) >= np.count_nonzero(told):
            return  # over water, or about to rise
        before = self._blind >= _BLIND_SCANS
        self._blind = np.where(told, (self._blind + 1) * blind, self._blind)
        now = self._blind >= _BLIND_SCANS
        if (now != before).any():
            where = ", ".join(f"{30 * i} to {30 * (i + 1)} deg" for i in np.flatnonzero(now))
            what = f"is blind at azimuths of {where}" if where else "sees all round again"
            events.append(f"LIDAR {what}")

    # ------------------------------------------------------------------------ images

    def _judge_image(self, image: CameraImage) -> tuple[CameraImage | None, str]:
        rgb = image.rgb
        if rgb.shape != self._shape or rgb.dtype != np.uint8:
            return None, f"{rgb.dtype} of shape {rgb.shape} instead of uint8 {self._shape}"
        pixels = some_pixels(rgb)
        if defect := image_defect(pixels, self._pixels):
            return None, defect
        self._pixels = pixels
        return image, ""


class _Stream:
    """Time stamps and dropouts of one sensor. ``period_ticks`` 0: dropouts are not reported."""

    def __init__(self, name: str, period_ticks: int, tick_hz: int) -> None:
        self._name = name
        self._tick_hz = tick_hz
        self._timeout = round(_DROPOUT_PERIODS * period_ticks)
        self._newest = -1
        """stamp of the newest accepted message"""
        self._delivered = -1
        """tick of the last delivery"""
        self._in_dropout = False
        self._defect = ""
        """defect of the previous message, without its numbers"""
        self._refused = 0
        """consecutive messages"""
        self._ahead_ticks = round(_AHEAD_S * tick_hz)
        self._ahead = (-self._ahead_ticks, -self._ahead_ticks)
        """deliveries of the last two messages from the future"""

    def screen(
        self,
        messages: tuple[Message, ...],
        now: int,
        judge: Callable[[Message], tuple[Message | None, str]],
        events: list[str],
    ) -> tuple[Message, ...]:
        if not messages:
            self._check_dropout(now, events)
            return messages
        if self._in_dropout:
            elapsed_s = (now - self._delivered) / self._tick_hz
            events.append(f"{self._name}s again after {elapsed_s:.2f} s")
        self._delivered, self._in_dropout = now, False
        flags = _unordered([_ticks(message)[1] for message in messages])
        kept: list[Message] = []
        for message, unordered in zip(messages, flags, strict=True):
            taken: Message | None = None
            reason = "out of order" if unordered else self._stamp_fault(message, now)
            if not reason:
                taken, reason = judge(message)
            self._report(_ticks(message)[1], taken is None, reason, events)
            if taken is not None:
                self._newest = _ticks(message)[1]
                kept.append(taken)
        same = len(kept) == len(messages) and all(
            a is b for a, b in zip(kept, messages, strict=True)
        )
        return messages if same else tuple(kept)

    def _report(self, tick: int, refused: bool, reason: str, events: list[str]) -> None:
        """Appends an event where a defect begins, changes or ends, not for every message that has
        it."""
        defect = re.sub(r"\d+", "", reason)
        if reason and defect != self._defect:
            events.append(f"{self._name} {tick} {'refused' if refused else 'cleaned'}: {reason}")
        if not refused and self._refused > 1:
            events.append(f"{self._name}s usable again after {self._refused} refused")
        self._defect = defect
        self._refused = self._refused + 1 if refused and reason else 0

    def _check_dropout(self, now: int, events: list[str]) -> None:
        elapsed = now - self._delivered
        awaited = self._timeout and self._delivered >= 0 and not self._in_dropout
        if awaited and elapsed > self._timeout:
            self._in_dropout = True
            events.append(f"no {self._name} for {elapsed / self._tick_hz:.2f} s")

    def _stamp_fault(self, message: LidarScan | CameraImage, now: int) -> str:
        start, end = _ticks(message)
        if end > now:
            self._ahead = self._ahead[1], now
        if now - self._ahead[0] < self._ahead_ticks:
            return "its clock runs ahead"
        if end > now:
            return "from the future"
        if start > end or (start == end and isinstance(message, LidarScan)):
            return "ends before it starts"
        if end == self._newest:
            return "repeats its time stamp"
        if end < self._newest or (isinstance(message, LidarScan) and start < self._newest):
            return "older than one that came before it"
        return ""


def _ticks(message: LidarScan | CameraImage) -> tuple[int, int]:
    if isinstance(message, LidarScan):
        return message.start_tick, message.end_tick
    return message.tick, message.tick


def _unordered(stamps: list[int]) -> list[bool]:
    """Returns a flag for each of the messages that arrived together: True if it is not in the order
    of the stamps. Of two swapped messages both are flagged, since either may be wrong."""
    return [
        max(stamps[:i], default=stamp) > stamp or min(stamps[i:]) < stamp
        for i, stamp in enumerate(stamps)
    ]


def clutter_of(scan: LidarScan) -> tuple[bool, Mask]:
    """Returns whether a scan shows rain or fog, and the mask (N,) of the echoes of either.

    Such echoes are near, weak and isolated: both neighbouring pulses in time return from elsewhere
    or not at all. Intensity separates them as in Park, Kim and Kim, "Fast and accurate desnowing
    algorithm for LiDAR point clouds", IEEE Access 8, 2020. Where most near echoes are weak, they
    need not be isolated, which echoes of dense fog are not.
    """
    ranges, level = scan.ranges, scan.intensity
    near = (ranges > 0.0) & (ranges < _CLUTTER_M)
    if not near.any():
        return False, near
    with np.errstate(invalid="ignore"):
        steps = np.abs(np.diff(ranges, prepend=_NOWHERE, append=_NOWHERE)) > _ISOLATED_GAP_M
    weak = near & (level <= _CLUTTER_LEVEL)
    floating = near & (level <= _ISOLATED_LEVEL) & steps[:-1] & steps[1:]
    few = np.count_nonzero(floating & weak) < _MIN_CLUTTER
    if few or weak.sum() < _CLUTTER_FRACTION * near.sum():
        return False, floating
    return True, floating | weak


def _without_pulses(scan: LidarScan, bad: Mask) -> LidarScan:
    """Returns the scan with ``bad`` (N,) pulses at range NaN along the boresight. They keep their
    position, because neighbours in a scan are found by index."""
    directions, ranges = scan.directions.copy(), scan.ranges.copy()
    directions[bad], ranges[bad] = (0.0, 0.0, 1.0), np.nan
    offsets = np.maximum.accumulate(np.nan_to_num(scan.time_offsets, nan=0.0))
    return dataclasses.replace(scan, directions=directions, ranges=ranges, time_offsets=offsets)
