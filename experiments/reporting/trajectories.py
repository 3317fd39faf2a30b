"""Trajectories of flights, and the deviation of the flown path from the reference."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from touchdown.experiments.io.tum import read_tum
from touchdown.sim.files.opening import no_file
from touchdown.sim.frames import matrices_from_quats_wxyz
from touchdown.sim.typing import Array

LIFT_OFF_M = 0.1


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


def path_deviation(run_dir: Path) -> dict[str, float]:
    """Mean absolute deviation of the flown path from the reference, from lift-off to the end.

    Metres along world x, y and z, degrees for ``yaw_deg``, as in the paper's Fig. 10b-e. For
    flights that end with the survey; empty without two samples of both trajectories at equal times.
    """
    truth, reference = (read_trajectory(run_dir / f"{name}.tum") for name in ("truth", "reference"))
    if truth is None or reference is None:
        return {}
    end = min(len(truth.time_s), len(reference.time_s))
    if end <= truth.lift_off + 1 or not np.allclose(truth.time_s[:end], reference.time_s[:end]):
        return {}
    aloft = slice(truth.lift_off, end)
    turn = truth.yaw[aloft] - reference.yaw[aloft]
    yaw_deg = np.degrees(np.abs(np.arctan2(np.sin(turn), np.cos(turn)))).mean()
    x, y, z = np.abs(truth.position[aloft] - reference.position[aloft]).mean(axis=0).tolist()
    return {"x": x, "y": y, "z": z, "yaw_deg": float(yaw_deg)}


def add_path_deviation(rows: Iterable[dict[str, Any]]) -> None:
    """Adds the keys ``path_deviation.x`` and so on to survey flights, from their files."""
    for row in rows:
        if row["mode"] == "fly":
            found = path_deviation(Path(row["run_dir"]))
            row |= {f"path_deviation.{key}": value for key, value in found.items()}
