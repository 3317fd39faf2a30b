"""The landing task behind Gymnasium's interface."""

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.environments.landing_task import LandingTask, TaskOptions

Observation = dict[str, NDArray[Any]]


class TouchdownEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """``gymnasium.make("Touchdown-v0", **options)`` with the fields of
    `experiments.environments.landing_task.TaskOptions`.

    ``reset(seed=n)`` builds layout n of the scene and seeds all random draws; a reset
    without seed keeps the layout and draws another start, wind and sensor errors.
    ``options={"layout": k}`` selects a layout by number. Render mode ``rgb_array`` gives the
    vehicle's view downwards.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012

    def __init__(self, render_mode: str | None = None, **options: Any) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode '{render_mode}' is unknown: give rgb_array or None")
        self.render_mode = render_mode
        self._task = LandingTask(TaskOptions(**_tuples(options)))
        self.metadata = {**self.metadata, "render_fps": self._task.options.action_hz}
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (4,), np.float32)
        spaces: dict[str, gymnasium.Space[Any]] = {
            name: gymnasium.spaces.Box(b.low, b.high, b.shape, b.dtype)
            for name, b in self._task.observations.bounds.items()
        }
        self.observation_space = gymnasium.spaces.Dict(spaces)  # type: ignore[assignment]

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        super().reset(seed=seed)
        layout = (options or {}).get("layout", seed)
        first = self._task.reset(layout, self.np_random)
        return first.observation, first.info

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        done = self._task.step(action)
        return done.observation, done.reward, done.terminated, done.truncated, done.info

    def render(self) -> NDArray[np.uint8] | None:  # type: ignore[override]
        return self._task.render() if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        self._task.close()


def _tuples(options: dict[str, Any]) -> dict[str, Any]:
    """Converts lists, as read from JSON and YAML, to tuples."""
    return {k: tuple(v) if isinstance(v, list) else v for k, v in options.items()}
