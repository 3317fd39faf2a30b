"""Scan patterns of Livox LIDARs: where pulse number k points.

The Horizon steers six lasers through three rotating wedge prisms (a Risley triplet). Each pulse is
traced through the six faces with Snell's law in vector form, so the pattern never repeats within a
flight and is a pure function of the pulse's number.

Parameters of the Horizon were fitted to recordings of the real sensor; the optics is the textbook
one (e.g. Li, "Closed-form analytical inverse solutions for Risley-prism-based beam steering
systems in different configurations", Applied Optics 50, 2011).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numba import njit
from numpy.typing import NDArray

Float32 = NDArray[np.float32]
Array = NDArray[np.float64]

POINT_RATE_HZ = 240_000
"""Pulses a second; one every 4.167 microseconds."""
LASERS = 6
FIELD_OF_VIEW_DEG = (81.7, 25.1)
"""Horizon, along x (long axis) and y."""

_REFRACTIVE_INDEX = 1.51
_FREQUENCY_HZ = 121.567
_PHASE_RAD = 4.78534
_SLOW_RATIO = 12.2361
_LASER_SPREAD_RAD = 0.03661


@dataclass(frozen=True, kw_only=True, slots=True)
class ScanPattern:
    """``directions(start_index, count)`` gives (count, 3) float32 unit vectors in the LIDAR frame
    (x long axis, z boresight) of the pulses ``start_index ... start_index + count - 1``; pulse k
    fires at ``k / point_rate_hz`` seconds."""

    directions: Callable[[int, int], Float32]
    point_rate_hz: int
    field_of_view_deg: tuple[float, float]


# One row a prism, in the order the beam meets them: turns per turn of the fast prisms, azimuth
# offset [rad], wedge angle [rad], and whether the wedge face comes first.
_PRISMS: Array = np.array(
    [
        [-1.0 / _SLOW_RATIO, 4.55226, 0.32929, 0.0],
        [1.0, _PHASE_RAD + 1.56112, 0.41937, 0.0],
        [-1.0, -_PHASE_RAD + 1.56112, 0.41991, 1.0],
    ]
)


def directions(start_index: int, count: int) -> Float32:
    """Horizon: (count, 3) float32 unit beam directions in the LIDAR frame.

    Raises ValueError for a negative index or count.
    """
    if start_index < 0 or count < 0:
        raise ValueError(
            f"pulse index {start_index} and count {count} must not be negative: "
            "pulses are numbered from the start of the simulation"
        )
    beams = np.empty((count, 3), dtype=np.float32)
    _trace_horizon(start_index, beams, _PRISMS)
    return beams


@njit(cache=True, inline="always")
def _refract(
    x: float, y: float, z: float, nx: float, ny: float, nz: float, ratio: float
) -> tuple[float, float, float]:
    """Snell's law in vector form for a unit ray that crosses a face whose unit normal points
    along the ray; ``ratio`` is index before over index behind."""
    cosine = x * nx + y * ny + z * nz
    gain = math.sqrt(1.0 - ratio * ratio * (1.0 - cosine * cosine)) - ratio * cosine
    return ratio * x + gain * nx, ratio * y + gain * ny, ratio * z + gain * nz


@njit(cache=True, nogil=True)
def _trace_horizon(start_index: int, beams: Float32, prisms: Array) -> None:
    """Fills ``beams`` (N, 3) with the pulses from ``start_index`` on."""
    into_glass = 1.0 / _REFRACTIVE_INDEX
    wedge_cos = np.cos(prisms[:, 2])
    wedge_sin = np.sin(prisms[:, 2])
    for k in range(beams.shape[0]):
        index = start_index + k
        turns = _FREQUENCY_HZ * (index / POINT_RATE_HZ)
        tilt = (2.0 * (index % LASERS) / (LASERS - 1) - 1.0) * _LASER_SPREAD_RAD
        x, y, z = 0.0, math.sin(tilt), math.cos(tilt)
        for p in range(prisms.shape[0]):
            # Whole turns are dropped before they are scaled by 2 pi: exact for hours of flight.
            rotation = turns * prisms[p, 0]
            azimuth = 2.0 * math.pi * (rotation - math.floor(rotation)) + prisms[p, 1]
            nx = wedge_sin[p] * math.cos(azimuth)
            ny = wedge_sin[p] * math.sin(azimuth)
            nz = wedge_cos[p]
            if prisms[p, 3] > 0.5:
                x, y, z = _refract(x, y, z, nx, ny, nz, into_glass)
                x, y, z = _refract(x, y, z, 0.0, 0.0, 1.0, _REFRACTIVE_INDEX)
            else:
                x, y, z = _refract(x, y, z, 0.0, 0.0, 1.0, into_glass)
                x, y, z = _refract(x, y, z, nx, ny, nz, _REFRACTIVE_INDEX)
        beams[k, 0] = x
        beams[k, 1] = y
        beams[k, 2] = z


PATTERNS: Mapping[str, ScanPattern] = MappingProxyType(
    {
        "horizon": ScanPattern(
            directions=directions,
            point_rate_hz=POINT_RATE_HZ,
            field_of_view_deg=FIELD_OF_VIEW_DEG,
        )
    }
)
"""Scan patterns by preset name."""


def pattern(preset: str) -> ScanPattern:
    """The named scan pattern. Raises ValueError naming the known presets."""
    try:
        return PATTERNS[preset]
    except KeyError:
        known = ", ".join(sorted(PATTERNS))
        raise ValueError(f"unknown LIDAR preset '{preset}': choose one of {known}") from None
