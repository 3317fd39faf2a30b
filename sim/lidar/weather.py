"""Effects of fog and rain on a LIDAR: weaker echoes of targets, and echoes of the air itself.

An echo of the strength s (reflectivity times cosine) at the range d arrives with s exp(-2 e d), e
the extinction of `sim.faults.disturbances.Air`, and is found or not by the same link budget as in
clear air. The air itself answers:

- fog is a soft target. Backscatter is e / S with the lidar ratio S = 18.8 sr of water droplets at
  905 nm (O'Connor, Illingworth and Hogan, J. Atmos. Oceanic Technol. 21, 2004). What lies within
  one pulse length L acts as a matt target of reflectivity pi L e / S exp(-2 e r). It fluctuates
  like the sum of 25 speckles, a gamma distribution (Goodman, "Statistical Optics", 1985);
- rain is single drops, N(D) = 8000 exp(-4.1 R^-0.21 D) per m^3 and mm (Marshall and Palmer, J.
  Meteor. 5, 1948). A drop in the beam of cross-section A acts as a matt target of reflectivity
  pi / S * 2 (pi D^2 / 4) / A exp(-2 e r).

An echo of the air counts from the strength that the link budget asks for at its range, or 1 %
where that is less: near by, where everything is strong, receivers turn their gain down. The chance
per metre of such an echo makes a Poisson process along the beam; its nearest event is reported.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from touchdown.sim.api import LidarParams
from touchdown.sim.faults.disturbances import Air, Weather, fog_extinction
from touchdown.sim.lidar import returns
from touchdown.sim.lidar.patterns import ScanPattern
from touchdown.sim.typing import Array, Bytes, Float32, Uint32

LIDAR_NM = 905.0
LIDAR_RATIO_SR = 18.8
DUST_RATIO_SR = 60.0
"""of mineral dust: 50 at 532 nm and 63 at 1064 nm (Haarig et al., Atmos. Chem. Phys. 22, 2022)"""
MIN_STRENGTH = 0.01
"""Least strength of an echo of the air that is reported at short range"""

_SPECKLES = 25.0
_DROPS_PER_M3_MM = 8000.0
_APERTURE_M = 0.01
"""width of a beam where it leaves the LIDAR; it widens by the divergence"""
_EXIT_M2 = 0.25 * math.pi * _APERTURE_M**2
_FOG_SPREAD = 0.05
_REACH_M, _STEP_M = 60.0, 0.05


@dataclass(frozen=True)
class Beam:
    """``divergence_rad``: full widths at half maximum along x and y."""

    budget: returns.LinkBudget
    divergence_rad: tuple[float, float]
    pulse_length_m: float
    min_range_m: float
    strongest: bool


@dataclass(frozen=True)
class Clutter:
    """False returns of one kind of air."""

    air: Air
    beam: Beam

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of what weakens and scatters."""
        return self.air.faults

    @cached_property
    def extinction(self) -> float:
        """1/m at the LIDAR's wavelength."""
        return self.air.extinction(LIDAR_NM)

    @cached_property
    def expected(self) -> Array:
        """(K,) expected number of echoes between the LIDAR and each of the grid's ranges."""
        per_metre = self.fog_per_metre() + self.rain_per_metre()
        return np.concatenate([[0.0], np.cumsum(per_metre[1:] * _STEP_M)])

    @cached_property
    def threshold(self) -> Array:
        """(K,) least strength of an echo of the air that is reported."""
        return np.maximum(self.beam.budget.strength_needed(grid_m()), MIN_STRENGTH)

    def fog_per_metre(self) -> Array:
        """(K,) rate per metre of fog echoes that are reported as a target."""
        if self.air.visibility_m is None:
            return np.zeros(len(grid_m()))
        return self._soft_per_metre(fog_extinction(self.air.visibility_m, LIDAR_NM), LIDAR_RATIO_SR)

    def _soft_per_metre(self, extinction: float, lidar_ratio_sr: float) -> Array:
        from scipy.special import gammaincc  # takes a while to load

        length = self.beam.pulse_length_m
        strength = math.pi * length * extinction / lidar_ratio_sr * self._both_ways()
        fraction: Array = gammaincc(_SPECKLES, _SPECKLES * self.threshold / strength)
        return fraction / length

    def rain_per_metre(self) -> Array:
        """(K,) drops per metre of beam that are large enough to be reported as a target."""
        rate = self.air.rain_mmph
        if rate <= 0.0:
            return np.zeros(len(grid_m()))
        across, along = (_APERTURE_M + angle * grid_m() for angle in self.beam.divergence_rad)
        area = 0.25 * math.pi * across * along
        square_m2 = self.threshold * LIDAR_RATIO_SR * area / (0.5 * math.pi**2 * self._both_ways())
        return area * drops_larger(1000.0 * np.sqrt(square_m2), rate)

    @cached_property
    def spread(self) -> float:
        """Mean by which the diameters of drops that count near by exceed the least, over it; fog
        hardly differs from pulse to pulse."""
        if self.air.rain_mmph <= 0.0:
            return _FOG_SPREAD
        min_mm = 1000.0 * math.sqrt(2.0 * MIN_STRENGTH * LIDAR_RATIO_SR / math.pi**2 * _EXIT_M2)
        return 1.0 / (marshall_palmer_slope(self.air.rain_mmph) * min_mm)

    def weaken(
        self, distance: Float32, bits: Uint32, strengths: Float32, ranges: Float32, intensity: Bytes
    ) -> None:
        """Attenuates echoes in place, see `sim.lidar.returns.weaken`."""
        returns.weaken(
            distance, bits, self.extinction, self.beam.budget, strengths, ranges, intensity
        )

    def scatter(self, bits: Uint32, ranges: Float32, intensity: Bytes) -> None:
        """Adds echoes of the air in place, see `sim.lidar.returns.clutter`."""
        returns.clutter(
            bits, self.expected, self.threshold, self.spread, _STEP_M, self.beam.min_range_m,
            self.beam.strongest, ranges, intensity,
        )  # fmt: skip

    def _both_ways(self) -> Array:
        return np.exp(-2.0 * self.extinction * grid_m())


@dataclass(frozen=True)
class DustClutter(Clutter):
    """False returns of a cloud of dust, which ends ``depth_m`` below the LIDAR. Like fog it is a
    soft target, of the lidar ratio of mineral dust."""

    dust_extinction: float = 0.0
    depth_m: float = 0.0

    @property
    def effects(self) -> tuple[str, ...]:
        return ("dust",)

    @cached_property
    def extinction(self) -> float:
        return self.dust_extinction

    def fog_per_metre(self) -> Array:
        inside = grid_m() <= self.depth_m
        return self._soft_per_metre(self.extinction, DUST_RATIO_SR) * inside


class LidarWeather:
    """The clutter of every tick, for one LIDAR."""

    def __init__(
        self,
        weather: Weather | None,
        pattern: ScanPattern,
        params: LidarParams,
        budget: returns.LinkBudget,
    ) -> None:
        width_x, width_y = np.deg2rad(pattern.divergence_deg).tolist()
        self._weather = weather
        self._beam = Beam(
            budget=budget,
            divergence_rad=(width_x, width_y),
            pulse_length_m=params.pulse_length_m,
            min_range_m=params.min_range_m,
            strongest=params.return_mode == "strongest",
        )
        self._known: dict[Air, Clutter] = {}

    def dust(self, extinction: float, depth_m: float) -> DustClutter:
        """Clutter of a cloud of dust of this extinction in 1/m."""
        return DustClutter(Air(), self._beam, extinction, depth_m)

    def at(self, tick: int) -> Clutter | None:
        """Clutter at ``tick``; None where the air is clear."""
        air = None if self._weather is None else self._weather.at(tick)
        if air is None:
            return None
        return self._known.setdefault(air, Clutter(air, self._beam))


def drops_larger(diameter_mm: Array, rate_mmph: float) -> Array:
    """Drops per cubic metre above a diameter, by Marshall and Palmer."""
    slope = marshall_palmer_slope(rate_mmph)
    return _DROPS_PER_M3_MM / slope * np.exp(-slope * diameter_mm)


def marshall_palmer_slope(rate_mmph: float) -> float:
    """1/mm, by which the numbers of drops fall with their diameter."""
    return float(4.1 * rate_mmph**-0.21)


def grid_m() -> Array:
    """(K,) ranges at which the chances are tabulated, metres, from 0."""
    return np.arange(0.0, _REACH_M + 0.5 * _STEP_M, _STEP_M)
