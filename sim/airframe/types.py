"""Parameters of the true vehicle's deviations from its model; part of `sim.api`."""

from __future__ import annotations

from dataclasses import dataclass

from touchdown.sim.ranges import FORBID_EXTRA, Fraction, NotNegative


@dataclass(frozen=True, kw_only=True, slots=True)
class VehicleErrorParams:
    """Bounds of the true vehicle's deviations from the model that controller and estimators know;
    each is drawn once a flight, uniformly between minus and plus the bound. Errors of the
    telemetry."""

    __pydantic_config__ = FORBID_EXTRA

    mass_share: Fraction = 0.0
    """of the mass, and of the moments of inertia with it; relative"""
    center_of_mass_m: NotNegative = 0.0
    """of each coordinate of the centre of mass"""
    thrust_share: Fraction = 0.0
    """of the thrust coefficient of all rotors; relative"""
    torque_share: Fraction = 0.0
    """of the torque coefficient of all rotors; relative"""
    rotor_share: Fraction = 0.0
    """of thrust and torque of each rotor by itself; relative"""
    telemetry_sigma_radps: NotNegative = 0.0
    """noise of the rotor speeds that the speed controllers report, standard deviation"""
    telemetry_step_radps: NotNegative = 0.0
    """step of the reported rotor speeds; 0: continuous"""
