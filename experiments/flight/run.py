"""One flight from configuration to run directory."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from touchdown.experiments.config.loading import dump_config
from touchdown.experiments.config.schema import Config
from touchdown.experiments.config.settings import settings_of
from touchdown.experiments.errors import ExternalPartError, UsageError, input_message
from touchdown.experiments.flight.conditions import inactive_faults
from touchdown.experiments.flight.estimator_calibration import check_calibration
from touchdown.experiments.flight.loop import run_flight
from touchdown.experiments.flight.observers import Progress, StageClock, StepObserver, Timed
from touchdown.experiments.flight.platform import keep_bitcode, limit_threads, set_up_memory
from touchdown.experiments.flight.referee import Referee, TruthLookup
from touchdown.experiments.flight.result import make_result
from touchdown.experiments.flight.slots import check_parts_available
from touchdown.experiments.flight.survey_path import with_path
from touchdown.experiments.flight.wiring import (
    FlightStack,
    build_classifier,
    build_flight_stack,
    build_scene,
    check_autopilot,
    check_estimator_name,
)
from touchdown.experiments.io.results import RunResult
from touchdown.experiments.io.run_directory import SENSORS_FILE, check_out_dir, run_directory
from touchdown.experiments.recording.recorder import NullRecorder, Recorder
from touchdown.experiments.recording.run_recorder import RunRecorder
from touchdown.landing.api import LandingParams
from touchdown.scenes.api import SAFE_CLASSES, Scene

if TYPE_CHECKING:
    from touchdown.experiments.io.sensor_log import SensorLog

_TIMED = {"world": "step"} | dict.fromkeys(
    ("estimator", "mapper", "lander", "controller"), "update"
)
"""Parts under the clock, and the method that is timed."""


def fly(
    config: Config,
    out_dir: Path | None,
    progress: Progress | None = None,
    live: str | None = None,
) -> RunResult:
    """Flies one configuration and returns its result.

    With ``out_dir`` the run directory appears there at once, complete, when the flight is over;
    an earlier run of that name is replaced. ``live``, the address of a Rerun viewer, streams the
    recording there while it flies. Raises UsageError for bad input before anything is written.
    """
    check_estimator_name(config.estimator)
    check_parts_available(config)
    check_calibration(config)
    check_autopilot(config)
    build_classifier(config)
    if out_dir is not None:
        check_out_dir(out_dir)
    asked = {"settings_set": settings_of(config)}
    limit_threads()
    keep_bitcode()
    with set_up_memory():
        scene = build_scene(config)
        config = with_path(config, scene)
        if scene.options is not None:  # the scene of a file
            from touchdown.experiments.flight.survey_fit import fitted

            config = fitted(config, scene)
        stack = build_flight_stack(config, scene)
        stack.world.take_textures()
    _warn_of_inactive_faults(config, stack)
    if out_dir is None:
        result = fly_and_judge(config, stack, _only_live(config, stack, live), progress)
        return result.model_copy(update=asked)
    with run_directory(out_dir) as partial:
        if stack.autopilot is not None:
            failed = out_dir.with_name(f"{out_dir.name}.px4.log")
            stack.autopilot.keep_in(partial, failed)
        sensors = _sensor_log(partial, stack) if config.log.sensors else None
        recorder = RunRecorder(partial, scene, stack.world.rig, config, sensors, live)
        result = fly_and_judge(config, stack, recorder, progress).model_copy(update=asked)
        (partial / "config.json").write_text(dump_config(config), encoding="utf-8")
        (partial / "result.json").write_text(result.to_json(), encoding="utf-8")
    return result


def _only_live(config: Config, stack: FlightStack, live: str | None) -> Recorder:
    if live is None:
        return NullRecorder()
    from touchdown.experiments.recording.rerun_recorder import RerunLog

    return RerunLog(None, stack.scene, stack.world.rig, config, live)


def fly_with_usage_errors(
    config: Config, out_dir: Path | None, progress: Progress, live: str | None = None
) -> RunResult:
    """As `fly`. A ValueError or OSError before the first control step is bad input and becomes a
    UsageError; a later one is a defect of the program and passes through."""
    airborne = False

    def watch(time_s: float, phase: str, note: str) -> None:
        nonlocal airborne
        airborne = True
        progress(time_s, phase, note)

    try:
        return fly(config, out_dir, watch, live)
    except (ValueError, OSError) as error:
        if airborne or isinstance(error, ExternalPartError):
            raise
        raise UsageError(input_message(error)) from error


def _warn_of_inactive_faults(config: Config, stack: FlightStack) -> None:
    needs = stack.estimator.needs
    if config.mapper.enabled:
        needs = needs | stack.mapper.needs | stack.lander.needs
    if stack.autopilot is not None:
        needs = needs | stack.autopilot.needs
    for sentence in inactive_faults(config, needs):
        warnings.warn(sentence, stacklevel=3)


def _sensor_log(folder: Path, stack: FlightStack) -> SensorLog:
    from touchdown.experiments.io.sensor_log import SensorLog

    shared = stack.mapper.needs | stack.lander.needs
    return SensorLog(
        folder / SENSORS_FILE, stack.nominal_rig, stack.estimator.needs | shared, shared
    )


def fly_and_judge(
    config: Config, stack: FlightStack, recorder: Recorder, progress: Progress | None
) -> RunResult:
    """Flies ``stack`` to the end, closes it and returns the result."""
    clock = StageClock()
    observer = StepObserver(recorder, progress, stack.nominal_rig, config.wind.roughness_length_m)
    try:
        by_class = stack.network is not None and class_counts(config.landing)
        referee = make_referee(config, stack.scene, observer.end_survey, by_class=by_class)
        timed: dict[str, Any] = {
            name: Timed(getattr(stack, name), call, name, clock) for name, call in _TIMED.items()
        }
        judgement = run_flight(
            **timed,
            recorder=Timed(observer, "tick", "recorder", clock),  # type: ignore[arg-type]
            referee=Timed(referee, "judge", "referee", clock),  # type: ignore[arg-type]
        )
    finally:
        if stack.autopilot is not None:
            stack.autopilot.close()
        stack.world.close()
        observer.close()
    for part in stack.external:
        if sentence := part.slowness():
            warnings.warn(sentence, stacklevel=3)
    return make_result(config, stack, judgement, clock, observer)


def class_counts(params: LandingParams) -> bool:
    """True if a touchdown must be on ground of a safe class where the ground is classified; False
    for flights that land whatever the class."""
    unchecked_site = params.site_xy_m is not None and not params.check_site
    risky = params.allow_risky or not SAFE_CLASSES.issuperset(params.allowed_classes)
    return not (risky or params.emergency or unchecked_site)


def make_referee(
    config: Config, scene: Scene, on_survey_end: Callable[[], None], *, by_class: bool = False
) -> Referee:
    """Returns the referee of a flight of ``config`` over ``scene``; ``by_class``: the class of the
    ground counts as well as its geometry."""
    return Referee(
        config.referee,
        survey_only=config.landing.survey_only,
        steps_per_s=config.sim.tick_hz / config.sim.control_ticks,
        ground=TruthLookup(scene),
        on_survey_end=on_survey_end,
        by_class=by_class,
        carried=bool(config.survey.trajectory),
        commanded_xy_m=config.landing.site_xy_m,
    )
