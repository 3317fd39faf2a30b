"""The phases of a landing flight, each a generator that yields one setpoint a control step."""

from __future__ import annotations

import dataclasses
from collections.abc import Generator

import numpy as np
from numpy.typing import NDArray

from touchdown.controller.api import Setpoint
from touchdown.landing.api import Candidate, Phase
from touchdown.landing.mission.descent import descend_to, final_descent
from touchdown.landing.mission.mission_state import Flight, Steps, vertical_move
from touchdown.landing.mission.second_look import ground_under
from touchdown.landing.mission.trajectory import straight_trajectory, survey_trajectory
from touchdown.landing.selection.choice import choose_commanded, choose_sites

Array = NDArray[np.float64]

_SENSOR_SETTLE_S = 1.5
_SPIN_UP_S = 0.8
_SPIN_UP_THRUST = 0.4
_HOVER_AFTER_CLIMB_S = 1.0
_SETTLE_S = 0.5
"""hover before a decision, so that scans and images on their way arrive"""
_ACCEL_MPS2 = 1.5
_CORRIDOR_M = 3.0


def fly(flight: Flight) -> Steps:
    """The whole flight, top to bottom; never ends."""
    yield from initialise(flight)
    yield from take_off(flight)
    yield from survey(flight)
    if not flight.params.survey_only:
        landed = yield from land_somewhere(flight)
        if not landed and flight.deadline_s is not None:
            yield from come_down_here(flight)
        elif not landed:
            yield from return_home(flight)
    yield from rest(flight)


def initialise(flight: Flight) -> Steps:
    """Motors off while the estimator learns biases at rest, then idle up."""
    flight.phase = Phase.INIT
    start = flight.now
    while flight.now - start < _SENSOR_SETTLE_S:
        yield flight.setpoint(flight.start_world, in_world=True, motors_on=False)
    flight.note = "motors on"
    start = flight.now
    while flight.now - start < _SPIN_UP_S:
        yield flight.setpoint(flight.start_world, in_world=True, thrust_limit=_SPIN_UP_THRUST)


def take_off(flight: Flight) -> Steps:
    """Climb to survey height above the start."""
    flight.phase = Phase.TAKEOFF
    flight.takeoff_s = flight.now
    height = flight.ground_world + flight.survey.height_m
    flight.note = f"climbing to {flight.survey.height_m:.0f} m"
    climb = vertical_move(flight.start_world, height, flight.params.climb_speed_mps)
    yield from flight.follow(climb, in_world=True, hold_s=_HOVER_AFTER_CLIMB_S)


def survey(flight: Flight) -> Steps:
    """The serpentine above the place."""
    flight.phase = Phase.SURVEY
    params = flight.survey
    flight.note = f"surveying {params.legs} legs of {params.leg_length_m:.0f} m"
    path = survey_trajectory(flight.reference_world.copy(), flight.start_yaw, params)
    yield from flight.follow(path, in_world=True)


def land_somewhere(flight: Flight) -> Generator[Setpoint, None, bool]:
    """Select, approach, descend; another try after a go-around. False: nothing to land on."""
    for attempt in range(flight.params.go_arounds + 1):
        site = yield from select(flight)
        if site is None:
            return False
        yield from approach(flight, site)
        look = yield from descend_to(flight)
        if look is None:
            yield from final_descent(flight)
            return True
        assert flight.site_odom is not None
        flight.refused_odom.append(flight.site_odom)
        flight.site_odom = flight.site_place = None
        if flight.params.site_xy_m is not None:
            flight.aborted = True
            flight.note = f"the commanded site is refused: {look}"
            return False
        flight.note = f"going around ({attempt + 1} of {flight.params.go_arounds}): {look}"
        if not flight.affords_go_around():
            flight.note = f"no energy to go around: {look}"
            break
        yield from climb_back(flight)
    flight.no_site = True
    return False


def select(flight: Flight) -> Generator[Setpoint, None, Candidate | None]:
    """Decide where to land; more legs where the map offers nothing."""
    for extra in range(flight.params.search_legs + 1):
        flight.phase = Phase.SELECT
        if flight.in_emergency and flight.deadline_s is None:
            flight.deadline_s = flight.now + flight.params.emergency_s
        yield from flight.hover(_SETTLE_S)
        asked = _batches(flight)
        site = _decide(flight)
        seconds = (_batches(flight) - asked) * flight.params.place_batch_latency_s
        yield from flight.hover(flight.params.decision_latency_s + seconds)
        if site is not None:
            return site
        if flight.params.site_xy_m is not None:
            return None
        if flight.in_emergency:
            break  # nothing in reach: down here, whatever is below
        if extra < flight.params.search_legs and flight.affords_search_leg():
            yield from search_leg(flight, extra)
    flight.no_site = True
    going = "coming down here" if flight.in_emergency else "returning to the take-off spot"
    flight.note = f"no safe site found: {going}"
    return None


def _decide(flight: Flight) -> Candidate | None:
    params = flight.params
    wanted = flight.commanded_odom
    if wanted is not None:
        candidate = choose_commanded(flight, wanted)
        if not (candidate.accepted or params.check_site):
            candidate = _on_their_word(flight, wanted, candidate)
        flight.candidates = (candidate,)
        flight.aborted = not candidate.accepted
        flight.note = f"commanded site {params.site_xy_m}: {candidate.reason}"
    else:
        flight.candidates = choose_sites(flight)
        if not flight.candidates:
            flight.note = "nothing mapped to choose from"
            return None
        candidate = flight.candidates[0]
        where = flight.world(candidate.position_odom)
        flight.note = f"site at ({where[0]:.1f}, {where[1]:.1f}): {candidate.reason}"
    if not candidate.accepted:
        return None
    flight.site_odom = candidate.position_odom
    if flight.places is not None:
        flight.site_place = flight.places.place_of(candidate)
    return candidate


def _batches(flight: Flight) -> int:
    """That ground classification was asked for so far."""
    return 0 if flight.places is None else flight.places.batches


def _on_their_word(flight: Flight, wanted: Array, refused: Candidate) -> Candidate:
    """The commanded site ``wanted`` (2,), accepted whatever the map says."""
    height = ground_under(flight.map_view, wanted)
    if not np.isfinite(height):
        height = float(flight.odom(flight.start_world)[2]) - flight.leg_height
    return dataclasses.replace(
        refused,
        position_odom=np.array([*wanted, height]),
        accepted=True,
        reason=f"landed on unchecked; the map would have {refused.reason}",
    )


def search_leg(flight: Flight, extra: int) -> Steps:
    """One more leg beside the last one, flown back."""
    flight.phase = Phase.SURVEY
    flight.note = "no safe site yet: another leg"
    params = flight.survey
    side = np.array([-np.sin(flight.start_yaw), np.cos(flight.start_yaw), 0.0])
    ahead = np.array([np.cos(flight.start_yaw), np.sin(flight.start_yaw), 0.0])
    base = flight.start_world.copy()
    base[2] = flight.ground_world + params.height_m
    row = base + (params.legs + extra) * params.leg_spacing_m * side
    near, far = row, row + params.leg_length_m * ahead
    here = flight.reference_world
    ends = (near, far) if np.linalg.norm(here - near) < np.linalg.norm(here - far) else (far, near)
    for end in ends:
        yield from _straight(flight, end, in_world=True)


def approach(flight: Flight, site: Candidate) -> Steps:
    """To a point above the site, sloping down as far as what was mapped on the way allows."""
    flight.phase = Phase.APPROACH
    start = flight.odom(flight.reference_world)
    height = approach_height(flight, start, site.position_odom)
    end = np.array([site.position_odom[0], site.position_odom[1], height])
    yield from _straight(flight, end, hold_s=0.5)


def approach_height(flight: Flight, start: Array, site: Array) -> float:
    """Lowest z of the end point above the site, in steps of 2 m from the look height up to the
    start's height, whose straight way keeps the obstacle margin above the mapped corridor."""
    lowest = site[2] + flight.params.look_height_m + flight.leg_height + 2.0
    highest = max(float(start[2]), lowest)
    grid = flight.map_view.coarse
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
        if (way - tops >= flight.params.obstacle_margin_m).all():
            return float(height)
    return highest


def climb_back(flight: Flight) -> Steps:
    """Straight up to survey height, where the next decision is made."""
    here = flight.odom(flight.reference_world)
    height = flight.odom(flight.start_world)[2] - flight.leg_height + flight.survey.height_m
    if height > here[2] + 0.5:
        yield from flight.follow(vertical_move(here, height, flight.params.climb_speed_mps))


def return_home(flight: Flight) -> Steps:
    """Back to the take-off spot, the one place known to be good, and down."""
    flight.phase = Phase.RETURN
    yield from climb_back(flight)
    above = flight.start_world.copy()
    above[2] = flight.reference_world[2]
    yield from _straight(flight, above, in_world=True, hold_s=1.0)
    home = flight.start_world.copy()
    home[2] = flight.ground_world
    flight.site_odom, flight.site_place = flight.odom(home), None
    low = flight.site_odom + np.array([0, 0, flight.params.commit_height_m + flight.leg_height])
    here = flight.odom(flight.reference_world)
    yield from flight.follow(vertical_move(here, low[2], flight.params.descent_speed_mps))
    flight.committed_site_world = home
    yield from final_descent(flight)


def come_down_here(flight: Flight) -> Steps:
    """Straight down from the reference, without looks."""
    flight.phase, flight.final = Phase.DESCEND, True
    here = flight.odom(flight.reference_world)
    ground = ground_under(flight.map_view, here[:2])
    if not np.isfinite(ground):
        ground = float(flight.odom(flight.start_world)[2]) - flight.leg_height
    flight.site_odom, flight.site_place = np.array([here[0], here[1], ground]), None
    low = ground + flight.params.commit_height_m + flight.leg_height
    if low < here[2]:
        yield from flight.follow(vertical_move(here, low, flight.params.descent_speed_mps))
    flight.committed_site_world = flight.world(flight.site_odom)
    yield from final_descent(flight)


def rest(flight: Flight) -> Steps:
    """Done: motors off on the ground (after a survey alone: hover, someone else ends it)."""
    flight.phase = Phase.DONE
    place = flight.reference_world.copy()
    while True:
        yield flight.setpoint(place, in_world=True, motors_on=flight.params.survey_only)


def _straight(flight: Flight, end: Array, *, in_world: bool = False, hold_s: float = 0.0) -> Steps:
    start = flight.reference_world if in_world else flight.odom(flight.reference_world)
    if np.linalg.norm(end - start) < 1e-3:
        return
    path = straight_trajectory(
        start.copy(), np.zeros(3), end, flight.params.cruise_speed_mps, _ACCEL_MPS2
    )
    yield from flight.follow(path, in_world=in_world, hold_s=hold_s)
