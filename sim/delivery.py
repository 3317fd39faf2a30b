"""Rates, the camera's clock, and delayed delivery: a measurement arrives at a tick that is fixed
when it is taken.

The work that turns a snapshot of the world into a measurement may run in another thread meanwhile.
The tick at which its result arrives is fixed when it is submitted, and whoever collects at that
tick waits for the result if need be, so thread timing cannot change what a flight sees.
"""

import math
from collections import deque
from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, ParamSpec, TypeVar
from zlib import crc32

import numpy as np

from touchdown.sim.api import CameraParams, SensorNeeds, SimParams, divisors

T = TypeVar("T")
P = ParamSpec("P")


class InlineExecutor(Executor):
    """Runs everything at once in the caller's thread."""

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        future: Future[T] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:  # handed over by Future.result, as from a thread
            future.set_exception(error)
        return future


def make_executor(threads: int) -> Executor:
    """An executor: ``threads`` 1 runs work in the caller's thread, 2 in one worker thread (one,
    since an OpenGL context belongs to one thread)."""
    if threads == 1:
        return InlineExecutor()
    return ThreadPoolExecutor(max_workers=1, thread_name_prefix="sensor")


LONGEST_WAIT_S = 0.2
"""for a busy computer, beyond which a message is dropped: two scans; assumed"""


@dataclass(slots=True)
class Computer:
    """A computer that takes the messages of all sensors one by one, in the order of their coming.
    ``free``: tick from which it is idle."""

    free: float = 0.0

    def finish(self, tick: int, work_ticks: float, longest_wait_ticks: float) -> float | None:
        """Tick at which the work on a message of ``tick`` is done; None where it would wait too
        long."""
        start = max(float(tick), self.free)
        if start - tick > longest_wait_ticks:
            return None
        self.free = start + work_ticks
        return self.free


class Latency:
    """Ticks at which the messages of one sensor arrive.

    The time from measurement to arrival is log-normal, with the median
    ``sim.compute_latency_ticks`` and the standard deviation ``sim.latency_sigma`` of its logarithm;
    it ends at a control tick, and no message arrives before an older one of the same sensor. It is
    a function of the seed, the sensor's ``name`` and the messages before. With a spread of 0 it is
    the median, to the tick. With a ``computer`` this is the time of its work, before which a
    message waits for those of all sensors that came earlier.
    """

    def __init__(
        self, sim: SimParams, seed: int, name: bytes, computer: Computer | None = None
    ) -> None:
        self._median, self._sigma = sim.compute_latency_ticks, sim.latency_sigma
        self._step = sim.control_ticks
        self._key = [seed, crc32(b"latency of " + name)]
        self._computer, self._longest_wait = computer, LONGEST_WAIT_S * sim.tick_hz
        self.restart()

    def restart(self) -> None:
        """Returns to the first message of a flight."""
        self._draw = np.random.default_rng(self._key).standard_normal
        self._last = 0

    def due(self, tick: int) -> int | None:
        """Tick of arrival of what was measured at ``tick``: call it once a message, in order. None:
        the computer is too busy, and the message is lost."""
        if self._sigma <= 0.0 and self._computer is None:
            return tick + self._median
        work = self._median * float(np.exp(self._sigma * self._draw()))
        done: float | None = tick + work
        if self._computer is not None:
            done = self._computer.finish(tick, work, self._longest_wait)
        if done is None:
            return None
        arrival = self._step * int(np.ceil(done / self._step))
        self._last = max(self._last, arrival)
        return self._last


class DeliveryQueue(Generic[T]):
    """First in, first out; due ticks never decrease."""

    def __init__(self, executor: Executor) -> None:
        self._executor = executor
        self._waiting: deque[tuple[int, Future[T]]] = deque()
        """ticks of arrival, and results"""

    def submit(self, due_tick: int, fn: Callable[..., T], *args: Any) -> None:
        """``fn(*args)`` starts now and its result arrives at ``due_tick``. ``args`` must not be
        written to afterwards. ValueError: something already queued is due later."""
        if self._waiting and due_tick < self._waiting[-1][0]:
            raise ValueError(
                f"due tick {due_tick} lies before {self._waiting[-1][0]}, already queued"
            )
        self._waiting.append((due_tick, self._executor.submit(fn, *args)))

    def collect(self, tick: int) -> tuple[T, ...]:
        """Everything due at or before ``tick``, oldest first; waits for work that is not done. An
        exception of the work is raised here."""
        arrived = []
        while self._waiting and self._waiting[0][0] <= tick:
            arrived.append(self._waiting.popleft()[1].result())
        return tuple(arrived)

    def clear(self) -> None:
        """Drops everything in transit, after waiting for work that already runs."""
        for _, result in self._waiting:
            if not result.cancel():
                result.exception()
        self._waiting.clear()


MIN_TICK_HZ = 500
"""The feet are 30 ms stiff; slower physics would not resolve a touchdown."""


def check_rates(sim: SimParams, needs: SensorNeeds) -> None:
    """Raises ValueError, with the allowed values, unless every rate divides ``tick_hz`` and the
    needed camera rate divides the camera's own clock."""
    if sim.tick_hz < MIN_TICK_HZ:
        raise ValueError(f"sim.tick_hz must be {MIN_TICK_HZ} or more, not {sim.tick_hz}")
    for name in ("control_ticks", "imu_ticks", "camera_ticks", "lidar_scan_ticks"):
        ticks = getattr(sim, name)
        if ticks < 1 or sim.tick_hz % ticks:
            raise ValueError(
                f"sim.{name} is {ticks}, but it must divide sim.tick_hz ({sim.tick_hz}): "
                f"one of {divisors(sim.tick_hz)}"
            )
    needs.check_camera_rate(sim.tick_hz // sim.camera_ticks)


def readout_ticks(readout_s: float, sim: SimParams) -> int:
    """Ticks between the first and the last row of a rolling shutter; 0 for a global one.

    Raises ValueError if the readout would last into the next exposure.
    """
    ticks = round(readout_s * sim.tick_hz)
    if ticks >= sim.camera_ticks:
        raise ValueError(
            f"camera.readout_s is {readout_s:g}, but the camera's clock beats every "
            f"{sim.camera_ticks / sim.tick_hz:.4g} s: give less"
        )
    return ticks


class Stamp(NamedTuple):
    """A time in seconds and the tick nearest to it."""

    tick: int
    time_s: float


class ShutterClock:
    """Ticks of a camera. A pulse is the middle of the last row's exposure, on a whole tick.

    phase_ticks: of the pulses after those of the LIDAR's clock. before_ticks: from the tick that is
    drawn to the pulse. after_ticks: from the pulse to the end of its exposure. span_ticks: from the
    beginning of the first row's exposure to the end of the last.
    """

    def __init__(self, params: CameraParams, sim: SimParams, seed: int, takes_time: bool) -> None:
        self._params, self._hz, self._seed = params, sim.tick_hz, seed
        readout = readout_ticks(params.readout_s, sim)
        longest = max(params.exposure_max_s, params.exposure_min_s) if takes_time else 0.0
        self.after_ticks = math.ceil(0.5 * longest * sim.tick_hz)
        self.before_ticks = readout // 2
        self.span_ticks = math.ceil(params.readout_s * sim.tick_hz) + 2 * self.after_ticks
        maximum = round(params.phase_s * sim.tick_hz)
        if maximum >= sim.camera_ticks:
            raise ValueError(
                f"camera.phase_s is {params.phase_s:g}, but the camera's clock beats every "
                f"{sim.camera_ticks / sim.tick_hz:.4g} s: give less"
            )
        draw = np.random.default_rng([seed, crc32(b"camera clock")])
        self.phase_ticks = int(draw.integers(0, maximum + 1)) if maximum else 0

    def stamp(self, pulse: int) -> Stamp:
        """The stamp of the image of a pulse."""
        p = self._params
        if p.stamp_delay_s == 0.0 and p.stamp_jitter_s == 0.0:
            return Stamp(pulse, pulse / self._hz)
        error = p.stamp_delay_s
        if p.stamp_jitter_s > 0.0:
            draw = np.random.default_rng([self._seed, crc32(b"camera stamps"), pulse])
            error += p.stamp_jitter_s * float(draw.standard_normal())
        time_s = max(pulse / self._hz + error, 0.0)
        return Stamp(round(time_s * self._hz), time_s)
