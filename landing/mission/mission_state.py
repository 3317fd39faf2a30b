"""What all phases of a landing flight share: the newest inputs, the reference, the decisions."""

from __future__ import annotations

from collections.abc import Generator

import numpy as np
from numpy.typing import NDArray

from touchdown.controller.api import Setpoint
from touchdown.estimator.api import Estimate, MapView
from touchdown.landing.api import Candidate, CostmapView, LandingParams, Phase, SurveyParams
from touchdown.landing.classification.site_check import SiteClass, SiteClassCheck
from touchdown.landing.mission.energy import (
    RAMP_S,
    emergency_reach_m,
    go_around_time_s,
    return_time_s,
    search_leg_time_s,
)
from touchdown.landing.mission.trajectory import PiecewiseTrajectory, State, through
from touchdown.landing.mission.wind import WindEstimator
from touchdown.sim.api import Observation, SensorRig
from touchdown.sim.frames import wrap_angle, yaw_from_rotation

Array = NDArray[np.float64]
Steps = Generator[Setpoint, None, None]

_RAMP_S = RAMP_S


class Mission:
    """The lander's memory. ``obs``, ``estimate`` and ``map_view`` are the newest; phases read
    them, move the reference and write their decisions here."""

    obs: Observation
    estimate: Estimate
    map_view: MapView

    def __init__(
        self,
        rig: SensorRig,
        params: LandingParams,
        survey: SurveyParams,
        class_check: SiteClassCheck | None = None,
    ) -> None:
        self.rig = rig
        self.params = params
        self.survey = survey
        start = rig.world_from_body_start
        self.start_world: Array = start.translation.copy()
        self.start_yaw = yaw_from_rotation(start.rotation)
        self.leg_height = rig.vehicle.leg_height_m
        self.ground_world = float(self.start_world[2]) - self.leg_height
        self.phase = Phase.INIT
        self.note = "waiting for the sensors to settle"
        self.candidates: tuple[Candidate, ...] = ()
        self.costmap: CostmapView | None = None
        self.site_odom: Array | None = None
        self.committed_site_world: Array | None = None
        self.refused_odom: list[Array] = []
        self.class_check = class_check
        """ground classification; None: it is off"""
        self.site_class: SiteClass | None = None
        self.unsafe_ground_odom: list[Array] = []
        """sites whose kind of ground was refused"""
        self.no_site = False
        self.aborted = False
        self.reference_world: Array = self.start_world.copy()
        self.takeoff_s: float | None = None
        self.wind = WindEstimator(rig.vehicle)
        self.final = False
        """in the last metres: nothing but down"""
        self.deadline_s: float | None = None
        """of an emergency, by ``now``"""
        self._paused_s = 0.0
        self._last_s = 0.0

    # ------------------------------------------------------------------------------- inputs

    def update(self, obs: Observation, estimate: Estimate, map_view: MapView) -> None:
        self._last_s = obs.time_s if self.takeoff_s is None else self.obs.time_s
        self.obs, self.estimate, self.map_view = obs, estimate, map_view
        if self.class_check is not None:
            self.class_check.update(obs, estimate)
        if self.takeoff_s is not None and self.phase is not Phase.TOUCHDOWN:
            self.wind.update(obs, estimate)

    @property
    def now(self) -> float:
        """Time that has been flown, pauses left out."""
        return self.obs.time_s - self._paused_s

    def pause(self) -> None:
        """Takes this control step out of ``now``: call before its setpoint."""
        self._paused_s += self.obs.time_s - self._last_s

    @property
    def position_odom(self) -> Array:
        return self.estimate.odom_from_body.translation

    def odom(self, world: Array) -> Array:
        """A world position in the odom frame as the estimate sees it now."""
        return self.estimate.world_from_odom.inverse().apply(world)

    def world(self, odom: Array) -> Array:
        return self.estimate.world_from_odom.apply(odom)

    @property
    def commanded_odom(self) -> Array | None:
        """(2,) the commanded site where the estimate sees it now; None where none was given."""
        if self.params.site_xy_m is None:
            return None
        return self.odom(np.array([*self.params.site_xy_m, self.ground_world]))[:2]

    @property
    def site_world(self) -> Array | None:
        if self.committed_site_world is not None:
            return self.committed_site_world
        return None if self.site_odom is None else self.world(self.site_odom)

    def time_left_s(self) -> float:
        """Flying time that the battery still gives at the mean rate since take-off."""
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
        """Whether the least bad site must do: asked for, or what the battery still gives is just
        enough for it."""
        return self.params.emergency == "battery" or self.time_left_s() < self.params.emergency_s

    @property
    def takes_risky(self) -> bool:
        """Whether roads and roofs will do."""
        return self.params.allow_risky or self.in_emergency

    def affords(self, seconds: float) -> bool:
        """Whether the battery gives ``seconds`` and then the way home and a landing there."""
        home = return_time_s(self.away_m, self.survey.height_m, self.params)
        return self.time_left_s() >= seconds + home

    def affords_search_leg(self) -> bool:
        return self.affords(search_leg_time_s(self.survey, self.params))

    def affords_go_around(self) -> bool:
        return self.affords(go_around_time_s(self.survey.height_m, self.params))

    def reach_m(self) -> float:
        """How far a site may be (the energy threshold of Eq. 18): near enough to land there and,
        should it not be what it seemed, to go around; in an emergency to be down in time."""
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
        """A setpoint in the odom frame from a reference in it or in the world frame; also what
        the recording shows as the reference."""
        velocity = np.zeros(3) if velocity is None else velocity
        acceleration = np.zeros(3) if acceleration is None else acceleration
        world_from_odom = self.estimate.world_from_odom
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
            yaw_odom=wrap_angle(self.start_yaw - yaw_from_rotation(world_from_odom.rotation)),
            motors_on=motors_on,
            thrust_limit=thrust_limit,
        )

    def follow(
        self, trajectory: PiecewiseTrajectory, *, in_world: bool = False, hold_s: float = 0.0
    ) -> Steps:
        """Flies a trajectory that ends at rest, and stays at its end for ``hold_s``."""
        start = self.now
        while (t := self.now - start) < trajectory.duration_s + hold_s:
            yield self.setpoint(
                *trajectory.sample(min(t, trajectory.duration_s)), in_world=in_world
            )

    def hover(self, seconds: float) -> Steps:
        """Stays at the reference."""
        place = self.odom(self.reference_world)
        start = self.now
        while self.now - start < seconds:
            yield self.setpoint(place)


def vertical_move(start: Array, height: float, speed: float) -> PiecewiseTrajectory:
    """Straight up or down from rest at ``start`` (3,) to rest at z = ``height``: three seconds to
    reach ``speed`` and to leave it again, or one minimum-jerk segment where that is too far."""
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
