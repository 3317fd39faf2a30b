"""Directions of a LIDAR's pulses: tracks, pointing and noise, in compiled single-threaded loops.

Noise is a pure function of a key and the pulse's number, so it does not matter how a flight is cut
into scans. Random bits come from the SplitMix64 generator (Steele, Lea, Flood, "Fast splittable
pseudorandom number generators", OOPSLA 2014), normal deviates from them by inversion.
"""

import math
from statistics import NormalDist

import numpy as np
from numba import njit

from touchdown.sim.lidar.rays import Rays, Track
from touchdown.sim.typing import Array, Float32, Indices, Uint32

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX_A = np.uint64(0xBF58476D1CE4E5B9)
_MIX_B = np.uint64(0x94D049BB133111EB)

_QUANTILE_BITS = 12
_QUANTILES: Array = np.array(
    [0.0]
    + [NormalDist().inv_cdf(k / 2**_QUANTILE_BITS) for k in range(1, 2**_QUANTILE_BITS)]
    + [0.0]
)
"""Quantiles of the normal distribution at k / 4096; the two ends are never read."""
_REST = np.uint32(32 - _QUANTILE_BITS)
_CELL = np.uint32(1 << 32 - _QUANTILE_BITS)
_IN_CELL = np.uint32((1 << 32 - _QUANTILE_BITS) - 1)
_BLOCK = 256
"""Most pulses that are aimed together"""
_Y, _Z, _U, _V, _W = (np.uint64(_BLOCK * k) for k in range(1, 6))
"""where the lanes of a block begin, behind the first"""


@njit(cache=True, forceinline=True, error_model="numpy")
def _mix(state: np.uint64) -> np.uint64:
    """SplitMix64's output function."""
    z = np.uint64(state)
    z = np.uint64((z ^ (z >> np.uint64(30))) * _MIX_A)
    z = np.uint64((z ^ (z >> np.uint64(27))) * _MIX_B)
    return np.uint64(z ^ (z >> np.uint64(31)))


@njit(cache=True, forceinline=True, error_model="numpy")
def _tail(bits: int) -> float:
    """Normal quantile in the outermost cells: Abramowitz and Stegun, 26.2.23."""
    p = (bits + 0.5) / 4294967296.0
    t = math.sqrt(-2.0 * math.log(min(p, 1.0 - p)))
    z = t - (2.515517 + t * (0.802853 + t * 0.010328)) / (
        1.0 + t * (1.432788 + t * (0.189269 + t * 0.001308))
    )
    return z if p > 0.5 else -z


@njit(cache=True, forceinline=True, error_model="numpy")
def normal_cell(bits: int) -> tuple[int, float]:
    """Cell of `quantile_table` that 32 random bits fall in, and the fraction of it."""
    rest = 32 - _QUANTILE_BITS
    return bits >> rest, (bits & ((1 << rest) - 1)) * (1.0 / (1 << rest))


@njit(cache=True, forceinline=True, error_model="numpy")
def normal_in(bits: int, low: float, high: float) -> float:
    """Standard normal deviate of 32 random bits whose cell has quantiles ``low`` and ``high``."""
    cell, part = normal_cell(bits)
    if cell == 0 or cell == (1 << _QUANTILE_BITS) - 1:
        return _tail(bits)
    return low + part * (high - low)


def quantile_table() -> Array:
    """Quantiles that `normal_in` interpolates."""
    return _QUANTILES


@njit(cache=True, forceinline=True, error_model="numpy")
def hashed(bits: np.uint32, salt: int) -> np.uint32:
    """Other random bits from a pulse's own (MurmurHash3's finaliser)."""
    h = np.uint32(bits ^ np.uint32(np.uint32(salt) * np.uint32(0x9E3779B9)))
    h = np.uint32(h ^ (h >> np.uint32(16)))
    h = np.uint32(h * np.uint32(0x85EBCA6B))
    h = np.uint32(h ^ (h >> np.uint32(13)))
    h = np.uint32(h * np.uint32(0xC2B2AE35))
    return np.uint32(h ^ (h >> np.uint32(16)))


@njit(cache=True, forceinline=True, error_model="numpy")
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
    track: Track,
    out: Rays,
) -> None:
    """World rays of the ``pulses`` (K,), ascending indices into ``nominal`` (N, 3), pulse i being
    number ``first_pulse + i``. Each has S rays, turned off its axis by the first two columns of
    ``offsets`` (S, 3), radians along the LIDAR's x and y, and all of them by the same pointing
    error of ``angle_sigma`` radians; the third column separates the random bits of the rays.

    The track is the LIDAR's. Fills ``out`` (S K rays), offset by offset; its range noise are normal
    deviates. It works on blocks of pulses between two poses, in loops that fill the lanes of the
    processor.
    """
    track_times, positions, rotations = track
    rays, times, range_noise, bits = out
    words = np.empty(4 * _BLOCK, np.uint32)
    normals, lanes = np.empty(3 * _BLOCK), np.empty(6 * _BLOCK)
    ends = np.empty(3 * _BLOCK, np.int64)
    last = track_times.shape[0] - 1
    count = pulses.shape[0]
    tick = 1.0 / rate
    k = 0
    for start in range(0, count, _BLOCK):
        size = min(_BLOCK, count - start)
        _draw(first_pulse, pulses, start, size, key, words)
        _deviates(words, 3 * size, quantiles, ends, normals)
        before = k
        for s in range(offsets.shape[0]):
            row, k = s * count + start, before
            salt = int(offsets[s, 2])
            for n in range(size):
                i = pulses[start + n]
                times[row + n] = (first_pulse + i) * tick
                range_noise[row + n] = normals[2 * size + n]
                own = words[3 * size + n]
                bits[row + n] = own if salt == 0 else hashed(own, salt)
                for axis in range(3):
                    lanes[axis * _BLOCK + n] = nominal[i, axis]
                lanes[3 * _BLOCK + n] = angle_sigma * normals[n] + offsets[s, 0]
                lanes[4 * _BLOCK + n] = angle_sigma * normals[size + n] + offsets[s, 1]
            done = 0
            while done < size:
                while k < last and track_times[k + 1] < times[row + done]:
                    k += 1
                j = min(k + 1, last)
                slope = 1.0 / (track_times[j] - track_times[k]) if j > k else 0.0
                end = done
                while end < size and (k == last or times[row + end] <= track_times[j]):
                    passed = (times[row + end] - track_times[k]) * slope
                    lanes[5 * _BLOCK + end] = min(max(passed, 0.0), 1.0)
                    end += 1
                _turn(lanes, done, end, positions[k], positions[j], rotations[k], rotations[j])
                done = end
            for n in range(size):
                for axis in range(6):
                    rays[row + n, axis] = lanes[axis * _BLOCK + n]


@njit(cache=True, nogil=True, error_model="numpy")
def _draw(
    first_pulse: int, pulses: Indices, start: int, count: int, key: np.uint64, words: Uint32
) -> None:
    """Random words of ``count`` pulses: three for deviates and their own, one kind after another in
    ``words`` (4 * count,)."""
    for n in range(count):
        place = np.uint64(first_pulse + pulses[start + n])
        place = np.uint64(np.uint64(2) * place + np.uint64(1))
        one = _mix(np.uint64(key + _GOLDEN * place))
        two = _mix(np.uint64(key + _GOLDEN * np.uint64(place + np.uint64(1))))
        words[n], words[count + n] = np.uint32(one), np.uint32(one >> np.uint64(32))
        words[2 * count + n], words[3 * count + n] = np.uint32(two), np.uint32(two >> np.uint64(32))


@njit(cache=True, nogil=True, error_model="numpy")
def _deviates(words: Uint32, count: int, quantiles: Array, ends: Indices, out: Array) -> None:
    """`normal_in` of the first ``count`` of ``words``; notes those in the tails in ``ends``."""
    for n in range(count):
        cell = words[n] >> _REST
        low = quantiles[cell]
        part = (words[n] & _IN_CELL) * (1.0 / _CELL)
        out[n] = low + part * (quantiles[cell + np.uint32(1)] - low)
    found = 0
    for n in range(count):  # apart from the tails, so that not all lanes work on them
        ends[found] = n
        found += int(np.uint32(words[n] + _CELL) < np.uint32(2 * _CELL))
    for n in ends[:found]:
        out[n] = _tail(int(words[n]))


@njit(cache=True, forceinline=True, error_model="numpy")
def _turn(
    lanes: Array,
    start: int,
    end: int,
    position: Array,
    next_position: Array,
    rotation: Array,
    next_rotation: Array,
) -> None:
    """Turns the pulses ``start`` to ``end`` of a block, ``lanes`` (6 * _BLOCK,): nominal direction,
    angles off it, fraction of the way to the next pose, into origins and unit directions."""
    a00, a01, a02 = rotation[0, 0], rotation[0, 1], rotation[0, 2]
    a10, a11, a12 = rotation[1, 0], rotation[1, 1], rotation[1, 2]
    a20, a21, a22 = rotation[2, 0], rotation[2, 1], rotation[2, 2]
    b00, b01, b02 = next_rotation[0, 0], next_rotation[0, 1], next_rotation[0, 2]
    b10, b11, b12 = next_rotation[1, 0], next_rotation[1, 1], next_rotation[1, 2]
    b20, b21, b22 = next_rotation[2, 0], next_rotation[2, 1], next_rotation[2, 2]
    ax, ay, az = position[0], position[1], position[2]
    bx, by, bz = next_position[0], next_position[1], next_position[2]
    for m in range(end - start):
        n = np.uint64(start) + np.uint64(m)  # unsigned: else no lanes are filled
        x, y, z = lanes[n], lanes[_Y + n], lanes[_Z + n]
        u, v, f = lanes[_U + n], lanes[_V + n], lanes[_W + n]
        # The nearer of x and y to the beam's plane of view spans it: no pole within any pattern.
        along_x = abs(x) < 0.99
        other = y if along_x else x
        inverse = 1.0 / np.sqrt(other * other + z * z)
        along, beside = 1.0 / inverse, -x * y * inverse
        ux, uy, uz = (
            (along, beside, -x * z * inverse) if along_x else (z * inverse, 0.0, -x * inverse)
        )
        vx, vy, vz = (
            (0.0, z * inverse, -y * inverse) if along_x else (beside, along, -y * z * inverse)
        )
        lx, ly, lz = x + u * ux + v * vx, y + u * uy + v * vy, z + u * uz + v * vz
        e = 1.0 - f
        # Neighbouring poses differ by fractions of a degree: the chord serves for the arc.
        dx = e * (a00 * lx + a01 * ly + a02 * lz) + f * (b00 * lx + b01 * ly + b02 * lz)
        dy = e * (a10 * lx + a11 * ly + a12 * lz) + f * (b10 * lx + b11 * ly + b12 * lz)
        dz = e * (a20 * lx + a21 * ly + a22 * lz) + f * (b20 * lx + b21 * ly + b22 * lz)
        scale = 1.0 / np.sqrt(dx * dx + dy * dy + dz * dz)
        lanes[n], lanes[_Y + n], lanes[_Z + n] = e * ax + f * bx, e * ay + f * by, e * az + f * bz
        lanes[_U + n], lanes[_V + n], lanes[_W + n] = dx * scale, dy * scale, dz * scale


@njit(cache=True, nogil=True, error_model="numpy")
def in_view(lidar: Track, body: Track, center: Array, radius: float, cone_rad: float) -> bool:
    """True if a moving body (``center`` (3,) in its own frame) may come into a cone about the
    LIDAR's z axis."""
    _, eyes, turns = lidar
    _, positions, rotations = body
    middle, half = eyes.shape[0] // 2, positions.shape[0] // 2
    wander = rotated = drift = squared = along = 0.0
    for m in range(eyes.shape[0]):
        for r in range(3):
            wander = max(wander, abs(eyes[m, r] - eyes[middle, r]))
            rotated = max(rotated, abs(turns[m, r, 2] - turns[middle, r, 2]))
    for r in range(3):
        first = 0.0
        for m in range(positions.shape[0]):
            at = positions[m, r]
            for c in range(3):
                at += rotations[m, r, c] * center[c]
            if m == 0:
                first = at
            drift = max(drift, abs(at - first))
            if m == half:
                squared += (at - eyes[middle, r]) ** 2
                along += (at - eyes[middle, r]) * turns[middle, r, 2]
    distance, reach = math.sqrt(squared), radius + 2.0 * (wander + drift)
    if reach >= distance:
        return True
    off_axis = math.acos(min(max(along / distance, -1.0), 1.0))
    return off_axis - math.asin(reach / distance) - 2.0 * rotated <= cone_rad


@njit(cache=True, nogil=True, error_model="numpy")
def rays_near(
    rays: Float32, times: Array, track: Track, center: Array, radius: float
) -> tuple[Indices, Float32]:
    """The rays (N, 6), fired at ``times`` (N,), that pass through the bounding sphere of
    a moving body (``center`` (3,) in its own frame): their indices (K,), and (K, 6) themselves in
    the body's frame at their own instants."""
    track_times, positions, rotations = track
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
        if track_times[k] > times[i]:
            k = 0
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
