"""The true path of a logged flight, at any time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from touchdown.experiments.flight.replay import LoggedRun
from touchdown.experiments.io.tum import read_tum
from touchdown.sim.frames import Pose

Array = NDArray[np.float64]

_FEWEST_ROWS = 3
_SURVEY_BELOW_M = 0.5
"""The survey begins where the vehicle first is this near to its greatest height."""


class TruePath:
    """The body's true path, from ``truth.tum``."""

    def __init__(self, file: Path) -> None:
        """Raises ValueError for fewer than three rows."""
        self.times_s, self.positions, quats = read_tum(file)
        if len(self.times_s) < _FEWEST_ROWS:
            raise ValueError(f"'{file}' has fewer than {_FEWEST_ROWS} rows: it is no flight")
        self._attitude = Rotation.from_quat(quats[:, [1, 2, 3, 0]])
        self._between = Slerp(self.times_s, self._attitude)
        self.rotations: Array = self._attitude.as_matrix()
        """(M, 3, 3) world_from_body"""

    @staticmethod
    def of_run(logged: LoggedRun) -> TruePath:
        """That of a run directory."""
        return TruePath(logged.path / "truth.tum")

    def at(self, times_s: Array) -> tuple[Array, Array]:
        """Positions (N, 3) and rotations (N, 3, 3), world_from_body; at either end the last one."""
        inside = np.clip(times_s, self.times_s[0], self.times_s[-1])
        axes = [np.interp(inside, self.times_s, axis) for axis in self.positions.T]
        return np.column_stack(axes), self._between(inside).as_matrix()

    def pose(self, time_s: float) -> Pose:
        """world_from_body at one time."""
        positions, rotations = self.at(np.array([time_s]))
        return Pose(rotations[0], positions[0])

    def rates_at(self, times_s: Array) -> Array:
        """(N, 6) velocity, m/s, and angular rate, rad/s, both in world axes."""
        steps = np.diff(self.times_s)[:, None]
        turns = (self._attitude[1:] * self._attitude[:-1].inv()).as_rotvec() / steps
        both = np.hstack([np.diff(self.positions, axis=0) / steps, turns])
        k = np.searchsorted(self.times_s, times_s, side="right") - 1
        rates: Array = both[np.clip(k, 0, len(both) - 1)]
        return rates

    def survey_s(self) -> float:
        """Time at which the vehicle first reaches the height of the survey."""
        heights = self.positions[:, 2]
        return float(self.times_s[np.argmax(heights > heights.max() - _SURVEY_BELOW_M)])
