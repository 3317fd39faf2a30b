"""Delayed delivery: a measurement arrives at a tick that is fixed when it is taken.

The work that turns a snapshot of the world into a measurement may run in another thread meanwhile.
The tick at which its result arrives is fixed when it is submitted, and whoever collects at that
tick waits for the result if need be, so thread timing cannot change what a flight sees.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Generic, ParamSpec, TypeVar
from zlib import crc32

import numpy as np

from touchdown.sim.api import SimParams

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
    since an OpenGL context belongs to one thread). Raises ValueError for other numbers."""
    if threads == 1:
        return InlineExecutor()
    if threads == 2:
        return ThreadPoolExecutor(max_workers=1, thread_name_prefix="sensor")
    raise ValueError(f"sim.threads must be 1 or 2, not {threads}")


@dataclass(frozen=True, slots=True)
class InFlight(Generic[T]):
    """A measurement in transit."""

    due_tick: int
    result: Future[T]


class Latency:
    """Ticks at which the messages of one sensor arrive.

    The time from measurement to arrival is log-normal, with the median
    ``sim.compute_latency_ticks`` and the standard deviation ``sim.latency_sigma`` of its logarithm;
    it ends at a control tick, and no message arrives before an older one of the same sensor. It is
    a function of the seed, the sensor's ``name`` and the messages before. With a spread of 0 it is
    the median, to the tick.
    """

    def __init__(self, sim: SimParams, seed: int, name: bytes) -> None:
        self._median, self._sigma = sim.compute_latency_ticks, sim.latency_sigma
        self._step = sim.control_ticks
        self._key = [seed, crc32(b"latency of " + name)]
        self.restart()

    def restart(self) -> None:
        """Returns to the first message of a flight."""
        self._draw = np.random.default_rng(self._key).standard_normal
        self._last = 0

    def due(self, tick: int) -> int:
        """Tick of arrival of what was measured at ``tick``: call it once a message, in order."""
        if self._sigma <= 0.0:
            return tick + self._median
        latency = self._median * float(np.exp(self._sigma * self._draw()))
        arrival = self._step * int(np.ceil((tick + latency) / self._step))
        self._last = max(self._last, arrival)
        return self._last


class DeliveryQueue(Generic[T]):
    """First in, first out; due ticks never decrease."""

    def __init__(self, executor: Executor) -> None:
        self._executor = executor
        self._waiting: deque[InFlight[T]] = deque()

    def submit(self, due_tick: int, fn: Callable[..., T], *args: Any) -> None:
        """``fn(*args)`` starts now and its result arrives at ``due_tick``. ``args`` must not be
        written to afterwards. ValueError: something already queued is due later."""
        if self._waiting and due_tick < self._waiting[-1].due_tick:
            raise ValueError(
                f"due tick {due_tick} lies before {self._waiting[-1].due_tick}, already queued"
            )
        self._waiting.append(InFlight(due_tick, self._executor.submit(fn, *args)))

    def collect(self, tick: int) -> tuple[T, ...]:
        """Everything due at or before ``tick``, oldest first; waits for work that is not done. An
        exception of the work is raised here."""
        arrived = []
        while self._waiting and self._waiting[0].due_tick <= tick:
            arrived.append(self._waiting.popleft().result.result())
        return tuple(arrived)

    def clear(self) -> None:
        """Drops everything in transit, after waiting for work that already runs."""
        for item in self._waiting:
            if not item.result.cancel():
                item.result.exception()
        self._waiting.clear()
