"""Shared state of the phases of a mission: latest inputs, reference, decisions."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Generator
from functools import partial

import numpy as np
from numpy.typing import NDArray

from touchdown.controller.api import Setpoint
from touchdown.estimator.api import Estimate, MapView
from touchdown.landing.api import (
    Candidate,
    CostmapView,
    Decision,
    LandingParams,
    Phase,
    Selection,
    SelectorInput,
    SelectorRig,
    SurveyParams,
)
from touchdown.landing.classification.site_check import SiteClass, SiteClassCheck
from touchdown.landing.mission.energy import (
    RAMP_S,
    emergency_reach_m,
    go_around_time_s,
    return_time_s,
    search_leg_time_s,
)
from touchdown.landing.mission.heading import HeadingTurn
from touchdown.landing.mission.time_scaling import TimeScaling, scaled
from touchdown.landing.mission.trajectory import PiecewiseTrajectory, State, through
from touchdown.landing.mission.wind import FeltWind, WindEstimator
from touchdown.landing.selection.selector import shipped_selection
from touchdown.sim.api import Observation, SensorRig
from touchdown.sim.frames import wrap_angle, yaw_from_rotation

Array = NDArray[np.float64]
Steps = Generator[Setpoint, None, None]
Select = Callable[[SelectorInput], Selection]

_RAMP_S = RAMP_S
_REPORTED_RATE = 0.9
"""rate of the reference's clock below which a leg is said to be slowed"""
_LEARN_PERIOD_S = 0.1


class LegBlockedError(Exception):
    """The wind leaves no way along a trajectory. The reference has stopped."""


class Mission:
    """State of a landing mission. ``obs``, ``estimate`` and ``map_view`` are the latest; phases
    read them, move the reference and store their decisions here."""

    obs: Observation
    estimate: Estimate
    map_view: MapView

    def __init__(
        self,
        rig: SensorRig,
        params: LandingParams,
        survey: SurveyParams,
        class_check: SiteClassCheck | None = None,
        select: Select | None = None,
    ) -> None:
        self.rig = rig
        self.select: Select = select or partial(
            shipped_selection, rig=SelectorRig(vehicle=rig.vehicle, landing=params)
        )
        """makes a selection of what is seen"""
        self.params = params
        self.survey = survey
        start = rig.world_from_body_start
        self.start_world: Array = start.translation.copy()
        self.start_yaw = yaw_from_rotation(start.rotation)
        self.turn: HeadingTurn | None = None
        self.leg_height = rig.vehicle.leg_height_m
        self.ground_world = float(self.start_world[2]) - self.leg_height
        self.phase = Phase.INIT
        self.note = "waiting for the sensors to settle"
        self.decisions: tuple[Decision, ...] = ()
        """all so far"""
        self.costmap: CostmapView | None = None
        self.site_odom: Array | None = None
        self.committed_site_world: Array | None = None
        self.refused_odom: list[Array] = []
        self.class_check = class_check
        """ground classification; None where it is off"""
        self.site_class: SiteClass | None = None
        self.unsafe_ground_odom: list[Array] = []
        """sites whose class of ground was refused"""
        self.no_site = False
        self.aborted = False
        self.reference_world: Array = self.start_world.copy()
        self.takeoff_s: float | None = None
        self.wind = WindEstimator(rig.vehicle)
        self.felt_wind = FeltWind(rig.vehicle)
        self.time_scaling = TimeScaling(rig.vehicle, params)
        self.events: list[str] = []
        """messages of this control step"""
        self.slowed_s = 0.0
        """time by which all trajectories so far took longer than they were set"""
        self._next_learning_s = 0.0
        self.final = False
        """in the final descent, which nothing interrupts"""
        self.deadline_s: float | None = None
        """of an emergency, by ``now``"""
        self._paused_s = 0.0
        self._last_s = 0.0

    # ------------------------------------------------------------------------------- inputs

    def update(self, obs: Observation, estimate: Estimate, map_view: MapView) -> None:
        """Takes over the inputs of a control step."""
        self._last_s = obs.time_s if self.takeoff_s is None else self.obs.time_s
        self.obs, self.estimate, self.map_view = obs, estimate, map_view
        self.events = []
        if self.class_check is not None:
            self.class_check.update(obs, estimate, map_view)
        if self.takeoff_s is not None and self.phase is not Phase.TOUCHDOWN:
            self.wind.update(obs, estimate)
            if self.params.slow_in_wind:
                self._feel_wind()

    def _feel_wind(self) -> None:
        self.felt_wind.update(self.obs, self.estimate)
        time_s = self.obs.time_s
        if time_s >= self._next_learning_s and not self.final:
            self._next_learning_s = time_s + _LEARN_PERIOD_S
            self.time_scaling.learn(
                self.estimate.velocity_odom - self.felt_wind.wind_odom,
                self.estimate.acceleration_odom,
                float(np.mean(self.obs.rotor_speed_radps)),
                _LEARN_PERIOD_S,
            )

    @property
    def candidates(self) -> tuple[Candidate, ...]:
        """Of the last decision."""
        return self.decisions[-1].candidates if self.decisions else ()

    def decide(self, decision: Decision) -> None:
        """Adds ``decision`` to those of the flight."""
        self.decisions += (decision,)

    def give_up_site(self, reason: str) -> None:
        """States in the last decision why its site was given up."""
        *before, last = self.decisions
        self.decisions = (*before, dataclasses.replace(last, given_up=reason))

    @property
    def now(self) -> float:
        """Mission time without pauses, s."""
        return self.obs.time_s - self._paused_s

    def pause(self) -> None:
        """Excludes this control step from ``now``; called before its setpoint."""
        self._paused_s += self.obs.time_s - self._last_s

    @property
    def position_odom(self) -> Array:
        """(3,) estimated position of the vehicle, odom frame."""
        return self.estimate.odom_from_body.translation

    def odom(self, world: Array) -> Array:
        """Returns a world position in the odom frame by the current estimate."""
        return self.estimate.world_from_odom.inverse().apply(world)

    def world(self, odom: Array) -> Array:
        """Returns an odom position in the world frame by the current estimate."""
        return self.estimate.world_from_odom.apply(odom)

    @property
    def commanded_odom(self) -> Array | None:
        """(2,) the commanded site in the odom frame by the current estimate; None without one."""
        if self.params.site_xy_m is None:
            return None
        return self.odom(np.array([*self.params.site_xy_m, self.ground_world]))[:2]

    @property
    def site_world(self) -> Array | None:
        """(3,) the committed site, else the current one, world frame; None without one."""
        if self.committed_site_world is not None:
            return self.committed_site_world
        return None if self.site_odom is None else self.world(self.site_odom)

    def time_left_s(self) -> float:
        """Returns the remaining flight time of the battery at the mean rate since take-off."""
        if self.takeoff_s is None or self.now - self.takeoff_s < 5.0:
            return np.inf
        used = 1.0 - self.obs.battery_fraction
        if used <= 0.0:
            return np.inf
        return self.obs.battery_fraction * (self.now - self.takeoff_s) / used

    @property
    def away_m(self) -> float:
        """Horizontal distance to the take-off spot."""
        return float(np.linalg.norm((self.position_odom - self.odom(self.start_world))[:2]))

    @property
    def in_emergency(self) -> bool:
        """True where the least bad site is accepted: by the parameters, or since the remaining
        battery time is below ``emergency_s``."""
        return self.params.emergency == "battery" or self.time_left_s() < self.params.emergency_s

    @property
    def takes_risky(self) -> bool:
        """True where roads and roofs are accepted."""
        return self.params.allow_risky or self.in_emergency

    def affords(self, seconds: float) -> bool:
        """True if the battery lasts for ``seconds`` and then the way home and a landing there."""
        home = return_time_s(self.away_m, self.survey.height_m, self.params)
        return self.time_left_s() >= seconds + home

    def affords_search_leg(self) -> bool:
        """True if the battery lasts for another survey leg."""
        return self.affords(search_leg_time_s(self.survey, self.params))

    def affords_go_around(self) -> bool:
        """True if the battery lasts for a go-around."""
        return self.affords(go_around_time_s(self.survey.height_m, self.params))

    def reach_m(self) -> float:
        """Returns the largest distance to a site (the energy threshold of Eq. 18): the battery must
        last for a landing there and a go-around, in an emergency for a landing in time."""
        params, height = self.params, self.survey.height_m
        if self.in_emergency:
            left = self.time_left_s()
            if self.deadline_s is not None:
                left = min(left, self.deadline_s - self.now)
            return emergency_reach_m(height, left, params)
        spare = self.time_left_s() - 2.0 * go_around_time_s(height, params)
        return max(spare, 0.0) * params.cruise_speed_mps / 1.875

    # ------------------------------------------------------------------------------ outputs

    def setpoint(
        self,
        position: Array,
        velocity: Array | None = None,
        acceleration: Array | None = None,
        *,
        in_world: bool = False,
        motors_on: bool = True,
        thrust_limit: float | None = None,
    ) -> Setpoint:
        """Returns a setpoint in the odom frame from a reference in that or in the world frame, and
        stores the reference for the recording."""
        velocity = np.zeros(3) if velocity is None else velocity
        acceleration = np.zeros(3) if acceleration is None else acceleration
        world_from_odom = self.estimate.world_from_odom
        turned, rate = (0.0, 0.0) if self.turn is None else self.turn.sample(self.now)
        heading = self.start_yaw + turned
        if in_world:
            self.reference_world = position
            position = self.odom(position)
            velocity = world_from_odom.rotation.T @ velocity
            acceleration = world_from_odom.rotation.T @ acceleration
        else:
            self.reference_world = world_from_odom.apply(position)
        return Setpoint(
            position_odom=position,
            velocity_odom=velocity,
            acceleration_odom=acceleration,
            yaw_odom=wrap_angle(heading - yaw_from_rotation(world_from_odom.rotation)),
            yaw_rate=rate,
            motors_on=motors_on,
            thrust_limit=thrust_limit,
        )

    def follow(
        self,
        trajectory: PiecewiseTrajectory,
        *,
        in_world: bool = False,
        hold_s: float = 0.0,
        until: Callable[[], bool] | None = None,
        least_rate: float = 0.0,
    ) -> Steps:
        """Follows a trajectory that ends at rest, and stays at its end for ``hold_s``.

        In a wind that leaves too little margin the trajectory takes longer, see `time_scaling`;
        raises LegBlockedError where it is blocked. Once ``until`` is true it comes to rest where it
        is. ``least_rate`` is a rate that the clock keeps in any wind."""
        scaling, start, before, reported, stop = self.time_scaling, self.now, self.now, False, False
        scaling.begin(trajectory, self._wind_for(in_world))
        while (t := self.now - start - scaling.lost_s) < trajectory.duration_s + hold_s:
            sample = trajectory.sample(min(t, trajectory.duration_s))
            yield self.setpoint(*scaled(sample, scaling.rate, scaling.change), in_world=in_world)
            stop = stop or (until is not None and until())
            late = scaling.lost_s
            scaling.advance(
                trajectory,
                t,
                self.now - before,
                self._wind_for(in_world),
                self._behind_m(),
                stop=stop,
                least=least_rate,
            )
            before = self.now
            self.slowed_s += scaling.lost_s - late
            if scaling.rate < _REPORTED_RATE and not reported and not stop:
                reported = True
                self.add_event(
                    f"{self.phase}: slowed by a wind of {self.felt_wind.speed_mps:.1f} m/s"
                )
            if stop and scaling.rate == 0.0:
                return
            if scaling.blocked and not stop:
                wind = self.felt_wind.speed_mps
                self.add_event(
                    f"{self.phase}: a wind of {wind:.1f} m/s leaves no way to fly this leg"
                )
                raise LegBlockedError
        if reported:
            set_s = trajectory.duration_s
            self.add_event(f"{self.phase}: {set_s + scaling.lost_s:.1f} s instead of {set_s:.1f} s")

    def add_event(self, text: str) -> None:
        """States ``text`` as the last decision and among the events."""
        self.note = text
        self.events.append(text)

    def _behind_m(self) -> float:
        """Distance of the vehicle from the reference, as estimated."""
        here = self.estimate.world_from_body.translation
        return math.dist(here.tolist(), self.reference_world.tolist())

    def _wind_for(self, in_world: bool) -> Array:
        wind = self.felt_wind.wind_odom
        return self.estimate.world_from_odom.rotation @ wind if in_world else wind

    def hover(self, seconds: float) -> Steps:
        """Stays at the reference for ``seconds``."""
        position = self.odom(self.reference_world)
        start = self.now
        while self.now - start < seconds:
            yield self.setpoint(position)


def vertical_move(start: Array, height: float, speed: float) -> PiecewiseTrajectory:
    """Returns a vertical trajectory from rest at ``start`` (3,) to rest at z = ``height``.

    ``speed`` is reached and left in three seconds each; where the distance is too short for that,
    the trajectory is one minimum-jerk segment."""
    distance = abs(height - float(start[2]))
    end = np.array([start[0], start[1], height])
    level = distance - speed * _RAMP_S
    if level <= 0.0:
        duration = max(1.875 * distance / speed, np.sqrt(6.0 * distance / speed), 0.5)
        return through([State(start), State(end)], [duration])
    velocity = np.array([0.0, 0.0, np.sign(height - start[2]) * speed])
    ramp = 0.5 * _RAMP_S * velocity
    states = [State(start), State(start + ramp, velocity), State(end - ramp, velocity), State(end)]
    return through(states, [_RAMP_S, level / speed, _RAMP_S])
