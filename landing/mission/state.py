"""What a mission has decided so far."""

import dataclasses
from collections.abc import Iterable
from typing import Literal

from touchdown.landing.api import Candidate, CostmapView, Decision, Phase, SurveyParams
from touchdown.landing.classification.site_check import SiteClass
from touchdown.landing.mission.site_recheck import Recheck
from touchdown.sim.typing import Array

Outcome = Literal["", "no_site", "aborted"]
"""what a flight counts as from a decision on; empty where it changes nothing"""


class MissionState:
    """Decisions of a mission. Everybody reads them; they change by the methods below alone."""

    def __init__(self, survey: SurveyParams) -> None:
        self.phase = Phase.INIT
        self.note = "waiting for the sensors to settle"
        """the last decision, as text"""
        self.events: tuple[str, ...] = ()
        """messages of this control step"""
        self.survey = survey
        self.takeoff_s: float | None = None
        self.deadline_s: float | None = None
        """time of the mission by which an emergency ends on the ground"""
        self.blind = False
        """True in a final descent whose position nothing measures: it waits for nobody"""
        self.final = False
        """True in the final descent, which nothing but the watch interrupts"""
        self.gave_way_s = 0.0
        """time for which something was in the way at the present site"""
        self.lift_m = 0.0
        """height above the place where the watch has interrupted the descent"""
        self.decisions: tuple[Decision, ...] = ()
        self.costmap: CostmapView | None = None
        self.site_odom: Array | None = None
        self.site_class: SiteClass | None = None
        self.committed_site_world: Array | None = None
        self.recheck: Recheck | None = None
        """the last check of the site from closer"""
        self.refused_odom: tuple[Array, ...] = ()
        self.unsafe_ground_odom: tuple[Array, ...] = ()
        """sites whose class of ground was refused"""
        self.search_legs = 0
        """further legs flown since a site was last refused"""
        self.no_site = False
        self.aborted = False
        self.slowed_s = 0.0
        """time by which all trajectories so far took longer than they were set"""
        self.stopped_s = 0.0
        """time for which the wind has stopped the clock of the present trajectory"""
        self._ruled = self._ruled_before = ""

    @property
    def candidates(self) -> tuple[Candidate, ...]:
        """Candidates of the last decision."""
        return self.decisions[-1].candidates if self.decisions else ()

    def begin_step(self) -> None:
        """Clears the messages of the last control step."""
        self.events = ()
        self._ruled, self._ruled_before = "", self._ruled

    def enter(self, phase: Phase, reason: str = "") -> None:
        """Begins a phase."""
        self.phase = phase
        self.note = reason or self.note

    def report(self, text: str) -> None:
        """States ``text`` as the last decision and, with the phase, among the events."""
        self.note = text
        self.events += (f"{self.phase}: {text}",)

    def follow_rule(self, name: str, reason: str, outcome: Outcome) -> None:
        """Notes what the rule ``name`` has decided. A rule that decides in many control steps in a
        row is listed in the events once."""
        self.note = reason
        if name != self._ruled_before:
            self.events += (f"{self.phase} {name}: {reason}",)
        self._ruled = name
        self.no_site |= outcome == "no_site"
        self.aborted |= outcome == "aborted"

    def take_off(self, now_s: float) -> None:
        """Begins the climb."""
        self.takeoff_s = now_s
        self.enter(Phase.TAKEOFF, f"climbing to {self.survey.height_m:.0f} m")

    def lower_survey(self) -> None:
        """Takes the lowest height for the survey."""
        low = self.survey.min_height_m
        ways = tuple((x, y, min(z, low)) for x, y, z in self.survey.waypoints_m)
        self.survey = dataclasses.replace(self.survey, height_m=low, waypoints_m=ways)

    def set_deadline(self, deadline_s: float) -> None:
        """Begins an emergency that ends on the ground by ``deadline_s``."""
        self.deadline_s = deadline_s

    def begin_search_leg(self) -> None:
        """Begins a further leg of the survey."""
        self.enter(Phase.SURVEY)
        self.search_legs += 1

    def decide(self, decision: Decision, costmap: CostmapView | None, reason: str) -> None:
        """Adds ``decision`` to those of the flight."""
        self.decisions += (decision,)
        self.costmap = costmap
        self.note = reason

    def choose(self, site_odom: Array, site_class: SiteClass | None = None) -> None:
        """Takes ``site_odom`` (3,), on the ground, as the site to land on."""
        self.site_odom, self.site_class = site_odom, site_class

    def examine(self, recheck: Recheck) -> None:
        """Keeps what a check of the site from closer has found."""
        self.recheck = recheck
        self.note = recheck.text

    def refuse(self, reason: str) -> None:
        """Gives up the site, for good; its decision says why."""
        assert self.site_odom is not None
        self.final, self.committed_site_world, self.gave_way_s = False, None, 0.0
        self.refused_odom += (self.site_odom,)
        self.site_odom = self.site_class = None
        self.search_legs = 0
        *before, last = self.decisions
        self.decisions = (*before, dataclasses.replace(last, given_up=reason))

    def refuse_ground(self, sites_odom: Iterable[Array]) -> None:
        """Remembers sites whose class of ground is not safe."""
        self.unsafe_ground_odom += tuple(sites_odom)

    def commit(self, site_world: Array) -> None:
        """Fixes the site (3,) that the touchdown is measured against."""
        self.committed_site_world = site_world

    def give_way(self, step_s: float, lift_m: float) -> None:
        """Notes a control step in which the descent is interrupted, and the climb so far."""
        self.gave_way_s += step_s
        self.lift_m = lift_m

    def descend_for_good(self, *, blind: bool = False) -> None:
        """Begins a descent that nothing but the watch interrupts."""
        self.phase, self.final, self.blind = Phase.DESCEND, True, blind

    def follow_clock(self, late_s: float, stopped_s: float) -> None:
        """Notes by how much this control step has made the trajectory later, and for how long its
        clock has stood still."""
        self.slowed_s += late_s
        self.stopped_s = stopped_s
