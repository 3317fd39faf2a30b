"""The moving air at the vehicle: mean wind and turbulence, wakes, rotational gusts, gusts of
faults."""

import math

from touchdown.scenes.api import Scene
from touchdown.sim.api import WindParams
from touchdown.sim.effects import Effect
from touchdown.sim.faults.disturbances import Disturbances
from touchdown.sim.typing import Array
from touchdown.sim.wakes import Wakes, obstacles
from touchdown.sim.wind import Wind


class Airflow:
    """Velocity and rotation of the air, once a control step.

    ``velocity`` (3,) m/s, world frame, is written in place; ``span_m`` is that of the vehicle and
    ``ground_m`` the world z that heights count from."""

    def __init__(
        self,
        scene: Scene,
        params: WindParams,
        seed: int,
        disturbances: Disturbances,
        velocity: Array,
        *,
        span_m: float,
        ground_m: float,
        step_s: float,
    ) -> None:
        self._wind = Wind(params, seed, span_m)
        self._roughness_m = params.roughness_length_m
        self._ground_m, self._step_s = ground_m, step_s
        self._disturbances = disturbances
        self.velocity = velocity
        self.rotation: Array | None = None
        """(3,) rad/s, world frame, of the air about the vehicle; None without rotational gusts"""
        self._wakes: Wakes | None = None
        if params.wakes:
            self._wakes = Wakes(obstacles(scene), self._wind.mean_direction, ground_m, seed)
        self.effects = {"wakes": Effect(), "rotation": Effect()}

    def start(self, height_m: float) -> None:
        """Sets the wind of a start at rest at a height over the ground."""
        self.velocity[:] = self._wind.step(self._step_s, height_m, 0.0)

    def step(self, tick: int, position: Array, velocity: Array) -> None:
        """Moves on to the control step that begins at ``tick``, for a vehicle at ``position`` (3,)
        that moves by ``velocity`` (3,), world frame."""
        height = float(position[2]) - self._ground_m
        airspeed = math.dist(velocity.tolist(), self.velocity.tolist())
        self.velocity[:] = self._wind.step(self._step_s, height, airspeed)
        if self._wakes is not None:
            self._add_wakes(self._wakes, position)
        if self._wind.rotational:
            self.rotation = self._wind.rotation(self._step_s, height, airspeed)
            rate = math.degrees(math.hypot(*self.rotation.tolist()))
            self.effects["rotation"].add(Effect(1, 1, 1.0, rate))
        self._disturbances.add_gust(tick, self._wind.mean_direction, self.velocity)

    def _add_wakes(self, wakes: Wakes, position: Array) -> None:
        free = self.velocity.copy()
        wakes.add(self.velocity, position, self._step_s, self._wind.friction, self._roughness_m)
        change = math.dist(free.tolist(), self.velocity.tolist())
        self.effects["wakes"].add(Effect(1, int(change > 0.0), 1.0, change))
