"""Photographs multiplied into a drawn raster: the kernels of `detail_texture`."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from touchdown.scenes.api import NO_DETAIL_ID
from touchdown.sim.typing import Array, Bytes, Float32

SIDE_BITS = 10
SIDE_PX = 1 << SIDE_BITS
FAR_M = 10.0
"""Depth beyond which nothing is added; it fades in over the next `_FADE_M` towards the camera."""
_FADE_M = 4.0
TOLERANCE_M = 0.16
"""What lies nearer to the ground's height than this is ground: a cell's corner lies 0.11 m off its
middle on a slope of 32 degrees."""
NOISE_CELL_M = 0.0625
LEVELS = 6
TURN = 0.7986 * 0.91, 0.6018 * 0.91
"""cosine and sine of the second layer's turn, at its scale"""
_RUN = 16
"""pixels"""
_FLAT_M = 0.01
"""Depths that lie nearer to a run's plane than this are on it."""


@njit(cache=True, nogil=True, error_model="numpy")
def multiply_texture(
    image: Bytes,
    depth: Float32,
    inverse_far: np.float32,
    per_level: np.float32,
    eye: Array,
    rays: Float32,
    frame: Array,
    height: Float32,
    kind: Bytes,
    texels: NDArray[np.uint32],
    starts: NDArray[np.int64],
    texels_per_m: Float32,
    noise: Float32,
    metres_per_pixel: np.float32,
) -> None:
    """Multiplies the detail texture into ``image`` (rows, W, 3). depth: (rows, W), 1 / metres along
    the axis is ``inverse_far`` + ``per_level`` times it; rays: (3, 3) direction of pixel (0, 0),
    its changes per column and row; frame: origin and cells per metre of ``height`` and ``kind``;
    texels, starts: as `Pyramid`; metres_per_pixel: at 1 m.

    Rows go in runs of `_RUN` pixels. Where both ends of a run lie on one material and its depths
    on one plane, places between them are interpolated; elsewhere each pixel is its own run."""
    rows, cols = depth.shape
    one, zero, last = np.float32(1.0), np.float32(0.0), cols - 1
    far, near = np.float32(FAR_M), np.float32(FAR_M - _FADE_M)
    coarse, half = np.float32(1.4), np.float32(0.5)
    slack, rounding, full = np.float32(_FLAT_M) / per_level, np.float32(0.5), np.float32(255.0)
    factors = np.empty((cols, 3), np.float32)
    line = factors.reshape(3 * cols)
    for i in range(rows):
        start, textured = 0, False
        line[:] = one
        this = _place(0, i, depth, inverse_far, per_level, eye, rays, frame, height, kind, noise)
        while start < cols:
            stop = min(start + _RUN, cols)
            end = min(stop, last)
            then = _place(
                end, i, depth, inverse_far, per_level, eye, rays, frame, height, kind, noise
            )
            part = one / np.float32(max(end - start, 1))
            rise = (depth[i, end] - depth[i, start]) * part
            off = zero
            for j in range(start, stop):
                off = max(off, abs(depth[i, start] + np.float32(j - start) * rise - depth[i, j]))
            whole = this[0] == then[0] and off * this[3] * this[3] < slack
            if whole and this[0] == NO_DETAIL_ID:
                start, this = stop, then
                continue
            for at in range(start, stop, stop - start if whole else 1):
                count, a, b = stop - start, this, then
                if not whole:
                    count, part = 1, zero
                    a = _place(
                        at, i, depth, inverse_far, per_level, eye, rays, frame, height, kind, noise
                    )
                    b = a
                layer, x, y, d, fraction = a
                if layer == NO_DETAIL_ID:
                    continue
                scale, level = texels_per_m[layer], 0
                size = d * metres_per_pixel * scale
                while size > coarse and level < LEVELS - 1:
                    size, scale, level = size * half, scale * half, level + 1
                shift = SIDE_BITS - level
                layers = texels[starts[layer, level] :]
                strength = min(one, (far - d) / (far - near))
                step = (b[1] - x) * part * scale, (b[2] - y) * part * scale
                fractions = fraction, (b[4] - fraction) * part
                textured = True
                _texture_run(
                    factors[at : at + count], layers, shift, (x * scale, y * scale), step,
                    fractions,
                    size, strength, frame[4] * scale,
                )  # fmt: skip
            start, this = stop, then
        if textured:
            pixels = image[i].reshape(3 * cols)
            for j in range(3 * cols):
                value = np.float32(pixels[j]) * line[j] + rounding
                pixels[j] = np.uint8(np.int32(min(value, full)))


@njit(cache=True, nogil=True, forceinline=True, error_model="numpy")
def _place(
    j: int, i: int, depth: Float32, inverse_far: np.float32, per_level: np.float32, eye: Array,
    rays: Float32, frame: Array, height: Float32, kind: Bytes, noise: Float32,
) -> tuple[int, np.float32, np.float32, np.float32, np.float32]:  # fmt: skip
    """Photograph of pixel (i, j) or `NO_DETAIL_ID`, its place (x, y) in metres from the map's
    corner, its depth in metres, and the fraction of the first layer there."""
    zero = np.float32(0.0)
    d = np.float32(1.0) / max(inverse_far + per_level * depth[i, j], np.float32(1e-6))
    right, up = np.float32(j), np.float32(i)
    x = np.float32(eye[0] - frame[0]) + d * (rays[0, 0] + up * rays[2, 0] + right * rays[1, 0])
    y = np.float32(eye[1] - frame[1]) + d * (rays[0, 1] + up * rays[2, 1] + right * rays[1, 1])
    if d >= np.float32(FAR_M) or x < zero or y < zero:
        return NO_DETAIL_ID, x, y, d, zero
    row, col = np.int32(y * frame[2]), np.int32(x * frame[2])
    if row >= height.shape[0] or col >= height.shape[1]:
        return NO_DETAIL_ID, x, y, d, zero
    z = np.float32(eye[2]) + d * (rays[0, 2] + up * rays[2, 2] + right * rays[1, 2])
    if abs(z - height[row, col]) > TOLERANCE_M:
        return NO_DETAIL_ID, x, y, d, zero
    row, col = np.int32(y * frame[3]), np.int32(x * frame[3])
    if row >= kind.shape[0] or col >= kind.shape[1]:
        return NO_DETAIL_ID, x, y, d, zero
    wrap, cells = noise.shape[0] - 1, np.float32(1.0 / NOISE_CELL_M)
    fraction = noise[np.int32(y * cells) & wrap, np.int32(x * cells) & wrap]
    return int(kind[row, col]), x, y, d, fraction


@njit(cache=True, nogil=True, error_model="numpy")
def _texture_run(
    factors: Float32, texels: NDArray[np.uint32], shift: int, place: tuple[np.float32, np.float32],
    step: tuple[np.float32, np.float32], fractions: tuple[np.float32, np.float32],
    size: np.float32, strength: np.float32, beyond: float,
) -> None:  # fmt: skip
    """Writes one photograph's (N, 3) factors at ``place`` and on by ``step``, in texels of a level;
    shares: of the first layer, and its change."""
    zero, one = np.float32(0.0), np.float32(1.0)
    turn_c, turn_s = np.float32(TURN[0]), np.float32(TURN[1])
    part = strength / np.float32(128.0)
    base, ahead = one - strength, np.float32(beyond)
    for j in range(len(factors)):
        count = np.float32(j)
        x, y = place[0] + count * step[0], place[1] + count * step[1]
        fraction = fractions[0] + count * fractions[1]
        red, green, blue = base, base, base
        if fraction > zero:
            r, g, b = _texel(texels, shift, y, x, size)
            weight = fraction * part
            red, green, blue = red + weight * r, green + weight * g, blue + weight * b
        if fraction < one:
            weight = (one - fraction) * part
            u = turn_c * x + turn_s * y
            v = turn_c * y - turn_s * x + ahead
            r, g, b = _texel(texels, shift, v, u, size)
            red, green, blue = red + weight * r, green + weight * g, blue + weight * b
        factors[j, 0], factors[j, 1], factors[j, 2] = red, green, blue


@njit(cache=True, nogil=True, forceinline=True, error_model="numpy")
def _channel(packed: np.uint32, bit: int) -> np.float32:
    return np.float32(np.uint8(packed >> bit))


@njit(cache=True, nogil=True, forceinline=True, error_model="numpy")
def _texel(
    texels: NDArray[np.uint32], shift: int, row: np.float32, col: np.float32, size: np.float32
) -> tuple[np.float32, np.float32, np.float32]:
    """Colour of the periodic image of 1 << ``shift`` texels a side there: of the texel, or between
    neighbours where a pixel's ``size`` in texels is small."""
    wide = np.uintp(shift)
    mask = (np.uintp(1) << wide) - np.uintp(1)
    if size > 0.7:
        packed = texels[((np.uintp(row) & mask) << wide) + (np.uintp(col) & mask)]
        return _channel(packed, 0), _channel(packed, 8), _channel(packed, 16)
    row, col = row + np.float32(mask) + np.float32(0.5), col + np.float32(mask) + np.float32(0.5)
    top, left = np.uintp(row), np.uintp(col)
    v, u = row - np.float32(top), col - np.float32(left)
    i, j = (top & mask) << wide, left & mask
    k, m = (top + np.uintp(1) & mask) << wide, left + np.uintp(1) & mask
    one = np.float32(1.0)
    a, b, c, d = (one - v) * (one - u), (one - v) * u, v * (one - u), v * u
    p, q = texels[i + j], texels[i + m]
    r, s = texels[k + j], texels[k + m]
    return (
        a * _channel(p, 0) + b * _channel(q, 0) + c * _channel(r, 0) + d * _channel(s, 0),
        a * _channel(p, 8) + b * _channel(q, 8) + c * _channel(r, 8) + d * _channel(s, 8),
        a * _channel(p, 16) + b * _channel(q, 16) + c * _channel(r, 16) + d * _channel(s, 16),
    )
