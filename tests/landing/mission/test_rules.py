"""The rules of the mission: where each decides, their order, and the events that name them."""

import ast
import dataclasses
import re
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from touchdown.landing.api import Candidate, Decision, LandingParams, Phase
from touchdown.landing.mission import choice
from touchdown.landing.mission.mission import Mission
from touchdown.landing.mission.rules import RULES, Action, Moment, first_ruling
from touchdown.landing.mission.site_recheck import Recheck
from touchdown.landing.mission.state import MissionState
from touchdown.sim.frames import Pose, rotation_from_yaw

from support.lander_support import QUICK, flat_map
from support.landing_support import make_estimate, make_obs, make_rig, view_of

ROOT = Path(__file__).parents[3]
REFUSED = Candidate(
    position_odom=np.zeros(3), c_sum=0.0, slope_deg=9.0,
    roughness_m=0.0, clearance_m=0.0, accepted=False, reason="refused: too steep", rule="steep",
)  # fmt: skip
DECISION = Decision(
    time_s=0.0, selector="risk", candidates=(REFUSED,), positions_world=np.zeros((1, 3)), why="",
    given_up="a box",
)  # fmt: skip


def flying(phase: Phase = Phase.SURVEY, **params: Any) -> Mission:
    mission = Mission(make_rig(), dataclasses.replace(LandingParams(), **params), QUICK)
    mission.state.take_off(0.0)
    mission.state.enter(phase)
    mission.update(make_obs(0), make_estimate(0, Pose.identity()), view_of(flat_map()))
    return mission


def seen(mission: Mission, **changes: Any) -> None:
    mission.view = dataclasses.replace(mission.view, **changes)


def recheck(state: MissionState, position: Any, unsafe: str = "") -> None:
    state.choose(np.zeros(3))
    state.examine(
        Recheck(position_odom=position, reason="a box", height="10 m", unsafe_class=unsafe)
    )


def refused(mission: Mission, times: int = 1) -> None:
    mission.state.decide(DECISION, None, "")
    for _ in range(times):
        recheck(mission.state, None)
        ruling = first_ruling(Moment.RECHECK, mission.view, mission.state)
        assert ruling is not None
        mission.state.refuse(ruling.reason)


def decided(mission: Mission, moment: Moment) -> str | None:
    ruling = mission.ask(moment)
    return None if ruling is None else ruling.rule.name


def test_the_estimate_s_health_is_judged_in_the_air_alone() -> None:
    mission = flying()
    for seconds, expected in ((-1.0, None), (0.9, None), (1.0, "estimate_unhealthy"),
                              (7.9, "estimate_unhealthy"), (8.0, "estimate_lost")):  # fmt: skip
        seen(mission, unhealthy_s=seconds)
        assert decided(mission, Moment.STEP) == expected
    assert mission.state.aborted
    for phase in (Phase.INIT, Phase.TOUCHDOWN, Phase.DONE):
        mission.state.enter(phase)
        assert decided(mission, Moment.STEP) is None


def test_a_lost_sight_ends_the_flight_at_once_in_a_descent_and_later_in_a_survey() -> None:
    for phase, patience in ((Phase.SURVEY, 6.0), (Phase.APPROACH, 2.0), (Phase.RETURN, 2.0)):
        mission = flying(phase)
        seen(mission, blind_s=patience)
        assert decided(mission, Moment.STEP) is None
        seen(mission, blind_s=patience + 0.1)
        assert decided(mission, Moment.STEP) == "sight_lost" and mission.state.aborted
        mission.state.descend_for_good()
        assert decided(mission, Moment.STEP) is None
    alone = flying(survey_only=True)
    seen(alone, blind_s=60.0)
    assert decided(alone, Moment.STEP) is None


def test_wind_ends_the_first_survey_or_the_flight() -> None:
    mission = flying()
    mission.state.follow_clock(0.0, 40.0)
    assert decided(mission, Moment.LEG) is None
    mission.state.follow_clock(0.0, 40.1)
    assert decided(mission, Moment.LEG) == "survey_blocked" and not mission.state.aborted
    mission.state.decide(DECISION, None, "")
    assert decided(mission, Moment.LEG) == "leg_blocked" and mission.state.aborted
    alone = flying(survey_only=True)
    alone.state.follow_clock(0.0, 41.0)
    assert decided(alone, Moment.LEG) == "leg_blocked"


def test_who_is_carried_away_from_a_reference_that_waits_comes_down() -> None:
    for phase in (Phase.SURVEY, Phase.APPROACH):
        mission = flying(phase)
        for stopped_s, behind_m, expected in ((5.0, 9.0, None), (5.1, 6.0, None),
                                              (5.1, 6.1, "blown_away")):  # fmt: skip
            mission.state.follow_clock(0.0, stopped_s)
            seen(mission, behind_m=behind_m)
            assert decided(mission, Moment.LEG) == expected
        assert mission.state.aborted
    alone = flying(survey_only=True)
    alone.state.follow_clock(0.0, 9.0)
    seen(alone, behind_m=9.0)
    assert decided(alone, Moment.LEG) is None


def test_an_emergency_begins_once() -> None:
    mission = flying(Phase.SELECT)
    assert decided(mission, Moment.SELECTION) is None
    seen(mission, time_left_s=44.0)
    assert decided(mission, Moment.SELECTION) == "battery"
    mission.state.set_deadline(45.0)
    assert decided(mission, Moment.SELECTION) is None


def test_without_a_site_another_leg_is_flown_while_keys_and_battery_allow() -> None:
    mission = flying(Phase.SELECT)
    assert decided(mission, Moment.NO_SITE) == "another_leg" and not mission.state.no_site
    mission.state.begin_search_leg()
    assert decided(mission, Moment.NO_SITE) == "no_site" and mission.state.no_site
    poor = flying(Phase.SELECT, emergency_s=5.0)
    seen(poor, time_left_s=20.0)
    assert decided(poor, Moment.NO_SITE) == "no_site"
    hurried = flying(Phase.SELECT, emergency="battery")
    assert decided(hurried, Moment.NO_SITE) == "no_site_in_time" and hurried.state.no_site
    commanded = flying(Phase.SELECT, emergency="battery", site_xy_m=(3.0, 4.0))
    commanded.state.decide(DECISION, None, "")
    assert decided(commanded, Moment.NO_SITE) == "commanded_site_unsuitable"
    assert commanded.state.aborted and "too steep" in commanded.state.note


@pytest.mark.parametrize(
    ("position", "unsafe", "expected"),
    [(np.zeros(3), "", None), (None, "", "site_recheck"), (np.zeros(3), "a road", "class_recheck")],
)
def test_a_recheck_refuses_shape_and_class_but_not_in_an_emergency(
    position: Any, unsafe: str, expected: str | None
) -> None:
    mission = flying(Phase.DESCEND)
    recheck(mission.state, position, unsafe)
    assert decided(mission, Moment.RECHECK) == expected
    assert ("at 10 m: " in mission.state.note) and ((unsafe or "a box") in mission.state.note)
    mission.state.set_deadline(30.0)
    assert decided(mission, Moment.RECHECK) is None


def test_a_refused_site_leads_to_another_or_home() -> None:
    mission = flying(Phase.DESCEND, go_arounds=1)
    refused(mission)
    assert mission.state.site_odom is None and len(mission.state.refused_odom) == 1
    assert decided(mission, Moment.REFUSED) == "go_around" and not mission.state.no_site
    refused(mission)
    assert decided(mission, Moment.REFUSED) == "no_go_around_left" and mission.state.no_site
    poor = flying(Phase.DESCEND)
    refused(poor)
    seen(poor, time_left_s=50.0)
    assert decided(poor, Moment.REFUSED) == "no_energy_to_go_around" and poor.state.no_site
    commanded = flying(Phase.DESCEND, site_xy_m=(3.0, 4.0))
    refused(commanded)
    assert decided(commanded, Moment.REFUSED) == "commanded_site_refused"
    assert commanded.state.aborted and not commanded.state.no_site


def test_events_name_the_rule_once_while_it_holds() -> None:
    mission, events = flying(), []
    for tick in range(0, 1812, 12):
        estimate = make_estimate(tick, Pose.identity())
        estimate = dataclasses.replace(estimate, healthy=tick % 900 >= 750)
        mission.update(make_obs(tick), estimate, view_of(flat_map()))
        mission.ask(Moment.STEP)
        events += mission.state.events
    assert len(events) == 2 and all(
        text.startswith("SURVEY estimate_unhealthy: the position estimate is unhealthy")
        for text in events
    )


def test_each_moment_s_last_word_is_a_rule_that_always_decides() -> None:
    """Without a site, and after a refusal, something has to follow."""
    mission = flying(Phase.SELECT, search_legs=0, go_arounds=0)
    refused(mission)
    for moment in (Moment.NO_SITE, Moment.REFUSED):
        last = [rule for rule in RULES if rule.moment is moment][-1]
        assert last.decides(mission.view, mission.state) and last.action is Action.RETURN


def test_architecture_lists_the_rules() -> None:
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    section = text.split("## Rules of the mission", 1)[1].split("\n## ", 1)[0]
    listed = re.findall(r"^\| `(\w+)` \| ([^|]+) \| [^|]+ \| ([^|]+) \|$", section, re.MULTILINE)
    assert listed == [(rule.name, rule.moment, rule.action) for rule in RULES]


def test_the_state_changes_by_its_own_methods_alone() -> None:
    """No other module assigns to an attribute of a `MissionState`."""
    attributes = set(vars(MissionState(QUICK)))
    for path in (ROOT / "landing/mission").glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            written = isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store)
            if not written or path.name == "state.py":
                continue
            owner = ast.unparse(node.value)
            assert not (owner.endswith("state") and node.attr in attributes), (path.name, node.attr)


def test_a_site_that_was_not_seen_has_a_place() -> None:
    """It has no height; turned into the world it had no place either, and rays that start nowhere
    take minutes."""
    unseen = dataclasses.replace(REFUSED, position_odom=np.array([3.0, 4.0, np.nan]))
    turn = rotation_from_yaw(np.pi / 2)
    view = types.SimpleNamespace(
        world=lambda position: turn @ position,
        ground_odom=-2.0,
        obs=types.SimpleNamespace(time_s=5.0),
    )
    mission: Any = types.SimpleNamespace(view=view, params=types.SimpleNamespace(selector="risk"))
    np.testing.assert_allclose(
        choice.decided(mission, (unseen,)).positions_world, [[-4.0, 3.0, -2.0]]
    )
