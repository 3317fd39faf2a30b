"""Turn of the heading during the climb.

Over level flight at one heading, an accelerometer's bias and an error of roll and pitch look alike.
Turned by half a circle, the bias points the other way and the error does not: an estimator with any
position reference separates them (observability of the accelerometer's bias: Goshen-Meskin and
Bar-Itzhack, "Observability analysis of piece-wise constant systems", IEEE TAES 28, 1992).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from touchdown.landing.mission.trajectory import PEAK_SPEED, PiecewiseTrajectory

BEGIN_ABOVE_M = 4.0
"""height of the climb above which the vehicle turns"""
_MAX_RATE = math.radians(40.0)
"""rad/s, largest rate of the turn: images blur with it"""
_STEP_S = 0.05


@dataclass(frozen=True, slots=True)
class HeadingTurn:
    """A minimum-jerk turn by ``angle_rad`` that begins at ``begin_s``."""

    angle_rad: float
    begin_s: float
    duration_s: float

    def sample(self, t: float) -> tuple[float, float]:
        """Returns the angle turned, rad, and the rate, rad/s, at the time ``t`` in seconds."""
        share = min(max((t - self.begin_s) / self.duration_s, 0.0), 1.0)
        angle = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
        rate = 30.0 * share**2 * (1.0 - share) ** 2 / self.duration_s
        return self.angle_rad * angle, self.angle_rad * rate


def turn_in_climb(climb: PiecewiseTrajectory, now_s: float, angle_deg: float) -> HeadingTurn | None:
    """Returns a turn over the part of a climb that begins now and lies above `BEGIN_ABOVE_M`, or
    longer where it would be too fast; None for an angle of 0."""
    if angle_deg == 0.0:
        return None
    angle = math.radians(angle_deg)
    floor, begin = float(climb.sample(0.0)[0][2]), 0.0
    while begin < climb.duration_s and climb.sample(begin)[0][2] < floor + BEGIN_ABOVE_M:
        begin += _STEP_S
    shortest = PEAK_SPEED * abs(angle) / _MAX_RATE
    return HeadingTurn(angle, now_s + begin, max(climb.duration_s - begin, shortest))
