"""PX4's local frame against the odom frame of the estimate."""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.api import Estimate
from touchdown.experiments.px4.frames import ned

Array = NDArray[np.float64]

_KEPT_S = 0.5
_JUMP_M = 1.0
"""A larger change is a reset of PX4's estimate, and counts at once."""
_SMOOTHING = 0.02
"""of each message, 50 a second: a second"""


class LocalFrame:
    """Offset of PX4's local frame, north, east, down, from the odom frame.

    On vision alone both are the same. With satellites PX4 puts its origin where the first fix was,
    and follows them: setpoints are given where they are meant against the estimate of that time.
    """

    def __init__(self, moves: bool) -> None:
        self._moves = moves
        self._estimates: deque[tuple[float, Array]] = deque()
        self._offset: Array | None = None if moves else np.zeros(3)

    @property
    def known(self) -> bool:
        """True where setpoints can be given."""
        return self._offset is not None

    @property
    def offset_ned(self) -> Array:
        """(3,) m, of the same point in PX4's frame, less that in the odom frame."""
        return np.zeros(3) if self._offset is None else self._offset

    def note(self, estimate: Estimate) -> None:
        """Takes the estimate of this control step."""
        if not self._moves:
            return
        self._estimates.append(
            (estimate.time_s, np.array(ned(estimate.odom_from_body.translation)))
        )
        while self._estimates[0][0] < estimate.time_s - _KEPT_S:
            self._estimates.popleft()

    def take(self, message: Any) -> None:
        """Takes a LOCAL_POSITION_NED, which is of an earlier step."""
        if not self._moves or not self._estimates:
            return
        time_s = 1e-3 * message.time_boot_ms
        _, there = min(self._estimates, key=lambda one: abs(one[0] - time_s))
        found = np.array([message.x, message.y, message.z]) - there
        if self._offset is None or math.dist(found, self._offset) > _JUMP_M:
            self._offset = found
        else:
            self._offset = self._offset + _SMOOTHING * (found - self._offset)
