"""Wind estimation from attitude, thrust and motion, without an anemometer."""

import numpy as np
from numba import njit

from touchdown.estimator.api import Estimate
from touchdown.landing.mission.thrust_need import (
    BODY_DRAG,
    MASS,
    ROTOR_DRAG,
    THRUST,
    air_coefficients,
)
from touchdown.sim.api import GRAVITY_MPS2, Observation, VehicleModel
from touchdown.sim.typing import Array

_TIME_CONSTANT_S = 3.0
_FELT_TIME_CONSTANT_S = 0.7
ROUGHNESS_M = 0.1


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


class FeltWind:
    """The horizontal wind of the last second or so, odom frame, for `time_scaling`.

    In the rotors' plane thrust has no component: the felt force there is the drag of rotors and
    fuselage at the velocity through the air. Taken as horizontal, the wind follows from the two
    components; the drag of the rotors is that at their measured speed."""

    def __init__(self, vehicle: VehicleModel) -> None:
        self._coefficients = air_coefficients(vehicle)
        self._weight = vehicle.mass_kg * GRAVITY_MPS2
        self._wind: Array = np.zeros(3)
        self._last_s: float | None = None

    @property
    def wind_odom(self) -> Array:
        """(3,) m/s, direction that the wind blows to; z is 0."""
        return self._wind.copy()

    def update(self, obs: Observation, estimate: Estimate) -> None:
        """Updates the estimate; called once a control step in the air. Keeps it while the rotors
        carry less than half of the weight, as on the ground."""
        step = 0.0 if self._last_s is None else obs.time_s - self._last_s
        self._last_s = obs.time_s
        thrust = self._coefficients[THRUST] * float(np.sum(obs.rotor_speed_radps**2))
        if self._coefficients[ROTOR_DRAG] <= 0.0 or thrust < 0.5 * self._weight:
            return
        wind = _felt_wind(
            estimate.odom_from_body.rotation,
            estimate.velocity_odom,
            estimate.acceleration_odom,
            float(np.sum(obs.rotor_speed_radps)),
            self._wind,
            self._coefficients,
        )
        if np.isfinite(wind).all():
            self._wind += min(step / _FELT_TIME_CONSTANT_S, 1.0) * (wind - self._wind)


class WindProfile:
    """Takes the wind that a climb has felt to another height, by the logarithmic profile of open
    country."""

    def __init__(self) -> None:
        self._sum: Array = np.zeros(3)
        self._samples = 0

    def update(self, felt_odom: Array, height_m: float) -> None:
        """Adds the felt wind (3,) at a height above the ground."""
        self._sum += felt_odom / np.log(height_m / ROUGHNESS_M)
        self._samples += 1

    def at(self, height_m: float) -> Array:
        """(3,) m/s, the mean wind at another height; needs one sample at least."""
        return self._sum / self._samples * np.log(height_m / ROUGHNESS_M)


@njit(cache=True, error_model="numpy")
def _felt_wind(
    rotation: Array,
    velocity: Array,
    acceleration: Array,
    speed_sum: float,
    last: Array,
    coefficients: Array,
) -> Array:
    """(3,) m/s, z = 0, from one sample; ``last`` linearises the drag of the fuselage."""
    mass = coefficients[MASS]
    relative = velocity - last
    airspeed = np.sqrt(np.sum(relative * relative))
    drag = coefficients[ROTOR_DRAG] * speed_sum + coefficients[BODY_DRAG] * airspeed
    fx, fy = mass * acceleration[0], mass * acceleration[1]
    fz = mass * (acceleration[2] + GRAVITY_MPS2)
    wind = np.zeros(3)
    # Rows of the rotation's transpose: through the air, along the body's x and y.
    along = np.empty(2)
    for i in range(2):
        force = rotation[0, i] * fx + rotation[1, i] * fy + rotation[2, i] * fz
        along[i] = -force / drag - rotation[2, i] * velocity[2]
    a, b, c, d = rotation[0, 0], rotation[1, 0], rotation[0, 1], rotation[1, 1]
    determinant = a * d - b * c
    if abs(determinant) < 0.2:  # lies on its side
        return last
    wind[0] = velocity[0] - (d * along[0] - b * along[1]) / determinant
    wind[1] = velocity[1] - (a * along[1] - c * along[0]) / determinant
    return wind
