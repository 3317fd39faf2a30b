"""Replay: logged sensors through an estimator, without the simulator.

A replay is open loop: the trajectory is that of the logged flight, whatever the estimate.
"""

import dataclasses
import itertools
import shutil
import time
import warnings
from collections.abc import Container, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from touchdown.estimator.api import Estimate, Estimator, ImageThinning, spare_sensors
from touchdown.experiments.api import Outcome
from touchdown.experiments.config.files import check_named_code
from touchdown.experiments.config.loading import dump_config, is_key, load_config, read_values
from touchdown.experiments.config.schema import Config
from touchdown.experiments.config.settings import settings_of
from touchdown.experiments.config.slots import PREFIX, SLOTS
from touchdown.experiments.errors import UsageError, reason_of
from touchdown.experiments.external.loading import flown_code
from touchdown.experiments.flight.metrics import Consistency, PositioningError
from touchdown.experiments.flight.observers import EventLog, Progress, StageClock
from touchdown.experiments.io.provenance import git_revision, versions
from touchdown.experiments.io.results import RunResult, load_result
from touchdown.experiments.io.sensor_log_reader import SensorLogReader
from touchdown.experiments.io.tum import TumWriter, read_tum
from touchdown.sim.api import Observation, SensorNeeds
from touchdown.sim.faults.injector import FaultInjector
from touchdown.sim.faults.types import WORLD_KINDS
from touchdown.sim.files.opening import no_file
from touchdown.sim.frames import Pose, matrix_from_quat_wxyz

_LIFT_OFF_HEIGHT_M = 0.1
_FLOWN = (
    "profile", "preset", "harsh_effects", "light", "scene", "seed", "calibration", "record", "sim",
    "wind", "lidar", "camera", "lamp", "imu", "gps", "barometer", "magnetometer", "rangefinder",
    "faults", "dust", "mapper", "control", "survey", "landing", "calibration_error",
    "vehicle_error", "start", "referee",
)  # fmt: skip
"""Configuration keys of the flight, which a replay cannot change."""


@dataclass(frozen=True, slots=True)
class LoggedRun:
    """The content of a run directory that a replay reads."""

    path: Path
    sensors: SensorLogReader
    truth: Mapping[int, Pose]
    """``world_from_body`` by tick, at the rate of ``truth.tum``"""
    result: RunResult
    from_s: float
    """lift-off"""
    to_s: float
    """the end of the survey"""

    @property
    def ticks(self) -> Container[int]:
        """Ticks whose estimates are written."""
        return self.truth

    @property
    def truth_hz(self) -> float:
        """Rate of the true poses in Hz."""
        ticks = sorted(self.truth)
        span = ticks[-1] - ticks[0] if ticks else 0
        return self.sensors.rig.tick_hz * (len(ticks) - 1) / span if span else 0.0

    def begin(self, folder: Path) -> None:
        """Called with the directory of the replay, before it."""

    def passed(self, obs: Observation, estimate: Estimate) -> None:
        """Called after each observation."""

    def finish(self, folder: Path, result: RunResult) -> RunResult:
        """Writes the truth into the directory of the replay; returns the result to be written."""
        shutil.copy(self.path / "truth.tum", folder / "truth.tum")
        return result

    def judged(self, tick: int) -> bool:
        """True if positions at ``tick`` count: from lift-off to the end of the survey."""
        time_s = tick / self.sensors.rig.tick_hz
        # as in the referee: the step of the lift-off counts, that of the survey's end does not
        return self.from_s <= time_s < self.to_s


def open_run(run: Path) -> LoggedRun:
    """Opens a run directory that was flown with a sensor log. Raises UsageError."""
    for name in ("result.json", "truth.tum"):
        if reason := no_file(run / name):
            raise UsageError(f"'{run}' is no run directory: its {name} {reason}")
    from touchdown.experiments.io.run_directory import SENSORS_FILE

    sensors = SensorLogReader(run / SENSORS_FILE)
    result = load_result(run / "result.json")
    try:
        times, positions, quats = read_tum(run / "truth.tum")
    except OSError as error:
        raise UsageError(f"'{run}' cannot be read: {reason_of(error)}") from error
    if not len(times):
        raise UsageError(f"'{run}' cannot be replayed: its truth.tum is empty")
    ticks = np.rint(times * sensors.rig.tick_hz).astype(int).tolist()
    truth = {
        tick: Pose(matrix_from_quat_wxyz(quat), position)
        for tick, position, quat in zip(ticks, positions, quats, strict=True)
    }
    lift_off, survey_end = result.span_s or (None, None)
    if lift_off is None:
        above = positions[:, 2] > positions[0, 2] + _LIFT_OFF_HEIGHT_M
        lift_off = float(times[np.argmax(above)]) if above.any() else np.inf
    if survey_end is None:
        survey_end = np.inf
    return LoggedRun(run, sensors, truth, result, float(lift_off), float(survey_end))


def replay_config(
    run: Path,
    estimator: str | None = None,
    overrides: tuple[str, ...] = (),
    fresh: bool = False,
    *,
    allow_code: bool = False,
) -> Config:
    """The configuration of a run with another estimator or other parameters.

    ``fresh``: default parameters instead of the run's. Parameters that no longer exist are left
    out with a warning; those of an external estimator are left out when another replaces it.
    ``allow_code``: the run may name an external estimator. Raises UsageError for a key of the
    flight itself.
    """
    file = run / "config.json"
    if reason := no_file(file):
        raise UsageError(f"'{run}' is no run directory: its config.json {reason}")
    set_here = [text.partition("=")[0].strip() for text in overrides]
    for key in set_here:
        if key.partition(".")[0] in _FLOWN:
            raise UsageError(f"--set {key}: the flight is over; a replay changes estimators only")
    gone: list[str] = []
    same = estimator in (None, read_values(file).get("estimator"))
    others = {slot.key for slot in SLOTS.values() if slot.kind != "estimator"}

    def take(key: str) -> bool:
        if key in others or key.startswith(tuple(f"external.{kind}." for kind in SLOTS)):
            return same and key.startswith("external.estimator.")  # nothing else is replayed
        if key.partition(".")[0] in _FLOWN or key == "estimator":
            return True
        if not is_key(key):
            gone.append(key)
        return not fresh and is_key(key) and (same or not key.startswith(PREFIX))

    config = load_config(file, overrides, take, allow_code=True, estimator=estimator)
    if not allow_code and estimator is None and "estimator" not in set_here:
        check_named_code(file, [("estimator", config.estimator)])  # a scene of code is not made
    if gone and not fresh:
        warnings.warn(f"'{run}' has parameters that are gone: {', '.join(gone)}", stacklevel=2)
    return config


def check_needs(name: str, estimator: Estimator, reader: SensorLogReader) -> None:
    """Raises UsageError naming the sensors that the estimator needs and the log lacks, but for
    those that it can do without."""
    needs, spare = estimator.needs, spare_sensors(estimator)
    missing = [
        field.name
        for field in dataclasses.fields(needs)
        if field.name not in ("camera_hz", *spare)
        and getattr(needs, field.name)
        and not getattr(reader.sensed, field.name)
    ]
    if needs.camera_hz > reader.sensed.camera_hz:
        have = f"{reader.sensed.camera_hz} Hz" if reader.sensed.camera_hz else "none"
        missing.insert(0, f"images at {needs.camera_hz} Hz (it has {have})")
    if missing:
        raise UsageError(
            f"'{reader.path}' lacks what {name} needs: {', '.join(missing)}; {reader.remedy}"
        )


def seen_by(needs: SensorNeeds, reader: SensorLogReader) -> Iterator[Observation]:
    """The observations of the log, reduced to the sensors that a flight of an estimator with these
    ``needs`` simulates."""
    wanted = needs | reader.shared
    clock_hz = reader.rig.tick_hz // reader.rig.camera_ticks
    thinned = bool(wanted.camera_hz) and reader.sensed.camera_hz % wanted.camera_hz == 0
    thinning = ImageThinning(reader.rig, clock_hz // wanted.camera_hz if thinned else 0)
    dropped: dict[str, Any] = {
        ("scans" if field.name == "lidar" else field.name): ()
        for field in dataclasses.fields(wanted)
        if field.name not in ("camera_hz", "stereo") and not getattr(wanted, field.name)
    }
    keep = thinning.keeps if thinned else None
    for obs in reader.observations(bool(wanted.camera_hz), keep, wanted.stereo):
        yield dataclasses.replace(obs, **dropped)


class RememberedLog(SensorLogReader):
    """What an estimator with ``needs`` sees of a log before ``until_s``, in memory: for many
    replays of it. A minute of stereo pairs takes a gigabyte."""

    def __init__(self, reader: SensorLogReader, needs: SensorNeeds, until_s: float) -> None:
        self.path, self.rig = reader.path, reader.rig
        self.sensed, self.shared = reader.sensed, reader.shared
        seen = seen_by(needs, reader)
        self._seen = tuple(itertools.takewhile(lambda obs: obs.time_s < until_s, seen))

    def observations(self, *_chosen: Any) -> Iterator[Observation]:
        """The observations; what is not wanted has been left out."""
        return iter(self._seen)


def replay_faults(config: Config, events: tuple[str, ...], tick_hz: int) -> FaultInjector:
    """Injects ``events`` into a log beside what the flight went through. Raises UsageError for one
    that is not understood, or that acts where things are measured."""
    params = dataclasses.replace(config.faults, events=events)
    try:
        schedule = params.schedule()
    except ValueError as error:
        raise UsageError(str(error)) from error
    for fault in schedule:
        if fault.kind in WORLD_KINDS:
            raise UsageError(
                f"fault '{fault.text}' acts on what is measured, and the log is of the flight "
                "without it; fly with it"
            )
        if fault.mark:
            raise UsageError(f"fault '{fault.text}': a replay knows no phases, give seconds")
    return FaultInjector(params, tick_hz)


def with_faults(config: Config, events: tuple[str, ...]) -> Config:
    """``config`` with faults of a replay beside those of the flight."""
    faults = dataclasses.replace(config.faults, events=(*config.faults.events, *events))
    return config.model_copy(update={"faults": faults})


def replay(
    run: Path | LoggedRun,
    config: Config,
    out_dir: Path | None = None,
    progress: Progress | None = None,
    faults: tuple[str, ...] = (),
    until_s: float = np.inf,
) -> RunResult:
    """Replays ``run``, a directory or one opened, into the estimator of ``config`` (see
    `replay_config`); returns the result and, with ``out_dir``, writes a run directory. ``faults``:
    of the logged messages, such as ``lidar_dropout@20``. ``until_s``: end of the replay, if that is
    before the log's.

    Errors are judged at the rows of the run's ``truth.tum`` (``judged_hz``) between lift-off and
    the end of the survey. ``estimate.tum`` is the same to the byte in every replay; only
    ``timing`` differs. Raises UsageError before anything is written.
    """
    from touchdown.experiments.flight.platform import limit_threads
    from touchdown.experiments.flight.wiring import build_estimator
    from touchdown.experiments.io.run_directory import check_out_dir, run_directory

    logged = run if isinstance(run, LoggedRun) else open_run(run)
    run = logged.path
    if out_dir is not None:
        check_out_dir(out_dir)
        if out_dir.resolve() == run.resolve():
            raise UsageError(f"--out {out_dir} is the run that is replayed; name another directory")
    limit_threads()
    estimator = build_estimator(config, logged.sensors.rig)
    check_needs(config.estimator, estimator, logged.sensors)
    injector = replay_faults(config, faults, logged.sensors.rig.tick_hz)
    config = with_faults(config, faults)
    if out_dir is None:
        return _replay(logged, estimator, config, None, progress, injector, until_s)
    with run_directory(out_dir) as partial:
        logged.begin(partial)
        writer = TumWriter(partial / "estimate.tum")
        try:
            result = _replay(logged, estimator, config, writer, progress, injector, until_s)
        finally:
            writer.close()
        result = logged.finish(partial, result)
        (partial / "config.json").write_text(dump_config(config), encoding="utf-8")
        (partial / "result.json").write_text(result.to_json(), encoding="utf-8")
    return result


def _replay(
    logged: LoggedRun,
    estimator: Estimator,
    config: Config,
    writer: TumWriter | None,
    progress: Progress | None,
    injector: FaultInjector,
    until_s: float,
) -> RunResult:
    error, consistency = PositioningError(), Consistency()
    clock, events = StageClock(), EventLog()
    outcome, reason, last_s = Outcome.COMPLETED, "", 0.0
    observations = map(injector.apply, seen_by(estimator.needs, logged.sensors))
    for obs, estimate in _estimates(estimator, observations, clock, logged):
        if obs.time_s >= until_s:
            break
        events.add(estimate.time_s, estimate.events)
        logged.passed(obs, estimate)
        if obs.tick not in logged.ticks:
            continue
        true = logged.truth.get(obs.tick)
        estimated, last_s = estimate.world_from_body, obs.time_s
        if writer is not None:
            writer.add(estimate.time_s, estimated)
        if true is None:
            continue
        if logged.judged(obs.tick):
            error.add(estimated, true)
            covariance = estimate.position_covariance
            consistency.add(estimated.translation, true.translation, covariance)
        distance = float(np.linalg.norm(estimated.translation - true.translation))
        if not distance <= config.referee.divergence_m:
            outcome, reason = Outcome.DIVERGED, f"the estimate is {distance:.1f} m off"
            break
        if progress is not None:
            progress(obs.time_s, "REPLAY", "")
    if outcome is Outcome.COMPLETED and not np.isfinite(logged.from_s):
        outcome, reason = Outcome.GROUNDED, "the logged flight never took off"
    timing = clock.timing(last_s)
    code: dict[str, Any] = dict(flown_code(config.estimator))
    return RunResult(
        outcome=str(outcome),
        reason=reason,
        scene=config.scene,
        seed=config.seed,
        unit=logged.result.unit,
        estimator=config.estimator,
        **code,
        profile=config.profile,
        preset=config.preset,
        wind_kmh=config.wind.mean_kmh,
        settings_set=settings_of(config),
        replay_of=str(logged.path),
        flown_by=logged.result.estimator,
        judged_hz=logged.truth_hz,
        position_error_m=error.summary(),
        nees=consistency.summary(),
        landing=None,
        timing=timing,
        versions=versions(),
        git_revision=git_revision(),
        events=events.kept,
        event_count=events.count,
        faults=injector.summary(),
    )


def _estimates(
    estimator: Estimator, observations: Iterable[Observation], clock: StageClock, logged: LoggedRun
) -> Iterator[tuple[Observation, Estimate]]:
    """Yields each observation with the estimate after it; the clock gets the CPU time of all
    threads. Raises UsageError where an estimator cannot take what was logged: a log comes from
    elsewhere, and each of its values may be possible but not all together."""
    source, last_s = iter(observations), 0.0
    with np.errstate(all="ignore"):
        while True:
            try:
                if (obs := next(source, None)) is None:
                    return
                began = time.process_time()
                estimate = estimator.update(obs)
                clock.seconds["estimator"] += time.process_time() - began
            except UsageError:
                raise
            except (ValueError, TypeError, LookupError, ArithmeticError, cv2.error) as error:
                raise UsageError(
                    f"'{logged.sensors.path}' holds messages after {last_s:.3f} s that the "
                    f"estimator cannot use; {logged.sensors.remedy}"
                ) from error
            last_s = obs.time_s
            yield obs, estimate
