"""The phases of a landing mission, each a generator that yields one setpoint a control step."""

from collections.abc import Callable, Generator

import numpy as np

from touchdown.controller.api import Setpoint
from touchdown.landing.api import Phase
from touchdown.landing.mission.blind_descent import blind_descent
from touchdown.landing.mission.choice import choose_commanded, choose_sites, decided
from touchdown.landing.mission.descent import descend_to, watched_descent
from touchdown.landing.mission.mission import (
    LegBlockedError,
    Mission,
    RuledSteps,
    SiteGivenUpError,
    Steps,
)
from touchdown.landing.mission.rules import Action, Moment
from touchdown.landing.mission.terrain_following import Lift, LiftedTrajectory
from touchdown.landing.mission.trajectory import (
    straight_trajectory,
    turn_in_climb,
    vertical_move,
)
from touchdown.landing.mission.waypoints import survey_path, survey_waypoints
from touchdown.sim.typing import Array

_SENSOR_SETTLE_S = 1.5
_SPIN_UP_S = 0.8
_SPIN_UP_THRUST = 0.4
_HOVER_AFTER_CLIMB_S = 1.0
_SETTLE_S = 0.5
"""hover before a decision, so that delayed scans and images arrive"""
_CORRIDOR_M = 3.0
_DESCENT_RATE = 0.3
"""slowest rate of the clock in a descent that nothing may stop"""


def run_phases(mission: Mission) -> Steps:
    """Runs the whole mission; never ends."""
    yield from initialise(mission)
    try:
        no_go = yield from take_off(mission)
        if no_go is None:
            yield from survey_and_land(mission)
        else:
            yield from land_at_home(mission)
    except LegBlockedError:
        if not mission.params.survey_only:
            yield from blind_descent(mission)
    yield from rest(mission)


def survey_and_land(mission: Mission) -> Steps:
    """What follows a climb: the survey and, unless it is all, a landing at a site or at home."""
    yield from survey(mission)
    if mission.params.return_home:
        yield from return_home(mission)
    elif not mission.params.survey_only:
        no_landing = yield from land_somewhere(mission)
        if no_landing is not None:
            yield from _WAYS_DOWN[no_landing.action](mission)


def initialise(mission: Mission) -> Steps:
    """Keeps the motors off while the estimator determines biases at rest, then spins them up."""
    mission.state.enter(Phase.INIT)
    start = mission.now
    while mission.now - start < _SENSOR_SETTLE_S:
        yield mission.setpoint(mission.start_world, in_world=True, motors_on=False)
    mission.state.enter(Phase.INIT, "motors on")
    start = mission.now
    while mission.now - start < _SPIN_UP_S:
        here = mission.view.estimate.world_from_body.translation
        yield mission.setpoint(here, in_world=True, thrust_limit=_SPIN_UP_THRUST)


def take_off(mission: Mission) -> RuledSteps:
    """Climbs to survey height above the start, or chooses the lowest height for the survey, where
    the wind is weaker, and goes there; returns the rule that lets it go no further. Leaves the
    ground where the estimate has it: towards the take-off spot, which an estimate in error has
    aside, it would lean while it stands."""
    state, start = mission.state, mission.view.estimate.world_from_body.translation.copy()
    state.take_off(mission.now)
    height = mission.view.ground_world + state.survey.height_m
    climb = vertical_move(start, height, mission.params.climb_speed_mps)
    mission.turn = turn_in_climb(climb, mission.now, state.survey.climb_turn_deg)
    ruling = yield from mission.follow(
        climb, in_world=True, hold_s=_HOVER_AFTER_CLIMB_S, until=Moment.CLIMB
    )
    if ruling is None or ruling.action is not Action.LOWER_SURVEY:
        return ruling
    state.lower_survey()
    height = mission.view.ground_world + state.survey.height_m
    if mission.reference_world[2] > height + 0.5:
        here = mission.reference_world.copy()
        sink = vertical_move(here, height, mission.params.descent_speed_mps)
        yield from mission.follow(sink, in_world=True, min_rate=_DESCENT_RATE)
    return None


def survey(mission: Mission) -> Steps:
    """Flies the survey, higher where the ground rises."""
    params = mission.state.survey
    legs = "1 leg" if params.legs == 1 else f"{params.legs} legs"
    what = f"{legs} of {params.leg_length_m:.0f} m"
    if not params.is_serpentine:
        what = f"{len(survey_waypoints(mission.start_yaw, params))} waypoints"
    mission.state.enter(Phase.SURVEY, f"surveying {what}")
    above = mission.reference_world.copy()
    path = survey_path(above, mission.start_yaw, params, mission.params)
    lift = Lift(params.height_m)
    try:
        for setpoint in mission.follow(LiftedTrajectory(path, lift), in_world=True):
            yield setpoint
            view = mission.view
            lift.update(view.map_view, mission.reference_odom[:2], view.ground_odom, mission.now)
            mission.lift_m = lift.height_m
    except LegBlockedError as blocked:
        if blocked.action is not Action.END_SURVEY:
            raise


def land_somewhere(mission: Mission) -> RuledSteps:
    """Selects a site, approaches it and descends, again after a go-around. Returns the rule by
    which it is left without a landing; None after one."""
    while True:
        no_site = yield from select(mission)
        if no_site is not None:
            return no_site
        reason = yield from _land_at_site(mission)
        if reason is None:
            return None
        mission.state.refuse(reason)
        ruling = mission.ask(Moment.REFUSED)
        if ruling is None or ruling.action is not Action.GO_AROUND:
            return ruling
        yield from climb_back(mission)


def _land_at_site(mission: Mission) -> Generator[Setpoint, None, str | None]:
    """Returns the reason why the site is refused; None after a landing."""
    try:
        mission.may_refuse = mission.state.deadline_s is None
        yield from approach(mission)
        refusal = yield from descend_to(mission)
        if refusal is not None:
            return refusal.reason
        yield from watched_descent(mission)
    except SiteGivenUpError as given_up:
        return str(given_up)
    finally:
        mission.may_refuse = False
    return None


def select(mission: Mission) -> RuledSteps:
    """Chooses the site to land on, after further legs where the map has none. Returns None with a
    site, else the rule that ends the search."""
    state, params = mission.state, mission.params
    while True:
        state.enter(Phase.SELECT, "choosing a site")
        if mission.ask(Moment.SELECTION) is not None:
            state.set_deadline(mission.now + params.emergency_s)
        yield from mission.hover(_SETTLE_S)
        before = _classified_batches(mission)
        chosen = _decide(mission)
        batches = _classified_batches(mission) - before
        seconds = batches * params.classifier_batch_latency_s
        yield from mission.hover(params.decision_latency_s + seconds)
        if chosen:
            return None
        ruling = mission.ask(Moment.NO_SITE)
        if ruling is None or ruling.action is not Action.SEARCH:
            return ruling
        yield from search_leg(mission)


def _decide(mission: Mission) -> bool:
    """Returns whether a site was chosen."""
    wanted = mission.view.commanded_odom
    choice = choose_sites(mission) if wanted is None else choose_commanded(mission, wanted)
    state, check, reason = mission.state, mission.class_check, "nothing is mapped"
    best = choice.candidates[0] if choice.candidates else None
    if best is not None:
        where = mission.view.world(best.position_odom)
        reason = f"site at ({where[0]:.1f}, {where[1]:.1f}): {best.reason}"
    state.decide(decided(mission, choice.candidates), choice.costmap, reason)
    if best is None or not best.accepted:
        return False
    state.choose(best.position_odom, None if check is None else check.class_of(best))
    return True


def _classified_batches(mission: Mission) -> int:
    """Returns the number of batches that ground classification has classified so far."""
    return 0 if mission.class_check is None else mission.class_check.batches


def search_leg(mission: Mission) -> Steps:
    """Flies one more leg beside the last one."""
    params, before = mission.state.survey, mission.state.search_legs
    mission.state.begin_search_leg()
    side = np.array([-np.sin(mission.start_yaw), np.cos(mission.start_yaw), 0.0])
    ahead = np.array([np.cos(mission.start_yaw), np.sin(mission.start_yaw), 0.0])
    base = mission.start_world.copy()
    base[2] = mission.view.ground_world + params.height_m + mission.lift_m
    row = base + (params.legs + before) * params.leg_spacing_m * side
    near, far = row, row + params.leg_length_m * ahead
    here = mission.reference_world
    ends = (near, far) if np.linalg.norm(here - near) < np.linalg.norm(here - far) else (far, near)
    for end in ends:
        yield from _straight(mission, end, in_world=True)


def approach(mission: Mission) -> Steps:
    """Flies to a point above the site, as low as the mapped obstacles on the way allow."""
    site = mission.state.site_odom
    assert site is not None
    mission.state.enter(Phase.APPROACH)
    height = approach_height(mission, mission.reference_odom, site)
    yield from _straight(mission, np.array([site[0], site[1], height]), hold_s=0.5)


def approach_height(mission: Mission, start: Array, site: Array) -> float:
    """Returns the lowest z of the end point above the site, in steps of 2 m between the look height
    and the start's height, at which the straight way keeps the obstacle margin above the map."""
    lowest = site[2] + mission.params.look_height_m + mission.leg_height + 2.0
    highest = max(float(start[2]), lowest)
    grid = mission.view.map_view.coarse
    length = float(np.linalg.norm(site[:2] - start[:2]))
    fractions = np.linspace(0.0, 1.0, max(int(length / 1.0), 2))
    along = start[:2] + fractions[:, None] * (site[:2] - start[:2])
    reach = int(np.ceil(_CORRIDOR_M / grid.cell_m))
    tops = np.full(fractions.size, -np.inf)
    for index, xy in enumerate(along):
        col, row = np.floor((xy - grid.origin_xy_m) / grid.cell_m).astype(int)
        patch = grid.max_height_m[
            max(row - reach, 0) : max(row + reach + 1, 0),
            max(col - reach, 0) : max(col + reach + 1, 0),
        ]
        if np.isfinite(patch).any():
            tops[index] = float(np.nanmax(patch))
    for height in np.arange(lowest, highest, 2.0):
        way = start[2] + fractions * (height - start[2])
        if (way - tops >= mission.params.obstacle_margin_m).all():
            return float(height)
    return highest


def climb_back(mission: Mission) -> Steps:
    """Climbs to survey height, where the next decision is made."""
    here = mission.reference_odom
    height = mission.view.ground_odom + mission.state.survey.height_m
    if height > here[2] + 0.5:
        yield from mission.follow(vertical_move(here, height, mission.params.climb_speed_mps))


def return_home(mission: Mission) -> Steps:
    """Flies back to the take-off spot at survey height and lands there."""
    mission.state.enter(Phase.RETURN)
    yield from climb_back(mission)
    yield from land_at_home(mission)


def land_at_home(mission: Mission) -> Steps:
    """Flies to the take-off spot at the present height and descends there, with the looks of any
    descent."""
    mission.state.enter(Phase.RETURN)
    above = mission.start_world.copy()
    above[2] = mission.reference_world[2]
    yield from _straight(mission, above, in_world=True, hold_s=1.0)
    home = mission.start_world.copy()
    home[2] = mission.view.ground_world
    mission.state.choose(mission.view.odom(home))
    yield from descend_to(mission)
    yield from watched_descent(mission)


_WAYS_DOWN: dict[Action, Callable[[Mission], Steps]] = {
    Action.RETURN: return_home,
    Action.LAND_BLIND: blind_descent,
}


def abort(mission: Mission) -> Steps:
    """Lands by velocity and rests, whatever the phase."""
    yield from blind_descent(mission)
    yield from rest(mission)


def rest(mission: Mission) -> Steps:
    """Keeps the motors off on the ground; after a survey alone hovers until the run is ended."""
    mission.state.enter(Phase.DONE)
    position = mission.reference_world.copy()
    while True:
        yield mission.setpoint(position, in_world=True, motors_on=mission.params.survey_only)


def _straight(
    mission: Mission, end: Array, *, in_world: bool = False, hold_s: float = 0.0
) -> Steps:
    start = mission.reference_world if in_world else mission.reference_odom
    if np.linalg.norm(end - start) < 1e-3:
        return
    params = mission.params
    path = straight_trajectory(
        start.copy(), np.zeros(3), end, params.cruise_speed_mps, params.accel_mps2
    )
    yield from mission.follow(path, in_world=in_world, hold_s=hold_s)
