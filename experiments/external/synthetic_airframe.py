"""A rigid quadrotor of a few lines, by numpy alone: for checks of a controller without a simulator.

Rotors follow their commands with the time constant of the data sheet; there is drag but no wind.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.api import Estimate
from touchdown.sim.api import GRAVITY_MPS2, VehicleModel
from touchdown.sim.frames import Pose, cross, so3_exp

Array = NDArray[np.float64]

_SUBSTEPS = 4


class SyntheticAirframe:
    """Flies from rest at ``position`` (3,), hovering; ``step_s`` is the control period."""

    def __init__(self, vehicle: VehicleModel, position: Array, step_s: float) -> None:
        self._vehicle, self._step_s = vehicle, step_s
        self.position: Array = np.array(position, np.float64)
        self.rotation: Array = np.eye(3)
        self._velocity, self._rates, self._acceleration = np.zeros(3), np.zeros(3), np.zeros(3)
        weight = vehicle.mass_kg * GRAVITY_MPS2
        self._speeds: Array = np.full(4, np.sqrt(weight / 4.0 / vehicle.thrust_coefficient))
        self._steps = 0

    def step(self, speeds: Array) -> None:
        """Flies one control period with commanded rotor speeds (4,) rad/s."""
        vehicle, step_s = self._vehicle, self._step_s / _SUBSTEPS
        wanted = np.clip(speeds, 0.0, vehicle.rotor_speed_max)
        follow = 1.0 - np.exp(-step_s / vehicle.motor_time_constant_s)
        before = self._velocity
        x, y = vehicle.rotor_xy_m.T
        spin = vehicle.rotor_spin * vehicle.torque_coefficient
        inertia = vehicle.inertia_kgm2
        gravity = np.array([0.0, 0.0, GRAVITY_MPS2])
        for _ in range(_SUBSTEPS):
            self._speeds = self._speeds + follow * (wanted - self._speeds)
            squared = self._speeds**2
            lift = vehicle.thrust_coefficient * squared
            torque = np.array([y @ lift, -x @ lift, spin @ squared])
            turn = cross(self._rates, inertia * self._rates)
            self._rates = self._rates + step_s * (torque - turn) / inertia
            drag = self.rotation.T @ self._velocity
            force = np.array([0.0, 0.0, lift.sum()]) - vehicle.linear_drag * drag * [1, 1, 0]
            self._velocity = self._velocity + step_s * (
                self.rotation @ force / vehicle.mass_kg - gravity
            )
            self.position = self.position + step_s * self._velocity
            self.rotation = self.rotation @ so3_exp(self._rates * step_s)
        self._acceleration = (self._velocity - before) / self._step_s
        self._steps += 1

    def estimate(self, tick_hz: int) -> Estimate:
        """The true state as an estimate."""
        time_s = self._steps * self._step_s
        return Estimate(
            tick=round(time_s * tick_hz),
            time_s=time_s,
            odom_from_body=Pose(self.rotation.copy(), self.position.copy()),
            world_from_odom=Pose.identity(),
            velocity_odom=self._velocity.copy(),
            angular_velocity_body=self._rates.copy(),
            acceleration_odom=self._acceleration.copy(),
            position_covariance=1e-4 * np.eye(3),
            rotation_covariance=1e-6 * np.eye(3),
        )
