"""What estimators and the mapper check before they believe a message.

A sensor fails in few ways that its messages alone can tell: values that are no numbers, nothing
seen, a stamp that cannot be, the same content again. Such a message is refused, which costs no more
than its loss, and the refusal is told in words. What only a comparison with everything else can
tell (a wrong but plausible measurement) is the filters' business.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from typing import TypeVar

import numpy as np
from numba import njit, types
from numpy.typing import NDArray

from touchdown.estimator.api import image_defect, some_pixels
from touchdown.sim.api import CameraImage, ImuSample, LidarScan, Observation, SensorRig

_CLUTTER_M = 10.0
"""within which rain and fog are taken for targets"""
_CLUTTER_LEVEL, _LONE_LEVEL = 6, 15
"""strongest intensity of an echo of the air, and of one that hangs alone in it"""
_CLUTTER_LEAST, _CLUTTER_SHARE = 10, 0.8
"""weak, lone echoes in a scan, and weak ones among all that are near, from which it counts as taken
in rain or fog: what is near otherwise is strong for the most part"""
_CLUTTER_SCANS, _CLUTTER_MEMORY_S = 3, 30.0
"""in a row before it is believed, and how long: over the ground everything is near"""
_LEAST_RETURNS = 1e-3
"""share of pulses that must be left when those echoes are taken away"""
_LONE_GAP_M = 1.0
_SILENCE_PERIODS = 3.5
"""a sensor that has been heard once is missed after so many of its periods"""

Message = TypeVar("Message", LidarScan, CameraImage)


class InputGuard:
    """Screens observations, in order. ``events`` are those of the last call of ``screen``.

    ``camera_hz``: images a second to be expected; 0: as they come. ``inertial``: whether IMU
    samples are looked at.
    """

    def __init__(self, rig: SensorRig, camera_hz: int = 0, *, inertial: bool = True) -> None:
        self._inertial = inertial
        self._shape = (rig.camera.height, rig.camera.width, 3)
        self._scans = _Stream("scan", rig.lidar_scan_ticks, rig.tick_hz)
        period = round(rig.tick_hz / camera_hz) if camera_hz else 0
        self._images = _Stream("image", period, rig.tick_hz)
        self._ranges: NDArray[np.float32] = np.zeros(0, np.float32)
        self._pixels: NDArray[np.uint8] = np.zeros(0, np.uint8)
        self._seeing = False
        """whether any scan had a return yet"""
        self._clutter_ticks = round(_CLUTTER_MEMORY_S * rig.tick_hz)
        self._clutter_until = -1
        self._cluttered = 0
        """scans in a row that show rain or fog"""
        self._imu: ImuSample | None = None
        self._repaired = 0
        self.events: tuple[str, ...] = ()
        self.refused = 0
        """messages refused or repaired in the last call"""

    def screen(self, obs: Observation) -> Observation:
        """``obs`` without what must be refused; pulses that are no numbers keep their place, with
        range NaN. A bad IMU sample is replaced by the one before it, because filters count on one
        for every step."""
        events: list[str] = []
        imu = self._steady(obs.imu, events) if self._inertial else obs.imu
        scans = self._scans.screen(obs.scans, obs.tick, self._judge_scan, events)
        images = self._images.screen(obs.images, obs.tick, self._judge_image, events)
        self.events = tuple(events)
        arrived = len(obs.scans) + len(obs.images)
        self.refused = arrived - len(scans) - len(images) + self._repaired
        if imu is obs.imu and scans is obs.scans and images is obs.images:
            return obs
        return dataclasses.replace(obs, imu=imu, scans=scans, images=images)

    # ------------------------------------------------------------------------ inertial samples

    def _steady(self, samples: tuple[ImuSample, ...], events: list[str]) -> tuple[ImuSample, ...]:
        """The samples themselves, if all of them are numbers."""
        out: list[ImuSample] = []
        self._repaired = 0
        for sample in samples:
            # of six numbers one that is infinite or no number makes the sum so
            total = sample.angular_velocity.sum() + sample.specific_force.sum()
            if np.isfinite(total):
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
        """The scan to be used, or None, and a word on it ("" if there is none to say)."""
        count = len(scan.ranges)
        if scan.directions.shape != (count, 3) or not (
            len(scan.time_offsets) == len(scan.intensity) == count
        ):
            return None, "its arrays differ in length"
        if count == 0:
            return None, "no pulses"
        ranges = scan.ranges
        total = float(ranges.sum() + scan.directions.sum() + scan.time_offsets.sum())
        bad: NDArray[np.bool_] | None = None
        if not np.isfinite(total):
            bad = ~(
                np.isfinite(ranges)
                & np.isfinite(scan.directions).all(axis=1)
                & np.isfinite(scan.time_offsets)
            )
            if bad.all():
                return None, "not a number"
        if not (ranges > 0.0).any():
            # standing on the ground it looks at nothing in its reach
            return None, "no returns" if self._seeing else ""
        self._seeing = True
        floating = self._clutter(scan)
        if floating is not None:
            bad = floating if bad is None else bad | floating
            if np.count_nonzero(ranges[~bad] > 0.0) < _LEAST_RETURNS * count:
                return None, "nothing but echoes of rain or fog"
        if _equal(ranges, self._ranges):
            return None, "the same as the one before"
        self._ranges = ranges
        if bad is None:
            return scan, ""
        what = "not a number" if floating is None else "echoes of rain or fog"
        return _without_pulses(scan, bad), f"{int(bad.sum())} of {count} pulses {what}"

    def _clutter(self, scan: LidarScan) -> NDArray[np.bool_] | None:
        """(N,) returns of rain or fog, None while there is no sign of either."""
        shows, floating = clutter_of(scan)
        self._cluttered = self._cluttered + 1 if shows else 0
        if self._cluttered >= _CLUTTER_SCANS:
            self._clutter_until = scan.end_tick + self._clutter_ticks
        if scan.end_tick > self._clutter_until or not floating.any():
            return None
        return floating

    # ------------------------------------------------------------------------ images

    def _judge_image(self, image: CameraImage) -> tuple[CameraImage | None, str]:
        rgb = image.rgb
        if rgb.shape != self._shape or rgb.dtype != np.uint8:
            return None, f"{rgb.dtype} of shape {rgb.shape} instead of uint8 {self._shape}"
        pixels = some_pixels(rgb)
        if trouble := image_defect(pixels, self._pixels):
            return None, trouble
        self._pixels = pixels
        return image, ""


class _Stream:
    """Stamps and silences of one sensor. ``period_ticks`` 0: it may be silent."""

    def __init__(self, name: str, period_ticks: int, tick_hz: int) -> None:
        self._name = name
        self._tick_hz = tick_hz
        self._patience = round(_SILENCE_PERIODS * period_ticks)
        self._newest = -1
        """stamp of the newest message that was taken"""
        self._heard = -1
        """tick of the last delivery"""
        self._missed = False
        self._trouble = ""
        """what was wrong with the message before, without its numbers"""
        self._refused = 0
        """messages in a row"""

    def screen(
        self,
        messages: tuple[Message, ...],
        now: int,
        judge: Callable[[Message], tuple[Message | None, str]],
        events: list[str],
    ) -> tuple[Message, ...]:
        if not messages:
            self._listen(now, events)
            return messages
        if self._missed:
            silent_s = (now - self._heard) / self._tick_hz
            events.append(f"{self._name}s again after {silent_s:.2f} s")
        self._heard, self._missed = now, False
        disorder = _disordered([_ticks(message)[1] for message in messages])
        kept: list[Message] = []
        for message, confused in zip(messages, disorder, strict=True):
            taken: Message | None = None
            word = "out of order" if confused else self._stamp_fault(message, now)
            if not word:
                taken, word = judge(message)
            self._tell(_ticks(message)[1], taken is None, word, events)
            if taken is not None:
                self._newest = _ticks(message)[1]
                kept.append(taken)
        same = len(kept) == len(messages) and all(
            a is b for a, b in zip(kept, messages, strict=True)
        )
        return messages if same else tuple(kept)

    def _tell(self, tick: int, refused: bool, word: str, events: list[str]) -> None:
        """An event where trouble begins, changes or ends, not for every message that has it."""
        trouble = re.sub(r"\d+", "", word)
        if word and trouble != self._trouble:
            events.append(f"{self._name} {tick} {'refused' if refused else 'cleaned'}: {word}")
        if not refused and self._refused > 1:
            events.append(f"{self._name}s usable again after {self._refused} refused")
        self._trouble = trouble
        self._refused = self._refused + 1 if refused and word else 0

    def _listen(self, now: int, events: list[str]) -> None:
        silent = now - self._heard
        if self._patience and self._heard >= 0 and not self._missed and silent > self._patience:
            self._missed = True
            events.append(f"no {self._name} for {silent / self._tick_hz:.2f} s")

    def _stamp_fault(self, message: LidarScan | CameraImage, now: int) -> str:
        start, end = _ticks(message)
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


def _disordered(stamps: list[int]) -> list[bool]:
    """Which of messages that arrived together are not in the order of their stamps: of two that
    are swapped neither tells which is right."""
    return [
        max(stamps[:i], default=stamp) > stamp or min(stamps[i:]) < stamp
        for i, stamp in enumerate(stamps)
    ]


def clutter_of(scan: LidarScan) -> tuple[bool, NDArray[np.bool_]]:
    """Whether a scan shows rain or fog, and (N,) which returns are echoes of either if it is about.

    They are near and weak, and hang alone in the air: both pulses next to one in time come back
    from elsewhere or not at all. Intensity tells them as in Park, Kim and Kim, "Fast and accurate
    desnowing algorithm for LiDAR point clouds", IEEE Access 8, 2020. Where they are all that is
    near, weak ones need not be alone, as they no longer are in fog.
    """
    floating = np.zeros(len(scan.ranges), np.bool_)
    return _find_clutter(scan.ranges, scan.intensity, floating), floating


_RANGES = types.Array(types.float32, 1, "A", readonly=True)
_LEVELS = types.Array(types.uint8, 1, "A", readonly=True)


@njit([(_RANGES, _LEVELS, types.boolean[::1])], cache=True)
def _find_clutter(
    ranges: NDArray[np.float32], level: NDArray[np.uint8], floating: NDArray[np.bool_]
) -> bool:
    """`clutter_of`, into ``floating`` (N,), which must be false."""
    near = weak = lone_weak = 0
    for i in range(ranges.shape[0]):
        if not (0.0 < ranges[i] < _CLUTTER_M):
            continue
        near += 1
        faint = level[i] <= _CLUTTER_LEVEL
        weak += faint
        if level[i] > _LONE_LEVEL:
            continue
        before = i == 0 or abs(ranges[i] - ranges[i - 1]) > _LONE_GAP_M
        after = i == ranges.shape[0] - 1 or abs(ranges[i + 1] - ranges[i]) > _LONE_GAP_M
        floating[i] = before and after
        lone_weak += faint and floating[i]
    if lone_weak < _CLUTTER_LEAST or weak < _CLUTTER_SHARE * near:
        return False
    for i in range(ranges.shape[0]):
        floating[i] |= 0.0 < ranges[i] < _CLUTTER_M and level[i] <= _CLUTTER_LEVEL
    return True


@njit([(_RANGES, _RANGES)], cache=True)
def _equal(one: NDArray[np.float32], other: NDArray[np.float32]) -> bool:
    """Whether (N,) and (M,) are the same; a NaN is like another."""
    if one.shape[0] != other.shape[0]:
        return False
    for i in range(one.shape[0]):
        if one[i] != other[i] and not (np.isnan(one[i]) and np.isnan(other[i])):
            return False
    return True


def _without_pulses(scan: LidarScan, bad: NDArray[np.bool_]) -> LidarScan:
    """The scan with ``bad`` (N,) pulses of range NaN along the boresight. They keep their places,
    because neighbours in a scan are found by number."""
    directions, ranges = scan.directions.copy(), scan.ranges.copy()
    directions[bad], ranges[bad] = (0.0, 0.0, 1.0), np.nan
    offsets = np.maximum.accumulate(np.nan_to_num(scan.time_offsets, nan=0.0))
    return dataclasses.replace(scan, directions=directions, ranges=ranges, time_offsets=offsets)
