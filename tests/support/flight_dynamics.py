"""A rigid quadrotor in gusts, independent of the simulator, for tests of the controller."""

from collections.abc import Callable

import numpy as np

from touchdown.controller.api import Controller, Setpoint
from touchdown.estimator.api import Estimate
from touchdown.sim.api import GRAVITY_MPS2, VehicleModel
from touchdown.sim.frames import Pose, so3_exp
from touchdown.sim.typing import Array

PHYSICS_HZ = 600
INFLOW_DRAG = 2.5
"""N per m/s of flow along the rotor axes."""
FUSELAGE_DRAG = 0.03
"""N per (m/s)^2."""


def example_vehicle() -> VehicleModel:
    """A 4 kg X quadrotor that hovers at 495 rad/s."""
    return VehicleModel(
        mass_kg=4.0, inertia_kgm2=np.array([0.06, 0.07, 0.10]),
        rotor_xy_m=np.array([[0.2, -0.2], [-0.2, 0.2], [0.2, 0.2], [-0.2, -0.2]]),
        rotor_spin=np.array([1.0, 1.0, -1.0, -1.0]), thrust_coefficient=4.0e-5,
        torque_coefficient=6.4e-7, rotor_speed_min=80.0, rotor_speed_max=800.0,
        motor_time_constant_s=0.04, linear_drag=0.35, leg_height_m=0.25, footprint_radius_m=0.45,
    )  # fmt: skip


class Flyer:
    """Rigid body, first-order rotors, drag of rotors and fuselage; semi-implicit Euler at 600 Hz
    under a 200 Hz control. ``acceleration`` is the mean over the last control step."""

    def __init__(self, vehicle: VehicleModel, wind: Callable[[float], Array] | None = None) -> None:
        self.vehicle = vehicle
        self.wind = wind or (lambda t: np.zeros(3))
        self.step = 0
        self.rotation = np.eye(3)
        self.position = np.zeros(3)
        self.velocity = np.zeros(3)
        self.rates = np.zeros(3)
        hover = vehicle.mass_kg * GRAVITY_MPS2 / (4.0 * vehicle.thrust_coefficient)
        self.rotors = np.full(4, np.sqrt(hover))
        self.acceleration = np.zeros(3)

    @property
    def time_s(self) -> float:
        return self.step / PHYSICS_HZ

    def estimate(self) -> Estimate:
        return Estimate(
            tick=self.step, time_s=self.time_s,
            odom_from_body=Pose(self.rotation.copy(), self.position.copy()),
            world_from_odom=Pose.identity(), velocity_odom=self.velocity.copy(),
            angular_velocity_body=self.rates.copy(), acceleration_odom=self.acceleration.copy(),
            position_covariance=np.zeros((3, 3)), rotation_covariance=np.zeros((3, 3)),
        )  # fmt: skip

    def advance(self, command_radps: Array) -> None:
        """One control step of three physics steps."""
        before = self.velocity.copy()
        for _ in range(3):
            self._tick(command_radps, 1.0 / PHYSICS_HZ)
        self.acceleration = (self.velocity - before) * PHYSICS_HZ / 3

    def _tick(self, command: Array, dt: float) -> None:
        v = self.vehicle
        self.rotors = command + np.exp(-dt / v.motor_time_constant_s) * (self.rotors - command)
        thrusts = v.thrust_coefficient * self.rotors**2
        torque = np.array(
            [
                thrusts @ v.rotor_xy_m[:, 1],
                -thrusts @ v.rotor_xy_m[:, 0],
                v.torque_coefficient * (v.rotor_spin @ self.rotors**2),
            ]
        )
        air = self.rotation.T @ (self.velocity - self.wind(self.time_s))
        drag = np.array([v.linear_drag, v.linear_drag, INFLOW_DRAG]) * air
        drag += FUSELAGE_DRAG * np.linalg.norm(air) * air
        force = self.rotation @ (np.array([0.0, 0.0, thrusts.sum()]) - drag)
        spin = v.inertia_kgm2 * self.rates
        self.rates = self.rates + dt * (torque - np.cross(self.rates, spin)) / v.inertia_kgm2
        self.rotation = self.rotation @ so3_exp(dt * self.rates)
        self.velocity = self.velocity + dt * (force / v.mass_kg - [0.0, 0.0, GRAVITY_MPS2])
        self.position = self.position + dt * self.velocity
        self.step += 1


def gusts(seed: int, mean_mps: float = 3.33, sigma_mps: float = 0.6) -> Callable[[float], Array]:
    """Mean wind and a sum of sines with a spectrum falling as 1 / f^2 above 0.05 Hz."""
    rng = np.random.default_rng(seed)
    frequencies = np.geomspace(0.02, 3.0, 40)
    power = np.gradient(frequencies) / (1.0 + (frequencies / 0.05) ** 2)
    amplitudes = sigma_mps * np.sqrt(2.0 * power / power.sum())
    phases = rng.uniform(0.0, 2.0 * np.pi, (3, frequencies.size))
    heading = rng.uniform(0.0, 2.0 * np.pi)
    mean = mean_mps * np.array([np.cos(heading), np.sin(heading), 0.0])

    def wind(t: float) -> Array:
        return mean + (amplitudes * np.sin(2.0 * np.pi * frequencies * t + phases)).sum(axis=1)

    return wind


def fly(
    flyer: Flyer, controller: Controller, reference: Callable[[float], Setpoint], duration_s: float
) -> Array:
    """(steps, 3) position minus reference, in metres, once every control step."""
    errors = []
    for _ in range(round(duration_s * PHYSICS_HZ / 3)):
        setpoint = reference(flyer.time_s)
        errors.append(flyer.position - setpoint.position_odom)
        flyer.advance(controller.update(flyer.estimate(), setpoint).rotor_speed_radps)
    return np.array(errors)
