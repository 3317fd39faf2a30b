"""Vectors, rotations and covariances in PX4's frames: local north-east-down, body
forward-right-down. Ours are east-north-up and forward-left-up."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from touchdown.sim.frames import quat_wxyz_from_matrix, wrap_angle

Array = NDArray[np.float64]

NED_FROM_ENU: Array = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FRD_FROM_FLU: Array = np.diag([1.0, -1.0, -1.0])

_EARTH_RADIUS_M = 6_371_000.0
"""of PX4's map projection, which is spherical: an ellipsoid would put a fix off by up to 0.3 %"""
HOME_LATITUDE_DEG, HOME_LONGITUDE_DEG = 47.397742, 8.545594
"""of the world's origin, PX4's own default"""


def ned(enu: Array) -> list[float]:
    """North, east, down of a vector (3,) east, north, up."""
    x, y, z = enu.tolist()
    return [y, x, -z]


def frd(flu: Array) -> list[float]:
    """Forward, right, down of a vector (3,) forward, left, up."""
    x, y, z = flu.tolist()
    return [x, -y, -z]


def ned_yaw(enu_yaw: float) -> float:
    """Heading in rad, clockwise from north, of an angle counter-clockwise from east."""
    return float(wrap_angle(0.5 * math.pi - enu_yaw))


def ned_quaternion(rotation: Array) -> list[float]:
    """(w, x, y, z) of ned_from_frd, from the rotation (3, 3) enu_from_flu."""
    return [float(q) for q in quat_wxyz_from_matrix(NED_FROM_ENU @ rotation @ FRD_FROM_FLU)]


def ned_covariance(covariance: Array) -> Array:
    """(3, 3) of a covariance (3, 3) in east, north, up."""
    return NED_FROM_ENU @ covariance @ NED_FROM_ENU.T


def geodetic(enu: Array) -> tuple[float, float]:
    """Latitude and longitude, degrees, of a place (3,) m: the inverse of PX4's azimuthal
    equidistant projection about the world's origin."""
    east, north, _ = enu.tolist()
    lat0, lon0 = math.radians(HOME_LATITUDE_DEG), math.radians(HOME_LONGITUDE_DEG)
    arc = math.hypot(east, north) / _EARTH_RADIUS_M
    if arc == 0.0:
        return HOME_LATITUDE_DEG, HOME_LONGITUDE_DEG
    bearing = math.atan2(east, north)
    sine = math.sin(lat0) * math.cos(arc) + math.cos(lat0) * math.sin(arc) * math.cos(bearing)
    lat = math.asin(sine)
    lon = lon0 + math.atan2(
        math.sin(bearing) * math.sin(arc) * math.cos(lat0), math.cos(arc) - math.sin(lat0) * sine
    )
    return math.degrees(lat), math.degrees(lon)
