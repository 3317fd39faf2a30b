"""Satellite receiver, barometer and magnetometer: readings of the truth with their errors."""

import dataclasses
import math
from collections.abc import Mapping

import numpy as np

from touchdown.sim import api
from touchdown.sim.frames import cross
from touchdown.sim.noise import GaussMarkov, random_stream
from touchdown.sim.typing import Array

_CEP_TO_SIGMA = 1.0 / 1.1774
"""Circular error probable (50 %) to the standard deviation of one horizontal axis."""
_R50_TO_SIGMA = 1.0 / 0.6745
"""Median absolute error to the standard deviation of one axis."""


@dataclasses.dataclass(frozen=True, kw_only=True, slots=True)
class GpsModel:
    """Numbers of a receiver. Standard deviations: of the wandering position error per axis, of the
    white position noise on top, of the white velocity noise."""

    sigma_xy_m: float
    sigma_z_m: float
    white_m: float
    velocity_sigma_mps: float
    tau_s: float = 60.0
    receives: bool = True


PRESETS: Mapping[api.GpsPreset, GpsModel] = {
    # The mean 3-D error of a flight is 1.01 m, the GPS row of Table 2 of Zou, Sun, Kong (2024).
    "zou2024": GpsModel(
        sigma_xy_m=0.536, sigma_z_m=1.5 * 0.536, white_m=0.0, velocity_sigma_mps=0.05
    ),
    # u-blox NEO-M8 data sheet: horizontal accuracy 2.5 m CEP, velocity accuracy 0.05 m/s.
    "ublox-m8": GpsModel(
        sigma_xy_m=2.5 * _CEP_TO_SIGMA,
        sigma_z_m=1.5 * 2.5 * _CEP_TO_SIGMA,
        white_m=0.02,
        velocity_sigma_mps=0.05,
    ),
    # u-blox ZED-F9P data sheet: RTK fixed 0.01 m CEP horizontal, 0.01 m R50 vertical.
    "rtk": GpsModel(
        sigma_xy_m=0.01 * _CEP_TO_SIGMA,
        sigma_z_m=0.01 * _R50_TO_SIGMA,
        white_m=0.003,
        velocity_sigma_mps=0.05,
    ),
    "denied": GpsModel(
        sigma_xy_m=0.0, sigma_z_m=0.0, white_m=0.0, velocity_sigma_mps=0.0, receives=False
    ),
}


def gps_model(params: api.GpsParams) -> GpsModel:
    """The preset with the fields that ``params`` overrides."""
    names = ("sigma_xy_m", "sigma_z_m", "white_m", "velocity_sigma_mps", "tau_s")
    given = {n: value for n in names if (value := getattr(params, n)) is not None}
    return dataclasses.replace(PRESETS[params.preset], **given)


class GpsSensor:
    """Fixes of the antenna, not of the body origin, every ``params.period_ticks``."""

    def __init__(self, params: api.GpsParams, tick_hz: int, seed: int) -> None:
        self._model = model = gps_model(params)
        self._tick_hz = tick_hz
        self._antenna = np.array(params.antenna_body_m)
        self._rng = random_stream(seed, "gps")
        spread = np.array([model.sigma_xy_m, model.sigma_xy_m, model.sigma_z_m])
        period_s = params.period_ticks / tick_hz
        self._wander = GaussMarkov(spread, model.tau_s, period_s, self._rng)
        self._reported = np.sqrt(spread**2 + model.white_m**2)
        self._reported.setflags(write=False)

    @property
    def receives(self) -> bool:
        """False for a receiver that never has a fix."""
        return self._model.receives

    def sample(
        self, tick: int, rotation: Array, position: Array, velocity: Array, rates: Array
    ) -> api.GpsFix:
        """A fix from the true world_from_body rotation (3, 3), world position (3,) m and velocity
        (3,) m/s of the body origin and body rates (3,) rad/s."""
        lever = rotation @ self._antenna
        white = self._rng.standard_normal((2, 3))
        measured = position + lever + self._wander.step() + self._model.white_m * white[0]
        speed = velocity + rotation @ cross(rates, self._antenna)
        speed = speed + self._model.velocity_sigma_mps * white[1]
        for array in (measured, speed):
            array.setflags(write=False)
        return api.GpsFix(
            tick=tick,
            time_s=tick / self._tick_hz,
            position_world=measured,
            velocity_world=speed,
            sigma_position_m=self._reported,
            sigma_velocity_mps=self._model.velocity_sigma_mps,
        )


SEA_LEVEL_PA = 101_325.0
_LAPSE_PER_M = 0.0065 / 288.15
_EXPONENT = 9.80665 * 0.0289644 / (8.314_32 * 0.0065)
"""ISO 2533 standard atmosphere, troposphere: p = p0 (1 - L h / T0) ^ (g M / (R L))"""


def pressure_at(height_m: float) -> float:
    """Static pressure, Pa, at a height above the mean sea level of the standard atmosphere."""
    return float(SEA_LEVEL_PA * (1.0 - _LAPSE_PER_M * height_m) ** _EXPONENT)


def height_at(pressure_pa: float) -> float:
    """The inverse of `pressure_at`, m."""
    return float((1.0 - (pressure_pa / SEA_LEVEL_PA) ** (1.0 / _EXPONENT)) / _LAPSE_PER_M)


class BarometerSensor:
    """Offset (turn-on), Gauss-Markov drift and white noise, all in pressure."""

    def __init__(self, params: api.BarometerParams, tick_hz: int, seed: int) -> None:
        self._tick_hz = tick_hz
        self._site_m = params.site_elevation_m
        self._white_pa = params.white_sigma_pa
        self._rng = random_stream(seed, "barometer")
        self._offset_pa = params.offset_sigma_pa * self._rng.standard_normal()
        period_s = params.period_ticks / tick_hz
        drift = np.array([params.drift_sigma_pa])
        self._drift = GaussMarkov(drift, params.drift_tau_s, period_s, self._rng)

    def sample(self, tick: int, height_world_m: float) -> api.BarometerSample:
        """The reading at a true height above world z = 0."""
        error = self._offset_pa + float(self._drift.step()[0])
        error += self._white_pa * self._rng.standard_normal()
        pressure = pressure_at(self._site_m + height_world_m) + error
        return api.BarometerSample(
            tick=tick,
            time_s=tick / self._tick_hz,
            pressure_pa=pressure,
            altitude_m=height_at(pressure) - self._site_m,
        )


def earth_field_world(params: api.MagnetometerParams) -> Array:
    """(3,) microtesla, ENU: declination turns the horizontal part from north to east, inclination
    dips it below the horizon."""
    declination = math.radians(params.declination_deg)
    inclination = math.radians(params.inclination_deg)
    level = params.strength_ut * math.cos(inclination)
    return np.array(
        [
            level * math.sin(declination),
            level * math.cos(declination),
            -params.strength_ut * math.sin(inclination),
        ]
    )


class MagnetometerSensor:
    """Hard-iron offset, constant in the body frame for one device (seed), and white noise."""

    def __init__(self, params: api.MagnetometerParams, tick_hz: int, seed: int) -> None:
        self._tick_hz = tick_hz
        self._field = earth_field_world(params)
        self._sigma_ut = params.noise_sigma_ut
        self._rng = random_stream(seed, "magnetometer")
        self._hard_iron = params.hard_iron_sigma_ut * self._rng.standard_normal(3)

    def sample(self, tick: int, rotation: Array) -> api.MagnetometerSample:
        """The reading under a true world_from_body rotation (3, 3)."""
        field = rotation.T @ self._field + self._hard_iron
        field = field + self._sigma_ut * self._rng.standard_normal(3)
        field.setflags(write=False)
        return api.MagnetometerSample(tick=tick, time_s=tick / self._tick_hz, field_body_ut=field)
