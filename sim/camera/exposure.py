"""Automatic exposure: exposure time and amplification that follow the light with a lag."""

from __future__ import annotations

import math
from dataclasses import dataclass

from touchdown.sim.api import CameraParams

MIDDLE_GREY = (110.0 / 255.0) ** 2.2
"""share of saturation to which the mean of an image is brought: a display level of 110"""
_DARK = 1e-12


@dataclass(frozen=True, slots=True)
class Exposure:
    """Time that each row collects light, and amplification of its signal."""

    time_s: float
    gain: float


class AutoExposure:
    """Brings the mean of images to a middle grey: the logarithm of time times gain follows what the
    light asks for as a first-order system. The first image is exposed as it should be."""

    def __init__(self, params: CameraParams) -> None:
        self._params = params
        self._level: float | None = None
        self.error_stops = 0.0
        """of the latest image: by how many factors of two it is over- or underexposed"""
        self._time_s = 0.0

    def settled(self, lux: float) -> Exposure:
        """The exposure of a scene with the mean ``lux`` (illuminance times reflectivity) once it
        has settled."""
        return self._split(self._wanted(lux))

    def follow(self, lux: float, time_s: float) -> Exposure:
        """The exposure of an image at ``time_s``; times ascend."""
        wanted, lag = self._wanted(lux), self._params.exposure_lag_s
        if self._level is None or lag <= 0.0 or time_s < self._time_s:
            self._level = wanted
        else:
            share = 1.0 - math.exp(-(time_s - self._time_s) / lag)
            self._level += share * (wanted - self._level)
        self._time_s = time_s
        self.error_stops = (self._level - wanted) / math.log(2.0)
        return self._split(self._level)

    def _wanted(self, lux: float) -> float:
        p = self._params
        needed = p.gain * MIDDLE_GREY * p.full_well_e / (p.electrons_per_lux_s * max(lux, _DARK))
        longest = max(p.exposure_max_s, p.exposure_min_s)
        return math.log(min(max(needed, p.exposure_min_s), longest * p.gain_max))

    def _split(self, level: float) -> Exposure:
        """Time first, gain only beyond the longest time: it adds no light."""
        p, product = self._params, math.exp(level)
        time_s = min(max(product, p.exposure_min_s), max(p.exposure_max_s, p.exposure_min_s))
        return Exposure(time_s, min(max(product / time_s, 1.0), p.gain_max))
