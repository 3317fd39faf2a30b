"""A magnetometer: the earth's field in the body frame, with a residual of its calibration."""

from __future__ import annotations

import math

import numpy as np

from touchdown.sim.api import MagnetometerParams, MagnetometerSample
from touchdown.sim.noise import random_stream
from touchdown.sim.typing import Array


def earth_field_world(params: MagnetometerParams) -> Array:
    """(3,) microtesla, ENU: declination turns the horizontal part from north to east, inclination
    dips it below the horizon. ValueError: not a field of the earth."""
    if not 20.0 <= params.strength_ut <= 70.0 or abs(params.inclination_deg) > 90.0:
        raise ValueError(
            f"a field of {params.strength_ut:g} microtesla dipping by {params.inclination_deg:g} "
            "degrees is nowhere on earth: magnetometer.strength_ut is 20 to 70, "
            "magnetometer.inclination_deg -90 to 90"
        )
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

    def __init__(self, params: MagnetometerParams, tick_hz: int, seed: int) -> None:
        self._tick_hz = tick_hz
        self._field = earth_field_world(params)
        self._sigma_ut = params.noise_sigma_ut
        self._rng = random_stream(seed, "magnetometer")
        self._hard_iron = params.hard_iron_sigma_ut * self._rng.standard_normal(3)

    @property
    def hard_iron_ut(self) -> Array:
        """(3,) true offset, body frame; a copy, for tests and records."""
        return self._hard_iron.copy()

    def sample(self, tick: int, rotation: Array) -> MagnetometerSample:
        """The reading under a true world_from_body rotation (3, 3)."""
        field = rotation.T @ self._field + self._hard_iron
        field = field + self._sigma_ut * self._rng.standard_normal(3)
        field.setflags(write=False)
        return MagnetometerSample(tick=tick, time_s=tick / self._tick_hz, field_body_ut=field)
