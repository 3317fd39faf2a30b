"""Local east, north, up as latitude, longitude and height on the ellipsoid of WGS 84."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_SEMI_MAJOR_M = 6378137.0
_FLATTENING = 1.0 / 298.257223563
_E2 = _FLATTENING * (2.0 - _FLATTENING)
_ROUNDS = 6
"""The latitude's error shrinks by a factor of about e^2 h / a, at least 100, each round."""


class LocalFrame:
    """A tangent plane whose origin is at ``latitude_deg``, ``longitude_deg``, ``height_m`` above
    the ellipsoid; x points east, y north, z up."""

    def __init__(self, latitude_deg: float, longitude_deg: float, height_m: float) -> None:
        latitude, longitude = math.radians(latitude_deg), math.radians(longitude_deg)
        sin_lat, cos_lat = math.sin(latitude), math.cos(latitude)
        sin_lon, cos_lon = math.sin(longitude), math.cos(longitude)
        normal_m = _normal_radius(sin_lat)
        self._origin = np.array(
            [
                (normal_m + height_m) * cos_lat * cos_lon,
                (normal_m + height_m) * cos_lat * sin_lon,
                ((1.0 - _E2) * normal_m + height_m) * sin_lat,
            ]
        )
        self._earth_from_local = np.array(
            [
                [-sin_lon, -sin_lat * cos_lon, cos_lat * cos_lon],
                [cos_lon, -sin_lat * sin_lon, cos_lat * sin_lon],
                [0.0, cos_lat, sin_lat],
            ]
        )

    def geodetic(self, local: Array) -> Array:
        """(3,) east, north, up in metres -> (3,) latitude, longitude in degrees, height in m."""
        x, y, z = (self._origin + self._earth_from_local @ local).tolist()
        out = math.hypot(x, y)
        latitude = math.atan2(z, out * (1.0 - _E2))
        for _ in range(_ROUNDS):
            sin_lat = math.sin(latitude)
            latitude = math.atan2(z + _E2 * _normal_radius(sin_lat) * sin_lat, out)
        sin_lat, cos_lat = math.sin(latitude), math.cos(latitude)
        height = out * cos_lat + z * sin_lat - _SEMI_MAJOR_M * math.sqrt(1.0 - _E2 * sin_lat**2)
        return np.array([math.degrees(latitude), math.degrees(math.atan2(y, x)), height])


def _normal_radius(sin_latitude: float) -> float:
    """Radius of curvature in the prime vertical, metres."""
    return _SEMI_MAJOR_M / math.sqrt(1.0 - _E2 * sin_latitude**2)
