"""The landing task as a task of dm_control."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from dm_control.mujoco.wrapper import MjData
from dm_control.rl import control
from dm_control.utils.rewards import tolerance
from dm_env import specs
from numpy.typing import NDArray

from touchdown.experiments.api import Outcome
from touchdown.experiments.environments.landing_task import (
    FAILED,
    PROGRESS_PER_M,
    SAFE,
    TIME_COST_PER_S,
    TOUCH_DOWN_MPS,
    UNSAFE,
    LandingTask,
    Measures,
    Step,
    TaskOptions,
)
from touchdown.experiments.environments.physics import LandingPhysics
from touchdown.experiments.environments.task_scene import MAX_DISTANCE_M

Array = NDArray[np.float64]

ACTION_NAMES = {
    "rotors": ("rotor 0", "rotor 1", "rotor 2", "rotor 3"),
    "velocity": ("forward", "left", "up", "yaw rate"),
}
_NEAR = np.array([0.1, 0.8, 0.2])
"""RGB of a vehicle that is at its goal, where the reward is shown."""


class Landing(control.Task):  # type: ignore[misc]
    """Fly from a hover to a touchdown on safe ground: actions, observations and ends of
    `experiments.environments.landing_task`, which runs the episode.

    random: a seed, a ``numpy.random.RandomState`` or None, as for tasks of ``dm_control.suite``;
    it draws start, wind and sensor errors of every episode. layout: seed of the scene; None takes
    ``random`` where that is an integer, else 0. flat: observations will be joined into one array.
    """

    def __init__(
        self,
        options: TaskOptions,
        random: int | np.random.RandomState | None,
        layout: int | None,
        flat: bool,
    ) -> None:
        if layout is None:
            layout = int(random) if isinstance(random, (int, np.integer)) else 0
        self._layout_seed, self._flat = layout, flat
        self._random = (
            random if isinstance(random, np.random.RandomState) else np.random.RandomState(random)
        )
        self.landing = LandingTask(options, drawn=True)
        self.visualize_reward = False
        self._now: Step | None = None
        self._closeness = 0.0

    @property
    def random(self) -> np.random.RandomState:
        """Draws the episodes."""
        return self._random

    @property
    def info(self) -> dict[str, Any]:
        """``time_s`` of flight, ``layout``, ``outcome`` ("" in flight) and ``safe``: stands on
        truly safe ground. Raises RuntimeError before the first reset."""
        return self._step.info

    def initial_physics(self) -> LandingPhysics:
        """Returns the physics of the scene at rest, which the first reset replaces."""
        scene = self.landing.layout(self._layout_seed).scene
        return LandingPhysics(MjData(mujoco.MjData(scene.model)))

    def close(self) -> None:
        """Frees the world."""
        self.landing.close()

    # ------------------------------------------------------------------------ control.Task

    def initialize_episode(self, physics: LandingPhysics) -> None:
        """Builds the world of a new episode and holds a hover for 0.4 s."""
        rng = np.random.default_rng(self._random.randint(2**31))
        self._now = self.landing.reset(self._layout_seed, rng)
        world = self.landing.world
        physics.attach(world.data, self.landing.advance, self.landing.control_ticks)
        self._heights = self.landing.heights_m
        self._closeness = self._closeness_of(self._now.measures)
        vehicle = physics.model.body_rootid[physics.model.geom_bodyid] == physics.vehicle
        self._geoms = np.flatnonzero(vehicle)
        self._colours = physics.model.geom_rgba[self._geoms].copy()

    def before_step(self, action: NDArray[Any], physics: LandingPhysics) -> None:
        """Sets the action of the next step, (4,), clipped to [-1, 1]. Raises ValueError for another
        shape or values that are not finite."""
        self.landing.take_action(action)

    def after_step(self, physics: LandingPhysics) -> None:
        """Takes what the sensors, and the referee, say of the step."""
        before, self._now = self._closeness, self.landing.result()
        measures = self._now.measures
        self._closeness = self._closeness_of(measures)
        cost = TIME_COST_PER_S / self.landing.options.action_hz
        self._reward = self._closeness - before - cost + self._reward_of_the_end(measures)
        if self.visualize_reward:
            share = self._low(measures) * self._near(measures)
            shown = physics.model.geom_rgba
            shown[self._geoms, :3] = share * _NEAR + (1.0 - share) * self._colours[:, :3]

    def get_reward(self, physics: LandingPhysics) -> float:
        """Returns the gain in closeness, less 0.01 a second; at the end the worth of the touchdown
        is added."""
        return self._reward

    def get_termination(self, physics: LandingPhysics) -> float | None:
        """Returns the discount of the last step: 0 where the flight ended, 1 where time ran
        out; None before."""
        if self._step.terminated:
            return 0.0
        return 1.0 if self._step.truncated else None

    def get_observation(self, physics: LandingPhysics) -> dict[str, NDArray[Any]]:
        """Returns the arrays of the chosen sensors."""
        return dict(self._step.observation)

    def observation_spec(self, physics: LandingPhysics) -> dict[str, specs.BoundedArray]:
        bounds = self.landing.observations.bounds
        if self._flat:
            parts = [bounds[name] for name in sorted(bounds)]
            low = np.concatenate([part.low.ravel() for part in parts])
            high = np.concatenate([part.high.ravel() for part in parts])
            name = control.FLAT_OBSERVATION_KEY
            return {name: specs.BoundedArray(low.shape, low.dtype, low, high, name)}
        return {
            name: specs.BoundedArray(b.shape, b.dtype, b.low, b.high, name)
            for name, b in bounds.items()
        }

    def action_spec(self, physics: LandingPhysics) -> specs.BoundedArray:
        names = "\t".join(ACTION_NAMES[self.landing.options.action])
        return specs.BoundedArray((4,), np.float32, -1.0, 1.0, names)

    # ------------------------------------------------------------------------------ reward

    @property
    def _step(self) -> Step:
        if self._now is None:
            raise RuntimeError("reset the environment before looking at it")
        return self._now

    def _low(self, measures: Measures) -> float:
        """1 at the lowest ground of the scene, 0 where a climb ends the episode."""
        low, high = self._heights
        return _linear(measures.height_m - low, high - low)

    def _near(self, measures: Measures) -> float:
        """1 over truly safe ground, 0 at 20 m from it."""
        return _linear(measures.distance_m, MAX_DISTANCE_M)

    def _closeness_of(self, measures: Measures) -> float:
        """A tenth of a metre of height or of distance, of which a step is paid the change (Ng,
        Harada, Russell 1999)."""
        low, high = self._heights
        metres = (high - low) * self._low(measures) + MAX_DISTANCE_M * self._near(measures)
        return PROGRESS_PER_M * metres

    def _reward_of_the_end(self, measures: Measures) -> float:
        step = self._step
        if not step.terminated:
            return 0.0
        if step.info["outcome"] != str(Outcome.LANDED):
            return FAILED
        if not step.info["safe"]:
            return UNSAFE
        return SAFE * _linear(measures.sink_mps, TOUCH_DOWN_MPS, at_margin=0.5)


def _linear(value: float, margin: float, at_margin: float = 0.0) -> float:
    """1 up to 0, linear down to ``at_margin`` at ``margin``."""
    bounds = (-np.inf, 0.0)
    return float(tolerance(value, bounds, margin, sigmoid="linear", value_at_margin=at_margin))
