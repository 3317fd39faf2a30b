"""A recording through an estimator: opened by its format, replayed as a log of a flight is, and
judged against its truth."""

import dataclasses
from collections.abc import Container, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from touchdown.estimator.api import Estimate
from touchdown.experiments.config.loading import load_config
from touchdown.experiments.config.schema import Config
from touchdown.experiments.errors import UsageError, reason_of
from touchdown.experiments.flight.metrics import PositioningError
from touchdown.experiments.flight.observers import Progress
from touchdown.experiments.flight.replay import LoggedRun, replay
from touchdown.experiments.io.result_parts import Event, PositionError
from touchdown.experiments.io.results import RunResult
from touchdown.experiments.io.run_directory import SENSORS_FILE
from touchdown.experiments.io.sensor_log import SensorLog
from touchdown.experiments.io.tum import TumWriter, read_tum
from touchdown.experiments.io.untrusted import as_plain_name
from touchdown.experiments.recordings.bags import RosBag
from touchdown.experiments.recordings.clock import poses_of, truth_at_ticks
from touchdown.experiments.recordings.compose import ComposedLog
from touchdown.experiments.recordings.contract import (
    PoseTable,
    RawScan,
    Recording,
    RigParts,
    Span,
)
from touchdown.experiments.recordings.folders import EurocFolder, KittiFolder
from touchdown.experiments.recordings.landing_site import LandingSite
from touchdown.experiments.recordings.px4_logs import Px4Log
from touchdown.experiments.recordings.registration import registered_path
from touchdown.experiments.recordings.rig_files import read_rig
from touchdown.sim.api import Observation, SimParams
from touchdown.sim.frames import Pose, matrix_from_quat_wxyz
from touchdown.sim.typing import Array

_ALIGNED = {
    "origin": "the truth is moved so that its first pose is that of the estimate (evo: "
    "--align_origin)",
    "none": "the truth is as it is",
    "se3": "the truth is moved so that all positions fit best, rigidly (evo: --align)",
}
_ROWS_HZ = 50
_DAY_S = 86_400.0
REGISTRATION = Path("registration")
"""asks for a truth by the registration of the scans with one another"""
_WITHOUT_SCANS = ("gps", "optical_flow", "hybrid_flow", "stereo")
"""estimators that no scan reaches"""
_SEES = ("livo", "zou2024", "optical_flow", "hybrid_flow", "stereo_vo")
"""tables of the configuration with a rate of images"""
_CLOCK = "calibration_clock_ms"
"""diagnostic of an estimator"""
RECORDED = "recorded"
"""stands for the estimator that flew"""


@dataclasses.dataclass(frozen=True, kw_only=True, slots=True)
class ReplayOptions:
    """What a replay of a recording is asked for beside DATA."""

    estimator: str | None = None
    rig: Path | None = None
    truth: Path | None = None
    """TUM file, times on the clock of the recording; or `REGISTRATION`"""
    align: str = "origin"
    """how truth and estimate are brought together: by the first pose, or over all positions"""
    moving: bool = False
    """the recording begins in motion"""
    from_s: float = 0.0
    until_s: float = np.inf
    """frames of this span are replayed, seconds after the first of all"""
    overrides: tuple[str, ...] = ()
    log_sensors: bool = False


def open_recording(path: Path, parts: RigParts) -> Recording:
    """The recording at ``path``, by its layout; ``parts``: what a rig file says. Raises
    UsageError."""
    if not path.exists():
        raise UsageError(f"'{path}' does not exist")
    if Px4Log.holds(path):
        return Px4Log(path)
    if RosBag.holds(path):
        return RosBag(path, parts)
    if path.is_dir() and EurocFolder.holds(path):
        return EurocFolder(path)
    if path.is_dir() and KittiFolder.holds(path):
        return KittiFolder(path)
    if (path / SENSORS_FILE).is_file():
        raise UsageError(f"'{path}' is a run: `touchdown fly --replay {path}` replays it")
    raise UsageError(
        f"'{path}' is no recording: no bag (.bag, or a folder with metadata.yaml), no log of PX4 "
        "(.ulg), no folder of EuRoC (mav0/) and none of KITTI odometry (calib.txt, velodyne/)"
    )


def replay_recording(
    data: Path, out_dir: Path | None, options: ReplayOptions, progress: Progress | None = None
) -> RunResult:
    """Replays the recording ``data``; with ``out_dir``, writes a run directory. The events of the
    result begin with what was done to the data. Raises UsageError, one line."""
    run = open_run(data, options)
    config = _config(data, options, run.log)
    if out_dir is not None and run.log.sensed.lidar and config.estimator not in _WITHOUT_SCANS:
        run.maps.append(LandingSite(run.log.rig, config.mapper, config.landing))
    return replay(run, config, out_dir, progress)


def open_run(data: Path, options: ReplayOptions) -> "RecordedRun":
    """A recording as `replay` takes it. Raises UsageError."""
    given = read_rig(options.rig) if options.rig is not None else RigParts()
    recording = open_recording(data, given)
    parts = recording.found.with_more(given)
    if options.moving:
        parts = dataclasses.replace(parts, moving=True)
    begins = recording.begins_ns()
    span = Span(*(
        round(begins + 1e9 * min(at, _DAY_S)) for at in (options.from_s, options.until_s)
    ))  # fmt: skip
    if options.truth == REGISTRATION:
        truth: PoseTable | None = _registered(recording, parts, span)
    else:
        truth = recording.truth() if options.truth is None else _tum(options.truth)
    log = ComposedLog(
        recording, parts, span, None if truth is None else int(truth.stamps_ns[0]),
        pair_as_scan=options.estimator not in _WITHOUT_SCANS,
    )  # fmt: skip
    result = RunResult(outcome="COMPLETED", scene=_name(data), seed=0, estimator=RECORDED)
    return RecordedRun(
        data, log, _truth(log, truth, options.align), result, 0.0, np.inf, options, log
    )


def _name(data: Path) -> str:
    return as_plain_name(data.resolve().name)


def _config(data: Path, options: ReplayOptions, log: ComposedLog) -> Config:
    """The configuration, with the clock of the recording's camera: an estimator that wants images
    at a rate that does not divide it gets the next lower one that does."""
    clock_hz, given = log.rig.tick_hz // log.rig.camera_ticks, []
    ticks = SimParams().tick_hz
    if (
        log.sensed.camera_hz
        and ticks % clock_hz == 0
        and clock_hz != ticks // SimParams().camera_ticks
    ):
        given.append(f"sim.camera_ticks={ticks // clock_hz}")
        usual = load_config(None, [o for o in options.overrides if ".camera_hz" not in o])
        for key in _SEES:
            hz = getattr(usual, key).camera_hz
            fits = max(one for one in range(1, hz + 1) if clock_hz % one == 0)
            given += [] if fits == hz else [f"{key}.camera_hz={fits}"]
    return load_config(
        None, (*given, *options.overrides), scene=_name(data), estimator=options.estimator, seed=0
    )


def _registered(recording: Recording, parts: RigParts, span: Span) -> PoseTable:
    scans = (one for one in recording.frames(span) if isinstance(one, RawScan))
    mount = parts.whole.body_from_lidar if parts.whole else parts.body_from_lidar
    try:
        found = registered_path(scans, mount or Pose.identity())
    except ValueError as error:
        raise UsageError(f"'{recording.path}': {error}; --from and --until choose scans") from error
    late_ns = round(1e9 * parts.lidar_offset_s)
    return dataclasses.replace(found, stamps_ns=found.stamps_ns + late_ns)


def _tum(file: Path) -> PoseTable:
    try:
        times, positions, quats = read_tum(file)
    except OSError as error:
        raise UsageError(f"'{file}' cannot be read: {reason_of(error)}") from error
    if len(times) < 2:
        raise UsageError(f"'{file}' has fewer than two poses")
    return poses_of(np.rint(times * 1e9).astype(np.int64), positions, quats)


def _truth(log: ComposedLog, truth: PoseTable | None, align: str) -> Mapping[int, Pose]:
    """True poses by tick, moved so that the first is the start of the rig, unless as they are."""
    if truth is None:
        return {}
    found = truth_at_ticks(truth, log.clock, log.last_tick)
    if align == "none":
        return found
    moved = log.rig.world_from_body_start @ found[min(found)].inverse()
    return {tick: moved @ pose for tick, pose in found.items()}


@dataclasses.dataclass(frozen=True, slots=True)
class RecordedRun(LoggedRun):
    """A recording, opened; what a replay of it writes beside the estimate."""

    options: ReplayOptions
    log: ComposedLog
    written: list[SensorLog] = dataclasses.field(default_factory=list)
    maps: list[LandingSite] = dataclasses.field(default_factory=list)
    found: dict[str, float] = dataclasses.field(default_factory=dict)
    """the calibration that the estimator has found so far"""

    @property
    def ticks(self) -> Container[int]:
        """Those of the truth; without one 50 a second."""
        rig = self.log.rig
        every = max(rig.tick_hz // (_ROWS_HZ * rig.imu_ticks), 1) * rig.imu_ticks
        return self.truth or range(every, self.log.last_tick + 1, every)

    def begin(self, folder: Path) -> None:
        """Begins a sensor log if one is asked for."""
        if self.options.log_sensors:
            rig, sensed = self.sensors.rig, self.sensors.sensed
            self.written.append(SensorLog(folder / SENSORS_FILE, rig, sensed))

    def passed(self, obs: Observation, estimate: Estimate) -> None:
        """Adds the observation to the sensor log and to the map."""
        if _CLOCK in estimate.diagnostics:
            self.found[_CLOCK] = estimate.diagnostics[_CLOCK]
        for log in self.written:
            log.add(obs)
        for site in self.maps:
            site.take(obs, estimate)

    def finish(self, folder: Path, result: RunResult) -> RunResult:
        """Writes the truth, judges again where it is aligned over all positions, and says in the
        result what was done."""
        while self.written:
            self.written.pop().close()
        truth, notes = dict(self.truth), self.log.notes()
        if self.options.truth == REGISTRATION:
            notes.append("the truth is the registration of the scans that were replayed")
        notes += [site.write(folder) for site in self.maps]
        if (ahead := self.found.get(_CLOCK)) is not None:
            notes.append(
                f"the estimator ends with the camera's clock {ahead:.2f} ms ahead of the IMU's: "
                f"time_offset_s = {-1e-3 * ahead:.5f} in --rig would hold that"
            )
        more: dict[str, Any] = {"profile": None, "wind_kmh": None}
        if truth:
            notes.append(_ALIGNED[self.options.align])
            judged = _judged(folder / "estimate.tum", truth, self)
            truth, more["position_error_m"] = judged.truth, judged.error
            if self.options.align == "se3" or not self.log.begins_at_rest:
                more["nees"] = None  # that of the replay is about the start that was assumed
        writer = TumWriter(folder / "truth.tum")
        for tick, pose in sorted(truth.items()):
            writer.add(tick / self.sensors.rig.tick_hz, pose)
        writer.close()
        said = [Event(time_s=0.0, text=note) for note in notes]
        return result.model_copy(
            update={**more, "events": [*said, *result.events],
                    "event_count": result.event_count + len(said)}
        )  # fmt: skip


class _Judged(NamedTuple):
    truth: dict[int, Pose]
    """moved onto the estimate"""
    error: PositionError


def _judged(estimate: Path, truth: Mapping[int, Pose], run: RecordedRun) -> _Judged:
    """The truth aligned with an estimate, and the errors that are left."""
    times, positions, quats = read_tum(estimate)
    ticks = np.rint(times * run.sensors.rig.tick_hz).astype(int).tolist()
    rows = {
        tick: Pose(matrix_from_quat_wxyz(quat), position)
        for tick, position, quat in zip(ticks, positions, quats, strict=True)
        if tick in truth
    }
    error, placed = PositioningError(), dict(truth)
    if rows:
        first = min(rows)
        moved = rows[first] @ truth[first].inverse()
        if run.options.align == "none":
            moved = Pose.identity()
        if run.options.align == "se3":
            moved = fitted(
                np.array([truth[tick].translation for tick in rows]),
                np.array([pose.translation for pose in rows.values()]),
            )
        placed = {tick: moved @ pose for tick, pose in truth.items()}
    for tick, pose in rows.items():
        error.add(pose, placed[tick])
    return _Judged(placed, error.summary())


def fitted(points: Array, onto: Array) -> Pose:
    """The rigid motion that brings (N, 3) ``points`` nearest to ``onto`` (N, 3) in the mean square
    (Umeyama 1991, without scale)."""
    centre, target = points.mean(axis=0), onto.mean(axis=0)
    u, _, vt = np.linalg.svd((onto - target).T @ (points - centre))
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ sign @ vt
    return Pose(rotation, target - rotation @ centre)
