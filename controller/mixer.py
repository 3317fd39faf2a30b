"""Mixer: rotor speeds from a wrench, by the inverse of the effectiveness matrix.

Under saturation roll and pitch torque have priority, since they keep the vehicle upright, then the
thrust, then the yaw torque.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from touchdown.sim.api import VehicleModel
from touchdown.sim.typing import Array


def allocation_matrix(vehicle: VehicleModel) -> Array:
    """(4, 4) matrix that maps squared rotor speeds to (thrust, torque x, y, z), body frame, SI.

    Rotor i pushes along +z at (x_i, y_i), so its torque is (y_i, -x_i) times its thrust.
    """
    thrust = vehicle.thrust_coefficient * np.ones(4)
    return np.stack(
        [
            thrust,
            thrust * vehicle.rotor_xy_m[:, 1],
            -thrust * vehicle.rotor_xy_m[:, 0],
            vehicle.torque_coefficient * vehicle.rotor_spin,
        ]
    )


class Mixer:
    """Rotor speeds for a wrench; the exact inverse of the rotor model where nothing saturates.

    Raises ValueError when the rotors cannot produce four independent wrenches.
    """

    def __init__(self, vehicle: VehicleModel) -> None:
        self.effectiveness = allocation_matrix(vehicle)
        if np.linalg.matrix_rank(self.effectiveness) < 4:
            raise ValueError(
                "rotor_xy_m, rotor_spin and the rotor coefficients leave a wrench axis without "
                "control; use four rotors with alternating spin"
            )
        self.inverse = np.ascontiguousarray(np.linalg.inv(self.effectiveness))
        self._square_min = max(vehicle.rotor_speed_min, 0.0) ** 2
        self._square_max = vehicle.rotor_speed_max**2

    def speeds(self, wrench: Array, thrust_limit_n: float = np.inf) -> Array:
        """(4,) rotor speeds in rad/s for ``wrench`` (4,) = thrust N, torque xyz N m (body frame).

        ``thrust_limit_n`` bounds the total thrust even where a torque would need more; the idle
        speed is the only thing that may exceed it.
        """
        return np.sqrt(
            _squared_speeds(
                self.inverse, wrench, self._square_min, self._square_max, thrust_limit_n
            )
        )

    def wrench(self, rotor_speed_radps: Array) -> Array:
        """(4,) wrench in steady state of (4,) rotor speeds."""
        return self.effectiveness @ (rotor_speed_radps * rotor_speed_radps)


@njit(cache=True, error_model="numpy")
def _squared_speeds(
    inverse: Array, wrench: Array, low: float, high: float, thrust_limit: float
) -> Array:
    exact = inverse @ wrench
    if wrench[0] <= thrust_limit and np.min(exact) >= low and np.max(exact) <= high:
        return exact
    per_thrust = inverse[:, 0]
    tilting = inverse[:, 1] * wrench[1] + inverse[:, 2] * wrench[2]
    yawing = inverse[:, 3] * wrench[3]

    tilting *= _tilting_scale(per_thrust, tilting, low, high, thrust_limit)
    thrust_low = np.max((low - tilting) / per_thrust)
    thrust_high = np.min((high - tilting) / per_thrust)
    thrust = min(wrench[0], thrust_limit)
    squares = tilting + per_thrust * max(min(thrust, thrust_high), thrust_low)

    scale = 1.0
    for i in range(4):
        if yawing[i] > 0.0:
            scale = min(scale, (high - squares[i]) / yawing[i])
        elif yawing[i] < 0.0:
            scale = min(scale, (low - squares[i]) / yawing[i])
    return np.minimum(np.maximum(squares + max(scale, 0.0) * yawing, low), high)


@njit(cache=True, error_model="numpy")
def _tilting_scale(
    per_thrust: Array, tilting: Array, low: float, high: float, thrust_limit: float
) -> float:
    """Largest factor in [0, 1] on roll and pitch for which some allowed thrust fits all rotors."""
    scale = 1.0
    for i in range(4):
        drop = -tilting[i] / per_thrust[i]
        if drop > 0.0:
            scale = min(scale, max(thrust_limit - low / per_thrust[i], 0.0) / drop)
        for j in range(4):
            spread = tilting[j] / per_thrust[j] + drop
            room = high / per_thrust[j] - low / per_thrust[i]
            if spread > 0.0:
                scale = min(scale, max(room, 0.0) / spread)
    return scale


class MotorLead:
    """Speeds up the rotors' first-order lag: a bounded first-order inverse.

    A model of the rotor runs along. The command overshoots the wanted speed so that the modelled
    speed approaches it with ``response_s`` instead of the motor's own time constant; the overshoot
    is bounded by the speeds the motor can take, and the model sees the bounded command.
    Linearised: (motor s + 1) / (response s + 1).
    """

    def __init__(self, vehicle: VehicleModel, response_s: float, step_s: float) -> None:
        self._low = max(vehicle.rotor_speed_min, 0.0)
        self._high = vehicle.rotor_speed_max
        self._gain, self._decay = lead_coefficients(
            vehicle.motor_time_constant_s, response_s, step_s
        )
        self.reset()

    def reset(self) -> None:
        """Resets the model to stopped rotors."""
        self.modelled_radps = np.zeros(4)

    def command(self, wanted_radps: Array) -> Array:
        """(4,) rad/s to send so that the rotors reach ``wanted_radps`` (4,) early."""
        command, self.modelled_radps = _lead_step(
            self.modelled_radps, wanted_radps, self._gain, self._decay, self._low, self._high
        )
        return command


def lead_coefficients(motor_s: float, response_s: float, step_s: float) -> tuple[float, float]:
    """``gain`` and ``decay`` of ``MotorLead``: the command overshoots the wanted change ``gain``
    times, so that after one held command the motor is where a lag of ``response_s`` would be.
    A response slower than the motor's leaves the command as it is."""
    if motor_s <= 0.0:
        return 1.0, 0.0
    decay = float(np.exp(-step_s / motor_s))
    wanted = float(np.exp(-step_s / min(response_s, motor_s))) if response_s > 0.0 else 0.0
    return (1.0 - wanted) / (1.0 - decay), decay


@njit(cache=True, error_model="numpy")
def _lead_step(
    modelled: Array, wanted: Array, gain: float, decay: float, low: float, high: float
) -> tuple[Array, Array]:
    command = modelled + gain * (wanted - modelled)
    command = np.minimum(np.maximum(command, low), high)
    return command, command + decay * (modelled - command)
