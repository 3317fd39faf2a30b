"""Per-pulse arithmetic of the LIDAR in compiled loops; single-threaded, so that the result is the
same wherever it runs.

Link budget: the range limits 90, 130 and 260 m that the manufacturer states for targets of 10, 20
and 80 % reflectivity are joined by power laws in reflectivity times cos(incidence).

Water: mirror facets with Gaussian slopes (Cox and Munk, "Measurement of the roughness of the sea
surface from photographs of the sun's glitter", JOSA 44, 1954). With Fresnel reflection F at normal
incidence and slope variance s^2 per axis, the sheet returns as much as a matt target of
reflectivity F / (8 s^2) exp(-tan^2(incidence) / (2 s^2)); glints fluctuate, so the strength of one
pulse is exponentially distributed about that mean.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]
Int32 = NDArray[np.int32]
Uint32 = NDArray[np.uint32]

_LIMITS_M = (90.0, 130.0, 260.0)
_LIMITS_REFLECTIVITY = (0.1, 0.2, 0.8)
_LOW_POWER = math.log(_LIMITS_M[1] / _LIMITS_M[0]) / math.log(
    _LIMITS_REFLECTIVITY[1] / _LIMITS_REFLECTIVITY[0]
)
_HIGH_POWER = math.log(_LIMITS_M[2] / _LIMITS_M[1]) / math.log(
    _LIMITS_REFLECTIVITY[2] / _LIMITS_REFLECTIVITY[1]
)
_LIMIT_SPREAD = 0.02
"""Relative standard deviation of the range limit from pulse to pulse."""

_WATER_SLOPE_VARIANCE = 0.005
"""Per axis: inland water in a wind of about 1.5 m/s by Cox and Munk's law."""
_WATER_FRESNEL = 0.02
_WATER_PEAK = _WATER_FRESNEL / (8.0 * _WATER_SLOPE_VARIANCE)

_INTENSITY_PER_REFLECTIVITY = 150.0
"""Livox scale: 0..150 is 0..100 % of a matt target, above lies mirror-like reflection."""
_HASH_STEP = np.uint32(0x9E3779B9)
_WATER_SALT = np.uint32(0x85EBCA6B)


@njit(cache=True, nogil=True)
def max_range(reflectivity: float) -> float:
    """Metres at which a target of this reflectivity times cos(incidence) is just detected."""
    if reflectivity <= 0.0:
        return 0.0
    ratio = reflectivity / _LIMITS_REFLECTIVITY[1]
    return _LIMITS_M[1] * ratio ** (_LOW_POWER if ratio < 1.0 else _HIGH_POWER)


@njit(cache=True, nogil=True)
def quat_products(left_wxyz: Array, right_wxyz: Array) -> Array:
    """(M, 4) times (4,) Hamilton products, wxyz."""
    out = np.empty_like(left_wxyz)
    bw, bx, by, bz = right_wxyz
    for k in range(left_wxyz.shape[0]):
        aw, ax, ay, az = left_wxyz[k]
        out[k, 0] = aw * bw - ax * bx - ay * by - az * bz
        out[k, 1] = aw * bx + ax * bw + ay * bz - az * by
        out[k, 2] = aw * by - ax * bz + ay * bw + az * bx
        out[k, 3] = aw * bz + ax * by - ay * bx + az * bw
    return out


@njit(cache=True, inline="always")
def _rotate(
    w: float, qx: float, qy: float, qz: float, x: float, y: float, z: float
) -> tuple[float, float, float]:
    """v + 2 q x (q x v + w v) for a unit quaternion."""
    cx = qy * z - qz * y + w * x
    cy = qz * x - qx * z + w * y
    cz = qx * y - qy * x + w * z
    return (
        x + 2.0 * (qy * cz - qz * cy),
        y + 2.0 * (qz * cx - qx * cz),
        z + 2.0 * (qx * cy - qy * cx),
    )


@njit(cache=True, inline="always")
def _bracket(times: Array, time: float, start: int) -> tuple[int, int, float]:
    """Neighbouring samples around ``time`` and the fraction between them; times ascend, so the
    search goes on from ``start``."""
    last = times.shape[0] - 1
    k = start
    while k < last and times[k + 1] < time:
        k += 1
    if k >= last:
        return last, last, 0.0
    fraction = (time - times[k]) / (times[k + 1] - times[k])
    return k, k + 1, min(max(fraction, 0.0), 1.0)


@njit(cache=True, inline="always")
def _blend(quats: Array, k: int, j: int, f: float) -> tuple[float, float, float, float]:
    """Normalised linear blend of two neighbouring quaternions of a track."""
    e = 1.0 - f
    w = e * quats[k, 0] + f * quats[j, 0]
    x = e * quats[k, 1] + f * quats[j, 1]
    y = e * quats[k, 2] + f * quats[j, 2]
    z = e * quats[k, 3] + f * quats[j, 3]
    scale = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    return w * scale, x * scale, y * scale, z * scale


@njit(cache=True, nogil=True)
def aim(
    nominal: Float32,
    normals: Float32,
    angle_sigma: float,
    times: Array,
    track_times: Array,
    track_positions: Array,
    track_quats: Array,
    rays: Float32,
) -> None:
    """Fills ``rays`` (N, 6) with world origins and unit directions of the true beams: the nominal
    ones (N, 3) turned by ``angle_sigma`` radians times the first two ``normals`` (N, 4), from the
    LIDAR's pose at ``times`` (N,) ascending."""
    k = 0
    for i in range(nominal.shape[0]):
        x, y, z = nominal[i, 0], nominal[i, 1], nominal[i, 2]
        # Tangent basis without a branch at the poles: Duff et al., JCGT 6(1), 2017.
        sign = math.copysign(1.0, z)
        a = -1.0 / (sign + z)
        b = x * y * a
        u, v = angle_sigma * normals[i, 0], angle_sigma * normals[i, 1]
        dx = x + u * (1.0 + sign * x * x * a) + v * b
        dy = y + u * sign * b + v * (sign + y * y * a)
        dz = z - u * sign * x - v * y
        scale = 1.0 / math.sqrt(dx * dx + dy * dy + dz * dz)
        k, j, f = _bracket(track_times, times[i], k)
        w, qx, qy, qz = _blend(track_quats, k, j, f)
        dx, dy, dz = _rotate(w, qx, qy, qz, dx * scale, dy * scale, dz * scale)
        for c in range(3):
            rays[i, c] = (1.0 - f) * track_positions[k, c] + f * track_positions[j, c]
        rays[i, 3] = dx
        rays[i, 4] = dy
        rays[i, 5] = dz


@njit(cache=True, nogil=True)
def rays_near(
    rays: Float32,
    times: Array,
    track_times: Array,
    track_positions: Array,
    track_quats: Array,
    track_centers: Array,
    radius: float,
) -> tuple[NDArray[np.int64], Float32]:
    """The rays that pass through a moving body's bounding sphere: their indices (K,), and (K, 6)
    themselves in the body's frame at their own instants. ``track_centers`` (M, 3): the sphere's
    centre in the world."""
    chosen = np.empty(rays.shape[0], dtype=np.int64)
    local = np.empty((rays.shape[0], 6), dtype=np.float32)
    count = 0
    k = 0
    for i in range(rays.shape[0]):
        k, j, f = _bracket(track_times, times[i], k)
        e = 1.0 - f
        dx, dy, dz = rays[i, 3], rays[i, 4], rays[i, 5]
        cx = e * track_centers[k, 0] + f * track_centers[j, 0] - rays[i, 0]
        cy = e * track_centers[k, 1] + f * track_centers[j, 1] - rays[i, 1]
        cz = e * track_centers[k, 2] + f * track_centers[j, 2] - rays[i, 2]
        along = cx * dx + cy * dy + cz * dz
        apart = cx * cx + cy * cy + cz * cz
        if apart - along * along > radius * radius or (along < 0.0 and apart > radius * radius):
            continue
        w, qx, qy, qz = _blend(track_quats, k, j, f)
        ox = rays[i, 0] - e * track_positions[k, 0] - f * track_positions[j, 0]
        oy = rays[i, 1] - e * track_positions[k, 1] - f * track_positions[j, 1]
        oz = rays[i, 2] - e * track_positions[k, 2] - f * track_positions[j, 2]
        ox, oy, oz = _rotate(w, -qx, -qy, -qz, ox, oy, oz)
        dx, dy, dz = _rotate(w, -qx, -qy, -qz, dx, dy, dz)
        chosen[count] = i
        local[count, 0], local[count, 1], local[count, 2] = ox, oy, oz
        local[count, 3], local[count, 4], local[count, 5] = dx, dy, dz
        count += 1
    return chosen[:count].copy(), local[:count].copy()


@njit(cache=True, inline="always")
def _uniform(bits: np.uint32, salt: np.uint32) -> float:
    """A number in (0, 1) from a pulse's random bits and a salt (MurmurHash3's finaliser)."""
    h = np.uint32(bits ^ np.uint32(salt * _HASH_STEP))
    h = np.uint32(h ^ (h >> np.uint32(16)))
    h = np.uint32(h * np.uint32(0x85EBCA6B))
    h = np.uint32(h ^ (h >> np.uint32(13)))
    h = np.uint32(h * np.uint32(0xC2B2AE35))
    h = np.uint32(h ^ (h >> np.uint32(16)))
    return (float(h) + 0.5) / 4294967296.0


@njit(cache=True, nogil=True)
def passing(geom: Int32, cosine: Float32, bits: Uint32, porosity: Float32) -> NDArray[np.int64]:
    """Indices of the pulses that pass through what they hit. A pulse that entered a porous body
    leaves it freely: the answer hangs on pulse and geom alone, and insides never reflect."""
    out = np.empty(geom.shape[0], dtype=np.int64)
    count = 0
    for i in range(geom.shape[0]):
        g = geom[i]
        if g < 0 or porosity[g] <= 0.0:
            continue
        if cosine[i] < 0.0 or _uniform(bits[i], np.uint32(g + 1)) < porosity[g]:
            out[count] = i
            count += 1
    return out[:count].copy()


@njit(cache=True, nogil=True)
def receive(
    rays: Float32,
    distance: Float32,
    geom: Int32,
    cosine: Float32,
    normals: Float32,
    bits: Uint32,
    reflectivity: Float32,
    water: NDArray[np.bool_],
    ground_geom: int,
    ground_origin: Array,
    ground_cell: float,
    ground_reflectivity: Float32,
    ground_water: NDArray[np.bool_],
    range_sigma: float,
    min_range: float,
    max_range_m: float,
    ranges: Float32,
    intensity: NDArray[np.uint8],
) -> None:
    """Fills ``ranges`` (N,) in metres and ``intensity`` (N,); both 0 where nothing comes back."""
    rows, cols = ground_reflectivity.shape
    for i in range(rays.shape[0]):
        ranges[i] = 0.0
        intensity[i] = 0
        g = geom[i]
        if g < 0 or distance[i] < min_range or distance[i] > max_range_m:
            continue
        rho, wet = reflectivity[g], water[g]
        if g == ground_geom:
            x = rays[i, 0] + distance[i] * rays[i, 3]
            y = rays[i, 1] + distance[i] * rays[i, 4]
            col = math.floor((x - ground_origin[0]) / ground_cell)
            row = math.floor((y - ground_origin[1]) / ground_cell)
            if 0 <= row < rows and 0 <= col < cols:
                rho, wet = ground_reflectivity[row, col], ground_water[row, col]
        c = abs(cosine[i])
        if wet:
            strength = _water_strength(c) * -math.log(_uniform(bits[i], _WATER_SALT))
        else:
            strength = rho * c
        if distance[i] > max_range(strength) * (1.0 + _LIMIT_SPREAD * normals[i, 3]):
            continue
        ranges[i] = max(distance[i] + range_sigma * normals[i, 2], min_range)
        intensity[i] = np.uint8(min(max(_INTENSITY_PER_REFLECTIVITY * strength + 0.5, 1.0), 255.0))


@njit(cache=True, inline="always")
def _water_strength(cosine: float) -> float:
    if cosine <= 0.0:
        return 0.0
    tangent_squared = 1.0 / (cosine * cosine) - 1.0
    return _WATER_PEAK * math.exp(-tangent_squared / (2.0 * _WATER_SLOPE_VARIANCE))
