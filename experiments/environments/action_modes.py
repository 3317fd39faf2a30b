"""Action modes: rotor commands, or velocities that an autopilot flies."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from touchdown.controller.api import Setpoint
from touchdown.experiments.environments.wiring import EnvBackend
from touchdown.sim.api import Command, Observation
from touchdown.sim.frames import rotation_from_yaw, yaw_from_rotation

Array = NDArray[np.float64]

MAX_VELOCITY_MPS = np.array([4.0, 4.0, 2.5])
MAX_YAW_RATE = float(np.radians(60.0))
_MAX_ACCELERATION_MPS2 = 4.0
_MAX_LEAD_M = 1.5


class ActionMode(Protocol):
    """Converts actions to rotor commands."""

    def hold(self, obs: Observation) -> Command:
        """Returns the command that keeps the position of the first call, before the policy
        flies."""
        ...

    def set_action(self, action: Array) -> None:
        """Sets the action of the next steps, (4,) in [-1, 1]."""
        ...

    def command(self, obs: Observation) -> Command:
        """Returns the command of the next control step."""
        ...


class VelocityMode:
    """Flies forward, left and up velocity and yaw rate through the cascade controller. The
    reference accelerates by at most 4 m/s^2 and stays within 1.5 m of the vehicle."""

    def __init__(self, backend: EnvBackend) -> None:
        self._backend = backend
        self._step_s = backend.step_s
        self._position: Array | None = None
        self._velocity = np.zeros(3)
        self._yaw = 0.0
        self._action = np.zeros(4)

    def hold(self, obs: Observation) -> Command:
        return self.command(obs)

    def set_action(self, action: Array) -> None:
        self._action = action

    def command(self, obs: Observation) -> Command:
        estimate = self._backend.estimator.update(obs)
        pose = estimate.odom_from_body
        if self._position is None:
            self._position, self._yaw = pose.translation.copy(), yaw_from_rotation(pose.rotation)
        rate = MAX_YAW_RATE * float(self._action[3])
        self._yaw += rate * self._step_s
        wanted = rotation_from_yaw(self._yaw) @ (MAX_VELOCITY_MPS * self._action[:3])
        change = wanted - self._velocity
        limit = _MAX_ACCELERATION_MPS2 * self._step_s
        change *= min(1.0, limit / max(float(np.linalg.norm(change)), 1e-9))
        self._velocity = self._velocity + change
        ahead = self._position + self._velocity * self._step_s - pose.translation
        ahead *= min(1.0, _MAX_LEAD_M / max(float(np.linalg.norm(ahead)), 1e-9))
        self._position = pose.translation + ahead
        setpoint = Setpoint(
            position_odom=self._position,
            velocity_odom=self._velocity,
            acceleration_odom=change / self._step_s,
            yaw_odom=self._yaw,
            yaw_rate=rate,
        )
        return self._backend.controller.update(estimate, setpoint)


class RotorMode:
    """Sets the thrust of each rotor, linear from idle (-1) to full (1)."""

    def __init__(self, backend: EnvBackend) -> None:
        self._hover = VelocityMode(backend)
        vehicle = backend.world.rig.vehicle
        self._least, self._most = vehicle.rotor_speed_min**2, vehicle.rotor_speed_max**2
        self._command = Command(rotor_speed_radps=np.zeros(4))

    def hold(self, obs: Observation) -> Command:
        return self._hover.hold(obs)

    def set_action(self, action: Array) -> None:
        squares = self._least + 0.5 * (action + 1.0) * (self._most - self._least)
        self._command = Command(rotor_speed_radps=np.sqrt(squares))

    def command(self, obs: Observation) -> Command:
        return self._command


ACTION_MODES: Mapping[str, Callable[[EnvBackend], ActionMode]] = {
    "rotors": RotorMode,
    "velocity": VelocityMode,
}
"""By the value of the option ``action``."""
