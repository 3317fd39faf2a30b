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


# One row a prism, in the order the beam meets them: 1 where it turns with the motor and -1 where
# against, 1 where it is the slow one, azimuth offset [rad], wedge angle [rad], 1 where the wedge
# face comes first.
_PRISMS: Array = np.array(
    [
        [-1.0, 1.0, 4.55226, 0.32929, 0.0],
        [1.0, 0.0, _PHASE_RAD + 1.56112, 0.41937, 0.0],
        [-1.0, 0.0, -_PHASE_RAD + 1.56112, 0.41991, 1.0],
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


@njit(cache=True, inline="always")
def _circle(turns: float) -> tuple[float, float]:
    """Cosine and sine of an angle in turns; whole ones are dropped first, exact for hours."""
    angle = 2.0 * math.pi * (turns - math.floor(turns))
    return math.cos(angle), math.sin(angle)


@njit(cache=True, nogil=True)
def _trace_horizon(start_index: int, beams: Float32, prisms: Array) -> None:
    """Fills ``beams`` (N, 3) with the pulses from ``start_index`` on."""
    into_glass = 1.0 / _REFRACTIVE_INDEX
    offset_cos, offset_sin = np.cos(prisms[:, 2]), np.sin(prisms[:, 2])
    wedge_cos, wedge_sin = np.cos(prisms[:, 3]), np.sin(prisms[:, 3])
    tilts = (2.0 * np.arange(LASERS) / (LASERS - 1) - 1.0) * _LASER_SPREAD_RAD
    tilt_cos, tilt_sin = np.cos(tilts), np.sin(tilts)
    for k in range(beams.shape[0]):
        index = start_index + k
        laser = index % LASERS
        turns = _FREQUENCY_HZ * (index / POINT_RATE_HZ)
        fast_cos, fast_sin = _circle(turns)
        slow_cos, slow_sin = _circle(turns / _SLOW_RATIO)
        x, y, z = 0.0, tilt_sin[laser], tilt_cos[laser]
        for p in range(prisms.shape[0]):
            slow = prisms[p, 1] > 0.5
            c = slow_cos if slow else fast_cos
            s = prisms[p, 0] * (slow_sin if slow else fast_sin)
            nx = wedge_sin[p] * (c * offset_cos[p] - s * offset_sin[p])
            ny = wedge_sin[p] * (s * offset_cos[p] + c * offset_sin[p])
            nz = wedge_cos[p]
            if prisms[p, 4] > 0.5:
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
