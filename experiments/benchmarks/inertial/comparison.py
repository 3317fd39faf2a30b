"""LIDAR-inertial odometry of others: its settings, and its errors on a log.

Each setting runs as a program of its own (`runner.py`), in the environment of ``python``, on a file
of the scans and IMU samples (`logfile.py`). It starts at the true pose of its first pose.
"""

from __future__ import annotations

import itertools
import json
import os
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.benchmarks.inertial.methods import METHODS
from touchdown.experiments.errors import UsageError
from touchdown.sim.frames import Pose, matrix_from_quat_wxyz

Array = NDArray[np.float64]

RUNNER = Path(__file__).with_name("runner.py")
LOST_M = 10.0
"""Distance from the truth at which a run ends as lost."""
MOST_SILENT_S = 1.0
"""A method that gives no pose for longer is lost at the last one."""
MOST_WAITING_S = 6.0
"""The same before the first pose: time in which methods initialise."""
BEFORE_SURVEY_S = 0.5
"""IMU samples before the first scan of a start at the survey."""
_COLUMNS = 9


@dataclass(slots=True)
class InertialTrack:
    """Result of a method with one setting: times (N,) s, positions (N, 3) of the body, world."""

    setting: dict[str, Any]
    times_s: list[float]
    positions: list[Array]
    cpu_s: float = 0.0
    data_s: float = 0.0
    lost_s: float | None = None
    failure: str = ""
    """what the program printed last, where it ended with an error"""


def installed(python: str) -> dict[str, str]:
    """Version by package that the environment of an interpreter has. Raises UsageError where it is
    no interpreter."""
    command = [python, "-I", str(RUNNER), "versions"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
        found: dict[str, str] = json.loads(done.stdout)
    except (OSError, subprocess.SubprocessError, ValueError) as error:
        raise UsageError(
            f"TOUCHDOWN_LIO_PYTHON: '{python}' is no Python interpreter with numpy"
        ) from error
    return found


def missing_line(method: str) -> str:
    """What to do about a method whose package is not installed."""
    package = METHODS[method].package
    return (
        f"{method} is not installed; pip install -c constraints.txt -e '.[lio]' installs {package}"
    )


def settings(method: str) -> Iterator[dict[str, Any]]:
    """Yields all combinations of each of a method's grids."""
    for grid in METHODS[method].grids:
        for values in itertools.product(*grid.values()):
            yield dict(zip(grid, values, strict=True))


def run_setting(
    method: str,
    setting: dict[str, Any],
    log: Path,
    true_pose: Callable[[float], Pose],
    span: tuple[float, float, float],
    python: str,
) -> InertialTrack:
    """Runs one setting over a log file.

    ``true_pose(time_s)``: ``world_from_body``, for the start and the distance at which the run is
    lost. ``span``: lift-off, begin of the survey and end of the log, s; poses before the lift-off
    do not count.
    """
    lift_off_s, survey_s, end_s = span
    early = setting.get("start") != "survey"
    job = {
        "method": method,
        "setting": {name: value for name, value in setting.items() if name != "start"},
        "log": str(log),
        "scans_from_s": 0.0 if early else survey_s,
        "imu_from_s": 0.0 if early else survey_s - BEFORE_SURVEY_S,
    }
    begin_s = lift_off_s if early else survey_s
    track = InertialTrack(setting, [], [])
    environment = os.environ | {
        name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "TBB_NUM_THREADS")
    }
    command = [python, "-I", str(RUNNER), json.dumps(job)]
    with (
        tempfile.TemporaryFile("w+") as errors,
        subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=errors, text=True, env=environment
        ) as process,
    ):
        assert process.stdout is not None
        follow(process.stdout, track, true_pose, begin_s)
        process.kill() if track.lost_s is not None else process.wait()
        if process.wait() and track.lost_s is None:
            errors.seek(0)
            lines = errors.read().strip().splitlines()
            track.failure = lines[-1] if lines else f"exit code {process.returncode}"
    last_s = track.times_s[-1] if track.times_s else begin_s
    track.data_s = max(last_s - begin_s, 0.0)
    waited = MOST_SILENT_S if track.times_s else MOST_WAITING_S
    if track.lost_s is None and (last_s < end_s - waited or len(track.times_s) < 2):
        track.lost_s = last_s
    return track


def follow(
    lines: IO[str], track: InertialTrack, true_pose: Callable[[float], Pose], begin_s: float
) -> None:
    """Reads poses until the program ends or is lost."""
    world_from_odom: Pose | None = None
    for time_s, odom_from_body, track.cpu_s in poses(lines):
        if time_s < begin_s:
            continue
        true = true_pose(time_s)
        if world_from_odom is None:
            world_from_odom = true @ odom_from_body.inverse()
        waited_s = time_s - (track.times_s[-1] if track.times_s else begin_s)
        if waited_s > (MOST_SILENT_S if track.times_s else MOST_WAITING_S):
            track.lost_s = time_s - waited_s
            return
        position = (world_from_odom @ odom_from_body).translation
        track.times_s.append(time_s)
        track.positions.append(position)
        if not np.linalg.norm(position - true.translation) <= LOST_M:
            track.lost_s = time_s
            return


def poses(lines: IO[str] | Sequence[str]) -> Iterator[tuple[float, Pose, float]]:
    """Yields time (s), pose and CPU seconds of each line of a runner; one cut short ends them."""
    for line in lines:
        numbers = [float(text) for text in line.split()]
        if len(numbers) != _COLUMNS:
            return
        time_s, x, y, z, qx, qy, qz, qw, cpu_s = numbers
        rotation = matrix_from_quat_wxyz(np.array([qw, qx, qy, qz]))
        yield time_s, Pose(rotation, np.array([x, y, z])), cpu_s
