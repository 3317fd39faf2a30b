"""A mission in the air whose vehicle is where its setpoint is, over maps made by hand."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from touchdown.controller.api import Setpoint
from touchdown.estimator.api import DeckTrack, GridMap, MapView
from touchdown.landing.api import LandingParams
from touchdown.landing.mission.mission import Mission
from touchdown.sim.api import GRAVITY_MPS2
from touchdown.sim.frames import Pose, rotation_from_yaw
from touchdown.sim.typing import Array

from support import landing_support
from support.lander_support import QUICK, STEP_TICKS

STEP_S = STEP_TICKS / 600.0
HOVER_RADPS = float(np.sqrt(GRAVITY_MPS2 / 4e-5))
SITE = np.array([1.0, -2.0, 0.0])
COARSE = landing_support.make_grid(np.zeros((100, 100)), origin=(-10.0, -10.0), returns=4)
Maps = Callable[[float], tuple[GridMap | None, int]]


def fine(height: Array | float, centre: Array = SITE) -> GridMap:
    """12 m of fine cells around a point."""
    corner = np.round((centre[:2] - 6.0) / 0.05) * 0.05
    raster = np.broadcast_to(np.asarray(height, float), (240, 240))
    return landing_support.make_grid(raster, 0.05, origin=(corner[0], corner[1]), returns=6)


LEVEL = fine(0.0)
RUBBLE = fine(np.random.default_rng(5).uniform(0.0, 0.6, (240, 240)))


class Stage:
    """A mission in the air whose vehicle is where its setpoint is. ``maps`` gives the fine map and
    the version by the height of the legs; rotors carry ``carried`` of the weight; ``spread`` is the
    variance of the estimated position."""

    def __init__(self, position: Array, yaw: float = 0.0, **params: Any) -> None:
        rig = landing_support.make_rig()
        start = Pose(rotation_from_yaw(yaw), rig.world_from_body_start.translation)
        rig = dataclasses.replace(rig, world_from_body_start=start)
        self.mission = Mission(rig, dataclasses.replace(LandingParams(), **params), QUICK)
        self.mission.state.take_off(0.0)
        self.mission.state.choose(SITE.copy())
        self.maps: Maps = lambda legs: (LEVEL, 1)
        self.coarse = COARSE
        self.position = np.array(position, float)
        self.world_from_odom = Pose.identity()
        self.tick, self.battery = 0, 1.0
        self.carried: Callable[[float], float] = lambda legs: 1.0
        self.spread: Callable[[float], float] = lambda legs: 1e-4
        self.healthy, self.load_aloft = True, lambda: 0.0
        self.deck: Callable[[float], DeckTrack | None] = lambda time_s: None
        self.result: Any = None
        self.feed()
        self.mission.reference_world = self.mission.view.world(self.position)

    def feed(self, velocity: Array | None = None) -> None:
        legs = float(self.position[2]) - landing_support.LEG_HEIGHT
        grid, version = self.maps(legs)
        speed = HOVER_RADPS * np.sqrt(self.carried(legs))
        obs = landing_support.make_obs(
            self.tick,
            imu=tuple(landing_support.make_imu(self.tick, GRAVITY_MPS2) for _ in range(4)),
            rotor_speed_radps=np.full(4, speed),
            battery_fraction=self.battery,
        )
        estimate = landing_support.make_estimate(
            self.tick, Pose(np.eye(3), self.position), np.zeros(3) if velocity is None else velocity
        )
        estimate = dataclasses.replace(
            estimate, world_from_odom=self.world_from_odom,
            position_covariance=self.spread(legs) * np.eye(3), healthy=self.healthy,
            deck=self.deck(self.tick / 600.0),
        )  # fmt: skip
        view: MapView = dataclasses.replace(
            landing_support.view_of(self.coarse, grid), version=version
        )
        self.mission.update(obs, estimate, view)
        self.mission.view = dataclasses.replace(self.mission.view, load_aloft=self.load_aloft())

    def show(self, coarse: GridMap, **changes: Any) -> None:
        """Replaces the coarse map, and more of the view, until the next control step."""
        self.mission.view = dataclasses.replace(
            self.mission.view, map_view=landing_support.view_of(coarse), **changes
        )

    def run(self, steps: Any, seconds: float = 120.0) -> list[Setpoint]:
        """Setpoints to the end of ``steps``; its value is ``result``."""
        found: list[Setpoint] = []
        for _ in range(round(seconds / STEP_S)):
            try:
                found.append(next(steps))
            except StopIteration as end:
                self.result = end.value
                return found
            self.position = found[-1].position_odom.copy()
            self.tick += STEP_TICKS
            self.feed(found[-1].velocity_odom)
        raise AssertionError(f"not at its end after {seconds} s")
