"""A landing on a deck that moves: it is waited for, followed from above, and met in a calm moment.

References are offsets from the site of the deck as `Estimate.deck` has it, so that the drift of the
position does not matter. There is no map and no watch: what moves below is the site.
"""

import dataclasses
import math
from collections.abc import Generator

import numpy as np

from touchdown.controller.api import Setpoint
from touchdown.estimator.api import DeckTrack
from touchdown.landing.api import LandingParams, Phase, SurveyParams
from touchdown.landing.mission.blind_descent import blind_descent
from touchdown.landing.mission.lander import SiteLander
from touchdown.landing.mission.mission import LegBlockedError, Mission, Steps
from touchdown.landing.mission.phases import (
    initialise,
    land_at_home,
    rest,
    return_home,
    take_off,
)
from touchdown.landing.mission.touchdown import TouchdownDetector
from touchdown.landing.mission.trajectory import straight_trajectory
from touchdown.sim.api import SensorRig
from touchdown.sim.typing import Array

_WAIT_S = 90.0
"""time for which a deck is waited for"""
_FOLLOW_M, _HOVER_M = 8.0, 1.5
"""heights of the legs above the deck: while it is caught up with, and while calm is waited for"""
_PER_S, _ACROSS_MPS, _ACROSS_MPS2 = 0.8, 4.0, 3.0
"""gain, speed and acceleration with which a horizontal offset is closed"""
_SINK_MPS, _LAST_MPS, _SINK_MPS2 = 2.0, 0.3, 1.5
"""vertical speed down to the hover, in the last descent, and acceleration"""
_NEAR_M, _OVER_M = 1.0, 0.35
"""horizontal distance from which the vehicle sinks, and from which it touches down"""
_SURE_M, _SURE_MPS, _FRESH_S = 0.2, 0.3, 0.5
"""standard deviations and age of the measurement with which it does"""
_CALM_MPS, _CALM_RAD = 0.4, math.radians(5.0)
"""heave and tilt of a calm moment"""
_CALM_S = np.arange(0.0, 4.1, 0.5)
"""when it has to be calm, from now on: the last descent takes this long"""
_PATIENCE_S = 30.0
"""time after which it is enough that it is calm now"""
_LOST_S, _BLIND_M = 1.0, 0.7
"""age of a measurement with which the vehicle climbs again, above the height from which scans see
the deck"""
_SEARCH_S, _SEARCH_M, _GONE_S = 4.0, 15.0, 30.0
"""age from which it climbs on to see more, height that it climbs to, and age from which it goes
home"""
_CONTACT_M = 0.4
_RAMP_S, _STOPPED_S = 0.4, 1.0


class DeckLander(SiteLander):
    """Takes off, waits for a deck, follows it and lands on it; returns home where none comes."""

    def __init__(self, rig: SensorRig, params: LandingParams, survey: SurveyParams) -> None:
        super().__init__(rig, params, survey)
        self._steps = _run(self._mission)


def _run(mission: Mission) -> Steps:
    yield from initialise(mission)
    try:
        no_go = yield from take_off(mission)
        if no_go is not None:
            yield from land_at_home(mission)
        elif not (yield from land_on_deck(mission)):
            mission.state.follow_rule("no_deck", "no deck is in sight", "no_site")
            yield from return_home(mission)
    except LegBlockedError:
        yield from blind_descent(mission)
    yield from rest(mission)


def land_on_deck(mission: Mission) -> Generator[Setpoint, None, bool]:
    """Flies to where a deck comes by, follows it and lands on it; returns False where none came or
    it is lost for good."""
    state = mission.state
    state.enter(Phase.SURVEY, "waiting for a deck")
    if not (yield from _wait(mission)):
        return False
    state.enter(Phase.APPROACH, "following the deck")
    state.final = True  # rules about the position do not count: it is not what is flown by
    state.final = yield from _Chase(mission).run()
    return state.final


def _wait(mission: Mission) -> Generator[Setpoint, None, bool]:
    """Flies one leg ahead and hovers there until there is a deck; False after `_WAIT_S`."""
    ahead = np.array([math.cos(mission.start_yaw), math.sin(mission.start_yaw), 0.0])
    here, start = mission.reference_world.copy(), mission.now
    end = here + mission.state.survey.leg_length_m * ahead
    params = mission.params
    leg = straight_trajectory(here, np.zeros(3), end, params.cruise_speed_mps, params.accel_mps2)
    while mission.view.estimate.deck is None:
        since = mission.now - start
        if since > _WAIT_S:
            return False
        yield mission.setpoint(*leg.sample(min(since, leg.duration_s)), in_world=True)
    return True


class _Chase:
    """The vehicle over a deck: an offset from its site that is closed step by step."""

    def __init__(self, mission: Mission) -> None:
        self._mission, self._before = mission, mission.now
        deck, estimate = self._deck, mission.view.estimate
        self._offset = mission.view.position_odom - deck.site_odom
        self._speed = estimate.velocity_odom - deck.velocity_odom
        self._known, self._known_s = deck, mission.view.obs.time_s

    @property
    def _deck(self) -> DeckTrack:
        """The deck; one that has been lost goes on along its course, so that it is met again."""
        view = self._mission.view
        if view.estimate.deck is not None:
            self._known, self._known_s = view.estimate.deck, view.obs.time_s
            return self._known
        deck, since = self._known, view.obs.time_s - self._known_s
        way = since * deck.velocity_odom + 0.5 * since**2 * deck.acceleration_odom
        return dataclasses.replace(deck, site_odom=deck.site_odom + way * [1.0, 1.0, 0.0])

    def run(self) -> Generator[Setpoint, None, bool]:
        """Follows the deck until it is stood on; returns False where it is lost for good."""
        mission, state = self._mission, self._mission.state
        detector = TouchdownDetector(mission.rig)
        waited, last = 0.0, False
        while True:
            deck, step = self._deck, mission.now - self._before
            legs = self._legs_m(deck)
            unseen_s = mission.view.obs.time_s - deck.seen_s
            lost = unseen_s > _LOST_S
            away = float(np.hypot(*(mission.view.position_odom - deck.site_odom)[:2]))
            if unseen_s > _GONE_S:
                return False
            if lost and (legs > _BLIND_M or not last):
                last, sink = False, _SINK_MPS
                target = _FOLLOW_M if unseen_s < _SEARCH_S else _SEARCH_M
            elif last:
                target, sink = -1.0, _LAST_MPS
            elif away > (_NEAR_M if legs > 2.0 * _HOVER_M else 2.0 * _NEAR_M):
                target, sink = max(min(legs, _FOLLOW_M), _HOVER_M), _SINK_MPS
                target = _FOLLOW_M if legs > _FOLLOW_M else target
            else:
                if state.phase is not Phase.DESCEND:
                    state.enter(Phase.DESCEND, "sinking to the deck")
                target, sink = _HOVER_M, _SINK_MPS
                waited += step * (legs < 1.2 * _HOVER_M)
                if legs < 1.2 * _HOVER_M and away < _OVER_M and self._is_calm(deck, waited):
                    last = True
                    state.commit(mission.view.world(deck.site_odom))
                    state.report(f"calm after {waited:.1f} s: touching down")
            setpoint = self._reference(deck, target, sink, step)
            rise = float(deck.velocity_odom[2])
            if (
                last
                and legs < _CONTACT_M
                and detector.update(mission.view.obs, mission.view.estimate, rise)
            ):
                break
            yield setpoint
        yield from self._stop()
        return True

    def _legs_m(self, deck: DeckTrack) -> float:
        """Height of the legs above the deck."""
        away = self._mission.view.position_odom - deck.site_odom
        return float(away[2] - away[:2] @ deck.slopes[:, 0]) - self._mission.leg_height

    def _is_calm(self, deck: DeckTrack, waited_s: float) -> bool:
        """True where the deck is well measured and is expected to be calm until the touchdown."""
        age = self._mission.view.obs.time_s - deck.seen_s
        if deck.sigma_m > _SURE_M or deck.sigma_mps > _SURE_MPS or age > _FRESH_S:
            return False
        over = self._mission.view.estimate.velocity_odom - deck.velocity_odom
        if float(np.hypot(over[0], over[1])) > _OVER_M:
            return False
        ahead = [deck.ahead(t) for t in (_CALM_S if waited_s < _PATIENCE_S else _CALM_S[:1])]
        return all(abs(rate) < _CALM_MPS and tilt < _CALM_RAD for rate, tilt in ahead)

    def _reference(self, deck: DeckTrack, legs_m: float, sink_mps: float, step: float) -> Setpoint:
        """Moves the offset towards ``legs_m`` above the site."""
        mission = self._mission
        self._before = mission.now
        mission.state.choose(deck.site_odom)
        left = np.array([0.0, 0.0, legs_m + mission.leg_height]) - self._offset
        wanted = _bounded(_PER_S * left[:2], _ACROSS_MPS)
        up = min(max(1.5 * float(left[2]), -sink_mps), mission.params.climb_speed_mps)
        across = _bounded(wanted - self._speed[:2], _ACROSS_MPS2 * step)
        most = _SINK_MPS2 * step
        change = np.array([*across, min(max(up - self._speed[2], -most), most)])
        self._speed = self._speed + change
        self._offset = self._offset + self._speed * step
        return mission.setpoint(
            deck.site_odom + self._offset,
            deck.velocity_odom + self._speed,
            deck.acceleration_odom + (change / step if step > 0.0 else 0.0 * change),
        )

    def _stop(self) -> Steps:
        """Reduces thrust to zero while it goes along with the deck, and stops the motors."""
        mission = self._mission
        mission.state.enter(Phase.TOUCHDOWN, "contact with the deck: motors off")
        start = mission.now
        while (since := mission.now - start) < _RAMP_S + _STOPPED_S:
            limit = max(0.5 * (1.0 - since / _RAMP_S), 0.0)
            yield mission.setpoint(
                mission.view.position_odom.copy(), self._deck.velocity_odom,
                motors_on=since < _RAMP_S, thrust_limit=limit,
            )  # fmt: skip


def _bounded(vector: Array, most: float) -> Array:
    size = float(np.linalg.norm(vector))
    return vector if size <= most else vector * (most / size)
