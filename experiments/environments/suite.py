"""The landing tasks as a suite of dm_control: ``touchdown.suite.load("crossroad", "land")``.

A domain is a scene, a task a kind of action: ``land`` sets the four rotors, ``land_by_velocity`` a
velocity that the project's controller flies. Needs dm_control, which the project brings on Python
3.11 and 3.12. Actions, observations and rewards are documented in `landing_task`.
"""

from collections.abc import Mapping
from typing import Any

from touchdown.experiments.environments.landing_task import TaskOptions
from touchdown.experiments.errors import UsageError, nearest, require_dm_control
from touchdown.scenes.registry import scene_names

require_dm_control("touchdown.suite")

import glfw  # noqa: E402
import numpy as np  # noqa: E402
from dm_control.rl import control  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

from touchdown.experiments.environments.suite_task import Landing  # noqa: E402

_ACTIONS = {"land": "rotors", "land_by_velocity": "velocity"}
_BENCHMARKED = ("crossroad", "forest", "houses", "lake")

ALL_TASKS = tuple((scene, task) for scene in scene_names() for task in _ACTIONS)
"""(domain, task), sorted by domain. The path of an MJCF file is a domain too."""
BENCHMARKING = tuple((scene, task) for scene, task in ALL_TASKS if scene in _BENCHMARKED)
"""Those in the scenes of the project's own tables."""
EXTRA = tuple(pair for pair in ALL_TASKS if pair not in BENCHMARKING)
TASKS_BY_DOMAIN: Mapping[str, tuple[str, ...]] = {scene: tuple(_ACTIONS) for scene in scene_names()}


class LandingEnvironment(control.Environment):  # type: ignore[misc]
    """dm_control's environment, which frees its world when it is closed."""

    def close(self) -> None:
        self._task.close()
        self._physics.free()


def load(
    domain_name: str,
    task_name: str,
    task_kwargs: Mapping[str, Any] | None = None,
    environment_kwargs: Mapping[str, Any] | None = None,
    visualize_reward: bool = False,
) -> LandingEnvironment:
    """Returns an environment, as ``dm_control.suite.load`` does.

    domain_name: a scene's name, or the path of an MJCF file. task_kwargs: ``random`` (a seed, a
    ``numpy.random.RandomState`` or None), ``time_limit`` in seconds, ``layout`` (seed of the scene;
    by default ``random`` where that is an integer, else 0), and the fields of
    `experiments.environments.landing_task.TaskOptions` other than ``scene`` and ``action``.
    environment_kwargs: of ``dm_control.rl.control.Environment``, such as ``flat_observation``.
    visualize_reward: colours the vehicle by how near to safe ground it is.
    Raises UsageError for an unknown domain or task, and ValueError for options out of range.
    """
    if task_name not in _ACTIONS:
        raise UsageError(
            f"task '{task_name}' does not exist{nearest(task_name, _ACTIONS)}: give one of "
            f"{', '.join(_ACTIONS)}"
        )
    options = dict(task_kwargs or {})
    random, layout = options.pop("random", None), options.pop("layout", None)
    if "time_limit" in options:
        options["time_limit_s"] = options.pop("time_limit")
    if "scene" in options or "action" in options:
        raise UsageError(
            "scene and action are the domain and the task: leave them out of task_kwargs"
        )
    chosen = TaskOptions(scene=domain_name, action=_ACTIONS[task_name], **options)
    settings = dict(environment_kwargs or {})
    task = Landing(chosen, random, layout, flat=bool(settings.get("flat_observation")))
    task.visualize_reward = visualize_reward
    physics = task.initial_physics()
    return LandingEnvironment(physics, task, control_timestep=1.0 / chosen.action_hz, **settings)


_KEYS = (
    (glfw.KEY_UP, glfw.KEY_DOWN),
    (glfw.KEY_LEFT, glfw.KEY_RIGHT),
    (glfw.KEY_PAGE_UP, glfw.KEY_PAGE_DOWN),
    (glfw.KEY_HOME, glfw.KEY_END),
)
"""For forward, left, up, yaw to the left, and against them: keys that the viewer leaves free, but
for the right arrow, which steps a viewer that is paused."""


class Keyboard:
    """A policy of ``land_by_velocity`` for ``dm_control.viewer.launch``: arrows fly forward, back,
    left and right, Page Up and Page Down climb and sink, Home and End turn. Without a key the
    vehicle hovers. speed: fraction of the maximum velocities, above 0, at most 1."""

    def __init__(self, speed: float = 0.4) -> None:
        self._speed = speed

    def __call__(self, time_step: Any) -> NDArray[np.float32]:
        """Returns the action of the keys that are down, (4,) float32; zeros without a window."""
        window = glfw.get_current_context()  # after a frame, the viewer's window
        if not window:
            return np.zeros(4, np.float32)
        down = [[glfw.get_key(window, key) == glfw.PRESS for key in pair] for pair in _KEYS]
        return self._speed * np.array([float(a) - float(b) for a, b in down], np.float32)
