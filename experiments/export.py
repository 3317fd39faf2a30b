"""Flights in the formats of other tools: what is common to all formats, and TUM and CSV tables."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

from experiments.config import UsageError
from experiments.run_directory import whole_file
from experiments.tum import TumWriter, tum_rows
from sim.frames import Pose, quat_wxyz_from_matrix, wrap_angle, yaw_from_rotation

Array = NDArray[np.float64]

FORMATS = ("mcap", "ply", "tum", "csv")
LIBRARY = "touchdown export"
"""what exported MCAP files say wrote them"""
_OWN_FILES = (
    "sensors.mcap", "map.ply", "truth.tum", "estimate.tum", "reference.tum", "odometry.tum",
    "result.json", "config.json", "flight.rrd", "costmap.png",
)  # fmt: skip
SAME_TIME_S = 1e-6


@dataclass(frozen=True, kw_only=True, slots=True)
class ExportOptions:
    """What of a run is exported, and how."""

    poses: str = "estimate"
    """``estimate``, ``truth`` or, for TUM alone, ``reference``: which trajectory is written, or
    where the vehicle is taken to have been"""
    points: str = "map"
    """PLY: ``map``, the run's own, or ``scans``, all returns of the LIDAR"""
    every: int = 1
    """PLY of scans: one return of so many"""
    images: str = "compressed"
    """MCAP: ``compressed`` (PNG, as logged), ``raw`` or ``none``"""
    tf: str = "all"
    """MCAP: ``all`` transforms; ``odom``: not that from map to odom; ``none`` that moves"""
    origin: tuple[float, float, float] | None = None
    """MCAP: latitude, longitude (degrees) and height (m) of the world's origin"""
    judged: bool = False
    """TUM, CSV: only rows at which positions are judged"""


@dataclass(slots=True)
class Exported:
    """What was written."""

    out: Path
    counts: dict[str, int] = field(default_factory=dict)
    """of messages, points or rows, by name"""
    notes: list[str] = field(default_factory=list)
    facts: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class FlownRun:
    """A run directory, of a flight or of a replay."""

    path: Path
    result: dict[str, Any]

    def file(self, name: str) -> Path:
        """Raises UsageError where the run lacks it."""
        found = self.path / name
        if not found.is_file():
            raise UsageError(f"'{self.path}' has no {name}")
        return found

    def sensors(self) -> Path:
        """The sensor log of the run, or of the flight that it replayed. Raises UsageError."""
        from experiments.sensor_log import FILE_NAME

        own, replayed = self.path / FILE_NAME, self.result.get("replay_of")
        if not own.is_file() and replayed and (Path(replayed) / FILE_NAME).is_file():
            return Path(replayed) / FILE_NAME
        if not own.is_file():
            raise UsageError(
                f"'{self.path}' has no {FILE_NAME}: fly with --log-sensors to export what sensors "
                "said; tum, csv and the map as ply do not need it"
            )
        return own

    def span_s(self) -> tuple[float, float]:
        """Positions are judged from here on, and before there: never, where it never took off;
        always, in runs of earlier versions, which do not tell."""
        first, last = self.result.get("span_s") or (-np.inf, None)
        return (
            np.inf if first is None else float(first),
            np.inf if last is None else float(last),
        )

    def wanted_s(self, judged: bool) -> tuple[float, float]:
        """The span to export: all, or ``judged`` alone. Raises UsageError where that is nothing."""
        if not judged:
            return -np.inf, np.inf
        first_s, end_s = self.span_s()
        if first_s == np.inf:
            raise UsageError(f"'{self.path}' never took off: no row is judged; leave out --judged")
        return first_s, end_s


def open_flown(run: Path) -> FlownRun:
    """Raises UsageError for what is no run directory."""
    if not (run / "result.json").is_file():
        raise UsageError(f"'{run}' is no run directory: it has no result.json")
    try:
        result = json.loads((run / "result.json").read_text(encoding="utf-8"))
    except (ValueError, OSError) as error:
        raise UsageError(f"'{run}' cannot be read: {error}") from error
    if not isinstance(result, dict):
        raise UsageError(f"'{run}' is no run directory: its result.json is no result")
    return FlownRun(run, result)


def export(run: Path, kind: str, out: Path | None, options: ExportOptions) -> Exported:
    """Writes ``run`` as one file of format ``kind``, at once or not at all; an earlier export of
    that name is replaced.

    ``out``: by default beside the run directory. Raises UsageError before anything is written for
    what is no run, or lacks what the format needs, and for an ``out`` that is something else.
    """
    flown = open_flown(run)
    if out is None:
        named = run if run.name not in ("", "..") else run.resolve()
        which = f"-{options.poses}" if kind == "tum" else ""
        out = named.with_name(f"{named.name}{which}.{kind}")
    check_out_file(out, kind, run)
    _check_inputs(flown, kind, options)
    try:
        with whole_file(out) as partial:
            done = _write(flown, kind, partial, options)
    except OSError as error:
        raise UsageError(f"--out {out}: cannot be written: {error.strerror or error}") from error
    done.out = out
    done.facts["bytes"] = out.stat().st_size
    return done


def _check_inputs(flown: FlownRun, kind: str, options: ExportOptions) -> None:
    """Raises UsageError where the run lacks what the format needs."""
    if kind == "ply" and options.points == "map":
        flown.file("map.ply")
        return
    if kind in ("mcap", "ply"):
        flown.sensors()
    names = ("truth", "estimate") if kind == "mcap" else (options.poses,)
    for name in ("truth",) if kind == "csv" else names:
        flown.file(f"{name}.tum")


def _write(flown: FlownRun, kind: str, path: Path, options: ExportOptions) -> Exported:
    if kind == "mcap":
        from experiments.export_mcap import write_bag

        return write_bag(flown, path, options)
    if kind == "ply":
        from experiments.export_cloud import write_cloud

        return write_cloud(flown, path, options)
    return write_tum(flown, path, options) if kind == "tum" else write_csv(flown, path, options)


def check_out_file(out: Path, kind: str, run: Path) -> None:
    """Raises UsageError unless ``out`` is new or an earlier export of that kind."""
    if out.is_dir():
        raise UsageError(f"--out {out}: is a directory; name a file")
    if out.name in _OWN_FILES and out.resolve().parent == run.resolve():
        raise UsageError(f"--out {out}: is a file of the run itself; name another file")
    if out.exists() and not _is_export(out, kind):
        raise UsageError(
            f"--out {out}: holds something that is no earlier export; name another file"
        )


def _is_export(path: Path, kind: str) -> bool:
    try:
        with path.open("rb") as file:
            head = file.read(400)
    except OSError as error:
        raise UsageError(f"--out {path}: cannot be read: {error.strerror}") from error
    if kind == "mcap":
        return head.startswith(b"\x89MCAP") and LIBRARY.encode() in head
    if kind == "ply":
        return head.startswith(b"ply\n") and f"comment {LIBRARY}".encode() in head
    if kind == "csv":
        return head.startswith(",".join(_COLUMNS[:3]).encode())
    try:
        return len([float(word) for word in head.partition(b"\n")[0].split()]) == 8
    except ValueError:
        return False


# ------------------------------------------------------------------------------------------- tables


def write_tum(flown: FlownRun, path: Path, options: ExportOptions) -> Exported:
    """One trajectory, ``t x y z qx qy qz qw``, world frame."""
    rows = tum_rows(flown.file(f"{options.poses}.tum"))
    first_s, end_s = flown.wanted_s(options.judged)
    writer, count = TumWriter(path), 0
    try:
        for time_s, pose in rows:
            if first_s <= time_s < end_s:
                writer.add(time_s, pose)
                count += 1
    except ValueError as error:
        raise UsageError(str(error)) from error
    finally:
        writer.close()
    return Exported(path, {"rows": count})


_POSE = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw", "yaw_deg")
_COLUMNS = (
    "time_s", "phase", "judged",
    *(f"truth_{name}" for name in _POSE),
    *(f"estimate_{name}" for name in _POSE),
    "reference_x_m", "reference_y_m", "reference_z_m",
    "error_x_m", "error_y_m", "error_z_m", "error_m", "error_yaw_deg", "deviation_m",
)  # fmt: skip


def write_csv(flown: FlownRun, path: Path, options: ExportOptions) -> Exported:
    """A row for each of truth.tum: time, phase, whether it is judged, true and believed pose, where
    the vehicle should have been, the error of the estimate (world axes) and the deviation from
    the reference. Cells without a value are empty."""
    first_s, end_s = flown.span_s()
    flown.wanted_s(options.judged)  # refuses what would be an empty table
    truth = tum_rows(flown.file("truth.tum"))
    others = [_at_times(flown, name) for name in ("estimate", "reference")]
    phase = _Phases(flown.result)
    count = 0
    with path.open("w", encoding="ascii", newline="") as file:
        _line(file, _COLUMNS)
        try:
            for time_s, true in truth:
                judged = first_s <= time_s < end_s
                if options.judged and not judged:
                    continue
                believed, reference = (other.at(time_s) for other in others)
                head = (f"{time_s:.9f}", phase.at(time_s), str(judged))
                _line(file, (*head, *_cells(true, believed, reference)))
                count += 1
        except ValueError as error:
            raise UsageError(str(error)) from error
    return Exported(path, {"rows": count})


def _cells(true: Pose, believed: Pose | None, reference: Pose | None) -> Iterator[str]:
    nothing = np.full(8, np.nan)
    yield from _numbers(_pose_cells(true))
    yield from _numbers(nothing if believed is None else _pose_cells(believed))
    yield from _numbers(nothing[:3] if reference is None else reference.translation)
    if believed is None:
        yield from _numbers(nothing[:5])
    else:
        error = believed.translation - true.translation
        turn = yaw_from_rotation(believed.rotation) - yaw_from_rotation(true.rotation)
        size = float(np.linalg.norm(error))
        yield from _numbers([*error, size, np.degrees(wrap_angle(turn))])
    away = np.nan if reference is None else np.linalg.norm(reference.translation - true.translation)
    yield from _numbers([float(away)])


def _pose_cells(pose: Pose) -> Array:
    w, x, y, z = quat_wxyz_from_matrix(pose.rotation)
    yaw_deg = np.degrees(yaw_from_rotation(pose.rotation))
    return np.array([*pose.translation, x, y, z, w, yaw_deg])


def _numbers(values: Iterable[float]) -> Iterator[str]:
    return (f"{value:.9f}" if np.isfinite(value) else "" for value in values)


def _line(file: TextIO, cells: Iterable[str]) -> None:
    file.write(",".join(cells) + "\n")


class PosesAt:
    """The rows of a trajectory at ascending times; None where it has no row."""

    def __init__(self, rows: Iterator[tuple[float, Pose]]) -> None:
        self._rows = rows
        self._next = next(rows, None)

    def at(self, time_s: float) -> Pose | None:
        while self._next is not None and self._next[0] < time_s - SAME_TIME_S:
            self._next = next(self._rows, None)
        if self._next is None or self._next[0] > time_s + SAME_TIME_S:
            return None
        return self._next[1]


def _at_times(flown: FlownRun, name: str) -> PosesAt:
    path = flown.path / f"{name}.tum"
    return PosesAt(tum_rows(path) if path.is_file() else iter(()))


class _Phases:
    """The phase of a flight by time; empty for runs whose results do not tell."""

    def __init__(self, result: dict[str, Any]) -> None:
        self._rest = iter([(p["time_s"], p["phase"]) for p in result.get("phases") or []])
        self._next = next(self._rest, None)
        self._now = ""

    def at(self, time_s: float) -> str:
        """Of times that ascend."""
        while self._next is not None and self._next[0] <= time_s + SAME_TIME_S:
            self._now, self._next = self._next[1], next(self._rest, None)
        return self._now


def with_neighbours(
    rows: Iterator[tuple[float, Pose]],
) -> Iterator[tuple[tuple[float, Pose], tuple[float, Pose], tuple[float, Pose]]]:
    """Each row between its neighbours; the first and the last are their own."""
    before = here = next(rows, None)
    if here is None or before is None:
        return
    for after in itertools.chain(rows, [None]):
        if after is None:
            yield before, here, here
            return
        yield before, here, after
        before, here = here, after
