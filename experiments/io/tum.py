"""Trajectories as TUM text: one ``t x y z qx qy qz qw`` a line, seconds and metres."""

from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import TextIO

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from touchdown.experiments.errors import UsageError
from touchdown.sim.frames import Pose, quat_wxyz_from_matrix
from touchdown.sim.typing import Array

_BUFFERED_ROWS = 256
_MAX_M = 1e12
"""largest time and position of a pose"""


class TumWriter:
    """Appends poses to a file. Memory is fixed: rows are written in blocks."""

    def __init__(self, path: Path) -> None:
        self._file: TextIO = path.open("w", encoding="ascii")
        self._rows: list[str] = []

    def add(self, time_s: float, world_from_body: Pose) -> None:
        x, y, z = world_from_body.translation.tolist()
        qw, qx, qy, qz = quat_wxyz_from_matrix(world_from_body.rotation).tolist()
        self._rows.append(
            f"{time_s:.9f} {x:.9f} {y:.9f} {z:.9f} {qx:.9f} {qy:.9f} {qz:.9f} {qw:.9f}\n"
        )
        if len(self._rows) >= _BUFFERED_ROWS:
            self._flush()

    def close(self) -> None:
        self._flush()
        self._file.close()

    def _flush(self) -> None:
        self._file.writelines(self._rows)
        self._rows.clear()


def read_tum(path: Path) -> tuple[Array, Array, Array]:
    """Times (N,) s, positions (N, 3) m, quaternions (N, 4) in the order w, x, y, z. Raises
    UsageError for a line that is no pose, or that is earlier than the one before."""
    table = np.array(list(_lines(path))).reshape(-1, 8)
    return table[:, 0], table[:, 1:4], table[:, [7, 4, 5, 6]]


class Trajectory:
    """The poses of a TUM file and those between them: positions on straight lines, rotations on
    great circles."""

    def __init__(self, path: Path) -> None:
        """Raises UsageError as `read_tum`, and for fewer than two times."""
        times, positions, quats = read_tum(path)
        self.times_s, rows = np.unique(times, return_index=True)
        if len(rows) < 2:
            raise UsageError(f"'{path}' is no trajectory of a flight: it has fewer than two rows")
        self.positions: Array = positions[rows]
        """(N, 3)"""
        self.attitudes = Rotation.from_quat(quats[rows][:, [1, 2, 3, 0]])
        self._between = Slerp(self.times_s, self.attitudes)

    @cached_property
    def rotations(self) -> Array:
        """(N, 3, 3)"""
        return self.attitudes.as_matrix()

    @property
    def poses(self) -> list[Pose]:
        """All poses."""
        return [Pose(*both) for both in zip(self.rotations, self.positions, strict=True)]

    def spans(self, first_s: float, last_s: float) -> bool:
        """True if there are poses from ``first_s`` to ``last_s``."""
        return bool(self.times_s[0] <= first_s <= last_s <= self.times_s[-1])

    def at(self, times_s: Array) -> tuple[Array, Array]:
        """Positions (M, 3) and rotations (M, 3, 3) at (M,) times; the last ones beyond an end."""
        inside = np.clip(times_s, self.times_s[0], self.times_s[-1])
        axes = [np.interp(inside, self.times_s, axis) for axis in self.positions.T]
        return np.column_stack(axes), self._between(inside).as_matrix()

    def pose(self, time_s: float) -> Pose:
        """Pose at one time."""
        positions, rotations = self.at(np.array([time_s]))
        return Pose(rotations[0], positions[0])


def _lines(path: Path) -> Iterator[list[float]]:
    before = -np.inf
    with path.open(encoding="ascii", errors="replace") as file:
        for number, line in enumerate(file, 1):
            if line.isspace() or line.startswith("#"):
                continue
            try:
                numbers = [float(word) for word in line.split()]
            except ValueError:
                numbers = []
            possible = len(numbers) == 8 and np.abs(numbers).max() < _MAX_M
            if not possible or not 0.5 < np.hypot.reduce(numbers[4:]) < 2.0:
                raise UsageError(
                    f"'{path}' is no trajectory: its line {number} is not eight numbers of a pose "
                    f"(t x y z qx qy qz qw), but {line[:60].strip()!r}"
                )
            if numbers[0] < before:
                raise UsageError(
                    f"'{path}' is no trajectory: its line {number} is earlier than the one before"
                )
            before = numbers[0]
            yield numbers
