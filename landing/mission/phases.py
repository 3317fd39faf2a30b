"""The phases of a landing mission, each a generator that yields one setpoint a control step."""

from __future__ import annotations

import dataclasses
from collections.abc import Generator

import numpy as np
from numpy.typing import NDArray

from touchdown.controller.api import Setpoint
from touchdown.landing.api import Candidate, Phase
from touchdown.landing.mission.choice import choose_commanded, choose_sites, decided
from touchdown.landing.mission.descent import descend_to, final_descent
from touchdown.landing.mission.heading import turn_in_climb
from touchdown.landing.mission.mission_state import LegBlockedError, Mission, Steps, vertical_move
from touchdown.landing.mission.second_look import ground_under
from touchdown.landing.mission.trajectory import straight_trajectory, survey_trajectory

Array = NDArray[np.float64]

_SENSOR_SETTLE_S = 1.5
_SPIN_UP_S = 0.8
_SPIN_UP_THRUST = 0.4
_HOVER_AFTER_CLIMB_S = 1.0
_SETTLE_S = 0.5
"""hover before a decision, so that delayed scans and images arrive"""
_CORRIDOR_M = 3.0
_FEEL_ABOVE_M = 3.0
"""height from which on the felt wind has settled after the take-off"""
_GUSTS_UP_THERE = 0.25
"""gusts over the mean wind that a survey at a height must leave room for: two standard deviations
of the turbulence of MIL-F-8785C at 30 m over the mean wind there"""
_ROUGHNESS_M = 0.1
_DESCENT_RATE = 0.3
"""slowest rate of the clock in a descent that nothing may stop"""
_BLOWN_OFF_M = 2.0


def run_phases(mission: Mission) -> Steps:
    """Runs the whole mission; never ends."""
    yield from initialise(mission)
    try:
        yield from take_off(mission)
        yield from survey(mission)
        if mission.params.return_home:
            yield from return_home(mission)
        elif not mission.params.survey_only:
            landed = yield from land_somewhere(mission)
            if not landed and mission.deadline_s is not None:
                yield from come_down_here(mission)
            elif not landed:
                yield from return_home(mission)
    except LegBlockedError:
        mission.aborted = True
        if not mission.params.survey_only:
            yield from come_down_here(mission)
    yield from rest(mission)


def initialise(mission: Mission) -> Steps:
    """Keeps the motors off while the estimator determines biases at rest, then spins them up."""
    mission.phase = Phase.INIT
    start = mission.now
    while mission.now - start < _SENSOR_SETTLE_S:
        yield mission.setpoint(mission.start_world, in_world=True, motors_on=False)
    mission.note = "motors on"
    start = mission.now
    while mission.now - start < _SPIN_UP_S:
        yield mission.setpoint(mission.start_world, in_world=True, thrust_limit=_SPIN_UP_THRUST)


def take_off(mission: Mission) -> Steps:
    """Climbs to survey height above the start."""
    mission.phase = Phase.TAKEOFF
    mission.takeoff_s = mission.now
    height = mission.ground_world + mission.survey.height_m
    mission.note = f"climbing to {mission.survey.height_m:.0f} m"
    climb = vertical_move(mission.start_world, height, mission.params.climb_speed_mps)
    mission.turn = turn_in_climb(climb, mission.now, mission.survey.climb_turn_deg)
    ceiling = _Ceiling(mission)
    yield from mission.follow(
        climb, in_world=True, hold_s=_HOVER_AFTER_CLIMB_S, until=ceiling.reached
    )
    if ceiling.found:
        yield from _lower_survey(mission)


def _lower_survey(mission: Mission) -> Steps:
    """Chooses the lowest height for the survey, where the wind is weaker, and goes there."""
    lowest, wind = mission.survey.min_height_m, mission.felt_wind.speed_mps
    mission.add_event(
        f"TAKEOFF: a wind of {wind:.1f} m/s, so that the survey is flown at {lowest:g} m"
    )
    mission.survey = dataclasses.replace(mission.survey, height_m=lowest)
    height = mission.ground_world + lowest
    if mission.reference_world[2] > height + 0.5:
        here = mission.reference_world.copy()
        sink = vertical_move(here, height, mission.params.descent_speed_mps)
        yield from mission.follow(sink, in_world=True, least_rate=_DESCENT_RATE)


class _Ceiling:
    """Finds during the climb whether the wind would leave a hover at survey height no margin.

    The mean of the wind felt so far is taken to survey height by the logarithmic profile of open
    country. Below ``survey.min_height_m`` the climb goes on in any wind."""

    def __init__(self, mission: Mission) -> None:
        self._mission = mission
        self._sum: Array = np.zeros(3)
        self._samples = 0
        self.found = False

    def reached(self) -> bool:
        """True once it would; called once a control step."""
        mission = self._mission
        height = float(mission.reference_world[2]) - mission.ground_world
        goal = mission.survey.height_m
        if not mission.params.slow_in_wind or height < _FEEL_ABOVE_M:
            return False
        self._sum += mission.felt_wind.wind_odom / np.log(height / _ROUGHNESS_M)
        self._samples += 1
        if mission.survey.min_height_m <= height < goal - 1.0:
            mean = self._sum / self._samples * np.log(goal / _ROUGHNESS_M)
            load = mission.time_scaling.hover_load((1.0 + _GUSTS_UP_THERE) * mean, gusts=False)
            self.found = self.found or load > 1.0
        return self.found


def survey(mission: Mission) -> Steps:
    """Flies the serpentine."""
    mission.phase = Phase.SURVEY
    params = mission.survey
    mission.note = f"surveying {params.legs} legs of {params.leg_length_m:.0f} m"
    path = survey_trajectory(mission.reference_world.copy(), mission.start_yaw, params)
    try:
        yield from mission.follow(path, in_world=True)
    except LegBlockedError:
        if mission.params.survey_only:
            raise
        mission.add_event("SURVEY broken off: landing on what is mapped")


def land_somewhere(mission: Mission) -> Generator[Setpoint, None, bool]:
    """Selects a site, approaches it and descends, again after a go-around. Returns False where
    there is no site to land on."""
    for attempt in range(mission.params.go_arounds + 1):
        site = yield from select(mission)
        if site is None:
            return False
        yield from approach(mission, site)
        look = yield from descend_to(mission)
        if look is None:
            yield from final_descent(mission)
            return True
        assert mission.site_odom is not None
        mission.refused_odom.append(mission.site_odom)
        mission.site_odom = mission.site_class = None
        mission.give_up_site(look)
        if mission.params.site_xy_m is not None:
            mission.aborted = True
            mission.note = f"the commanded site is refused: {look}"
            return False
        mission.note = f"going around ({attempt + 1} of {mission.params.go_arounds}): {look}"
        if not mission.affords_go_around():
            mission.note = f"no energy to go around: {look}"
            break
        yield from climb_back(mission)
    mission.no_site = True
    return False


def select(mission: Mission) -> Generator[Setpoint, None, Candidate | None]:
    """Returns the site to land on, after further legs where the map has none; None without one."""
    for extra in range(mission.params.search_legs + 1):
        mission.phase = Phase.SELECT
        if mission.in_emergency and mission.deadline_s is None:
            mission.deadline_s = mission.now + mission.params.emergency_s
        yield from mission.hover(_SETTLE_S)
        before = _classified_batches(mission)
        site = _decide(mission)
        batches = _classified_batches(mission) - before
        seconds = batches * mission.params.classifier_batch_latency_s
        yield from mission.hover(mission.params.decision_latency_s + seconds)
        if site is not None:
            return site
        if mission.params.site_xy_m is not None:
            return None
        if mission.in_emergency:
            break  # no site within reach: descend at the current position
        if extra < mission.params.search_legs and mission.affords_search_leg():
            yield from search_leg(mission, extra)
    mission.no_site = True
    going = "coming down here" if mission.in_emergency else "returning to the take-off spot"
    mission.note = f"no safe site found: {going}"
    return None


def _decide(mission: Mission) -> Candidate | None:
    params = mission.params
    wanted = mission.commanded_odom
    if wanted is not None:
        candidate = choose_commanded(mission, wanted)
        if not (candidate.accepted or params.check_site):
            candidate = _accepted_unchecked(mission, wanted, candidate)
        mission.decide(decided(mission, (candidate,)))
        mission.aborted = not candidate.accepted
        mission.note = f"commanded site {params.site_xy_m}: {candidate.reason}"
    else:
        mission.decide(decided(mission, choose_sites(mission)))
        if not mission.candidates:
            mission.note = "nothing is mapped"
            return None
        candidate = mission.candidates[0]
        where = mission.world(candidate.position_odom)
        mission.note = f"site at ({where[0]:.1f}, {where[1]:.1f}): {candidate.reason}"
    if not candidate.accepted:
        return None
    mission.site_odom = candidate.position_odom
    if mission.class_check is not None:
        mission.site_class = mission.class_check.class_of(candidate)
    return candidate


def _classified_batches(mission: Mission) -> int:
    """Returns the number of batches that ground classification has classified so far."""
    return 0 if mission.class_check is None else mission.class_check.batches


def _accepted_unchecked(mission: Mission, wanted: Array, refused: Candidate) -> Candidate:
    """Returns the commanded site ``wanted`` (2,), accepted without the check of the map."""
    height = ground_under(mission.map_view, wanted)
    if not np.isfinite(height):
        height = float(mission.odom(mission.start_world)[2]) - mission.leg_height
    return dataclasses.replace(
        refused,
        position_odom=np.array([*wanted, height]),
        accepted=True,
        rule="commanded_unchecked",
        reason=f"accepted unchecked; by the map: {refused.reason}",
    )


def search_leg(mission: Mission, extra: int) -> Steps:
    """Flies one more leg beside the last one."""
    mission.phase = Phase.SURVEY
    mission.note = "no safe site yet: another leg"
    params = mission.survey
    side = np.array([-np.sin(mission.start_yaw), np.cos(mission.start_yaw), 0.0])
    ahead = np.array([np.cos(mission.start_yaw), np.sin(mission.start_yaw), 0.0])
    base = mission.start_world.copy()
    base[2] = mission.ground_world + params.height_m
    row = base + (params.legs + extra) * params.leg_spacing_m * side
    near, far = row, row + params.leg_length_m * ahead
    here = mission.reference_world
    ends = (near, far) if np.linalg.norm(here - near) < np.linalg.norm(here - far) else (far, near)
    for end in ends:
        yield from _straight(mission, end, in_world=True)


def approach(mission: Mission, site: Candidate) -> Steps:
    """Flies to a point above the site, as low as the mapped obstacles on the way allow."""
    mission.phase = Phase.APPROACH
    start = mission.odom(mission.reference_world)
    height = approach_height(mission, start, site.position_odom)
    end = np.array([site.position_odom[0], site.position_odom[1], height])
    yield from _straight(mission, end, hold_s=0.5)


def approach_height(mission: Mission, start: Array, site: Array) -> float:
    """Returns the lowest z of the end point above the site, in steps of 2 m between the look height
    and the start's height, at which the straight way keeps the obstacle margin above the map."""
    lowest = site[2] + mission.params.look_height_m + mission.leg_height + 2.0
    highest = max(float(start[2]), lowest)
    grid = mission.map_view.coarse
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
    here = mission.odom(mission.reference_world)
    height = mission.odom(mission.start_world)[2] - mission.leg_height + mission.survey.height_m
    if height > here[2] + 0.5:
        yield from mission.follow(vertical_move(here, height, mission.params.climb_speed_mps))


def return_home(mission: Mission) -> Steps:
    """Flies back to the take-off spot, which is known to be safe, and lands."""
    mission.phase = Phase.RETURN
    yield from climb_back(mission)
    above = mission.start_world.copy()
    above[2] = mission.reference_world[2]
    yield from _straight(mission, above, in_world=True, hold_s=1.0)
    home = mission.start_world.copy()
    home[2] = mission.ground_world
    mission.site_odom, mission.site_class = mission.odom(home), None
    low = mission.site_odom + np.array([0, 0, mission.params.commit_height_m + mission.leg_height])
    here = mission.odom(mission.reference_world)
    yield from mission.follow(vertical_move(here, low[2], mission.params.descent_speed_mps))
    mission.committed_site_world = home
    yield from final_descent(mission)


def come_down_here(mission: Mission) -> Steps:
    """Descends from the reference without looks."""
    mission.phase, mission.final = Phase.DESCEND, True
    here = mission.odom(mission.reference_world)
    if np.linalg.norm(mission.position_odom - here) > _BLOWN_OFF_M:
        here = mission.position_odom.copy()
    ground = ground_under(mission.map_view, here[:2])
    if not np.isfinite(ground):
        ground = float(mission.odom(mission.start_world)[2]) - mission.leg_height
    mission.site_odom, mission.site_class = np.array([here[0], here[1], ground]), None
    low = ground + mission.params.commit_height_m + mission.leg_height
    if low < here[2]:
        sink = vertical_move(here, low, mission.params.descent_speed_mps)
        yield from mission.follow(sink, least_rate=_DESCENT_RATE)
    mission.committed_site_world = mission.world(mission.site_odom)
    yield from final_descent(mission)


def rest(mission: Mission) -> Steps:
    """Keeps the motors off on the ground; after a survey alone hovers until the run is ended."""
    mission.phase = Phase.DONE
    position = mission.reference_world.copy()
    while True:
        yield mission.setpoint(position, in_world=True, motors_on=mission.params.survey_only)


def _straight(
    mission: Mission, end: Array, *, in_world: bool = False, hold_s: float = 0.0
) -> Steps:
    start = mission.reference_world if in_world else mission.odom(mission.reference_world)
    if np.linalg.norm(end - start) < 1e-3:
        return
    params = mission.params
    path = straight_trajectory(
        start.copy(), np.zeros(3), end, params.cruise_speed_mps, params.accel_mps2
    )
    yield from mission.follow(path, in_world=in_world, hold_s=hold_s)
