"""A satellite receiver: positions with a correlated error, at a low rate, with a delay."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from touchdown.sim.api import GpsFix, GpsParams, GpsPreset
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


PRESETS: Mapping[GpsPreset, GpsModel] = {
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


def gps_model(params: GpsParams) -> GpsModel:
    """The preset with the fields that ``params`` overrides. Raises ValueError for a negative
    standard deviation."""
    names = ("sigma_xy_m", "sigma_z_m", "white_m", "velocity_sigma_mps", "tau_s")
    given = {n: value for n in names if (value := getattr(params, n)) is not None}
    for name, value in given.items():
        if value < 0.0 or (name == "tau_s" and value == 0.0):
            raise ValueError(f"gps.{name} is {value:g}: choose it positive")
    return dataclasses.replace(PRESETS[params.preset], **given)


class GpsSensor:
    """Fixes of the antenna, not of the body origin, every ``params.period_ticks``."""

    def __init__(self, params: GpsParams, tick_hz: int, seed: int) -> None:
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
    ) -> GpsFix:
        """A fix from the true world_from_body rotation (3, 3), world position (3,) m and velocity
        (3,) m/s of the body origin and body rates (3,) rad/s."""
        lever = rotation @ self._antenna
        white = self._rng.standard_normal((2, 3))
        measured = position + lever + self._wander.step() + self._model.white_m * white[0]
        speed = velocity + rotation @ cross(rates, self._antenna)
        speed = speed + self._model.velocity_sigma_mps * white[1]
        for array in (measured, speed):
            array.setflags(write=False)
        return GpsFix(
            tick=tick,
            time_s=tick / self._tick_hz,
            position_world=measured,
            velocity_world=speed,
            sigma_position_m=self._reported,
            sigma_velocity_mps=self._model.velocity_sigma_mps,
        )
