"""The rules of a mission: what may end or change it, in the order in which they count.

A rule is a function of the view of a control step and of the state; it returns the reason in words
where it decides, else None. Of the rules that are asked at one moment the first that decides
counts, and the events of the flight list it by its name.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

from touchdown.landing.api import Phase, Verdict
from touchdown.landing.mission import energy
from touchdown.landing.mission.state import MissionState, Outcome
from touchdown.landing.mission.view import MissionView

_IN_THE_AIR = frozenset(
    {Phase.TAKEOFF, Phase.SURVEY, Phase.SELECT, Phase.APPROACH, Phase.DESCEND, Phase.RETURN}
)
_MAX_STOP_S = 40.0
"""time for which a reference waits for a weaker wind"""
_BLOWN_STOP_S, _BLOWN_M = 5.0, 6.0
"""the same beside a vehicle so far away from it"""
_MAX_CLIMB_STOP_S = 5.0
"""the same in the climb, from which the way home is short"""
_NO_GO = 1.1
"""load of a hover, gusts included, from which a vehicle cannot hold its place"""
_PATIENCE_S, _STILL_S, _HURRIED_S = 60.0, 10.0, 5.0
"""time for which a descent that has no other site waits for who may leave, and for what stays; in
an emergency"""
_RESERVE_S = 30.0
"""flight time of the battery that is left for the descent"""


class Moment(StrEnum):
    """When a rule is asked."""

    STEP = "each control step"
    CLIMB = "each control step of the climb"
    LEG = "each control step of a trajectory"
    SELECTION = "before a selection"
    NO_SITE = "after a selection without a site"
    RECHECK = "after a recheck"
    REFUSED = "after the refusal of a site"


class Action(StrEnum):
    """What follows from a rule."""

    HOLD = "hold the position"
    GIVE_WAY = "wait, climb, or move or refuse the site"
    LAND_BLIND = "land by velocity on the best ground in view"
    LOWER_SURVEY = "lower the survey"
    END_SURVEY = "end the survey"
    HURRY = "land by a deadline"
    SEARCH = "fly another leg"
    BEST_GROUND = "land on the best ground in view"
    REFUSE = "refuse the site"
    GO_AROUND = "go around"
    RETURN = "return and land at the take-off spot"


@dataclass(frozen=True, slots=True)
class Rule:
    """One rule, and what follows where it decides."""

    moment: Moment
    decides: Callable[[MissionView, MissionState], str | None]
    action: Action
    outcome: Outcome = ""

    @property
    def name(self) -> str:
        """Name of the function that decides."""
        return self.decides.__name__


@dataclass(frozen=True, slots=True)
class Ruling:
    """A rule that has decided, with the reason in words."""

    rule: Rule
    reason: str

    @property
    def action(self) -> Action:
        """What follows."""
        return self.rule.action


def estimate_lost(view: MissionView, state: MissionState) -> str | None:
    """Decides where the estimate has been unhealthy for ``unhealthy_abort_s``: no target can be
    reached without an estimate."""
    if not _interruptible(state) or view.unhealthy_s < view.params.unhealthy_abort_s:
        return None
    return "the position estimate stays unhealthy"


def sight_lost(view: MissionView, state: MissionState) -> str | None:
    """Decides where nothing has measured the position for ``blind_abort_s``: what is known of
    place, height and speed is worth less each second. A survey for its positions alone goes on."""
    early = state.phase in (Phase.TAKEOFF, Phase.SURVEY)
    patience = view.params.blind_abort_s * (3.0 if early else 1.0)
    if not _interruptible(state) or view.params.survey_only or view.blind_s <= patience:
        return None
    return f"nothing has measured the position for {view.blind_s:.1f} s"


def estimate_unhealthy(view: MissionView, state: MissionState) -> str | None:
    """Decides while the estimate has been unhealthy for ``unhealthy_hold_s``. The clock of the
    mission stops, so that trajectories resume where they stopped."""
    if not _interruptible(state) or view.unhealthy_s < view.params.unhealthy_hold_s:
        return None
    return "the position estimate is unhealthy: holding the position"


def site_not_clear(view: MissionView, state: MissionState) -> str | None:
    """Decides while the watch sees something in the way, and until the descent is back where it was
    interrupted. Without another site it has an end."""
    if is_in_the_way(view, state):
        assert view.watch is not None
        return f"{view.watch.reason}: giving way"
    return "nothing is in the way: sinking back" if state.lift_m > 0.0 else None


def is_in_the_way(view: MissionView, state: MissionState) -> bool:
    """True while the descent is to be interrupted."""
    watch = view.watch
    if watch is None or watch.verdict is Verdict.GO or view.time_left_s < _RESERVE_S or state.blind:
        return False
    kinds = {finding.kind for finding in watch.findings} or {"new"}
    patience = _PATIENCE_S if kinds & {"person", "new", "moving"} else _STILL_S
    if state.deadline_s is not None:
        patience = _HURRIED_S
    return state.phase in (Phase.DESCEND, Phase.RETURN) and state.gave_way_s <= patience


def wind_no_go(view: MissionView, state: MissionState) -> str | None:
    """Decides where the wind would not let the vehicle hold its place even at the lowest height of
    a survey, or has stopped the climb. A survey for its positions alone goes on."""
    holds = view.load_lowest <= _NO_GO and state.stopped_s <= _MAX_CLIMB_STOP_S
    if holds or view.params.survey_only:
        return None
    return f"a wind of {view.felt_wind_mps:.1f} m/s is too strong to survey: landing where it began"


def wind_aloft(view: MissionView, state: MissionState) -> str | None:
    """Decides where the wind would leave a hover at survey height no margin."""
    if view.load_aloft <= 1.0:
        return None
    height = state.survey.min_height_m
    return f"a wind of {view.felt_wind_mps:.1f} m/s, so that the survey is flown at {height:g} m"


def blown_away(view: MissionView, state: MissionState) -> str | None:
    """Decides where the wind carries the vehicle away from a reference that waits: nearer to the
    ground it is weaker. A survey for its positions alone goes on."""
    waits = state.stopped_s > _BLOWN_STOP_S and view.behind_m > _BLOWN_M
    if not waits or view.params.survey_only:
        return None
    return f"a wind of {view.felt_wind_mps:.1f} m/s has carried it {view.behind_m:.0f} m away"


def survey_blocked(view: MissionView, state: MissionState) -> str | None:
    """Decides where the wind stops the first survey: sites are chosen on what is mapped."""
    if state.phase is not Phase.SURVEY or state.decisions or view.params.survey_only:
        return None
    reason = leg_blocked(view, state)
    return None if reason is None else f"{reason}: landing on what is mapped"


def leg_blocked(view: MissionView, state: MissionState) -> str | None:
    """Decides where the wind stops any other trajectory."""
    if state.stopped_s <= _MAX_STOP_S:
        return None
    return f"a wind of {view.felt_wind_mps:.1f} m/s leaves no way to fly this leg"


def battery(view: MissionView, state: MissionState) -> str | None:
    """Decides, once, where a low battery leaves no time for a better site than the least bad."""
    if not view.in_emergency or state.deadline_s is not None:
        return None
    return f"an emergency: landing within {view.params.emergency_s:g} s"


def commanded_site_unsuitable(view: MissionView, state: MissionState) -> str | None:
    """Decides where the map refuses the commanded site."""
    if view.params.site_xy_m is None:
        return None
    return f"commanded site {view.params.site_xy_m}: {state.candidates[0].reason}"


def no_site_in_time(view: MissionView, state: MissionState) -> str | None:
    """Decides where an emergency finds no site within reach."""
    hurried = view.in_emergency or state.deadline_s is not None
    return "no safe site found in time" if hurried else None


def another_leg(view: MissionView, state: MissionState) -> str | None:
    """Decides where ``search_legs`` and the battery allow a further leg of a serpentine."""
    if not state.survey.is_serpentine:
        return None
    if state.search_legs >= view.params.search_legs or not energy.affords_search_leg(view, state):
        return None
    return "no safe site yet: another leg"


def no_site(view: MissionView, state: MissionState) -> str | None:
    """Decides where no other rule does."""
    return "no safe site found: returning to the take-off spot"


def home_recheck(view: MissionView, state: MissionState) -> str | None:
    """Decides where the fine map shows no place to land at the take-off spot, in an emergency
    too."""
    found = state.recheck
    if state.phase is not Phase.RETURN or found is None or found.position_odom is not None:
        return None
    return f"{found.text}: landing on the best ground in view"


def site_recheck(view: MissionView, state: MissionState) -> str | None:
    """Decides where the fine map shows no place to land. An emergency lands nevertheless."""
    found = state.recheck
    if found is None or found.position_odom is not None or state.deadline_s is not None:
        return None
    return found.text


def class_recheck(view: MissionView, state: MissionState) -> str | None:
    """Decides where the ground of the site is not of a safe class, seen from closer. An emergency
    lands nevertheless."""
    found = state.recheck
    if found is None or not found.unsafe_class or state.deadline_s is not None:
        return None
    return found.text


def commanded_site_refused(view: MissionView, state: MissionState) -> str | None:
    """Decides where the commanded site was refused from closer."""
    if view.params.site_xy_m is None:
        return None
    return f"the commanded site is refused: {state.decisions[-1].given_up}"


def no_energy_to_go_around(view: MissionView, state: MissionState) -> str | None:
    """Decides where the battery does not last for another landing and the way home."""
    if energy.affords_go_around(view, state):
        return None
    return f"no energy to go around: {state.decisions[-1].given_up}"


def go_around(view: MissionView, state: MissionState) -> str | None:
    """Decides where fewer than ``go_arounds`` were flown."""
    tried, allowed = len(state.refused_odom), view.params.go_arounds
    if tried > allowed:
        return None
    return f"going around ({tried} of {allowed}): {state.decisions[-1].given_up}"


def no_go_around_left(view: MissionView, state: MissionState) -> str | None:
    """Decides where no other rule does."""
    return f"no go-around left: {state.decisions[-1].given_up}"


RULES: tuple[Rule, ...] = (
    Rule(Moment.STEP, estimate_lost, Action.LAND_BLIND, "aborted"),
    Rule(Moment.STEP, sight_lost, Action.LAND_BLIND, "aborted"),
    Rule(Moment.STEP, estimate_unhealthy, Action.HOLD),
    Rule(Moment.STEP, site_not_clear, Action.GIVE_WAY),
    Rule(Moment.CLIMB, wind_no_go, Action.RETURN, "aborted"),
    Rule(Moment.CLIMB, wind_aloft, Action.LOWER_SURVEY),
    Rule(Moment.LEG, blown_away, Action.LAND_BLIND, "aborted"),
    Rule(Moment.LEG, survey_blocked, Action.END_SURVEY),
    Rule(Moment.LEG, leg_blocked, Action.LAND_BLIND, "aborted"),
    Rule(Moment.SELECTION, battery, Action.HURRY),
    Rule(Moment.NO_SITE, commanded_site_unsuitable, Action.RETURN, "aborted"),
    Rule(Moment.NO_SITE, no_site_in_time, Action.LAND_BLIND, "no_site"),
    Rule(Moment.NO_SITE, another_leg, Action.SEARCH),
    Rule(Moment.NO_SITE, no_site, Action.RETURN, "no_site"),
    Rule(Moment.RECHECK, home_recheck, Action.BEST_GROUND),
    Rule(Moment.RECHECK, site_recheck, Action.REFUSE),
    Rule(Moment.RECHECK, class_recheck, Action.REFUSE),
    Rule(Moment.REFUSED, commanded_site_refused, Action.RETURN, "aborted"),
    Rule(Moment.REFUSED, no_energy_to_go_around, Action.RETURN, "no_site"),
    Rule(Moment.REFUSED, go_around, Action.GO_AROUND),
    Rule(Moment.REFUSED, no_go_around_left, Action.RETURN, "no_site"),
)
"""All rules, in the order in which they count."""


def first_ruling(moment: Moment, view: MissionView, state: MissionState) -> Ruling | None:
    """Returns the first of the rules asked at ``moment`` that decides; None where none does."""
    for rule in RULES:
        if rule.moment is moment and (reason := rule.decides(view, state)) is not None:
            return Ruling(rule, reason)
    return None


def _interruptible(state: MissionState) -> bool:
    return state.phase in _IN_THE_AIR and not state.final
