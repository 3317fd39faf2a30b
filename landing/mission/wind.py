"""Wind estimation from attitude, thrust and motion, without an anemometer."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.api import Estimate
from touchdown.sim.api import GRAVITY_MPS2, Observation, VehicleModel

Array = NDArray[np.float64]

_TIME_CONSTANT_S = 3.0


class WindEstimator:
    """Estimates the mean horizontal wind, odom frame.

    The residual force after thrust (rotor telemetry) and gravity is the rotors' drag, which is
    linear in the air-relative velocity."""

    def __init__(self, vehicle: VehicleModel) -> None:
        self._vehicle = vehicle
        self._wind: Array = np.zeros(2)
        self._last_s: float | None = None

    @property
    def speed_mps(self) -> float:
        """Wind speed, m/s."""
        return float(np.hypot(*self._wind))

    @property
    def wind_odom(self) -> Array:
        """(2,) m/s, direction that the wind blows to."""
        return self._wind.copy()

    def update(self, obs: Observation, estimate: Estimate) -> None:
        """Updates the estimate; called once a control step in the air."""
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
