"""Figures of survey flights from their trajectories: deviation of the path, error by distance."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.io.tum import read_tum
from touchdown.sim.files.opening import no_file
from touchdown.sim.frames import matrices_from_quats_wxyz

Array = NDArray[np.float64]

LIFT_OFF_M = 0.1
_BINS_M = (0.0, 50.0, 100.0, 150.0, 200.0)
DISTANCES = tuple(f"{first:.0f}-{last:.0f}" for first, last in pairwise(_BINS_M))
"""Intervals of the distance flown, m; ``error_by_distance.0-50`` and so on are columns."""


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Times (N,) s, positions (N, 3) m in the world frame, headings (N,) rad."""

    time_s: Array
    position: Array
    yaw: Array

    @property
    def lift_off(self) -> int:
        """Index of the first sample in the air; the number of samples where there is none."""
        above = self.position[:, 2] > self.position[0, 2] + LIFT_OFF_M
        return int(np.argmax(above)) if above.any() else len(above)


def read_trajectory(file: Path) -> Trajectory | None:
    """A ``.tum`` file of a run directory; None where it is missing, empty or damaged."""
    if no_file(file):
        return None
    try:
        time_s, position, quaternion = read_tum(file)
    except (ValueError, IndexError):
        return None
    if not len(time_s):
        return None
    rotation = matrices_from_quats_wxyz(quaternion)
    return Trajectory(time_s, position, np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0]))


def _airborne(run_dir: Path, other: str) -> tuple[Trajectory, Trajectory, slice] | None:
    """The truth and another trajectory of a run, and the samples from lift-off to the end of both;
    None without two samples at equal times."""
    truth, found = (read_trajectory(run_dir / f"{name}.tum") for name in ("truth", other))
    if truth is None or found is None:
        return None
    end = min(len(truth.time_s), len(found.time_s))
    if end <= truth.lift_off + 1 or not np.allclose(truth.time_s[:end], found.time_s[:end]):
        return None
    return truth, found, slice(truth.lift_off, end)


def path_deviation(run_dir: Path) -> dict[str, float]:
    """Mean absolute deviation of the flown path from the reference, from lift-off to the end.

    Metres along world x, y and z, degrees for ``yaw_deg``, ``mean`` the distance in 3-D, as in the
    paper's Fig. 10b-e. For flights that end with the survey; empty without trajectories.
    """
    both = _airborne(run_dir, "reference")
    if both is None:
        return {}
    truth, reference, aloft = both
    offset = truth.position[aloft] - reference.position[aloft]
    turn = truth.yaw[aloft] - reference.yaw[aloft]
    turn = np.arctan2(np.sin(turn), np.cos(turn))
    x, y, z = np.abs(offset).mean(axis=0).tolist()
    distance = float(np.linalg.norm(offset, axis=1).mean())
    yaw_deg = float(np.degrees(np.abs(turn)).mean())
    return {"mean": distance, "x": x, "y": y, "z": z, "yaw_deg": yaw_deg}


def error_by_distance(run_dir: Path) -> dict[str, float]:
    """Mean 3-D error of the estimate (m) while the distance flown since lift-off, by the truth, was
    within each of `DISTANCES`, which separates drift from a constant offset; those that a flight
    did not reach are left out."""
    both = _airborne(run_dir, "estimate")
    if both is None:
        return {}
    truth, estimate, aloft = both
    position = truth.position[aloft]
    steps = np.linalg.norm(np.diff(position, axis=0), axis=1)
    flown = np.concatenate([[0.0], np.cumsum(steps)])
    error = np.linalg.norm(estimate.position[aloft] - position, axis=1)
    found = {}
    for name, (first, last) in zip(DISTANCES, pairwise(_BINS_M), strict=True):
        if flown[-1] >= last - 0.1 * (last - first):
            found[name] = float(error[(flown >= first) & (flown < last)].mean())
    return found


def add_trajectory_columns(rows: Iterable[dict[str, Any]]) -> None:
    """Adds the keys ``path_deviation.x`` and so on, and ``error_by_distance.0-50`` and so on, to
    survey flights, from their files."""
    for row in rows:
        if row["mode"] == "fly":
            folder = Path(row["run_dir"])
            row |= {f"path_deviation.{k}": v for k, v in path_deviation(folder).items()}
            row |= {f"error_by_distance.{k}": v for k, v in error_by_distance(folder).items()}
