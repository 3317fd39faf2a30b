"""Timers of the stages of the main loop."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any


class StageClock:
    """Accumulates time per stage; ``now`` is the clock, wall time by default. Constant memory."""

    def __init__(self, now: Callable[[], float] = time.perf_counter) -> None:
        self.now = now
        self.restart()

    def restart(self) -> None:
        """Resets all timers."""
        self._seconds: defaultdict[str, float] = defaultdict(float)
        self._started = self.now()

    def add(self, stage: str, seconds: float) -> None:
        self._seconds[stage] += seconds

    def wall_s(self) -> float:
        """Time since the start, inside and outside of stages."""
        return self.now() - self._started

    def stage_ms(self, sim_s: float) -> dict[str, float]:
        """Milliseconds of wall time per 0.1 s of simulated time (one LIDAR scan), by stage."""
        scans = max(sim_s / 0.1, 1e-9)
        return {name: 1e3 * total / scans for name, total in sorted(self._seconds.items())}


class Timed:
    """Proxy of a component that times the calls of one of its methods."""

    def __init__(self, target: Any, method: str, stage: str, clock: StageClock) -> None:
        self._target = target
        setattr(self, method, _timed(getattr(target, method), stage, clock))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._target, name)


def _timed(call: Callable[..., Any], stage: str, clock: StageClock) -> Callable[..., Any]:
    def timed(*args: Any) -> Any:
        started = clock.now()
        try:
            return call(*args)
        finally:
            clock.add(stage, clock.now() - started)

    return timed
