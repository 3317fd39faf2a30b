"""Mixer: rotor speeds from a wrench, by the pseudo-inverse of the effectiveness matrix.

Under saturation roll and pitch torque have priority, since they keep the vehicle upright, then the
thrust, then the yaw torque. A lost rotor is left out; where the others cannot balance the yaw
torque, or not without a rotor at its limit, yaw is given up.
"""

from collections.abc import Collection

import numpy as np
from numba import njit
from numpy.typing import NDArray

from touchdown.sim.api import GRAVITY_MPS2, VehicleModel
from touchdown.sim.typing import Array

AXES = ("thrust", "roll", "pitch", "yaw")
_IDLE = 0.02
"""fraction of the mean share of the weight below which a rotor idles"""
_SPARE_THRUST = 1.3
"""thrust over the weight that is kept where a rotor is lost"""


def allocation_matrix(vehicle: VehicleModel) -> Array:
    """(4, R) matrix that maps squared rotor speeds to (thrust, torque x, y, z), body frame, SI.

    Rotor i pushes along +z at (x_i, y_i), so its torque is (y_i, -x_i) times its thrust.
    """
    thrust = vehicle.thrust_coefficient * np.ones(len(vehicle.rotor_spin))
    return np.stack(
        [
            thrust,
            thrust * vehicle.rotor_xy_m[:, 1],
            -thrust * vehicle.rotor_xy_m[:, 0],
            vehicle.torque_coefficient * vehicle.rotor_spin,
        ]
    )


def _scaled(vehicle: VehicleModel) -> Array:
    """The allocation matrix of arms and torques in units of their own size."""
    matrix = allocation_matrix(vehicle) / vehicle.thrust_coefficient
    arm = float(np.abs(vehicle.rotor_xy_m).max()) or 1.0
    matrix[1:3] /= arm
    matrix[3] *= vehicle.thrust_coefficient / vehicle.torque_coefficient
    return matrix


def uncontrolled_axis(vehicle: VehicleModel) -> str:
    """The first of `AXES` that the rotors cannot command by itself, "" where they can all four."""
    matrix = _scaled(vehicle)
    for count, name in enumerate(AXES, start=1):
        if np.linalg.matrix_rank(matrix[:count], tol=1e-3) < count:
            return name
    return ""


class Mixer:
    """Rotor speeds for a wrench; the exact inverse of the rotor model where nothing saturates.
    ``lost``: rotors that do not turn.

    Raises ValueError when the rotors cannot produce four independent wrenches, or those left cannot
    carry the vehicle upright.
    """

    def __init__(self, vehicle: VehicleModel, lost: Collection[int] = ()) -> None:
        self.effectiveness = allocation_matrix(vehicle)
        if axis := uncontrolled_axis(vehicle):
            raise ValueError(
                f"the rotors cannot {axis}: their places (rotor_xy_m) and rotor_spin leave that "
                "axis without control; put rotors on all sides of the centre of mass, and let "
                "neighbours turn against one another"
            )
        if lost or len(vehicle.rotor_spin) > 4:
            self._active, self.inverse = _shared(vehicle, lost)
        else:
            self._active = np.arange(len(vehicle.rotor_spin), dtype=np.int64)
            self.inverse = np.ascontiguousarray(np.linalg.inv(self.effectiveness))
        if self.inverse[:, 0].min() <= 0.0:
            raise ValueError(
                f"rotor {int(self._active[self.inverse[:, 0].argmin()])} cannot help to carry the "
                "weight upright; put the rotors around the centre of mass"
            )
        self._all = len(self._active) == len(vehicle.rotor_spin)
        self._square_min = max(vehicle.rotor_speed_min, 0.0) ** 2
        self._square_max = vehicle.rotor_speed_max**2
        self._squares = np.full(len(vehicle.rotor_spin), self._square_min)
        self._squares[list(lost)] = 0.0

    def speeds(self, wrench: Array, thrust_limit_n: float = np.inf) -> Array:
        """(R,) rotor speeds in rad/s for ``wrench`` (4,) = thrust N, torque xyz N m (body frame).

        ``thrust_limit_n`` bounds the total thrust even where a torque would need more; the idle
        speed is the only thing that may exceed it.
        """
        squares = _squared_speeds(
            self.inverse, wrench, self._square_min, self._square_max, thrust_limit_n
        )
        if not self._all:
            whole = self._squares.copy()
            whole[self._active] = squares
            squares = whole
        return np.sqrt(squares)

    def wrench(self, rotor_speed_radps: Array) -> Array:
        """(4,) wrench in steady state of (R,) rotor speeds."""
        return self.effectiveness @ (rotor_speed_radps * rotor_speed_radps)


def _shared(vehicle: VehicleModel, lost: Collection[int]) -> tuple[NDArray[np.int64], Array]:
    """Rotors (M,) that share the work, and their (M, 4) inverse.

    The first column, of the thrust, is the most even share without torque that leaves each rotor
    below its limit at `_SPARE_THRUST` of the weight. Rotors without a share idle. Raises ValueError
    where there is none.
    """
    from scipy.optimize import lsq_linear  # a flight without a lost rotor needs it once

    matrix = _scaled(vehicle)
    working = np.array([i for i in range(matrix.shape[1]) if i not in lost])
    full_n = vehicle.thrust_coefficient * vehicle.rotor_speed_max**2
    weights = np.array([1e4, 1e4, 1e4, 1e2])
    rows = np.vstack([weights[:, None] * matrix[:, working], np.eye(len(working))])
    wanted = np.zeros(len(rows))
    wanted[0] = weights[0]
    highest = full_n / (_SPARE_THRUST * vehicle.mass_kg * GRAVITY_MPS2)
    share = lsq_linear(rows, wanted, (0.0, highest), method="bvls").x
    left = matrix[:, working] @ share - [1.0, 0.0, 0.0, 0.0]
    if np.abs(left[:3]).max() > 1e-3:
        raise ValueError("the rotors that are left cannot carry the vehicle upright")
    active = working[share > _IDLE / len(working)]
    used = allocation_matrix(vehicle)[:, active]
    balanced = abs(left[3]) < 1e-3 and np.linalg.matrix_rank(matrix[:, active], tol=1e-3) == 4
    inverse = np.zeros((len(active), 4))
    axes = 4 if balanced else 3
    inverse[:, :axes] = np.linalg.pinv(used[:axes])
    if not balanced or inverse[:, 0].min() <= 0.0:
        inverse[:, 0] = share[share > _IDLE / len(working)] / vehicle.thrust_coefficient
    return active, np.ascontiguousarray(inverse)


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
    for i in range(per_thrust.size):
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
    for i in range(per_thrust.size):
        drop = -tilting[i] / per_thrust[i]
        if drop > 0.0:
            scale = min(scale, max(thrust_limit - low / per_thrust[i], 0.0) / drop)
        for j in range(per_thrust.size):
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
        self._high, self._count = vehicle.rotor_speed_max, len(vehicle.rotor_spin)
        self._gain, self._decay = lead_coefficients(
            vehicle.motor_time_constant_s, response_s, step_s
        )
        self.reset()

    def reset(self) -> None:
        """Resets the model to stopped rotors."""
        self.modelled_radps = np.zeros(self._count)

    def command(self, wanted_radps: Array) -> Array:
        """(R,) rad/s to send so that the rotors reach ``wanted_radps`` (R,) early."""
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
