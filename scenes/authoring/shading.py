"""The texels of a ground's texture: materials with their patterns, noise, stains and marking paint,
in their light."""

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import ndimage

from touchdown.scenes.api import Array, Bytes, Float32

_PIECE = 512
"""Texels of a row that are shaded together: what is held of them fits the fastest cache"""
_BLOCK = 16
_FRAY = 2.6
"""Texels by which edges are ragged, for each standard deviation of the noise"""


def ragged_texels(*noises: Float32) -> int:
    """The width of blocks over which no edge reaches that ``noises`` make ragged."""
    reach = _FRAY * max(max(float(noise.max()), -float(noise.min())) for noise in noises)
    return max(_BLOCK, int(reach))


def mixed_blocks(material: Bytes, side: int) -> NDArray[np.bool_]:
    """Whether a block of ``side`` texels and its neighbours are of several materials."""
    bands = [material[row : row + side] for row in range(0, len(material), side)]
    cols = np.arange(0, material.shape[1], side)
    low = np.minimum.reduceat([band.min(axis=0) for band in bands], cols, axis=1)
    high = np.maximum.reduceat([band.max(axis=0) for band in bands], cols, axis=1)
    around = {"size": 3, "mode": "nearest"}
    near = ndimage.minimum_filter(low, **around) != ndimage.maximum_filter(high, **around)
    return np.asarray(near)


@njit(cache=True, error_model="numpy")
def shade(
    image: Bytes,
    material: Bytes,
    paint: Bytes,
    stain: Bytes,
    bright: Bytes,
    slopes: Bytes,
    fine: Float32,
    coarse: Float32,
    patches: Float32,
    hue: Float32,
    base: Float32,
    gains: Float32,
    hues: Float32,
    ragged: Bytes,
    frames: Array,
    texel_m: float,
    mixed: NDArray[np.bool_],
    side: int,
    salt: int,
) -> None:
    """Fills ``image`` (rows, cols, 3), the texture of a canvas' ``material``, ``paint`` and
    ``stain`` (rows, cols) under the light ``bright`` and, where there are any, ``slopes``. All
    noise is addressed so that nothing repeats in step: the tiles ``fine`` and ``coarse`` are turned
    against each other, and grain is hashed from the texel's number. ``base``, ``gains``, ``hues``,
    ``ragged`` and ``frames`` have a row for each material. ``coarse`` is flat; ``mixed``: see
    `mixed_blocks`; ``side``: texels of a block, no fewer than `ragged_texels`.

    It goes along pieces of rows in loops of few operations, of which the compiler makes vector
    instructions; each texel's numbers are worked out in the same order whatever the piece."""
    rows, cols = material.shape
    tile = fine.shape[0] - 1
    to_patch = (patches.shape[0] - 1.001) / rows
    half = 0.5 * rows * texel_m
    first_noise, second_noise = np.empty(_PIECE, np.float32), np.empty(_PIECE, np.float32)
    kinds = np.empty(_PIECE, np.uint8)
    tone, grain, colour = np.empty(_PIECE), np.empty(_PIECE), np.empty((3, _PIECE))
    patch, drift = np.empty(_PIECE), np.empty(_PIECE)
    ends = np.empty((4, cols))
    node = -1
    for row in range(rows):
        y = (row + 0.5) * texel_m - half
        fraction = row * to_patch
        if min(int(fraction), patches.shape[0] - 2) != node:
            node = min(int(fraction), patches.shape[0] - 2)
            for k in range(2):
                _stretch(ends[k], patches[node + k], to_patch)
                _stretch(ends[2 + k], hue[node + k], to_patch)
        fraction -= node
        for first in range(0, cols, _PIECE):
            last = min(first + _PIECE, cols)
            n = last - first
            a, b, here = first_noise[:n], second_noise[:n], kinds[:n]
            _mix(patch[:n], ends[0, first:last], ends[1, first:last], fraction)
            _mix(drift[:n], ends[2, first:last], ends[3, first:last], fraction)
            start = first & tile  # a piece lies in one tile
            noise, canvas = fine[row & tile, start : start + n], material[row, first:last]
            for k in range(n):
                a[k] = noise[k]
            for k in range(n):
                here[k] = canvas[k]
            _turn(b, coarse, tile, row, first)
            _hashes(grain[:n], row, first, salt)
            for k in range(n):
                grain[k] = 2.0 * grain[k] - 1.0
            _fray(here, a, b, material, mixed, side, ragged, row, first)
            start = 0
            while start < n:
                kind, end = int(here[start]), start + 1
                while end < n and here[end] == kind:
                    end += 1
                run, left = slice(start, end), first + start
                _pave(tone[run], kind, frames[kind], left, y, texel_m, half, salt)
                _vary(tone[run], a[run], b[run], grain[run], patch[run], gains[kind])
                if ragged[kind]:
                    _strew(tone[run], row, left, kind, salt)
                _soil(tone[run], stain[row, left : first + end])
                for k in range(3):
                    _tint(colour[k, run], tone[run], drift[run], base[kind, k], hues[kind, k])
                if kind == 26:
                    _sprout(colour, tone, a, b, start, end, frames[kind], first, y, texel_m, half)
                if kind <= 1:
                    _bloom(colour, tone, drift, start, end, kind, row, first, salt)
                start = end
            _mark(colour, paint[row, first:last], a, b, grain, patch)
            lit = bright[row, first:last]
            for k in range(n):
                tone[k] = lit[k] * (1.0 / 255.0)
            if slopes.shape[0] > 0:
                level = slopes[row, first:last]
                for k in range(n):
                    tone[k] *= level[k] * (1.0 / 128.0)
            _quantize(image[rows - 1 - row, first:last], colour, tone)


@njit(cache=True, error_model="numpy")
def _fray(
    here: Bytes,
    a: Float32,
    b: Float32,
    material: Bytes,
    mixed: NDArray[np.bool_],
    side: int,
    ragged: Bytes,
    row: int,
    first: int,
) -> None:
    """Makes edges ragged: a texel takes the material of one that the noises ``a`` and ``b`` point
    to. Where nothing is mixed it would find its own."""
    rows, cols = material.shape
    last = first + here.size
    for block in range(first // side, (last - 1) // side + 1):
        if not mixed[row // side, block]:
            continue
        for k in range(max(block * side, first) - first, min((block + 1) * side, last) - first):
            if ragged[here[k]]:
                near_row = min(max(row + int(_FRAY * a[k]), 0), rows - 1)
                near_col = min(max(first + k + int(_FRAY * b[k]), 0), cols - 1)
                near = material[near_row, near_col]
                if ragged[near]:
                    here[k] = near


@njit(cache=True, error_model="numpy")
def _stretch(out: Array, nodes: Float32, to_node: float) -> None:
    for k in range(out.size):
        at = min(int(k * to_node), nodes.size - 2)
        fraction = k * to_node - at
        out[k] = nodes[at] * (1.0 - fraction) + nodes[at + 1] * fraction


@njit(cache=True, error_model="numpy")
def _mix(out: Array, one: Array, other: Array, fraction: float) -> None:
    for k in range(out.size):
        out[k] = one[k] * (1.0 - fraction) + other[k] * fraction


@njit(cache=True, error_model="numpy")
def _turn(out: Float32, coarse: Float32, tile: int, row: int, first: int) -> None:
    """``coarse`` along a row that is turned by atan(3/4)."""
    places = np.empty(out.size, np.uint32)
    for k in range(out.size):
        col = first + k
        i = np.int32(0.8 * row + 0.6 * col) & tile
        j = np.int32(0.8 * col - 0.6 * row) & tile
        places[k] = np.uint32(i * (tile + 1) + j)
    for k in range(out.size):
        out[k] = coarse[places[k]]


@njit(cache=True, error_model="numpy")
def _hash(a: int, b: int, salt: int) -> float:
    """Uniform in [0, 1) from two integers."""
    value = (a * 73856093) ^ (b * 19349663) ^ (salt * 83492791)
    value &= 0xFFFFFFFF
    value = ((value ^ (value >> 15)) * 0x2C1B3C6D) & 0xFFFFFFFF
    value = ((value ^ (value >> 12)) * 0x297A2D39) & 0xFFFFFFFF
    value ^= value >> 15
    return value / 4294967296.0


@njit(cache=True, error_model="numpy")
def _hashes(out: Array, row: int, first: int, salt: int) -> None:
    """`_hash` of a row's texels, in numbers of 32 bits."""
    start = np.uint32((row * 73856093) ^ (salt * 83492791))
    for k in range(out.size):
        value = np.uint32(start ^ np.uint32((first + k) * 19349663))
        value = np.uint32(np.uint32(value ^ (value >> np.uint32(15))) * np.uint32(0x2C1B3C6D))
        value = np.uint32(np.uint32(value ^ (value >> np.uint32(12))) * np.uint32(0x297A2D39))
        out[k] = np.uint32(value ^ (value >> np.uint32(15))) / 4294967296.0


@njit(cache=True, error_model="numpy")
def _slab(u: float, v: float, length: float, width: float, joint: float, salt: int) -> float:
    """Relative tone of slabs in running bond with dark joints."""
    course = np.floor(v / width)
    shifted = u / length + 0.5 * (int(course) & 1)
    number = np.floor(shifted)
    if v - course * width < joint or (shifted - number) * length < joint:
        return -0.24
    return 0.13 * (_hash(int(course), int(number), salt) - 0.5)


@njit(cache=True, error_model="numpy")
def _first_half(turns: float) -> bool:
    """Where the sine of a turn is positive."""
    return turns - np.floor(turns) < 0.5


@njit(cache=True, error_model="numpy")
def _pattern(material: int, u: float, v: float, salt: int) -> float:
    """Relative tone of a material's regular pattern at (u, v) metres in its own frame."""
    if material == 3 or material == 4:
        return _slab(u, v, 0.8, 0.5, 0.03, salt)
    if material == 8:
        return _slab(u, v, 0.4, 0.2, 0.026, salt)
    if material == 0:
        return 0.055 if _first_half(v / 2.6) else -0.055
    if material == 15:
        return 0.075 if _first_half(v / 11.0) else -0.075
    if material == 16:
        return 0.035 if np.sin(np.pi * u / 1.5) * np.sin(np.pi * v / 1.5) > 0.0 else -0.035
    if material == 14:
        return 0.03 * np.sin(2.0 * np.pi * v / 0.16)
    if material == 2:
        return 0.13 * np.sin(2.0 * np.pi * v / 0.75)
    if material == 19:
        return _slab(u, v, 0.6, 0.6, 0.02, salt)
    if material == 20:
        return _slab(u, v, 2.4, 0.15, 0.02, salt)
    if material == 21:
        return 0.07 if _first_half(u / 8.0) else -0.07
    if material == 24:
        return 1.3 * _slab(u, v, 0.17, 0.13, 0.022, salt)
    return 0.0


@njit(cache=True, error_model="numpy")
def _pave(
    tone: Array,
    material: int,
    frame: Array,
    first: int,
    y: float,
    texel_m: float,
    half: float,
    salt: int,
) -> None:
    """The tone of a run of one material with its regular pattern."""
    c, s = frame[0], frame[1]
    if material == 0:  # of a constant the compiler makes a loop without branches
        for k in range(tone.size):
            x = (first + k + 0.5) * texel_m - half
            tone[k] = 1.0 + _pattern(0, c * x + s * y, c * y - s * x, salt)
    elif 2 <= material <= 4 or material == 8 or material >= 14:
        for k in range(tone.size):
            x = (first + k + 0.5) * texel_m - half
            tone[k] = 1.0 + _pattern(material, c * x + s * y, c * y - s * x, salt)
    else:
        for k in range(tone.size):
            tone[k] = 1.0


@njit(cache=True, error_model="numpy")
def _vary(tone: Array, a: Float32, b: Float32, grain: Array, patch: Array, gains: Float32) -> None:
    of_a, of_b, of_grain, of_patch = gains[0], gains[1], gains[2], gains[3]
    for k in range(tone.size):
        level = tone[k] + (of_a * a[k] + of_b * b[k])
        tone[k] = level + (of_grain * grain[k] + of_patch * patch[k])


@njit(cache=True, error_model="numpy")
def _strew(tone: Array, row: int, first: int, material: int, salt: int) -> None:
    """Tufts, clods and stones: in some cells of 7 texels lies one with a sharp outline, so that
    there are corners to track at the scale of a camera's pixel."""
    cell_row = row // 7
    for cell_col in range(first // 7, (first + tone.size - 1) // 7 + 1):
        pick = _hash(cell_row, cell_col, salt + 7 + material)
        if pick > 0.26:
            continue
        place = _hash(cell_col, cell_row, salt + 13)
        down = row - cell_row * 7 - 2.0 - 2.0 * place
        aside = 2.0 * ((place * 64.0) % 1.0)
        wide, radius = 0.6 + pick * 3.4, 1.0 + 5.5 * pick
        light = -0.27 if place < 0.60 else 0.25
        start = cell_col * 7 - first
        for k in range(max(start, 0), min(start + 7, tone.size)):
            right = k - start - 2.0 - aside
            if down * down + wide * right * right <= radius * radius:
                tone[k] += light


@njit(cache=True, error_model="numpy")
def _soil(tone: Array, stain: Bytes) -> None:
    for k in range(tone.size):
        tone[k] *= 1.0 - 0.62 * (stain[k] * (1.0 / 255.0))


@njit(cache=True, error_model="numpy")
def _tint(out: Array, tone: Array, drift: Array, base: float, hue: float) -> None:
    for k in range(tone.size):
        out[k] = base * tone[k] + hue * drift[k]


@njit(cache=True, error_model="numpy")
def _sprout(
    colour: Array,
    tone: Array,
    a: Float32,
    b: Float32,
    start: int,
    end: int,
    frame: Array,
    first: int,
    y: float,
    texel_m: float,
    half: float,
) -> None:
    """Leaves of crops, in rows."""
    for k in range(start, end):
        x = (first + k + 0.5) * texel_m - half
        across = frame[0] * y - frame[1] * x
        leaf = np.sin(2.0 * np.pi * across / 0.5) + 0.45 * a[k] + 0.45 * b[k]
        if leaf > 0.25:
            lit = tone[k] * (0.8 + 0.35 * min(leaf, 1.2))
            colour[0, k], colour[1, k], colour[2, k] = 70.0 * lit, 112.0 * lit, 44.0 * lit


@njit(cache=True, error_model="numpy")
def _bloom(
    colour: Array,
    chance: Array,
    drift: Array,
    start: int,
    end: int,
    material: int,
    row: int,
    first: int,
    salt: int,
) -> None:
    """Flowers, in some parts of lawns and meadows; ``chance`` is overwritten."""
    _hashes(chance[start:end], row, first + start, salt + 1)
    for k in range(start, end):
        if chance[k] > 0.9988 and drift[k] + 0.5 * material > 0.35:
            colour[0, k], colour[1, k] = 216.0, 208.0
            colour[2, k] = 90.0 if chance[k] > 0.9994 else 204.0


@njit(cache=True, error_model="numpy")
def _mark(colour: Array, paint: Bytes, a: Float32, b: Float32, grain: Array, patch: Array) -> None:
    """Worn marking paint."""
    for k in range(paint.size):
        if paint[k] > 0:
            cover = paint[k] * (1.0 / 255.0)
            cover *= min(max(0.93 + 0.17 * b[k] + 0.16 * a[k], 0.25), 1.0)
            white = 222.0 * (1.0 + 0.03 * grain[k] + 0.03 * patch[k])
            colour[0, k] += cover * (white - colour[0, k])
            colour[1, k] += cover * (white - colour[1, k])
            colour[2, k] += cover * (0.985 * white - colour[2, k])


@njit(cache=True, error_model="numpy")
def _quantize(image: Bytes, colour: Array, glow: Array) -> None:
    """Colours in their light. Skylight is bluer than sunlight."""
    n = image.shape[0]
    levels = np.empty((3, n), np.uint8)
    red, green, blue = levels[0], levels[1], levels[2]
    for k in range(n):
        red[k] = np.int32(min(max(colour[0, k] * glow[k], 0.0), 255.0))
    for k in range(n):
        green[k] = np.int32(min(max(colour[1, k] * glow[k], 0.0), 255.0))
    for k in range(n):
        cool = 1.0 + 0.10 * (1.0 - glow[k])
        blue[k] = np.int32(min(max(colour[2, k] * glow[k] * cool, 0.0), 255.0))
    for k in range(n):
        image[k, 0], image[k, 1], image[k, 2] = red[k], green[k], blue[k]
