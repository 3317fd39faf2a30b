"""Reaction to an unhealthy estimate: hold the position, then descend."""

from __future__ import annotations

from touchdown.controller.api import Setpoint
from touchdown.landing.api import Phase
from touchdown.landing.mission.mission_state import Mission, Steps
from touchdown.landing.mission.phases import come_down_here, rest

_IN_THE_AIR = frozenset(
    {Phase.TAKEOFF, Phase.SURVEY, Phase.SELECT, Phase.APPROACH, Phase.DESCEND, Phase.RETURN}
)


class HealthWatch:
    """Holds the reference while the estimate is unhealthy, and ends the mission where it stays so.

    A hold stops the clock of the mission: trajectories resume where they stopped."""

    def __init__(self) -> None:
        self._bad_since_s: float | None = None
        self._gave_up = False

    def hold(self, mission: Mission) -> Setpoint | None:
        """Returns the setpoint that replaces that of this control step, or None to continue."""
        params, now = mission.params, mission.obs.time_s
        if self._gave_up or mission.final or mission.phase not in _IN_THE_AIR:
            return None
        if mission.estimate.healthy:
            self._bad_since_s = None
            return None
        if self._bad_since_s is None:
            self._bad_since_s = now
        if now - self._bad_since_s < params.unhealthy_hold_s:
            return None
        if now - self._bad_since_s >= params.unhealthy_abort_s:
            return None
        mission.pause()
        return mission.setpoint(mission.reference_world, in_world=True)

    def lost(self, mission: Mission) -> bool:
        """True once, when the mission is to be replaced by ``give_up``."""
        if self._gave_up or self._bad_since_s is None or mission.estimate.healthy:
            return False
        if mission.obs.time_s - self._bad_since_s < mission.params.unhealthy_abort_s:
            return False
        self._gave_up = True
        return True


def give_up(mission: Mission) -> Steps:
    """Descends at the current position, since no other target can be reached without an
    estimate."""
    mission.aborted = True
    mission.note = "the position estimate stays unhealthy: landing straight down"
    yield from come_down_here(mission)
    yield from rest(mission)
