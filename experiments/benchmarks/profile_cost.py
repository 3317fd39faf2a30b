"""Cost of the loop in profile ``field`` over that in ``ideal``.

Both flights are flown in one process on one core, in turns of a LIDAR scan (0.1 s), so that they
meet the same state of the machine. Time is processor time of the process, in which the flight that
waits has no share; the first seconds, in which compiled code is loaded, do not count.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator, Mapping
from typing import Any

from touchdown.experiments.benchmarks.jit_warmup import compiled_before
from touchdown.experiments.config.schema import Config
from touchdown.experiments.flight.platform import limit_threads
from touchdown.experiments.flight.run import fly_and_judge
from touchdown.experiments.flight.wiring import build_flight_stack, build_scene
from touchdown.experiments.recording.run_recorder import NullRecorder
from touchdown.experiments.recording.step_record import StepRecord

WARM_UP_S = 3.0
TURN_S = 0.1


class _Turns:
    """Lets one of several threads work at a time, in turn."""

    def __init__(self, names: list[str]) -> None:
        self._turn = threading.Condition()
        self._left, self._now = list(names), names[0]

    def wait(self, name: str) -> None:
        with self._turn:
            self._turn.wait_for(lambda: self._now == name)

    def hand_over(self, name: str) -> None:
        with self._turn:
            place = self._left.index(name)
            self._now = self._left[(place + 1) % len(self._left)]
            self._turn.notify_all()

    @contextlib.contextmanager
    def member(self, name: str) -> Iterator[None]:
        """Waits for the first turn; in the end leaves the turns to the others."""
        self.wait(name)
        try:
            yield
        finally:
            with self._turn:
                place = self._left.index(name)
                self._left.remove(name)
                if self._left:
                    self._now = self._left[place % len(self._left)]
                self._turn.notify_all()


class _Clocked(NullRecorder):
    """Sums the processor time of a flight, and hands over after every turn."""

    def __init__(self, name: str, turns: _Turns) -> None:
        self._name, self._turns = name, turns
        self._until_s, self._started = TURN_S, time.process_time()
        self.spent_s, self.flown_s = 0.0, 0.0

    def tick(self, step: StepRecord) -> None:
        now_s = step.truth.time_s
        if now_s < self._until_s:
            return
        if now_s >= WARM_UP_S:
            self.spent_s += time.process_time() - self._started
            self.flown_s += TURN_S
        self._until_s += TURN_S
        self._turns.hand_over(self._name)
        self._turns.wait(self._name)
        self._started = time.process_time()


def measure_profile_cost(configs: Mapping[str, Config]) -> dict[str, Any]:
    """Flies the configurations ``field`` and ``ideal`` in turns. Returns ``ms``, the processor time
    of each for 0.1 s of flight, and ``ratio``, that of ``field`` over that of ``ideal``."""
    return compiled_before(lambda: _measure(configs))


def _measure(configs: Mapping[str, Config]) -> dict[str, Any]:
    limit_threads()
    turns = _Turns(list(configs))
    found: dict[str, float] = {}
    failures: list[BaseException] = []

    def fly(name: str) -> None:
        try:
            with turns.member(name):
                # here, since OpenGL binds a context to the thread that makes it
                stack = build_flight_stack(configs[name], build_scene(configs[name]))
                clocked = _Clocked(name, turns)
                fly_and_judge(configs[name], stack, clocked, None)
                found[name] = 1e3 * TURN_S * clocked.spent_s / max(clocked.flown_s, TURN_S)
        except BaseException as error:
            failures.append(error)

    threads = [threading.Thread(target=fly, args=(name,)) for name in configs]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if failures:
        raise failures[0]
    return {"ms": found, "ratio": found["field"] / found["ideal"]}
