"""The tilt and the rotor speed that a motion through moving air needs.

The model is the vehicle's nominal one: thrust that inflow along the rotors' axis lowers, drag in
the rotors' plane that grows with their speed, and the quadratic drag of the fuselage,

    m (a + g) = T z + D,    T = k_T W2 - k_i W1 v.z,    D = -k_D W1 (v - (v.z) z) - c |v| v

with v the velocity through the air, z the thrust axis, and W1, W2 the sums of the rotors' speeds
and of their squares. In a steady wind of the speed that a vehicle just holds against, inflow takes
half of the thrust: tilt alone does not say what is left.
"""

import numpy as np
from numba import njit

from touchdown.sim.api import GRAVITY_MPS2, VehicleModel
from touchdown.sim.typing import Array

_ITERATIONS = 25
_RELAXATION = 0.4
"""fraction of a step of the fixed point that is taken: inflow and tilt drive each other"""

MASS, THRUST, INFLOW, ROTOR_DRAG, BODY_DRAG, FASTEST, ROTORS = range(7)
"""indices into the coefficients of `air_coefficients`"""


def air_coefficients(vehicle: VehicleModel) -> Array:
    """(7,) mass, thrust, inflow, drag of one rotor, drag of the fuselage, largest rotor speed,
    number of rotors."""
    rotors = len(vehicle.rotor_spin)
    hover = np.sqrt(vehicle.mass_kg * GRAVITY_MPS2 / (rotors * vehicle.thrust_coefficient))
    return np.array(
        [
            vehicle.mass_kg,
            vehicle.thrust_coefficient,
            vehicle.rotor_inflow,
            vehicle.linear_drag / (rotors * hover),
            vehicle.quadratic_drag,
            vehicle.rotor_speed_max,
            rotors,
        ]
    )


@njit(cache=True, error_model="numpy")
def rotor_need(through_air: Array, acceleration: Array, coefficients: Array) -> tuple[float, float]:
    """Mean rotor speed over the largest, above 1 where the motion cannot be flown, and tilt (rad)
    of a steady motion, by a relaxed fixed point.

    ``through_air`` (3,) m/s and ``acceleration`` (3,) m/s^2, z up; ``coefficients`` of
    `air_coefficients`."""
    mass, thrust, rotors = coefficients[MASS], coefficients[THRUST], coefficients[ROTORS]
    fastest = coefficients[FASTEST]
    vx, vy, vz = through_air[0], through_air[1], through_air[2]
    airspeed = np.sqrt(vx * vx + vy * vy + vz * vz)
    body = coefficients[BODY_DRAG] * airspeed
    fx = mass * acceleration[0] + body * vx
    fy = mass * acceleration[1] + body * vy
    fz = mass * (acceleration[2] + GRAVITY_MPS2) + body * vz
    zx, zy, zz = 0.0, 0.0, 1.0
    speed = np.sqrt(mass * GRAVITY_MPS2 / (rotors * thrust))
    for _ in range(_ITERATIONS):
        along = vx * zx + vy * zy + vz * zz
        drag = rotors * coefficients[ROTOR_DRAG] * speed
        tx = fx + drag * (vx - along * zx)
        ty = fy + drag * (vy - along * zy)
        tz = fz + drag * (vz - along * zz)
        size = max(np.sqrt(tx * tx + ty * ty + tz * tz), 1e-9)
        zx += _RELAXATION * (tx / size - zx)
        zy += _RELAXATION * (ty / size - zy)
        zz += _RELAXATION * (tz / size - zz)
        norm = max(np.sqrt(zx * zx + zy * zy + zz * zz), 1e-9)
        zx, zy, zz = zx / norm, zy / norm, zz / norm
        lost = rotors * coefficients[INFLOW] * along
        root = np.sqrt(max(lost * lost + 4.0 * rotors * thrust * size, 0.0))
        wanted = (lost + root) / (2.0 * rotors * thrust)
        speed += _RELAXATION * (min(max(wanted, 0.0), 2.0 * fastest) - speed)
    return speed / fastest, np.arccos(min(max(zz, -1.0), 1.0))
