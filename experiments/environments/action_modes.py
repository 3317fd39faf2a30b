"""What an action does: rotor commands, or velocities that an autopilot flies."""

import numpy as np

from touchdown.controller.api import Controller, Setpoint
from touchdown.estimator.api import Estimator
from touchdown.sim.api import Command, Observation, VehicleModel
from touchdown.sim.frames import rotation_from_yaw, yaw_from_rotation
from touchdown.sim.typing import Array

ACTIONS = ("rotors", "velocity")
MAX_VELOCITY_MPS = np.array([4.0, 4.0, 2.5])
MAX_YAW_RATE = float(np.radians(60.0))
_MAX_ACCELERATION_MPS2 = 4.0
_MAX_LEAD_M = 1.5


def rotor_command(action: Array, vehicle: VehicleModel) -> Command:
    """Thrust of each rotor, linear from idle (-1) to full (1)."""
    idle, full = vehicle.rotor_speed_min**2, vehicle.rotor_speed_max**2
    return Command(rotor_speed_radps=np.sqrt(idle + 0.5 * (action + 1.0) * (full - idle)))


class Autopilot:
    """Flies forward, left and up velocity and yaw rate through the cascade controller. The
    reference accelerates by at most 4 m/s^2 and stays within 1.5 m of the vehicle."""

    def __init__(self, estimator: Estimator, controller: Controller, step_s: float) -> None:
        self._estimator, self._controller = estimator, controller
        self._step_s = step_s
        self._position: Array | None = None
        self._velocity = np.zeros(3)
        self._yaw = 0.0

    def command(self, obs: Observation, action: Array) -> Command:
        """Returns the command of the next control step for an action (4,) in [-1, 1]."""
        estimate = self._estimator.update(obs)
        pose = estimate.odom_from_body
        if self._position is None:
            self._position, self._yaw = pose.translation.copy(), yaw_from_rotation(pose.rotation)
        rate = MAX_YAW_RATE * float(action[3])
        self._yaw += rate * self._step_s
        wanted = rotation_from_yaw(self._yaw) @ (MAX_VELOCITY_MPS * action[:3])
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
        return self._controller.update(estimate, setpoint)
