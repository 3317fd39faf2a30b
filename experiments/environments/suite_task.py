"""The landing task as a task and a physics of dm_control."""

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
from dm_control import mujoco as dm_mujoco
from dm_control.mujoco.wrapper import MjData
from dm_control.rl import control
from dm_env import specs
from numpy.typing import NDArray

from touchdown.experiments.environments.landing_task import LandingTask, Step, TaskOptions
from touchdown.experiments.environments.task_scene import MAX_DISTANCE_M
from touchdown.scenes.api import VEHICLE_BODY

ACTION_NAMES = {
    "rotors": ("rotor 0", "rotor 1", "rotor 2", "rotor 3"),
    "velocity": ("forward", "left", "up", "yaw rate"),
}
_NEAR = np.array([0.1, 0.8, 0.2])
"""RGB of a vehicle that is at its goal, where the reward is shown."""


class LandingPhysics(dm_mujoco.Physics):  # type: ignore[misc]
    """Holds the world's own ``MjModel`` and ``MjData``: what is read here is the state that flies,
    and what is written here moves it. ``named`` indexes both by name; the vehicle is
    ``vehicle/quadrotor``.

    ``step`` flies the world with its rotors, wind and sensors, not MuJoCo alone, and leaves all
    that depends on ``qpos`` in step with it. A wrench that is set in
    ``named.data.xfrc_applied["vehicle/quadrotor"]`` between two steps, newtons and newton metres in
    world axes at the centre of mass, pushes the vehicle during the next one, as the viewer's mouse
    does; with ``land_by_velocity`` the controller holds against it. Before the first reset it holds
    the scene at rest.
    """

    vehicle: int
    """id of the vehicle's body"""
    _advance: Callable[[], bool] | None = None
    _control_ticks = 1

    def attach(self, data: Any, advance: Callable[[], bool], control_ticks: int) -> None:
        """Takes the world of a new episode. data: its ``mujoco.MjData``; advance: flies one control
        step of ``control_ticks`` and is False where the episode ended."""
        self._advance, self._control_ticks = advance, control_ticks
        self.vehicle = int(data.model.body(VEHICLE_BODY).id)
        self._reload_from_data(MjData(data))
        self._own_wrench = self.data.xfrc_applied[self.vehicle].copy()

    def step(self, nstep: int = 1) -> None:
        """Flies ``nstep`` ticks of 1/600 s, or fewer where the episode ends.

        Raises ValueError unless ``nstep`` is a multiple of the control step (3 ticks), PhysicsError
        where the state diverges, and RuntimeError before the first reset.
        """
        if self._advance is None:
            raise RuntimeError("reset the environment before its physics steps; a copy cannot step")
        if nstep < 1 or nstep % self._control_ticks:
            raise ValueError(f"nstep is {nstep}: give a multiple of {self._control_ticks}")
        push = self._push()
        with self.check_invalid_state():
            for _ in range(nstep // self._control_ticks):
                if not self._fly(push):
                    break
            mujoco.mj_step1(self.model.ptr, self.data.ptr)
        self._own_wrench = self.data.xfrc_applied[self.vehicle].copy()

    def reset(self, keyframe_id: int | None = None) -> None:
        """Does nothing: an episode begins in ``Landing.initialize_episode``."""

    def after_reset(self) -> None:
        """Brings what depends on the position in step with it."""
        mujoco.mj_step1(self.model.ptr, self.data.ptr)

    def _push(self) -> Any:
        """(6,) the wrench that was set since the last step, None for none."""
        wrench = self.data.xfrc_applied[self.vehicle]
        if not wrench.any() or np.array_equal(wrench, self._own_wrench):
            return None
        return wrench.copy()

    def _fly(self, push: Any) -> bool:
        """One control step, with the push as a generalized force: the world writes the rotors'
        wrench into ``xfrc_applied`` at every tick."""
        assert self._advance is not None
        forces = self.data.qfrc_applied
        before = None if push is None else forces.copy()
        if push is not None:
            model, data, point = self.model.ptr, self.data.ptr, self.data.xipos[self.vehicle]
            mujoco.mj_applyFT(model, data, push[:3], push[3:], point, self.vehicle, forces)
        try:
            return self._advance()
        except RuntimeError as error:
            raise control.PhysicsError(str(error)) from error
        finally:
            if before is not None:
                forces[:] = before


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
        vehicle = physics.model.body_rootid[physics.model.geom_bodyid] == physics.vehicle
        self._geoms = np.flatnonzero(vehicle)
        self._colours = physics.model.geom_rgba[self._geoms].copy()

    def before_step(self, action: NDArray[Any], physics: LandingPhysics) -> None:
        """Sets the action of the next step, (4,), clipped to [-1, 1]. Raises ValueError for another
        shape or values that are not finite."""
        self.landing.take_action(action)

    def after_step(self, physics: LandingPhysics) -> None:
        """Takes what the sensors, and the referee, say of the step."""
        self._now = self.landing.result()
        if self.visualize_reward:
            near = max(0.0, 1.0 - self.landing.away_m / MAX_DISTANCE_M)
            shown = physics.model.geom_rgba
            shown[self._geoms, :3] = near * _NEAR + (1.0 - near) * self._colours[:, :3]

    def get_reward(self, physics: LandingPhysics) -> float:
        """Returns that of the last step."""
        return self._step.reward

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
        ones = np.ones(4, np.float32)
        return specs.BoundedArray((4,), np.float32, -ones, ones, names)

    @property
    def _step(self) -> Step:
        if self._now is None:
            raise RuntimeError("reset the environment before looking at it")
        return self._now
