"""Scan patterns (direction of pulse number k) and data-sheet figures of Livox LIDARs.

Parameters of the patterns were fitted to recordings of the real sensors; ranges, fields of view,
rates and beam widths are those of the manufacturer's data sheets and user manuals.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

from touchdown.sim.api import LidarPreset
from touchdown.sim.lidar.patterns import mid360
from touchdown.sim.lidar.patterns.risley import Prism, RisleyPattern
from touchdown.sim.typing import Float32


@dataclass(frozen=True, kw_only=True, slots=True)
class ScanPattern:
    """``directions(start_index, count)`` gives (count, 3) float32 unit vectors in the LIDAR frame
    (x long axis, z boresight) of the pulses ``start_index ... start_index + count - 1``; pulse k
    fires at ``k / point_rate_hz`` seconds."""

    directions: Callable[[int, int], Float32]
    point_rate_hz: int
    field_of_view_deg: tuple[float, float]
    """along x and along y; for a sensor that looks all round: azimuth and elevation"""
    range_limits_m: tuple[float, ...]
    """detection range at each of ``range_reflectivities``, full sunlight"""
    range_reflectivities: tuple[float, ...]
    max_range_m: float
    divergence_deg: tuple[float, float]
    """full width at half maximum of the beam along x and y"""


_FAST_HZ = 121.567
_FAST_PHASE = 4.78534

HORIZON = ScanPattern(
    directions=RisleyPattern(
        (
            Prism(frequency_hz=-_FAST_HZ / 12.2361, phase_rad=4.55226, wedge_rad=0.32929),
            Prism(frequency_hz=_FAST_HZ, phase_rad=_FAST_PHASE + 1.56112, wedge_rad=0.41937),
            Prism(
                frequency_hz=-_FAST_HZ,
                phase_rad=-_FAST_PHASE + 1.56112,
                wedge_rad=0.41991,
                flat_face_first=False,
            ),
        ),
        lasers=6,
        spread_rad=0.03661,
        point_rate_hz=240_000,
    ),
    point_rate_hz=240_000,
    field_of_view_deg=(81.7, 25.1),
    range_limits_m=(90.0, 130.0, 260.0),
    range_reflectivities=(0.1, 0.2, 0.8),
    max_range_m=260.0,
    divergence_deg=(0.03, 0.28),
)
"""Six lasers through a slow prism and a pair that turns against one another."""

AVIA = ScanPattern(
    directions=RisleyPattern(
        (
            Prism(
                frequency_hz=131.55003, phase_rad=3.13259, wedge_rad=0.28685, flat_face_first=False
            ),
            Prism(frequency_hz=-40.79991, phase_rad=0.00125, wedge_rad=0.28803),
        ),
        lasers=6,
        spread_rad=-0.03931,
        point_rate_hz=240_000,
        refractive_index=1.89951,
    ),
    point_rate_hz=240_000,
    field_of_view_deg=(70.4, 77.2),
    range_limits_m=(190.0, 230.0, 320.0),
    range_reflectivities=(0.1, 0.2, 0.8),
    max_range_m=320.0,
    divergence_deg=(0.03, 0.28),
)
"""Six lasers through two prisms that turn at different rates: a rosette that never closes.
Stays within 0.13 degrees (root mean square) of four seconds of recordings."""

MID360 = ScanPattern(
    directions=mid360.directions,
    point_rate_hz=mid360.POINT_RATE_HZ,
    field_of_view_deg=(360.0, 59.0),
    range_limits_m=(40.0, 70.0),
    range_reflectivities=(0.1, 0.8),
    max_range_m=70.0,
    divergence_deg=(0.28, 0.28),
)
"""Mounted like the others it looks down and around: its z axis points down, and within 38 degrees
of nadir it sees nothing. The manufacturer states no beam width: that of its others is
taken."""

PATTERNS: Mapping[LidarPreset, ScanPattern] = MappingProxyType(
    {"avia": AVIA, "horizon": HORIZON, "mid360": MID360}
)
"""Scan patterns by preset name."""
