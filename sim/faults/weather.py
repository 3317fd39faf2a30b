"""Fog and rain: how the air weakens light.

Extinction (Beer and Lambert): light is weakened by exp(-e d) over the distance d.

- fog: e = 3.912 / V with the visibility V (Koschmieder, 1924: contrast falls to 2 % there), times
  (wavelength / 550 nm)^-q; q is 0 below V = 500 m, where droplets are larger than any wavelength
  used (Kim, McArthur and Korevaar, "Comparison of laser beam propagation at 785 nm and 1550 nm in
  fog and haze", Proc. SPIE 4214, 2001);
- rain: 1.076 R^0.67 dB/km at R mm/h (Carbonneau; Recommendation ITU-R P.1814).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from touchdown.sim.api import FaultParams
from touchdown.sim.faults.disturbances import Happening

KOSCHMIEDER = 3.912
REFERENCE_NM = 550.0


def fog_extinction(visibility_m: float, wavelength_nm: float = REFERENCE_NM) -> float:
    """1/m at a meteorological optical range in metres, by Koschmieder and Kim."""
    km = visibility_m / 1000.0
    if km < 0.5:
        q = 0.0
    elif km < 1.0:
        q = km - 0.5
    elif km < 6.0:
        q = 0.16 * km + 0.34
    else:
        q = 1.3 if km < 50.0 else 1.6
    return KOSCHMIEDER / visibility_m * (wavelength_nm / REFERENCE_NM) ** -q


def rain_extinction(rate_mmph: float) -> float:
    """1/m at a rain rate in mm/h, for all wavelengths of light."""
    decibel_per_km = 1.076 * rate_mmph**0.67
    return decibel_per_km / (10.0 * math.log10(math.e) * 1000.0)


@dataclass(frozen=True)
class Air:
    """Fog and rain at an instant; ``visibility_m`` None: no fog."""

    visibility_m: float | None = None
    rain_mmph: float = 0.0

    @property
    def faults(self) -> tuple[str, ...]:
        """Kinds of faults that it consists of."""
        kinds = ("fog", self.visibility_m is not None), ("rain", self.rain_mmph > 0.0)
        return tuple(kind for kind, there in kinds if there)

    def extinction(self, wavelength_nm: float = REFERENCE_NM) -> float:
        """1/m, fog and rain together."""
        fog = 0.0
        if self.visibility_m is not None:
            fog = fog_extinction(self.visibility_m, wavelength_nm)
        return fog + rain_extinction(self.rain_mmph)


class Weather:
    """The air at every tick; ``at`` gives None for clear air."""

    def __init__(self, params: FaultParams, tick_hz: int) -> None:
        self._params = params
        self._fog = Happening(params, "fog", tick_hz)
        self._rain = Happening(params, "rain", tick_hz)

    @property
    def ever(self) -> bool:
        """True if the schedule contains fog or rain."""
        return bool(self._fog.faults or self._rain.faults)

    def at(self, tick: int) -> Air | None:
        foggy = self._fog.since(tick) is not None
        wet = self._rain.since(tick) is not None and self._params.rain_mmph > 0.0
        if not foggy and not wet:
            return None
        return Air(
            visibility_m=self._params.fog_visibility_m if foggy else None,
            rain_mmph=self._params.rain_mmph if wet else 0.0,
        )
