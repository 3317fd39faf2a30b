"""The simulated world as a ``dm_control.mujoco.Physics``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
from dm_control import mujoco as dm_mujoco
from dm_control.mujoco.wrapper import MjData
from dm_control.rl.control import PhysicsError

from touchdown.scenes.api import VEHICLE_BODY


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
            raise PhysicsError(str(error)) from error
        finally:
            if before is not None:
                forces[:] = before
