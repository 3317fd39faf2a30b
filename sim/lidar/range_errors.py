"""Errors of a LIDAR's ranges beyond white noise of one size: bias, and noise that follows the echo.

Noise: the timing of an echo jitters with the square root of its power over that of the noise, so
that the variance of the range falls with the received power, down to a floor (intensity-based
models of laser scanners: Wujanz et al., Sensors 18, 2187, 2018; incidence: Soudarissanane et al.,
ISPRS Laser Scanning 2009). The power of an echo of the strength s (reflectivity times cosine) at
the range r is s / r^2; ``range_sigma_m`` is stated at 20 m on 80 %.

Bias: data sheets bound the systematic error at a few centimetres (Livox HAP: 3 cm at 20 m). It has
three parts. What calibration leaves over is constant for a flight. Time walk: a weak echo crosses
a threshold later than a strong one; receivers correct it by the echo's size, which leaves a residue
of either sign. Incidence: a beam that meets a surface at a slant is smeared out in range, and its
near edge crosses the threshold first, so that ranges come out short.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from zlib import crc32

import numpy as np
from numba import njit

from touchdown.sim.api import LidarParams
from touchdown.sim.lidar.patterns.livox import ScanPattern
from touchdown.sim.typing import Bytes, Float32

REFERENCE_M, REFERENCE_STRENGTH = 20.0, 0.8
"""Range and reflectivity that the data sheet's range noise is stated at"""
WALK_DECADES = 1.5
"""Decades of echo power below the reference over which time walk grows to its bound"""
SMEAR_M = 0.05
"""Depth of a smeared echo at which half of the incidence's share is reached"""
SHARES = (0.3, 0.4, 0.3)
"""Of the bound: the constant, time walk, incidence"""

_INTENSITY_PER_STRENGTH = 150.0
_LEAST_COSINE = 0.05


@dataclass(frozen=True, slots=True)
class RangeErrors:
    """Range errors of one flight, metres but for ``growth``."""

    constant_m: float
    walk_m: float
    """of an echo ``WALK_DECADES`` weaker than the reference; of either sign"""
    incidence_m: float
    """least value of the incidence's part, not above 0"""
    sigma_m: float
    growth: float
    """share of the noise's variance, at the reference, that falls with the power of the echo"""
    half_width_rad: float
    """half the beam's width along its long axis"""
    min_range_m: float

    @staticmethod
    def of(params: LidarParams, pattern: ScanPattern, seed: int) -> RangeErrors | None:
        """The errors drawn from ``seed``; None where ``params`` ask for none."""
        if params.range_bias_m <= 0.0 and params.range_noise_growth <= 0.0:
            return None
        draw = np.random.default_rng([seed, crc32(b"lidar range bias")]).uniform
        bounds = params.range_bias_m * np.array(SHARES)
        return RangeErrors(
            constant_m=float(bounds[0] * draw(-1.0, 1.0)),
            walk_m=float(bounds[1] * draw(-1.0, 1.0)),
            incidence_m=float(-bounds[2] * draw(0.5, 1.0)),
            sigma_m=params.range_sigma_m,
            growth=params.range_noise_growth,
            half_width_rad=0.5 * math.radians(max(pattern.divergence_deg)),
            min_range_m=params.min_range_m,
        )

    def bias_m(self, range_m: float, strength: float, cosine: float) -> float:
        """Systematic error of an echo."""
        return float(
            _bias(range_m, strength, cosine, self.constant_m, self.walk_m, self.incidence_m,
                  self.half_width_rad)
        )  # fmt: skip

    def noise_sigma_m(self, range_m: float, strength: float) -> float:
        """Standard deviation of the range of an echo."""
        return self.sigma_m * float(_noise_factor(range_m, strength, self.growth))

    def apply(
        self, range_noise: Float32, cosine: Float32, ranges: Float32, intensity: Bytes
    ) -> None:
        """Adds the errors to ``ranges`` (N,), which have the white noise of ``sigma_m`` already:
        its normal deviates are the first N of ``range_noise``, cosines of incidence those of
        ``cosine``."""
        _disturb(
            range_noise,
            cosine,
            self.constant_m,
            self.walk_m,
            self.incidence_m,
            self.half_width_rad,
            self.sigma_m,
            self.growth,
            self.min_range_m,
            ranges,
            intensity,
        )


@njit(cache=True, forceinline=True)
def _weakness(distance: float, strength: float) -> float:
    """Power of the reference's echo over that of this one."""
    reach = distance / REFERENCE_M
    return reach * reach * REFERENCE_STRENGTH / strength


@njit(cache=True, forceinline=True)
def _noise_factor(distance: float, strength: float, growth: float) -> float:
    return math.sqrt(1.0 + growth * (_weakness(distance, strength) - 1.0))


@njit(cache=True, forceinline=True)
def _bias(
    distance: float,
    strength: float,
    cosine: float,
    constant: float,
    walk: float,
    incidence: float,
    half_width: float,
) -> float:
    late = math.log10(_weakness(distance, strength)) / WALK_DECADES
    c = max(abs(cosine), _LEAST_COSINE)
    smear = half_width * distance * math.sqrt(1.0 - min(c * c, 1.0)) / c
    total = constant + walk * min(max(late, -1.0), 1.0)
    return total + incidence * smear / (smear + SMEAR_M)


@njit(cache=True, nogil=True)
def _disturb(
    range_noise: Float32,
    cosine: Float32,
    constant: float,
    walk: float,
    incidence: float,
    half_width: float,
    sigma: float,
    growth: float,
    min_range: float,
    ranges: Float32,
    intensity: Bytes,
) -> None:
    for i in range(ranges.shape[0]):
        d = ranges[i]
        if d <= 0.0:
            continue
        strength = intensity[i] / _INTENSITY_PER_STRENGTH
        more = sigma * range_noise[i] * (_noise_factor(d, strength, growth) - 1.0)
        bias = _bias(d, strength, cosine[i], constant, walk, incidence, half_width)
        ranges[i] = max(d + more + bias, min_range)
