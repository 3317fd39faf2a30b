"""One flight from configuration to run directory."""

from __future__ import annotations

import copy
import json
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from touchdown.estimator.api import GridMap
from touchdown.experiments.config.loading import dump_config
from touchdown.experiments.config.schema import Config
from touchdown.experiments.errors import input_message
from touchdown.experiments.flight.estimator_calibration import check_calibration
from touchdown.experiments.flight.inactive_faults import idle_faults
from touchdown.experiments.flight.loop import run_flight
from touchdown.experiments.flight.platform import limit_threads
from touchdown.experiments.flight.referee import Referee
from touchdown.experiments.flight.result import _result
from touchdown.experiments.flight.stage_timer import StageClock, Timed
from touchdown.experiments.flight.truth_lookup import TruthLookup
from touchdown.experiments.flight.wiring import (
    Flight,
    build_classifier,
    build_flight,
    build_scene,
    find_estimator,
)
from touchdown.experiments.io.provenance import plain_json
from touchdown.experiments.io.run_directory import check_out_dir, run_directory
from touchdown.experiments.recording.run_recorder import NullRecorder, Recorder, RunRecorder
from touchdown.landing.api import LandingParams
from touchdown.scenes.api import Scene

if TYPE_CHECKING:
    from touchdown.experiments.io.sensor_log import SensorLog

Progress = Callable[[float, str, str], None]
"""Called with simulated seconds, phase and note."""

_MOST_EVENTS = 200
"""of the estimator that a result keeps"""

_STAGES = (
    ("world", "step", "world"),
    ("estimator", "update", "estimator"),
    ("mapper", "update", "mapper"),
    ("lander", "update", "lander"),
    ("controller", "update", "controller"),
)


def fly(config: Config, out_dir: Path | None, progress: Progress | None = None) -> dict[str, Any]:
    """Flies one configuration and returns ``result.json`` as a dictionary.

    With ``out_dir`` the run directory appears there at once, complete, when the flight is over;
    an earlier run of that name is replaced. Raises UsageError for bad input before anything is
    written.
    """
    find_estimator(config.estimator)
    check_calibration(config)
    build_classifier(config)
    if out_dir is not None:
        check_out_dir(out_dir)
    limit_threads()
    scene = build_scene(config)
    flight = build_flight(config, scene)
    _warn_of_idle_faults(config, flight)
    if out_dir is None:
        return fly_and_judge(config, flight, NullRecorder(), progress)
    with run_directory(out_dir) as partial:
        sensors = _sensor_log(partial, flight) if config.log.sensors else None
        recorder = RunRecorder(partial, scene, flight.world.rig, config, sensors)
        result = fly_and_judge(config, flight, recorder, progress)
        (partial / "config.json").write_text(dump_config(config), encoding="utf-8")
        (partial / "result.json").write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    return result


def _warn_of_idle_faults(config: Config, flight: Flight) -> None:
    needs = flight.estimator.needs
    if config.mapper.enabled:
        needs = needs | flight.mapper.needs | flight.lander.needs
    for sentence in idle_faults(config, needs):
        warnings.warn(sentence, stacklevel=3)


def _sensor_log(folder: Path, flight: Flight) -> SensorLog:
    from touchdown.experiments.io.sensor_log import FILE_NAME, SensorLog

    shared = flight.mapper.needs | flight.lander.needs
    return SensorLog(
        folder / FILE_NAME, flight.believed_rig, flight.estimator.needs | shared, shared
    )


def fly_and_judge(
    config: Config, flight: Flight, recorder: Recorder, progress: Progress | None
) -> dict[str, Any]:
    """Flies ``flight`` to its end, closes it and returns ``result.json`` as a dictionary."""
    clock = StageClock()
    surveyed: list[GridMap] = []
    latest: list[GridMap] = []

    def keep_map() -> None:
        surveyed.extend(copy.deepcopy(grid) for grid in latest)

    by_class = flight.network is not None and class_counts(config.landing)
    referee = make_referee(config, flight.scene, keep_map, by_class=by_class)
    watched = _Watcher(recorder, latest, progress)
    parts = timed_parts(flight, clock)
    try:
        outcome = run_flight(
            **parts,
            recorder=Timed(watched, "tick", "recorder", clock),  # type: ignore[arg-type]
            referee=Timed(referee, "judge", "referee", clock),  # type: ignore[arg-type]
        )
    finally:
        flight.world.close()
        recorder.close()
    result = _result(config, flight, outcome, clock, surveyed or latest)
    told = {**watched.events.summary(), "phases": watched.phases.kept}
    return plain_json({**result, **told, "faults": flight.faults()})


def class_counts(params: LandingParams) -> bool:
    """Whether a touchdown must be on ground of a safe class where places are recognised: not where
    a flight is to land whatever the kind of place."""
    on_their_word = params.site_xy_m is not None and not params.check_site
    return not (params.allow_risky or params.emergency or on_their_word)


def make_referee(
    config: Config, scene: Scene, on_survey_end: Callable[[], None], *, by_class: bool = False
) -> Referee:
    """The judge of a flight of ``config`` over ``scene``; ``by_class``: the class of the ground
    counts as well as its geometry."""
    truth = TruthLookup(scene)
    return Referee(
        config.referee,
        survey_only=config.landing.survey_only,
        steps_per_s=config.sim.tick_hz / config.sim.control_ticks,
        judge_ground=truth.judge,
        moving_geoms=truth.moving_geoms,
        on_survey_end=on_survey_end,
        by_class=by_class,
    )


def timed_parts(flight: Flight, clock: StageClock) -> dict[str, Any]:
    """The parts of a flight as ``run_flight`` takes them, each under the clock."""
    return {name: Timed(getattr(flight, name), call, stage, clock) for name, call, stage in _STAGES}


class EventLog:
    """What the estimator had to tell; the first ``_MOST_EVENTS`` in full, all of them counted."""

    def __init__(self) -> None:
        self.kept: list[dict[str, Any]] = []
        self.count = 0

    def add(self, time_s: float, texts: tuple[str, ...]) -> None:
        for text in texts:
            self.count += 1
            if len(self.kept) < _MOST_EVENTS:
                self.kept.append({"time_s": time_s, "text": text})

    def summary(self) -> dict[str, Any]:
        return {"events": self.kept, "event_count": self.count}


class PhaseLog:
    """When each phase began; the first ``_MOST_EVENTS`` changes."""

    def __init__(self) -> None:
        self.kept: list[dict[str, Any]] = []
        self._phase = ""

    def add(self, time_s: float, phase: str) -> None:
        if phase != self._phase and len(self.kept) < _MOST_EVENTS:
            self.kept.append({"time_s": time_s, "phase": phase})
        self._phase = phase


class _Watcher:
    """Passes every tick on to the recorder, keeps the newest map at hand, reports progress."""

    def __init__(
        self, recorder: Recorder, latest: list[GridMap], progress: Progress | None
    ) -> None:
        self._recorder = recorder
        self._latest = latest
        self._progress = progress
        self._next_s = 0.0
        self.events = EventLog()
        self.phases = PhaseLog()

    def tick(self, *event: Any) -> None:
        truth, _obs, estimate, map_view, view = event[:5]
        self.events.add(estimate.time_s, estimate.events)
        self.phases.add(truth.time_s, str(view.phase))
        self._latest[:] = [map_view.coarse]
        if self._progress is not None and truth.time_s >= self._next_s:
            self._next_s = truth.time_s + 0.5
            self._progress(truth.time_s, str(view.phase), view.note)
        self._recorder.tick(*event)


def guarded_fly(config: Any, out: Path | None, progress: Callable[..., None]) -> dict[str, Any]:
    """Flies. What goes wrong before the first control step is bad input; after it, our fault."""
    from touchdown.experiments.errors import UsageError
    from touchdown.experiments.external.wrapper import ExternalEstimatorError

    airborne = False

    def watch(time_s: float, phase: str, note: str) -> None:
        nonlocal airborne
        airborne = True
        progress(time_s, phase, note)

    try:
        return fly(config, out, watch)
    except (ValueError, OSError) as error:
        if airborne or isinstance(error, ExternalEstimatorError):
            raise
        raise UsageError(input_message(error)) from error
