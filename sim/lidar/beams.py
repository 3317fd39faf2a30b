"""Directions of a LIDAR's pulses: tracks, pointing and noise, in compiled single-threaded loops.

Noise is a pure function of a key and the pulse's number, so it does not matter how a flight is cut
into scans. Random bits come from the SplitMix64 generator (Steele, Lea, Flood, "Fast splittable
pseudorandom number generators", OOPSLA 2014), normal deviates from them by inversion.
"""

from __future__ import annotations

import math
from statistics import NormalDist

import numpy as np
from numba import njit

from touchdown.sim.typing import Array, Float32, Indices, Uint32

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX_A = np.uint64(0xBF58476D1CE4E5B9)
_MIX_B = np.uint64(0x94D049BB133111EB)
_LOW_WORD = np.uint64(0xFFFFFFFF)

_QUANTILE_BITS = 12
_QUANTILES: Array = np.array(
    [0.0]
    + [NormalDist().inv_cdf(k / 2**_QUANTILE_BITS) for k in range(1, 2**_QUANTILE_BITS)]
    + [0.0]
)
"""Quantiles of the normal distribution at k / 4096; the two ends are never read."""


@njit(cache=True, forceinline=True)
def _mix(state: np.uint64) -> np.uint64:
    """SplitMix64's output function."""
    z = np.uint64(state)
    z = np.uint64((z ^ (z >> np.uint64(30))) * _MIX_A)
    z = np.uint64((z ^ (z >> np.uint64(27))) * _MIX_B)
    return np.uint64(z ^ (z >> np.uint64(31)))


@njit(cache=True, forceinline=True)
def _draw(key: np.uint64, pulse: int, word: int) -> np.uint64:
    """Random 64-bit word 0 or 1 of a pulse."""
    return _mix(np.uint64(key + _GOLDEN * np.uint64(2 * pulse + word + 1)))


@njit(cache=True, forceinline=True)
def _tail(bits: int) -> float:
    """Normal quantile in the outermost cells: Abramowitz and Stegun, 26.2.23."""
    p = (bits + 0.5) / 4294967296.0
    t = math.sqrt(-2.0 * math.log(min(p, 1.0 - p)))
    z = t - (2.515517 + t * (0.802853 + t * 0.010328)) / (
        1.0 + t * (1.432788 + t * (0.189269 + t * 0.001308))
    )
    return z if p > 0.5 else -z


@njit(cache=True, forceinline=True)
def normal_cell(bits: int) -> tuple[int, float]:
    """Cell of `quantile_table` that 32 random bits fall in, and the fraction of it."""
    rest = 32 - _QUANTILE_BITS
    return bits >> rest, (bits & ((1 << rest) - 1)) * (1.0 / (1 << rest))


@njit(cache=True, forceinline=True)
def normal_in(bits: int, low: float, high: float) -> float:
    """Standard normal deviate of 32 random bits whose cell has quantiles ``low`` and ``high``."""
    cell, part = normal_cell(bits)
    if cell == 0 or cell == (1 << _QUANTILE_BITS) - 1:
        return _tail(bits)
    return low + part * (high - low)


def quantile_table() -> Array:
    """Quantiles that `normal_in` interpolates."""
    return _QUANTILES


@njit(cache=True, forceinline=True)
def hashed(bits: np.uint32, salt: int) -> np.uint32:
    """Other random bits from a pulse's own (MurmurHash3's finaliser)."""
    h = np.uint32(bits ^ np.uint32(np.uint32(salt) * np.uint32(0x9E3779B9)))
    h = np.uint32(h ^ (h >> np.uint32(16)))
    h = np.uint32(h * np.uint32(0x85EBCA6B))
    h = np.uint32(h ^ (h >> np.uint32(13)))
    h = np.uint32(h * np.uint32(0xC2B2AE35))
    return np.uint32(h ^ (h >> np.uint32(16)))


@njit(cache=True, nogil=True)
def rotations_of(quats_wxyz: Array) -> Array:
    """(M, 4) unit quaternions -> (M, 3, 3)."""
    out = np.empty((quats_wxyz.shape[0], 3, 3))
    for k in range(quats_wxyz.shape[0]):
        w, x, y, z = quats_wxyz[k]
        out[k, 0, 0], out[k, 0, 1], out[k, 0, 2] = (
            1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        )  # fmt: skip
        out[k, 1, 0], out[k, 1, 1], out[k, 1, 2] = (
            2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        )  # fmt: skip
        out[k, 2, 0], out[k, 2, 1], out[k, 2, 2] = (
            2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
        )  # fmt: skip
    return out


@njit(cache=True, forceinline=True)
def _dot(ax: float, ay: float, az: float, bx: float, by: float, bz: float) -> float:
    return ax * bx + ay * by + az * bz


@njit(cache=True, forceinline=True)
def _fraction(start: float, end: float, time: float) -> float:
    """Fraction of the interval between two samples of a track at ``time``, clamped to [0, 1]."""
    return min(max((time - start) / (end - start), 0.0), 1.0) if end > start else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def aim(
    first_pulse: int,
    rate: int,
    pulses: Indices,
    offsets: Array,
    nominal: Float32,
    key: np.uint64,
    quantiles: Array,
    angle_sigma: float,
    track_times: Array,
    positions: Array,
    rotations: Array,
    rays: Float32,
    range_noise: Float32,
    bits: Uint32,
) -> None:
    """World rays of the ``pulses`` (K,), ascending indices into ``nominal`` (N, 3), pulse i being
    number ``first_pulse + i``. Each has S rays, turned off its axis by the first two columns of
    ``offsets`` (S, 3), radians along the LIDAR's x and y, and all of them by the same pointing
    error of ``angle_sigma`` radians; the third column separates the random bits of the rays.

    The track: (M,) seconds, (M, 3) and (M, 3, 3) world_from_lidar. Fills ``rays`` (K S, 6) with
    origins and unit directions, ``range_noise`` (K S,) with normal deviates, ``bits`` (K S,).
    """
    k = 0
    row = 0
    last = track_times.shape[0] - 1
    tick = 1.0 / rate
    slope = 1.0 / (track_times[1] - track_times[0]) if last > 0 else 0.0
    for i in pulses:
        x, y, z = nominal[i, 0], nominal[i, 1], nominal[i, 2]
        # The nearer of x and y to the beam's plane of view spans it: no pole within any pattern.
        along_x = abs(x) < 0.99
        if along_x:
            inverse = 1.0 / np.sqrt(y * y + z * z)
            ux, uy, uz = 1.0 / inverse, -x * y * inverse, -x * z * inverse
            vx, vy, vz = 0.0, z * inverse, -y * inverse
        else:
            inverse = 1.0 / np.sqrt(x * x + z * z)
            ux, uy, uz = z * inverse, 0.0, -x * inverse
            vx, vy, vz = -x * y * inverse, 1.0 / inverse, -y * z * inverse
        word, second = _draw(key, first_pulse + i, 0), _draw(key, first_pulse + i, 1)
        own_bits = np.uint32(second >> np.uint64(32))
        low, high = int(word & _LOW_WORD), int(word >> np.uint64(32))
        third = int(second & _LOW_WORD)
        cell, _ = normal_cell(low)
        wander_u = angle_sigma * normal_in(low, quantiles[cell], quantiles[cell + 1])
        cell, _ = normal_cell(high)
        wander_v = angle_sigma * normal_in(high, quantiles[cell], quantiles[cell + 1])
        cell, _ = normal_cell(third)
        noise = normal_in(third, quantiles[cell], quantiles[cell + 1])
        time = (first_pulse + i) * tick
        while k < last and track_times[k + 1] < time:
            k += 1
            slope = 1.0 / (track_times[k + 1] - track_times[k]) if k < last else 0.0
        j = min(k + 1, last)
        f = min(max((time - track_times[k]) * slope, 0.0), 1.0)
        e = 1.0 - f
        px = e * positions[k, 0] + f * positions[j, 0]
        py = e * positions[k, 1] + f * positions[j, 1]
        pz = e * positions[k, 2] + f * positions[j, 2]
        for s in range(offsets.shape[0]):
            u, v = wander_u + offsets[s, 0], wander_v + offsets[s, 1]
            bx, by, bz = x + u * ux + v * vx, y + u * uy + v * vy, z + u * uz + v * vz
            # Neighbouring poses differ by fractions of a degree: the chord serves for the arc.
            dx = e * _dot(rotations[k, 0, 0], rotations[k, 0, 1], rotations[k, 0, 2], bx, by, bz)
            dy = e * _dot(rotations[k, 1, 0], rotations[k, 1, 1], rotations[k, 1, 2], bx, by, bz)
            dz = e * _dot(rotations[k, 2, 0], rotations[k, 2, 1], rotations[k, 2, 2], bx, by, bz)
            dx += f * _dot(rotations[j, 0, 0], rotations[j, 0, 1], rotations[j, 0, 2], bx, by, bz)
            dy += f * _dot(rotations[j, 1, 0], rotations[j, 1, 1], rotations[j, 1, 2], bx, by, bz)
            dz += f * _dot(rotations[j, 2, 0], rotations[j, 2, 1], rotations[j, 2, 2], bx, by, bz)
            excess = dx * dx + dy * dy + dz * dz - 1.0
            # Lengths are 1 but for what pointing errors and chords add: two terms do.
            scale = 1.0 - 0.5 * excess
            if abs(excess) > 1e-4:
                scale = 1.0 / np.sqrt(1.0 + excess)
            rays[row, 0], rays[row, 1], rays[row, 2] = px, py, pz
            rays[row, 3], rays[row, 4], rays[row, 5] = dx * scale, dy * scale, dz * scale
            range_noise[row] = noise
            salt = int(offsets[s, 2])
            bits[row] = own_bits if salt == 0 else hashed(own_bits, salt)
            row += 1


@njit(cache=True, nogil=True)
def rays_near(
    rays: Float32,
    times: Array,
    track_times: Array,
    positions: Array,
    rotations: Array,
    center: Array,
    radius: float,
) -> tuple[Indices, Float32]:
    """The rays (N, 6), fired at ``times`` (N,) ascending, that pass through the bounding sphere of
    a moving body (``center`` (3,) in its own frame): their indices (K,), and (K, 6) themselves in
    the body's frame at their own instants. The track as for `aim`."""
    centers = np.empty_like(positions)
    for m in range(positions.shape[0]):
        for r in range(3):
            centers[m, r] = positions[m, r] + (
                rotations[m, r, 0] * center[0]
                + rotations[m, r, 1] * center[1]
                + rotations[m, r, 2] * center[2]
            )
    # A sphere around all the places that the body takes sorts out most rays at once.
    ax, ay, az = centers[0]
    drift = 0.0
    for m in range(1, centers.shape[0]):
        drift = max(drift, (centers[m, 0] - ax) ** 2 + (centers[m, 1] - ay) ** 2
                    + (centers[m, 2] - az) ** 2)  # fmt: skip
    wide = (radius + math.sqrt(drift)) ** 2
    last = track_times.shape[0] - 1
    chosen = np.empty(rays.shape[0], dtype=np.int64)
    local = np.empty((rays.shape[0], 6), dtype=np.float32)
    count = 0
    k = 0
    for i in range(rays.shape[0]):
        dx, dy, dz = rays[i, 3], rays[i, 4], rays[i, 5]
        cx, cy, cz = ax - rays[i, 0], ay - rays[i, 1], az - rays[i, 2]
        along = cx * dx + cy * dy + cz * dz
        if cx * cx + cy * cy + cz * cz - along * along > wide:
            continue
        while k < last and track_times[k + 1] < times[i]:
            k += 1
        j = min(k + 1, last)
        f = _fraction(track_times[k], track_times[j], times[i])
        e = 1.0 - f
        cx = e * centers[k, 0] + f * centers[j, 0] - rays[i, 0]
        cy = e * centers[k, 1] + f * centers[j, 1] - rays[i, 1]
        cz = e * centers[k, 2] + f * centers[j, 2] - rays[i, 2]
        along = cx * dx + cy * dy + cz * dz
        apart = cx * cx + cy * cy + cz * cz
        if apart - along * along > radius * radius or (along < 0.0 and apart > radius * radius):
            continue
        ox = rays[i, 0] - e * positions[k, 0] - f * positions[j, 0]
        oy = rays[i, 1] - e * positions[k, 1] - f * positions[j, 1]
        oz = rays[i, 2] - e * positions[k, 2] - f * positions[j, 2]
        squared = 0.0
        for c in range(3):
            tx = e * rotations[k, 0, c] + f * rotations[j, 0, c]
            ty = e * rotations[k, 1, c] + f * rotations[j, 1, c]
            tz = e * rotations[k, 2, c] + f * rotations[j, 2, c]
            local[count, c] = tx * ox + ty * oy + tz * oz
            local[count, 3 + c] = tx * dx + ty * dy + tz * dz
            squared += (tx * dx + ty * dy + tz * dz) ** 2
        for c in range(3, 6):
            local[count, c] /= math.sqrt(squared)
        chosen[count] = i
        count += 1
    return chosen[:count].copy(), local[:count].copy()
