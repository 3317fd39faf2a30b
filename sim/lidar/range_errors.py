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

import math
from dataclasses import dataclass
from typing import Any
from zlib import crc32

import numpy as np
from numba import njit
from numpy.typing import NDArray

from touchdown.sim.api import LidarParams
from touchdown.sim.lidar.patterns import ScanPattern
from touchdown.sim.typing import Bytes, Float32

Reals = NDArray[Any]
"""Floating-point numbers of any width"""

REFERENCE_M, REFERENCE_STRENGTH = 20.0, 0.8
"""Range and reflectivity that the data sheet's range noise is stated at"""
WALK_DECADES = 1.5
"""Decades of echo power below the reference over which time walk grows to its bound"""
SMEAR_M = 0.05
"""Depth of a smeared echo at which half of the incidence's share is reached"""
FRACTIONS = (0.3, 0.4, 0.3)
"""Of the bound: the constant, time walk, incidence"""

_STRENGTH_OF_LEVEL: Float32 = (np.maximum(np.arange(256), 1) / 150.0).astype(np.float32)
_MIN_COSINE = 0.05


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
    """fraction of the noise's variance, at the reference, that falls with the power of the echo"""
    half_width_rad: float
    """half the beam's width along its long axis"""
    min_range_m: float

    @staticmethod
    def of(params: LidarParams, pattern: ScanPattern, seed: int) -> "RangeErrors | None":
        """The errors drawn from ``seed``; None where ``params`` ask for none."""
        if params.range_bias_m <= 0.0 and params.range_noise_growth <= 0.0:
            return None
        draw = np.random.default_rng([seed, crc32(b"lidar range bias")]).uniform
        bounds = params.range_bias_m * np.array(FRACTIONS)
        return RangeErrors(
            constant_m=float(bounds[0] * draw(-1.0, 1.0)),
            walk_m=float(bounds[1] * draw(-1.0, 1.0)),
            incidence_m=float(-bounds[2] * draw(0.5, 1.0)),
            sigma_m=params.range_sigma_m,
            growth=params.range_noise_growth,
            half_width_rad=0.5 * math.radians(max(pattern.divergence_deg)),
            min_range_m=params.min_range_m,
        )

    def bias_m(self, range_m: Reals, strength: Reals, cosine: Reals) -> Reals:
        """Systematic errors (N,) of echoes."""
        return self._errors(range_m, strength, cosine)[0]

    def noise_sigma_m(self, range_m: Reals, strength: Reals) -> Reals:
        """Standard deviations (N,) of the ranges of echoes."""
        return self._errors(range_m, strength, np.ones(1))[1]

    def apply(
        self, range_noise: Float32, cosine: Float32, ranges: Float32, intensity: Bytes
    ) -> tuple[int, float]:
        """Adds the errors to ``ranges`` (N,), which have the white noise of ``sigma_m`` already:
        its normal deviates are the first N of ``range_noise``, cosines of incidence those of
        ``cosine``. Returns the number of ranges that change, and the sum of the changes."""
        distance = np.maximum(ranges, np.float32(self.min_range_m))
        strength = np.take(_STRENGTH_OF_LEVEL, intensity)
        bias, sigma = self._errors(distance, strength, cosine[: len(ranges)])
        return _add(range_noise, bias, sigma, self.sigma_m, self.min_range_m, ranges)

    def _errors(self, range_m: Reals, strength: Reals, cosine: Reals) -> tuple[Reals, Reals]:
        distance, strength, cosine = np.broadcast_arrays(*np.atleast_1d(range_m, strength, cosine))
        reach = distance * (1.0 / REFERENCE_M)
        weakness = reach * reach * (REFERENCE_STRENGTH / strength)
        bias, sigma = np.log10(weakness), np.empty_like(weakness)
        _fill(
            distance, weakness, cosine, self.constant_m, self.walk_m, self.incidence_m,
            self.half_width_rad, self.sigma_m, self.growth, bias, sigma,
        )  # fmt: skip
        return bias, sigma


@njit(cache=True, nogil=True, error_model="numpy")
def _fill(
    distance: Reals,
    weakness: Reals,
    cosine: Reals,
    constant: float,
    walk: float,
    incidence: float,
    half_width: float,
    sigma_m: float,
    growth: float,
    bias: Reals,
    sigma: Reals,
) -> None:
    """Fills ``bias`` (N,), which holds the decades of ``weakness`` (N,), the power of the
    reference's echo over that of these, and the noise's ``sigma`` (N,)."""
    for n in range(distance.shape[0]):
        c = max(abs(cosine[n]), _MIN_COSINE)
        smear = half_width * distance[n] * np.sqrt(max(1.0 / (c * c) - 1.0, 0.0))
        late = min(max(bias[n] * (1.0 / WALK_DECADES), -1.0), 1.0)
        bias[n] = constant + walk * late + incidence * (smear / (smear + SMEAR_M))
        sigma[n] = sigma_m * np.sqrt(1.0 + growth * (weakness[n] - 1.0))


@njit(cache=True, nogil=True, error_model="numpy")
def _add(
    noise: Float32, bias: Float32, sigma: Float32, usual: float, min_range: float, ranges: Float32
) -> tuple[int, float]:
    """As `RangeErrors.apply`, where ``usual`` is the standard deviation of the white noise."""
    changed, total = 0, 0.0
    for n in range(ranges.shape[0]):
        before = ranges[n]
        if before > 0.0:
            ranges[n] = max(before + noise[n] * (sigma[n] - usual) + bias[n], min_range)
            changed += ranges[n] != before
            total += abs(ranges[n] - before)
    return changed, total
