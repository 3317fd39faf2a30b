"""A barometer: static pressure in the standard atmosphere, with drift."""

from __future__ import annotations

import numpy as np

from touchdown.sim.api import BarometerParams, BarometerSample
from touchdown.sim.noise import GaussMarkov, random_stream

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

    def __init__(self, params: BarometerParams, tick_hz: int, seed: int) -> None:
        self._tick_hz = tick_hz
        self._site_m = params.site_elevation_m
        self._white_pa = params.white_sigma_pa
        self._rng = random_stream(seed, "barometer")
        self._offset_pa = params.offset_sigma_pa * self._rng.standard_normal()
        period_s = params.period_ticks / tick_hz
        drift = np.array([params.drift_sigma_pa])
        self._drift = GaussMarkov(drift, params.drift_tau_s, period_s, self._rng)

    def sample(self, tick: int, height_world_m: float) -> BarometerSample:
        """The reading at a true height above world z = 0."""
        error = self._offset_pa + float(self._drift.step()[0])
        error += self._white_pa * self._rng.standard_normal()
        pressure = pressure_at(self._site_m + height_world_m) + error
        return BarometerSample(
            tick=tick,
            time_s=tick / self._tick_hz,
            pressure_pa=pressure,
            altitude_m=height_at(pressure) - self._site_m,
        )
