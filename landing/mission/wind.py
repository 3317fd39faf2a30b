"""The wind as the vehicle feels it: no sensor for it, only attitude, thrust and motion."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.api import Estimate
from touchdown.sim.api import GRAVITY_MPS2, Observation, VehicleModel

Array = NDArray[np.float64]

_TIME_CONSTANT_S = 3.0


class WindEstimator:
    """Mean horizontal wind, odom frame: what is left of Newton's law when thrust (rotor telemetry)
    and gravity are taken away is the rotors' drag, linear in the air-relative velocity."""

    def __init__(self, vehicle: VehicleModel) -> None:
        self._vehicle = vehicle
        self._wind: Array = np.zeros(2)
        self._last_s: float | None = None

    @property
    def speed_mps(self) -> float:
        return float(np.hypot(*self._wind))

    @property
    def wind_odom(self) -> Array:
        """(2,) m/s, where it blows to."""
        return self._wind.copy()

    def update(self, obs: Observation, estimate: Estimate) -> None:
        """Call once a control step in the air."""
        vehicle = self._vehicle
        if vehicle.linear_drag <= 0.0:
            return
        thrust = vehicle.thrust_coefficient * float(np.sum(obs.rotor_speed_radps**2))
        force = vehicle.mass_kg * estimate.acceleration_odom
        force = force - thrust * estimate.odom_from_body.rotation[:, 2]
        force[2] += vehicle.mass_kg * GRAVITY_MPS2
        wind = estimate.velocity_odom[:2] + force[:2] / vehicle.linear_drag
        step = 0.0 if self._last_s is None else obs.time_s - self._last_s
        self._last_s = obs.time_s
        if np.isfinite(wind).all():
            self._wind += min(step / _TIME_CONSTANT_S, 1.0) * (wind - self._wind)
