"""Rotor aerodynamics: rotor speeds in, wrench on the body out.

Per rotor, with w its speed, v its velocity relative to the air and z its height over the ground:

- motor: first-order lag, ``tau dw/dt = w_demanded - w``, integrated exactly over a tick;
- thrust: ``(k_T w^2 - k_i w v_axial) G``, along body +z. The second term is the blade element
  result that inflow along the axis lowers the blades' angle of attack (heave damping);
- ground effect: ``G = 1 / (1 - (R / 4z)^2)`` (Cheeseman and Bennett, 1955, hover);
- drag torque: ``spin k_Q w^2`` about body +z, the reaction on the motor;
- in-plane drag: ``-k_D w v_plane`` (the linear rotor drag of Mahony, Kumar and Corke, 2012).

The rotors' own angular momentum is left out: at 1e-4 kg m^2 each and opposite spins, it is below
the effect of one per cent of thrust.
"""

import math

import numpy as np
from numba import njit

from touchdown.sim.airframe.deviations import Deviations, nominal
from touchdown.sim.airframe.vehicle import RotorGeometry
from touchdown.sim.api import VehicleModel
from touchdown.sim.typing import Array

GROUND_EFFECT_MIN_HEIGHT_RADII = 0.5
"""Below half a radius the formula diverges; its factor is held at 4/3."""

_KT, _KQ, _INFLOW, _DRAG, _RADIUS = range(5)


class Rotors:
    """The rotors. ``speeds`` (R,) rad/s is the state; ``wrench`` (6,) is force and torque about
    the centre of mass, both in world axes, as MuJoCo's ``xfrc_applied`` takes them."""

    def __init__(
        self,
        vehicle: VehicleModel,
        geometry: RotorGeometry,
        tick_s: float,
        deviations: Deviations | None = None,
    ) -> None:
        count = len(vehicle.rotor_spin)
        deviations = deviations or nominal(count)
        self._positions = np.ascontiguousarray(geometry.positions_body)
        self._spin = np.ascontiguousarray(vehicle.rotor_spin)
        self._coefficients = np.array(
            [
                vehicle.thrust_coefficient,
                vehicle.torque_coefficient,
                geometry.inflow,
                geometry.drag * deviations.drag,
                geometry.radius_m,
            ]
        )
        self._deviations = deviations
        self.speed_fraction = 1.0
        """of the highest speed, what the battery's voltage reaches"""
        self._min = vehicle.rotor_speed_min
        self._max = vehicle.rotor_speed_max
        self._lag = float(-np.expm1(-tick_s / vehicle.motor_time_constant_s))
        self._demand = np.zeros(count)
        self.speeds = np.zeros(count)
        self.wrench = np.zeros(6)

    def demand(self, rotor_speed_radps: Array, speed_fraction: Array | None = None) -> None:
        """Takes a command, (R,) rad/s: 0 switches a motor off, other values are clipped to the
        motor's range. ``speed_fraction`` (R,) is the fraction of it that weak motors reach. Raises
        ValueError for a wrong shape or a value that is not finite."""
        # Scalars: at every control step, numpy's calls on few numbers are most of what they cost.
        wanted = np.asarray(rotor_speed_radps).tolist()
        if np.shape(rotor_speed_radps) != self.speeds.shape or not math.isfinite(sum(wanted)):
            raise ValueError(
                f"a command must hold {len(self.speeds)} finite rotor speeds in rad/s, not "
                f"{rotor_speed_radps!r}"
            )
        low, high = self._min, self._max * self.speed_fraction
        self._demand[:] = [min(max(w, low), high) if w > 0.0 else 0.0 for w in wanted]
        if speed_fraction is not None:
            self._demand *= speed_fraction

    def cut(self) -> None:
        """Cuts the power: every demand is 0."""
        self._demand[:] = 0.0

    def step(
        self,
        quat_wxyz: Array,
        velocity_world: Array,
        angular_velocity_body: Array,
        wind_world: Array,
        ground_clearance_m: float,
    ) -> Array:
        """Advances the motors by a tick and returns ``wrench``.

        quat_wxyz: (4,) unit, ``world_from_body``; velocity_world: (3,) m/s of the body origin;
        ground_clearance_m: body origin over the ground below it, ``inf`` for none.
        """
        _step(
            self.speeds,
            self._demand,
            self._lag,
            self._positions,
            self._spin,
            self._coefficients,
            self._deviations.thrust,
            self._deviations.torque,
            self._deviations.center_of_mass_m,
            quat_wxyz,
            velocity_world,
            angular_velocity_body,
            wind_world,
            ground_clearance_m,
            self.wrench,
        )
        return self.wrench

    def shaft_power(self) -> float:
        """Mechanical power of all rotors at their present speed, W."""
        fractions = self._deviations.torque.tolist()
        cubes = sum(k * w * w * w for k, w in zip(fractions, self.speeds.tolist(), strict=True))
        return self._coefficients.item(_KQ) * cubes


@njit(cache=True, error_model="numpy")
def ground_effect(height_m: float, radius_m: float) -> float:
    """Thrust at ``height_m`` of the rotor plane over the ground / thrust far from it."""
    height = max(height_m, GROUND_EFFECT_MIN_HEIGHT_RADII * radius_m)
    ratio = radius_m / (4.0 * height)
    return 1.0 / (1.0 - ratio * ratio)


@njit(cache=True, error_model="numpy")
def _step(
    speeds: Array,
    demand: Array,
    lag: float,
    positions: Array,
    spin: Array,
    coefficients: Array,
    thrust_fraction: Array,
    torque_fraction: Array,
    center_of_mass: Array,
    quat_wxyz: Array,
    velocity_world: Array,
    angular_velocity: Array,
    wind_world: Array,
    ground_clearance: float,
    wrench: Array,
) -> None:
    rotation = _rotation(quat_wxyz)
    air = rotation.T @ (velocity_world - wind_world)
    force, torque = np.zeros(3), np.zeros(3)
    for i in range(speeds.size):
        speeds[i] += lag * (demand[i] - speeds[i])
        w = speeds[i]
        x, y, z = positions[i, 0], positions[i, 1], positions[i, 2]
        # about the centre of mass
        a, b, c = x - center_of_mass[0], y - center_of_mass[1], z - center_of_mass[2]
        vx = air[0] + angular_velocity[1] * z - angular_velocity[2] * y
        vy = air[1] + angular_velocity[2] * x - angular_velocity[0] * z
        vz = air[2] + angular_velocity[0] * y - angular_velocity[1] * x
        rotor_up = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z
        gain = ground_effect(ground_clearance + rotor_up, coefficients[_RADIUS])
        lift = coefficients[_KT] * thrust_fraction[i]
        thrust = (lift * w - coefficients[_INFLOW] * vz) * w * gain
        fx = -coefficients[_DRAG] * w * vx
        fy = -coefficients[_DRAG] * w * vy
        fz = max(thrust, 0.0)
        force[0] += fx
        force[1] += fy
        force[2] += fz
        torque[0] += b * fz - c * fy
        torque[1] += c * fx - a * fz
        torque[2] += a * fy - b * fx + spin[i] * (coefficients[_KQ] * torque_fraction[i]) * w * w
    force, torque = rotation @ force, rotation @ torque
    for a in range(3):
        wrench[a], wrench[3 + a] = force[a], torque[a]


@njit(cache=True, error_model="numpy")
def _rotation(quat_wxyz: Array) -> Array:
    """``sim.frames.matrix_from_quat_wxyz`` for compiled callers."""
    w, x, y, z = quat_wxyz[0], quat_wxyz[1], quat_wxyz[2], quat_wxyz[3]
    r = np.empty((3, 3))
    r[0, 0], r[0, 1], r[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    r[1, 0], r[1, 1], r[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    r[2, 0], r[2, 1], r[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    return r
