"""Returns of LIDAR pulses, in compiled single-threaded loops.

Link budget: the range limits that the manufacturer states for targets of given reflectivity are
joined by power laws in reflectivity times cos(incidence).

Water: mirror facets with Gaussian slopes (Cox and Munk, "Measurement of the roughness of the sea
surface from photographs of the sun's glitter", JOSA 44, 1954). With Fresnel reflection F at normal
incidence and slope variance s^2 per axis, the sheet returns as much as a matt target of
reflectivity F / (8 s^2) exp(-tan^2(incidence) / (2 s^2)); glints fluctuate, so the strength of one
pulse is exponentially distributed about that mean.

Mixed pixels: where a beam is split by an edge, its parts come back as echoes. Surfaces nearer to
one another than the pulse is long merge into one echo at their energy-weighted mean range.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from touchdown.sim.geometry.ray_target import Hits
from touchdown.sim.lidar.beams import hashed, normal_cell, normal_in, quantile_table
from touchdown.sim.lidar.rays import Rays
from touchdown.sim.typing import Array, Bytes, Float32, Indices, Int32, Mask, Uint32

_LIMIT_SPREAD = 0.02
"""Relative standard deviation of the range limit from pulse to pulse."""
_SURE_SIGMAS = 6.5
"""Bound of a normal deviate made of 32 bits, in standard deviations."""
_SURE_STEP_M = 0.5

_WATER_SLOPE_VARIANCE = 0.005
"""Per axis: inland water in a wind of about 1.5 m/s by Cox and Munk's law."""
_WATER_FRESNEL = 0.02
_WATER_PEAK = _WATER_FRESNEL / (8.0 * _WATER_SLOPE_VARIANCE)

_INTENSITY_PER_REFLECTIVITY = 150.0
"""Livox scale: 0..150 is 0..100 % of a matt target, above lies mirror-like reflection."""
_WATER_SALT = 0x85EBCA6B
_LIMIT_SALT = 0x27D4EB2F
_AIR_SALT = 0x165667B1
_DROP_SALT = 0x2545F491
_STEP_BEHIND_M = np.float32(1e-3)
_PORE_SALT = 1 << 8
"""Plus the geom's id; keeps clear of the salts of a beam's parts."""


class LinkBudget(NamedTuple):
    """Range limit by strength (reflectivity times cosine of the incidence)."""

    anchors: Array
    """(K, 3): limit in metres, its reflectivity, exponent up to the next anchor"""
    sure: Array
    """Strength that is detected at any distance up to (i + 1) * 0.5 m, whatever the noise."""
    quantiles: Array = quantile_table()

    @staticmethod
    def of(
        limits_m: tuple[float, ...], reflectivities: tuple[float, ...], max_m: float
    ) -> "LinkBudget":
        """Raises ValueError unless both are ascending and at least two."""
        limits, levels = np.array(limits_m), np.array(reflectivities)
        if len(limits) < 2 or len(limits) != len(levels) or (np.diff([limits, levels]) <= 0).any():
            raise ValueError("a link budget needs two or more ascending limits and reflectivities")
        powers = np.diff(np.log(limits)) / np.diff(np.log(levels))
        anchors = np.column_stack([limits, levels, np.append(powers, powers[-1])])
        steps = np.arange(1, math.ceil(max_m / _SURE_STEP_M) + 2) * _SURE_STEP_M
        reach = steps / (1.0 - _SURE_SIGMAS * _LIMIT_SPREAD)
        at = np.clip(np.searchsorted(limits, reach) - 1, 0, len(powers) - 1)
        return LinkBudget(anchors, levels[at] * (reach / limits[at]) ** (1.0 / powers[at]))

    def strength_needed(self, ranges_m: Array) -> Array:
        """Strength that is just detected at each of the ranges."""
        limits, levels, powers = self.anchors.T
        at = np.clip(np.searchsorted(limits, ranges_m) - 1, 0, len(limits) - 2)
        return levels[at] * (ranges_m / limits[at]) ** (1.0 / powers[at])


@njit(cache=True, forceinline=True, error_model="numpy")
def _limit(strength: float, anchors: Array) -> float:
    if strength <= 0.0:
        return 0.0
    k = 0
    while k < anchors.shape[0] - 2 and strength > anchors[k + 1, 1]:
        k += 1
    return anchors[k, 0] * (strength / anchors[k, 1]) ** anchors[k, 2]


@njit(cache=True, forceinline=True, error_model="numpy")
def _uniform(bits: np.uint32, salt: int) -> float:
    """A number in (0, 1) from a pulse's random bits and a salt."""
    return (float(hashed(bits, salt)) + 0.5) / 4294967296.0


@njit(cache=True, nogil=True, error_model="numpy")
def pass_on(
    rows: Indices, pulses: Rays, hits: Hits, porosity: Float32, onward: Float32, travelled: Float32
) -> int:
    """Puts those of the ``pulses`` ``rows`` (K,) that pass through what they hit to its front, what
    is left of them to ``onward`` (K, 6), and how far they have come to ``travelled`` (K,); takes
    the hits from them. Returns their number. The result depends on ray and geom alone and insides
    never reflect, so a ray that entered a porous body also leaves it."""
    rays, _, _, bits = pulses
    distance, geom, cosine = hits
    count = 0
    for k in range(rows.shape[0]):
        i = rows[k]
        g = geom[i]
        if g < 0 or porosity[g] <= 0.0:
            continue
        if cosine[i] < 0.0 or _uniform(bits[i], _PORE_SALT + g) < porosity[g]:
            rows[count], travelled[count] = i, distance[i] + _STEP_BEHIND_M
            for c in range(3):
                onward[count, c] = rays[i, c] + travelled[count] * rays[i, 3 + c]
                onward[count, 3 + c] = rays[i, 3 + c]
            distance[i], geom[i], cosine[i] = np.inf, -1, 0.0
            count += 1
    return count


@njit(cache=True, forceinline=True, error_model="numpy")
def _strength(reflectivity: float, wet: bool, cosine: float, bits: np.uint32) -> float:
    """Strength that a surface returns: reflectivity times cosine, or a glint of water."""
    c = abs(cosine)
    if not wet:
        return reflectivity * c
    if c <= 0.0:
        return 0.0
    tangent_squared = 1.0 / (c * c) - 1.0
    mean = _WATER_PEAK * math.exp(-tangent_squared / (2.0 * _WATER_SLOPE_VARIANCE))
    return mean * -math.log(_uniform(bits, _WATER_SALT))


@njit(cache=True, error_model="numpy")
def _detected(
    distance: float, strength: float, bits: np.uint32, anchors: Array, quantiles: Array
) -> bool:
    draw = int(hashed(bits, _LIMIT_SALT))
    cell, _ = normal_cell(draw)
    deviate = normal_in(draw, quantiles[cell], quantiles[cell + 1])
    return distance <= _limit(strength, anchors) * (1.0 + _LIMIT_SPREAD * deviate)


@njit(cache=True, forceinline=True, error_model="numpy")
def _level(strength: float) -> np.uint8:
    return np.uint8(min(max(_INTENSITY_PER_REFLECTIVITY * strength + 0.5, 1.0), 255.0))


@njit(cache=True, nogil=True, error_model="numpy")
def receive(
    pulses: Rays,
    hits: Hits,
    cells: Int32,
    reflectivity: Float32,
    water: Mask,
    ground: Float32,
    gain: Float32,
    budget: LinkBudget,
    range_sigma: float,
    min_range: float,
    max_range: float,
    strengths: Float32,
    ranges: Float32,
    intensity: Bytes,
) -> None:
    """Fills, for undivided pulses, ``ranges`` (N,) in metres and ``intensity`` (N,), both 0 where
    nothing comes back, and ``strengths`` (N,). Surfaces as in
    ``sim.lidar.raycast_scene.OpticalTable``, the ground's (C,) by ``cells`` (N,), -1 elsewhere.
    ``gain``: factors (N,) of matt reflectivities, or empty."""
    _, _, range_noise, bits = pulses
    distance, geom, cosine = hits
    anchors, sure, quantiles = budget
    varied = gain.shape[0] > 0
    for i in range(distance.shape[0]):
        strengths[i], ranges[i], intensity[i] = 0.0, 0.0, 0
        d, g = float(distance[i]), geom[i]
        if g < 0 or d < min_range or d > max_range:
            continue
        rho, wet = reflectivity[g], water[g]
        if cells[i] >= 0:
            rho = ground[cells[i]]
            wet = rho < 0.0
        if varied:
            rho = min(rho * gain[i], max(rho, np.float32(1.0)))
        strength = _strength(rho, wet, cosine[i], bits[i])
        strengths[i] = strength
        step = int(d * (1.0 / _SURE_STEP_M))
        if strength >= sure[step] or _detected(d, strength, bits[i], anchors, quantiles):
            ranges[i] = max(d + range_sigma * range_noise[i], min_range)
            intensity[i] = _level(strength)


@njit(cache=True, nogil=True, error_model="numpy")
def weaken(
    distance: Float32,
    bits: Uint32,
    extinction: float,
    budget: LinkBudget,
    strengths: Float32,
    ranges: Float32,
    intensity: Bytes,
) -> None:
    """Attenuates undivided pulses by air of this extinction in 1/m, over the way out and back:
    lowers ``strengths`` and ``intensity`` (N,) and sets the ``ranges`` (N,) of echoes that become
    too weak to 0."""
    anchors, _, quantiles = budget
    for i in range(distance.shape[0]):
        if strengths[i] <= 0.0:
            continue
        strengths[i] *= math.exp(-2.0 * extinction * distance[i])
        if ranges[i] > 0.0:
            distance_m, strength = float(distance[i]), float(strengths[i])
            if _detected(distance_m, strength, bits[i], anchors, quantiles):
                intensity[i] = _level(strengths[i])
            else:
                ranges[i], intensity[i] = 0.0, 0


@njit(cache=True, nogil=True, error_model="numpy")
def clutter(
    bits: Uint32,
    expected: Array,
    threshold: Array,
    spread: float,
    step_m: float,
    min_range: float,
    strongest: bool,
    ranges: Float32,
    intensity: Bytes,
) -> None:
    """Replaces ``ranges`` and ``intensity`` (N,) by the nearest echo of the air where that comes
    first, or with ``strongest`` where it is the stronger one. ``expected`` (K,) echoes up to k
    ``step_m``, each of the strength ``threshold`` (K,) at least. Beyond what just counts, diameters
    of drops are exponentially distributed, with the relative mean ``spread``."""
    first = min(math.ceil(min_range / step_m), expected.shape[0] - 1)
    for i in range(bits.shape[0]):
        draw = expected[first] - math.log(_uniform(bits[i], _AIR_SALT))
        if draw >= expected[-1]:
            continue
        k = int(np.searchsorted(expected, draw))
        part = (draw - expected[k - 1]) / (expected[k] - expected[k - 1])
        r = (k - 1 + part) * step_m
        width = 1.0 - spread * math.log(_uniform(bits[i], _DROP_SALT))
        strength = threshold[k] * width * width
        if ranges[i] > 0.0:
            if strongest:
                target = intensity[i] / _INTENSITY_PER_REFLECTIVITY / (ranges[i] * ranges[i])
                if target >= strength / (r * r):
                    continue
            elif ranges[i] <= r:
                continue
        ranges[i], intensity[i] = r, _level(strength)


@njit(cache=True, nogil=True, error_model="numpy")
def receive_split(
    pulses: Indices,
    rays: Rays,
    distance: Float32,
    strength: Float32,
    pulse_length: float,
    strongest: bool,
    budget: LinkBudget,
    range_sigma: float,
    min_range: float,
    ranges: Float32,
    intensity: Bytes,
) -> None:
    """For divided pulses, overwrites ``ranges`` and ``intensity`` of ``pulses`` (K,) by the first
    or the strongest echo of their P equal parts. ``distance`` and ``strength``, none where a part
    meets nothing: of the axes of the N pulses, then of K parts of one kind after another.
    """
    _, _, range_noise, bits = rays
    anchors, _, quantiles = budget
    size = pulses.shape[0]
    parts = 1 + (distance.shape[0] - ranges.shape[0]) // max(size, 1)
    distances, strengths = np.empty(parts, np.float32), np.empty(parts, np.float32)
    for k in range(size):
        i = pulses[k]
        distances[0], strengths[0] = distance[i], strength[i]
        for p in range(1, parts):
            part = ranges.shape[0] + (p - 1) * size + k
            distances[p], strengths[p] = distance[part], strength[part]
        _sort_parts(distances, strengths)
        best_range, best_strength, best_power = 0.0, 0.0, 0.0
        p = 0
        while p < parts and distances[p] < np.inf:
            start = distances[p]
            total, power, moment = 0.0, 0.0, 0.0
            while p < parts and distances[p] - start <= pulse_length:
                d, s = distances[p], strengths[p]
                total += s / parts
                power += s / (d * d + 1e-9)
                moment += d * s / (d * d + 1e-9)
                p += 1
            mean = moment / power
            if not _detected(mean, total, bits[i], anchors, quantiles):
                continue
            if power > best_power:
                best_range, best_strength, best_power = mean, total, power
            if not strongest:
                break
        ranges[i], intensity[i] = 0.0, 0
        if best_power > 0.0:
            ranges[i] = max(best_range + range_sigma * range_noise[i], min_range)
            intensity[i] = _level(best_strength)


@njit(cache=True, forceinline=True, error_model="numpy")
def _sort_parts(distance: Float32, strength: Float32) -> None:
    """By distance, a few of them, in place; parts without strength go last."""
    for a in range(distance.shape[0]):
        if strength[a] <= 0.0:
            distance[a] = np.inf
        b = a
        while b > 0 and distance[b - 1] > distance[b]:
            distance[b - 1], distance[b] = distance[b], distance[b - 1]
            strength[b - 1], strength[b] = strength[b], strength[b - 1]
            b -= 1
