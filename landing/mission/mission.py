"""One mission: its view of the control step, its state, and the reference that it moves."""

import dataclasses
import math
from collections.abc import Callable, Generator
from functools import partial

import numpy as np

from touchdown.controller.api import Setpoint
from touchdown.estimator.api import Estimate, MapView
from touchdown.landing.api import (
    LandingParams,
    Phase,
    Selection,
    SelectorInput,
    SelectorRig,
    SurveyParams,
    Verdict,
    Watch,
    WatchReport,
)
from touchdown.landing.classification.site_check import SiteClassCheck
from touchdown.landing.mission.lookout import Lookout
from touchdown.landing.mission.rules import Moment, Ruling, first_ruling, is_in_the_way
from touchdown.landing.mission.site_recheck import recheck_site
from touchdown.landing.mission.state import MissionState
from touchdown.landing.mission.time_scaling import TimeScaling, scaled
from touchdown.landing.mission.trajectory import HeadingTurn, PiecewiseTrajectory
from touchdown.landing.mission.view import MissionView, Sight
from touchdown.landing.mission.wind import FeltWind, WindEstimator, WindProfile
from touchdown.landing.selection.selector import select_sites
from touchdown.sim.api import Observation, SensorRig
from touchdown.sim.frames import wrap_angle, yaw_from_rotation
from touchdown.sim.typing import Array

Steps = Generator[Setpoint, None, None]
RuledSteps = Generator[Setpoint, None, Ruling | None]
"""steps that end with the rule that ended them, or None"""
Select = Callable[[SelectorInput], Selection]

_REPORTED_RATE = 0.9
"""rate of the reference's clock below which a leg is said to be slowed"""
_LEARN_PERIOD_S = 0.1
_GIVE_UP_S = 20.0
"""time for which something may be in the way before the site is given up"""
_LIFT_ACCEL_MPS2 = 2.0
_ASIDE_SHIFT_M = 0.5
_LEVEL_M = 0.02
"""height above the place of the interruption from which the descent goes on"""
_FEEL_ABOVE_M = 3.0
"""height from which on the felt wind has settled after the take-off"""
_SETTLED_ABOVE_M = 6.0
"""height from which on its mean tells the wind at the lowest survey height"""
_GUSTS_ALOFT = 0.25
"""gusts over the mean wind that a survey at a height must leave room for: two standard deviations
of the turbulence of MIL-F-8785C at 30 m over the mean wind there"""


class LegBlockedError(Exception):
    """The wind leaves no way along a trajectory. The reference has stopped."""

    def __init__(self, ruling: Ruling) -> None:
        super().__init__(ruling.reason)
        self.action = ruling.action


class SiteMovedError(Exception):
    """The watch has found a place ``aside_odom`` (2,) near the site where nothing is in the way.
    The reference has stopped."""

    def __init__(self, aside_odom: Array) -> None:
        super().__init__("the site is moved aside")
        self.aside_odom = aside_odom


class SiteGivenUpError(Exception):
    """The watch has seen something in the way for too long. The reference has stopped."""


class Mission:
    """A landing mission. Phases read ``view`` and ``state``, change ``state`` by its methods, and
    move the reference."""

    view: MissionView

    def __init__(
        self,
        rig: SensorRig,
        params: LandingParams,
        survey: SurveyParams,
        class_check: SiteClassCheck | None = None,
        select: Select | None = None,
        watch: Watch | None = None,
    ) -> None:
        self.rig = rig
        self.params = params
        self.select: Select = select or partial(
            select_sites, rig=SelectorRig(vehicle=rig.vehicle, landing=params)
        )
        """makes a selection of what is seen"""
        self.class_check = class_check
        """ground classification; None where it is off"""
        self.state = MissionState(survey)
        self.lookout = None if watch is None else Lookout(watch, params, rig.vehicle.leg_height_m)
        """asks the watch; None where it is off"""
        self.may_refuse = False
        """whether the present site may be given up for another"""
        self.may_move = False
        """whether it may be moved to where nothing is in the way"""
        self._lift_speed = 0.0
        self._asked_map = -1
        """version of the map that was last asked for ground beside the site"""
        start = rig.world_from_body_start
        self.start_world: Array = start.translation.copy()
        self.start_yaw = yaw_from_rotation(start.rotation)
        self.leg_height = rig.vehicle.leg_height_m
        self.reference_world: Array = self.start_world.copy()
        """(3,) position of the last setpoint"""
        self.turn: HeadingTurn | None = None
        self.lift_m = 0.0
        """by which the survey was lifted over risen ground"""
        self.wind = WindEstimator(rig.vehicle)
        self.felt_wind = FeltWind(rig.vehicle)
        self._profile = WindProfile()
        self._time_scaling = TimeScaling(rig.vehicle, params)
        self._next_learning_s = 0.0
        self._time_s = self._last_s = self._held_s = 0.0
        self._unhealthy_since_s: float | None = None
        self._sight = Sight()

    # ------------------------------------------------------------------------------- inputs

    def update(self, obs: Observation, estimate: Estimate, map_view: MapView) -> None:
        """Takes over the inputs of a control step."""
        state, flying = self.state, self.state.takeoff_s is not None
        self._last_s, self._time_s = self._time_s, obs.time_s
        state.begin_step()
        if self.class_check is not None:
            self.class_check.update(obs, estimate, map_view)
        if flying and state.phase is not Phase.TOUCHDOWN:
            self.wind.update(obs, estimate)
            if self.params.slow_in_wind:
                self._feel_wind(obs, estimate)
        survey = state.survey
        lowest = min(survey.min_height_m, survey.height_m)
        now = obs.time_s - self._held_s
        self.view = MissionView(
            params=self.params,
            start_world=self.start_world,
            leg_height_m=self.leg_height,
            obs=obs,
            estimate=estimate,
            map_view=map_view,
            now_s=now,
            time_left_s=_time_left_s(obs.battery_fraction, now, state.takeoff_s),
            unhealthy_s=self._unhealthy_s(obs.time_s, estimate.healthy),
            blind_s=self._sight.lost_s(obs.time_s, estimate.position_covariance),
            wind_mps=self.wind.speed_mps,
            felt_wind_odom=self.felt_wind.wind_odom,
            load_aloft=self._load_in_climb(survey.height_m, survey.min_height_m),
            load_lowest=self._load_in_climb(lowest, _SETTLED_ABOVE_M),
            behind_m=math.dist(estimate.world_from_body.translation, self.reference_world),
            watch=None if self.lookout is None else self._look(obs, estimate, map_view),
        )

    def _look(self, obs: Observation, estimate: Estimate, map_view: MapView) -> WatchReport | None:
        assert self.lookout is not None
        start = estimate.world_from_odom.inverse().apply(self.start_world)
        return self.lookout.look(self.state, start, obs, estimate, map_view)

    def _feel_wind(self, obs: Observation, estimate: Estimate) -> None:
        self.felt_wind.update(obs, estimate)
        if (height := self._climbed_m()) >= _FEEL_ABOVE_M:
            self._profile.update(self.felt_wind.wind_odom, height)
        if obs.time_s >= self._next_learning_s and not self.state.final:
            self._next_learning_s = obs.time_s + _LEARN_PERIOD_S
            self._time_scaling.learn(
                estimate.velocity_odom - self.felt_wind.wind_odom,
                estimate.acceleration_odom,
                float(np.mean(obs.rotor_speed_radps)),
                _LEARN_PERIOD_S,
            )

    def _unhealthy_s(self, time_s: float, healthy: bool) -> float:
        if healthy or self.state.takeoff_s is None:
            self._unhealthy_since_s = None
            return -1.0
        if self._unhealthy_since_s is None:
            self._unhealthy_since_s = time_s
        return time_s - self._unhealthy_since_s

    def _load_in_climb(self, survey_m: float, lowest_m: float) -> float:
        """Load of a hover at ``survey_m`` in the mean wind felt so far in the climb, while the
        climb is between ``lowest_m`` and that height; 0 elsewhere."""
        if not max(lowest_m, _FEEL_ABOVE_M) <= self._climbed_m() < survey_m - 1.0:
            return 0.0
        wind = (1.0 + _GUSTS_ALOFT) * self._profile.at(survey_m)
        return self._time_scaling.hover_load(wind, gusts=False)

    def _climbed_m(self) -> float:
        """Height of the reference above the ground in a climb whose wind counts; else 0."""
        if self.state.phase is not Phase.TAKEOFF or not self.params.slow_in_wind:
            return 0.0
        return float(self.reference_world[2] - self.start_world[2]) + self.leg_height

    @property
    def now(self) -> float:
        """Mission time without the control steps that were held, s."""
        return self.view.now_s

    @property
    def reference_odom(self) -> Array:
        """(3,) position of the last setpoint, odom frame by the current estimate."""
        return self.view.odom(self.reference_world)

    def ask(self, moment: Moment) -> Ruling | None:
        """Returns the first rule that decides at ``moment``, noted in the state; None where none
        does."""
        ruling = first_ruling(moment, self.view, self.state)
        if ruling is not None:
            self.state.follow_rule(ruling.rule.name, ruling.reason, ruling.rule.outcome)
        return ruling

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
        world_from_odom = self.view.estimate.world_from_odom
        turned, rate = (0.0, 0.0) if self.turn is None else self.turn.sample(self.now)
        heading = self.start_yaw + turned
        if in_world:
            self.reference_world = position
            position = self.view.odom(position)
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

    def velocity_setpoint(self, velocity: Array, acceleration: Array) -> Setpoint:
        """Returns the setpoint that keeps a velocity (3,), odom frame: its position is that of the
        estimate, wherever that goes, so that there is no position to correct."""
        return self.setpoint(self.view.position_odom.copy(), velocity, acceleration)

    def hold(self) -> Setpoint:
        """Returns the setpoint that stays at the reference, and stops the clock of the mission for
        this control step."""
        self._held_s += self._time_s - self._last_s
        self.view = dataclasses.replace(self.view, now_s=self._time_s - self._held_s)
        return self.setpoint(self.reference_world, in_world=True)

    def give_way(self) -> Setpoint:
        """As `hold`; climbs to ``look_height_m`` while the watch wants to see more, and sinks back
        where nothing is in the way any more. Raises SiteGivenUpError where it has taken too long
        and the site may be refused, SiteMovedError where the watch has found another place and the
        site may be moved."""
        state, params, step = self.state, self.params, self._time_s - self._last_s
        watch = self.view.watch if is_in_the_way(self.view, state) else None
        blocked = watch is not None
        if watch is not None and state.gave_way_s > _GIVE_UP_S and self.may_refuse:
            self.end_lift()
            raise SiteGivenUpError(watch.reason)
        if watch is not None and watch.verdict is Verdict.MOVE and self.may_move:
            assert watch.aside_odom is not None
            if (place := self._landable(watch.aside_odom)) is not None:
                self.end_lift()
                raise SiteMovedError(place)
        lift, wanted = state.lift_m, 0.0
        if watch is None:
            wanted = -min(params.descent_speed_mps, math.sqrt(2.0 * _LIFT_ACCEL_MPS2 * lift))
        elif watch.verdict is Verdict.CLIMB:
            assert state.site_odom is not None
            top = state.site_odom[2] + params.look_height_m + self.leg_height
            room = max(top - float(self.reference_odom[2]), 0.0)
            wanted = min(params.climb_speed_mps, math.sqrt(2.0 * _LIFT_ACCEL_MPS2 * room))
        most = _LIFT_ACCEL_MPS2 * step
        self._lift_speed += min(max(wanted - self._lift_speed, -most), most)
        lifted = max(lift + step * self._lift_speed, 0.0)
        if lifted < _LEVEL_M and not blocked:
            lifted = self._lift_speed = 0.0
        self.reference_world = self.reference_world + [0.0, 0.0, lifted - lift]
        state.give_way(step if blocked else 0.0, lifted)
        setpoint = self.hold()
        up = np.array([0.0, 0.0, self._lift_speed])
        return dataclasses.replace(setpoint, velocity_odom=up)

    def _landable(self, aside: Array) -> Array | None:
        """(2,) where the fine map has ground to land on, too, within half a metre of ``aside``;
        None where it has none. Each map is asked once."""
        maps, site = self.view.map_view, self.state.site_odom
        if site is None or maps.version == self._asked_map:
            return None
        self._asked_map = maps.version
        at = np.array([*aside, site[2]])
        found = recheck_site(maps, at, _ASIDE_SHIFT_M, self.params).position_odom
        return None if found is None else found[:2]

    def end_lift(self) -> None:
        """Takes the reference as it is, wherever the descent was interrupted."""
        self._lift_speed = 0.0
        self.state.give_way(0.0, 0.0)

    def follow(
        self,
        trajectory: PiecewiseTrajectory,
        *,
        in_world: bool = False,
        hold_s: float = 0.0,
        until: Moment | None = None,
        min_rate: float = 0.0,
    ) -> RuledSteps:
        """Follows a trajectory that ends at rest, and stays at its end for ``hold_s``.

        In a wind that leaves too little margin the trajectory takes longer, see `time_scaling`;
        raises LegBlockedError where a rule says that it is blocked. Once a rule of the moment
        ``until`` decides, the reference comes to rest where it is, and that rule is returned.
        ``min_rate`` is a rate that the clock keeps in any wind."""
        scaling, state, start, before = self._time_scaling, self.state, self.now, self.now
        reported, stop = False, None
        scaling.begin(trajectory, self._wind_for(in_world))
        while (t := self.now - start - scaling.lost_s) < trajectory.duration_s + hold_s:
            sample = trajectory.sample(min(t, trajectory.duration_s))
            yield self.setpoint(*scaled(sample, scaling.rate, scaling.change), in_world=in_world)
            if stop is None and until is not None:
                stop = self.ask(until)
            late = scaling.lost_s
            scaling.advance(
                trajectory,
                t,
                self.now - before,
                self._wind_for(in_world),
                self.view.behind_m,
                stop=stop is not None,
                min_rate=min_rate,
            )
            before = self.now
            state.follow_clock(scaling.lost_s - late, scaling.stopped_s)
            if stop is not None:
                if scaling.rate == 0.0:
                    break
                continue
            if scaling.rate < _REPORTED_RATE and not reported:
                reported = True
                wind = self.view.felt_wind_mps
                state.report(f"slowed to keep a margin of thrust in a wind of {wind:.1f} m/s")
            if (blocked := self.ask(Moment.LEG)) is not None:
                raise LegBlockedError(blocked)
        if reported and stop is None:
            set_s = trajectory.duration_s
            state.report(f"{set_s + scaling.lost_s:.1f} s instead of {set_s:.1f} s")
        return stop

    def hover(self, seconds: float) -> Steps:
        """Stays at the reference for ``seconds``."""
        position = self.reference_odom
        start = self.now
        while self.now - start < seconds:
            yield self.setpoint(position)

    def _wind_for(self, in_world: bool) -> Array:
        wind = self.view.felt_wind_odom
        return self.view.estimate.world_from_odom.rotation @ wind if in_world else wind


def _time_left_s(battery_fraction: float, now_s: float, takeoff_s: float | None) -> float:
    """Remaining flight time of the battery at the mean rate since take-off, s."""
    used = 1.0 - battery_fraction
    if takeoff_s is None or now_s - takeoff_s < 5.0 or used <= 0.0:
        return float("inf")
    return battery_fraction * (now_s - takeoff_s) / used
