"""Trajectories as TUM text: one ``t x y z qx qy qz qw`` a line, seconds and metres."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

import numpy as np
from numpy.typing import NDArray

from touchdown.sim.frames import Pose, matrix_from_quat_wxyz, quat_wxyz_from_matrix

Array = NDArray[np.float64]

_BUFFERED_ROWS = 256


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
    """Times (N,) s, positions (N, 3) m, quaternions (N, 4) in the order w, x, y, z."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # an empty file: there is nothing to take
        table = np.loadtxt(path, dtype=np.float64, ndmin=2)
    return table[:, 0], table[:, 1:4], table[:, [7, 4, 5, 6]]


def tum_rows(path: Path) -> Iterator[tuple[float, Pose]]:
    """Yields time (s) and pose of each row, with one row in memory. Raises ValueError for a line
    that is no row."""
    with path.open(encoding="ascii") as file:
        for line in file:
            if line.isspace() or line.startswith("#"):
                continue
            numbers = [float(word) for word in line.split()]
            if len(numbers) != 8:
                raise ValueError(f"'{path}' is no trajectory: it has the line {line.strip()!r}")
            time_s, x, y, z, qx, qy, qz, qw = numbers
            rotation = matrix_from_quat_wxyz(np.array([qw, qx, qy, qz]))
            yield time_s, Pose(rotation, np.array([x, y, z]))
