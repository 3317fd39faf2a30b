"""Observers of the main loop: events, phases, progress, the newest map; timers of its stages."""

import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any

from touchdown.estimator.api import GridMap
from touchdown.experiments.external.processes import release_pages
from touchdown.experiments.flight.conditions import ConditionsObserver
from touchdown.experiments.flight.intrusion import IntrusionObserver
from touchdown.experiments.flight.metrics import GroundMap
from touchdown.experiments.io.result_parts import Event, PhaseStart, StageTimes, Timing
from touchdown.experiments.recording.recorder import Recorder, StepRecord
from touchdown.landing.api import Decision
from touchdown.sim.api import SensorRig

Progress = Callable[[float, str, str], None]
"""Called with simulated seconds, phase and note."""

_MAX_EVENTS = 200
"""Events and phases that a result keeps."""
_PROGRESS_PERIOD_S = 0.5
_RELEASE_PERIOD_S = 5.0
"""Otherwise 40 MB lie free between what is in use at the end of a landing"""


class EventLog:
    """Messages of estimator and lander: the first ``_MAX_EVENTS`` in full, all of them counted."""

    def __init__(self) -> None:
        self.kept: list[Event] = []
        self.count = 0

    def add(self, time_s: float, texts: tuple[str, ...]) -> None:
        """Adds the messages of one control step."""
        for text in texts:
            self.count += 1
            if len(self.kept) < _MAX_EVENTS:
                self.kept.append(Event(time_s=time_s, text=text))


class StepObserver:
    """Passes every step on to the recorder, keeps events, phases and maps, reports progress, and
    has free memory given back."""

    def __init__(
        self,
        recorder: Recorder,
        progress: Progress | None,
        rig: SensorRig,
        roughness_length_m: float,
    ) -> None:
        self.events = EventLog()
        self.phases: list[PhaseStart] = []
        """beginnings of phases, the first ``_MAX_EVENTS``"""
        self.slowed_s = 0.0
        """time by which wind has made the lander's trajectories longer than they were set"""
        self.decisions: tuple[Decision, ...] = ()
        """decisions of the lander so far"""
        self.conditions = ConditionsObserver(roughness_length_m)
        self.intrusion = IntrusionObserver(rig)
        self._recorder, self._progress = recorder, progress
        self._phase = ""
        self._next_s = self._release_s = 0.0
        self._latest_map: GridMap | None = None
        self._survey_map: GroundMap | None = None

    def tick(self, step: StepRecord) -> None:
        """Takes one control step."""
        time_s, phase = step.truth.time_s, str(step.lander_view.phase)
        self.events.add(step.estimate.time_s, step.estimate.events)
        self.events.add(time_s, step.lander_view.events + step.command.events)
        self.slowed_s = step.lander_view.slowed_s
        self.decisions = step.lander_view.decisions
        if phase != self._phase and len(self.phases) < _MAX_EVENTS:
            self.phases.append(PhaseStart(time_s=time_s, phase=phase))
        self._phase = phase
        self.conditions.tick(step)
        self.intrusion.tick(step)
        self._latest_map = step.map_view.coarse
        if self._progress is not None and time_s >= self._next_s:
            self._next_s = time_s + _PROGRESS_PERIOD_S
            self._progress(time_s, phase, step.lander_view.note)
        self._recorder.tick(step)
        if time_s >= self._release_s:
            self._release_s = time_s + _RELEASE_PERIOD_S
            release_pages()

    def end_survey(self) -> None:
        """Keeps the ground of the map as it is now."""
        if self._latest_map is not None:
            self._survey_map = GroundMap.of(self._latest_map)

    def close(self) -> None:
        """Closes the recorder."""
        self._recorder.close()

    @property
    def judged_map(self) -> GroundMap:
        """The ground mapped at the end of the survey, or the newest where the survey did not end.
        Raises RuntimeError before the first step."""
        if self._survey_map is not None:
            return self._survey_map
        if self._latest_map is None:
            raise RuntimeError("judged_map before the first step")
        return GroundMap.of(self._latest_map)


class StageClock:
    """Accumulates wall time per stage. Constant memory."""

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)
        """by stage, so far"""
        self._started = time.perf_counter()

    def timing(self, sim_s: float) -> Timing:
        """The times since the start, inside and outside of stages, of ``sim_s`` simulated
        seconds; those of stages for each 0.1 s of them, which is one LIDAR scan."""
        wall_s, scans = time.perf_counter() - self._started, max(sim_s / 0.1, 1e-9)
        stages = {name: 1e3 * total / scans for name, total in sorted(self.seconds.items())}
        return Timing(
            wall_s=wall_s, sim_s=sim_s, real_time_factor=sim_s / wall_s,
            stage_ms=StageTimes(**stages),
        )  # fmt: skip


class Timed:
    """Proxy of a component that times the calls of one of its methods."""

    def __init__(self, target: Any, method: str, stage: str, clock: StageClock) -> None:
        call, self._target = getattr(target, method), target

        def timed(*args: Any) -> Any:
            started = time.perf_counter()
            try:
                return call(*args)
            finally:
                clock.seconds[stage] += time.perf_counter() - started

        setattr(self, method, timed)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._target, name)
