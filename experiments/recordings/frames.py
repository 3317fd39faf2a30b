"""Frames of a recording in the order of their times, and what the first of them show."""

from collections.abc import Callable, Iterator

import numpy as np

from touchdown.experiments.errors import UsageError
from touchdown.experiments.recordings.clock import BEFORE_IMAGES_S, ImuGrid, even_grid
from touchdown.experiments.recordings.contract import (
    ImuTable,
    RawFrame,
    RawImage,
    RawScan,
    Recording,
    RigParts,
    Span,
)
from touchdown.experiments.recordings.registration import moved_by_twist, registered
from touchdown.sim.api import GRAVITY_MPS2
from touchdown.sim.frames import so3_log
from touchdown.sim.typing import Array

PAIR_S = 0.005
"""largest difference of the stamps of a pair"""
_ORDER_S = 0.5
"""by which a frame may come too late in the recording, and is still put in its place"""
_AHEAD = 3
"""frames after that time that must have been read: the stamp of one alone may be wrong"""


class Waiting:
    """Frames in the order of their times, read a little ahead."""

    def __init__(self, frames: Iterator[RawFrame], time_of: Callable[[RawFrame], float]) -> None:
        self._frames, self._time_of = frames, time_of
        self._held: list[tuple[float, bool, RawFrame]] = []
        self._rights: list[RawImage] = []
        self._ended = False

    @property
    def empty(self) -> bool:
        """True once all frames have been handed out."""
        return self._ended and not self._held

    def until(self, time_s: float) -> list[RawFrame]:
        """Frames up to ``time_s``, of one instant the scan first."""
        ahead = sum(at > time_s + _ORDER_S for at, *_ in self._held)
        while not self._ended and ahead < _AHEAD:
            frame = next(self._frames, None)
            if frame is None:
                self._ended = True
                break
            at = self._time_of(frame)
            ahead += at > time_s + _ORDER_S
            if isinstance(frame, RawImage) and frame.right:
                self._rights.append(frame)
            else:
                self._held.append((at, isinstance(frame, RawImage), frame))
        self._held.sort(key=lambda one: one[:2])
        due = [frame for at, _, frame in self._held if at <= time_s]
        self._held = self._held[len(due) :]
        return due

    def twin(self, left: RawImage) -> RawImage | None:
        """The image of the right camera at the instant of the left one."""
        at = self._time_of(left)
        self._rights = [one for one in self._rights if self._time_of(one) > at - _ORDER_S]
        return twin_of(left, self._rights)


def twin_of(left: RawImage, rights: list[RawImage]) -> RawImage | None:
    near = min(rights, key=lambda one: abs(one.stamp_ns - left.stamp_ns), default=None)
    if near is None or abs(near.stamp_ns - left.stamp_ns) > PAIR_S * 1e9:
        return None
    return near


def period_s(frames: list[RawFrame], kind: str) -> float:
    """Median time between frames of a kind; 0: there are none."""
    stamps = [
        one.stamp_ns for one in frames
        if isinstance(one, RawScan) == (kind == "scan")
        and not (isinstance(one, RawImage) and one.right)
    ]  # fmt: skip
    if len(stamps) < 2:
        return 0.1 * len(stamps)
    return float(np.median(np.abs(np.diff(stamps)))) * 1e-9 or 0.1


def constant_velocity(recording: Recording, span: Span, peeked: list[RawFrame]) -> ImuGrid:
    """What an IMU that never accelerates measures, from the first frame to the last."""
    first = min(one.stamp_ns for one in peeked)
    last = max(one.stamp_ns for one in recording.frames(span))
    step_ns = round(BEFORE_IMAGES_S * 1e9)
    count = (last - first) // step_ns + 3
    if count * BEFORE_IMAGES_S > 86_400.0:
        raise UsageError(f"'{recording.path}' spans more than a day")
    still: Array = np.zeros((count, 3))
    table = ImuTable(
        stamps_ns=first + step_ns * np.arange(count, dtype=np.int64), gyro=still,
        force=still + [0.0, 0.0, GRAVITY_MPS2],
    )  # fmt: skip
    return even_grid(table)


def first_velocity(frames: list[RawFrame], parts: RigParts) -> Array | None:
    """(3,) m/s of the body in its own frame, from the first two scans; None without."""
    first, second, *_ = [*(one for one in frames if isinstance(one, RawScan)), None, None]
    if first is None or second is None or parts.body_from_lidar is None:
        return None
    apart_s = (second.stamp_ns - first.stamp_ns) * 1e-9
    moved = registered(first.points, second.points)
    for _ in range(2 if first.offsets_s.any() else 0):  # while they turned, sweeps were skewed
        if moved is None:
            break
        twist = np.concatenate([so3_log(moved.rotation), moved.translation]) / apart_s
        still = [moved_by_twist(one.points.astype(np.float64), one.offsets_s.astype(np.float64),
                                twist) for one in (first, second)]  # fmt: skip
        moved = registered(still[0], still[1], moved)
    if moved is None:
        return None
    mount = parts.body_from_lidar
    body = mount @ moved @ mount.inverse()
    return body.translation / apart_s
