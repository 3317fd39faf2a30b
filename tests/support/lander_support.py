"""A vehicle that follows the lander exactly, over a flat map."""

import copy
import dataclasses
import functools
from collections.abc import Iterator

import numpy as np

from touchdown.controller.api import Setpoint
from touchdown.estimator.api import GridMap, MapView
from touchdown.landing.api import LanderView, LandingParams, Phase, SurveyParams
from touchdown.landing.mission.lander import SiteLander
from touchdown.sim.api import GRAVITY_MPS2
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array

from support.landing_support import (
    LEG_HEIGHT,
    make_estimate,
    make_grid,
    make_imu,
    make_obs,
    make_rig,
    view_of,
)

QUICK = SurveyParams(height_m=20.0, legs=2, leg_length_m=20.0, leg_spacing_m=10.0, duration_s=14.0)
PARAMS = LandingParams(climb_speed_mps=6.0, descent_speed_mps=5.0)
STEP_TICKS = 12
ORIGIN = (-20.0, -20.0)


def flat_map() -> GridMap:
    return copy.deepcopy(_flat_map())


@functools.cache
def _flat_map() -> GridMap:
    return make_grid(np.zeros((280, 280)), origin=ORIGIN, seed=1)


def fine_map(centre: Array, height: float = 0.0) -> GridMap:
    """6 m of fine cells around a point, as after a flight above it."""
    corner = np.round((centre[:2] - 3.0) / 0.05) * 0.05
    return dataclasses.replace(_fine_map(height), origin_xy_m=corner)


@functools.cache
def _fine_map(height: float) -> GridMap:
    return make_grid(np.full((120, 120), height), 0.05, returns=12, seed=2)


class Puppet:
    """Stands where its setpoint is, on the ground at the lowest; thrust as the flight needs."""

    def __init__(self, lander: SiteLander, coarse: GridMap, ground: float = 0.0) -> None:
        self.lander, self.coarse, self.ground = lander, coarse, ground
        self.position = np.array([0.0, 0.0, LEG_HEIGHT])
        self.setpoint: Setpoint | None = None
        self.tick = 0
        self.battery = 1.0
        self.fine_height = ground
        self.world_from_odom = Pose.identity()

    def view_map(self) -> MapView:
        low = self.position[2] - self.ground < 14.0
        return view_of(self.coarse, fine_map(self.position, self.fine_height) if low else None)

    def run(self, seconds: float) -> Iterator[tuple[LanderView, Setpoint]]:
        weight = 4.0 * GRAVITY_MPS2
        fine: MapView | None = None
        while self.tick < seconds * 600:
            on_ground = self.position[2] <= self.ground + LEG_HEIGHT + 1e-9
            carried = 0.5 if on_ground and self.setpoint and self.setpoint.motors_on else 1.0
            speed = np.full(4, np.sqrt(carried * weight / 4.0 / 4e-5))
            if self.tick % 120 == 0 or fine is None:
                fine = self.view_map()
            obs = make_obs(
                self.tick, imu=(make_imu(self.tick, GRAVITY_MPS2),), rotor_speed_radps=speed,
                battery_fraction=self.battery,
            )  # fmt: skip
            velocity = (
                np.zeros(3) if on_ground or not self.setpoint else self.setpoint.velocity_odom
            )
            estimate = dataclasses.replace(
                make_estimate(self.tick, Pose(np.eye(3), self.position.copy()), velocity),
                world_from_odom=self.world_from_odom,
            )
            self.setpoint = self.lander.update(obs, estimate, fine)
            if self.setpoint.motors_on:
                self.position = self.setpoint.position_odom.copy()
                self.position[2] = max(self.position[2], self.ground + LEG_HEIGHT)
            yield self.lander.view(), self.setpoint
            self.tick += STEP_TICKS


def fly(puppet: Puppet, seconds: float = 200.0) -> tuple[list[Phase], LanderView]:
    phases: list[Phase] = []
    for view, _ in puppet.run(seconds):
        if not phases or phases[-1] != view.phase:
            phases.append(view.phase)
        if view.phase is Phase.DONE:
            break
    return phases, view


def make_lander(**changes: object) -> SiteLander:
    return SiteLander(make_rig(), dataclasses.replace(PARAMS, **changes), QUICK)
