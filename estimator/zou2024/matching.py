"""Matching of features with the landmarks of the map, near their predicted pixels."""

from __future__ import annotations

import numpy as np
from numba import njit

from touchdown.estimator.typing import Array, Bytes, Indices
from touchdown.estimator.zou2024.landmarks import SIFT

_BITS = np.array([bin(byte).count("1") for byte in range(256)], dtype=np.uint8)
_TWIN_PX = 6.0
"""candidates closer than this to the best one may be duplicates of it in the map"""
_SIFT_LIMIT = 300.0
_BRISK_LIMIT = 140.0


@njit(cache=True)
def descriptor_distance(a: Bytes, b: Bytes, bits: Bytes, binary: bool, limit: float) -> float:
    """Hamming distance of bit strings, else squared Euclidean distance; stops beyond ``limit``."""
    total = 0
    for i in range(a.shape[0]):
        if binary:
            total += int(bits[a[i] ^ b[i]])
        else:
            d = int(a[i]) - int(b[i])
            total += d * d
        if total > limit and i % 16 == 15:
            break
    return float(total)


@njit(cache=True)
def _match(
    pixels: Array,
    descriptors: Bytes,
    expected: Array,
    known: Bytes,
    radius: float,
    limit: float,
    ratio: float,
    binary: bool,
) -> Indices:
    """See ``match_near``; distances squared where not ``binary``."""
    count, landmarks = pixels.shape[0], expected.shape[0]
    result = np.full(count, -1, dtype=np.int64)
    if landmarks == 0 or count == 0:
        return result
    low_u, low_v = expected[:, 0].min(), expected[:, 1].min()
    cols = int((expected[:, 0].max() - low_u) / radius) + 1
    rows = int((expected[:, 1].max() - low_v) / radius) + 1
    starts = np.zeros(rows * cols + 1, dtype=np.int64)
    cell = np.empty(landmarks, dtype=np.int64)
    for m in range(landmarks):
        cell[m] = int((expected[m, 1] - low_v) / radius) * cols
        cell[m] += int((expected[m, 0] - low_u) / radius)
        starts[cell[m] + 1] += 1
    for c in range(rows * cols):
        starts[c + 1] += starts[c]
    cursor = starts[:-1].copy()
    members = np.empty(landmarks, dtype=np.int64)
    for m in range(landmarks):
        members[cursor[cell[m]]] = m
        cursor[cell[m]] += 1
    taken = np.full(landmarks, -1, dtype=np.int64)
    taken_by = np.full(landmarks, np.inf)
    near = np.empty(landmarks, dtype=np.int64)
    distance = np.empty(landmarks)
    for f in range(count):
        col = int(np.floor((pixels[f, 0] - low_u) / radius))
        row = int(np.floor((pixels[f, 1] - low_v) / radius))
        have, best, best_distance = 0, -1, np.inf
        for r in range(max(row - 1, 0), min(row + 2, rows)):
            for c in range(max(col - 1, 0), min(col + 2, cols)):
                for at in range(starts[r * cols + c], starts[r * cols + c + 1]):
                    m = members[at]
                    du, dv = expected[m, 0] - pixels[f, 0], expected[m, 1] - pixels[f, 1]
                    if du * du + dv * dv > radius * radius:
                        continue
                    d = descriptor_distance(
                        descriptors[f], known[m], _BITS, binary, limit / (ratio * ratio)
                    )
                    near[have], distance[have] = m, d
                    have += 1
                    if d < best_distance:
                        best, best_distance = m, d
        if best < 0 or best_distance > limit:
            continue
        clear = True
        for k in range(have):
            du = expected[near[k], 0] - expected[best, 0]
            dv = expected[near[k], 1] - expected[best, 1]
            if du * du + dv * dv > _TWIN_PX * _TWIN_PX and best_distance > ratio * distance[k]:
                clear = False
        if not clear or best_distance >= taken_by[best]:
            continue
        if taken[best] >= 0:
            result[taken[best]] = -1
        result[f], taken[best], taken_by[best] = best, f, best_distance
    return result


def match_near(
    kind: int,
    pixels: Array,
    descriptors: Bytes,
    expected: Array,
    known: Bytes,
    radius_px: float,
    ratio: float = 0.85,
) -> Indices:
    """Returns, for each of (F, 2) features, the index of its landmark, or -1.

    ``expected`` (L, 2): predicted pixels of the landmarks with descriptors ``known`` (L, D); only
    those within ``radius_px`` of a feature are compared. A match must be clearly better (``ratio``
    of descriptor distances) than any candidate elsewhere, and each landmark matches once.
    """
    binary = kind != SIFT
    limit = _BRISK_LIMIT if binary else _SIFT_LIMIT**2
    used_ratio = ratio if binary else ratio**2
    return _match(pixels, descriptors, expected, known, radius_px, limit, used_ratio, binary)
