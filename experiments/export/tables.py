"""Trajectories and tables of a flight: TUM and CSV."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.errors import UsageError
from touchdown.experiments.export.flown_run import SAME_TIME_S, Exported, ExportOptions, FlownRun
from touchdown.experiments.io.tum import TumWriter, tum_rows
from touchdown.sim.files.opening import no_file
from touchdown.sim.frames import Pose, quat_wxyz_from_matrix, wrap_angle, yaw_from_rotation

Array = NDArray[np.float64]


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
    """A row for each of truth.tum: time, phase, ``judged``, true and estimated pose, reference
    position, error of the estimate (world axes) and deviation from the reference. Cells without a
    value are empty."""
    first_s, end_s = flown.span_s()
    flown.wanted_s(options.judged)  # refuses an empty table
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
                estimated, reference = (other.at(time_s) for other in others)
                head = (f"{time_s:.9f}", phase.at(time_s), str(judged))
                _line(file, (*head, *_cells(true, estimated, reference)))
                count += 1
        except ValueError as error:
            raise UsageError(str(error)) from error
    return Exported(path, {"rows": count})


def _cells(true: Pose, estimated: Pose | None, reference: Pose | None) -> Iterator[str]:
    nothing = np.full(8, np.nan)
    yield from _numbers(_pose_cells(true))
    yield from _numbers(nothing if estimated is None else _pose_cells(estimated))
    yield from _numbers(nothing[:3] if reference is None else reference.translation)
    if estimated is None:
        yield from _numbers(nothing[:5])
    else:
        error = estimated.translation - true.translation
        yaw_error = yaw_from_rotation(estimated.rotation) - yaw_from_rotation(true.rotation)
        size = float(np.linalg.norm(error))
        yield from _numbers([*error, size, np.degrees(wrap_angle(yaw_error))])
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
    """Rows of a trajectory at ascending times; None where it has no row."""

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
    return PosesAt(iter(()) if no_file(path) else tum_rows(path))


class _Phases:
    """Phase of a flight by time; empty for runs whose results do not record it."""

    def __init__(self, result: dict[str, Any]) -> None:
        self._rest = iter([(p["time_s"], p["phase"]) for p in result.get("phases") or []])
        self._next = next(self._rest, None)
        self._now = ""

    def at(self, time_s: float) -> str:
        """Phase at a time; times must ascend."""
        while self._next is not None and self._next[0] <= time_s + SAME_TIME_S:
            self._now, self._next = self._next[1], next(self._rest, None)
        return self._now


def with_neighbours(
    rows: Iterator[tuple[float, Pose]],
) -> Iterator[tuple[tuple[float, Pose], tuple[float, Pose], tuple[float, Pose]]]:
    """Each row between its neighbours; first and last row are their own neighbours."""
    before = here = next(rows, None)
    if here is None or before is None:
        return
    for after in itertools.chain(rows, [None]):
        if after is None:
            yield before, here, here
            return
        yield before, here, after
        before, here = here, after
