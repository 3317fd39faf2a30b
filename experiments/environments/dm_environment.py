"""The landing task behind DeepMind's dm_env interface."""

from __future__ import annotations

from typing import Any

import dm_env
import numpy as np
from dm_env import specs
from numpy.typing import NDArray

from touchdown.experiments.environments.landing_task import LandingTask, TaskOptions


class TouchdownEnvironment(dm_env.Environment):
    """Takes the fields of `experiments.environments.landing_task.TaskOptions` and a ``seed`` for
    the layout of the scene and all random draws. The discount is 0 at termination and 1 at
    truncation."""

    def __init__(self, seed: int = 0, **options: Any) -> None:
        self._task = LandingTask(TaskOptions(**options))
        self._seed = seed
        self._rng = np.random.default_rng(seed)
        self._ended = True

    def reset(self) -> dm_env.TimeStep:
        """Begins an episode on the layout of the seed."""
        self._ended = False
        return dm_env.restart(self._task.reset(self._seed, self._rng).observation)

    def step(self, action: NDArray[Any]) -> dm_env.TimeStep:
        """Flies one action; after a last time step begins a new episode instead."""
        if self._ended:
            return self.reset()
        done = self._task.step(action)
        self._ended = done.terminated or done.truncated
        if done.terminated:
            return dm_env.termination(reward=done.reward, observation=done.observation)
        if done.truncated:
            return dm_env.truncation(reward=done.reward, observation=done.observation)
        return dm_env.transition(reward=done.reward, observation=done.observation)

    def observation_spec(self) -> dict[str, specs.BoundedArray]:
        return {
            name: specs.BoundedArray(b.shape, b.dtype, b.low, b.high, name)
            for name, b in self._task.observations.bounds.items()
        }

    def action_spec(self) -> specs.BoundedArray:
        return specs.BoundedArray((4,), np.float32, -1.0, 1.0, "action")

    def close(self) -> None:
        self._task.close()
