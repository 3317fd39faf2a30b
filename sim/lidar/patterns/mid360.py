"""The scan pattern of the Livox Mid-360, which looks all round.

Recordings show a fan of four beams that turns about itself at 182.4 Hz while it runs round the
horizon at the same rate; a slower drive carries it up and down between -7 and 52 degrees ten times
a second, leading and lagging in azimuth as it goes. The two rates have no common period, so the
lines, about 40 in a tenth of a second, keep moving. The closed form below holds the leading
terms of a Fourier series fitted to such recordings, four seconds of which it follows within 0.9
degrees (root mean square).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from touchdown.sim.lidar.patterns.risley import check_pulses
from touchdown.sim.typing import Float32

POINT_RATE_HZ = 200_000
_LASERS = 4
_ROUND_HZ = -182.41768
_NOD_HZ = 9.99903
_AZIMUTH_DEG = 270.58
_ELEVATION_DEG = (20.45, 23.52, 1.12, 2.30)
"""Mean, and amplitudes of the nod and its harmonics."""
_LEAD_DEG = (28.42, 2.34, 2.69)
_FAN_STEP_DEG = 0.92
"""Half the angle between neighbours in the fan."""
_FAN_WIDENING = 1.14
"""Widening of the fan in azimuth, where the meridians converge."""


def directions(start_index: int, count: int) -> Float32:
    """(count, 3) float32 unit directions of the pulses from ``start_index`` on, in a frame whose z
    is the sensor's axis: elevation counts from its x-y plane towards +z, the side it sees most of.

    Raises ValueError for a negative index or count.
    """
    check_pulses(start_index, count)
    beams = np.empty((count, 3), dtype=np.float32)
    _trace(start_index, beams)
    return beams


@njit(cache=True, nogil=True, error_model="numpy")
def _trace(start_index: int, beams: Float32) -> None:
    for k in range(beams.shape[0]):
        index = start_index + k
        turns, nods = _ROUND_HZ * index / POINT_RATE_HZ, _NOD_HZ * index / POINT_RATE_HZ
        angle = 2.0 * math.pi * (turns - math.floor(turns))
        nod = 2.0 * math.pi * (nods - math.floor(nods))
        c, s = math.cos(angle), math.sin(angle)
        c1, s1 = math.cos(nod), math.sin(nod)
        c2, s2 = 2.0 * c1 * c1 - 1.0, 2.0 * s1 * c1
        c3, s3 = c2 * c1 - s2 * s1, s2 * c1 + c2 * s1
        place = _FAN_STEP_DEG * (_LASERS - 1 - 2 * (index % _LASERS))
        elevation = _ELEVATION_DEG[0] + _ELEVATION_DEG[1] * c1 + _ELEVATION_DEG[2] * c2
        elevation = math.radians(elevation + _ELEVATION_DEG[3] * c3 + place * c)
        lead = _LEAD_DEG[0] * s1 + _LEAD_DEG[1] * s2 + _LEAD_DEG[2] * s3
        azimuth = angle + math.radians(_AZIMUTH_DEG + lead - _FAN_WIDENING * place * s)
        level = math.cos(elevation)
        beams[k, 0] = level * math.cos(azimuth)
        beams[k, 1] = level * math.sin(azimuth)
        beams[k, 2] = math.sin(elevation)
