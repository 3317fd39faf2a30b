"""Matching of features with the landmarks of the map, near their predicted pixels."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from touchdown.estimator.typing import Array, Bytes, Indices
from touchdown.estimator.zou2024.landmarks import SIFT

_TWIN_PX = 6.0
"""candidates closer than this to the best one may be duplicates of it in the map"""
_SIFT_LIMIT = 300.0
_BRISK_LIMIT = 140.0
_RATIO = 0.85


def _descriptor_distances(own: Bytes, other: Bytes, binary: bool) -> Array:
    """Hamming distances (N,) of bit strings (N, D), else squared Euclidean ones."""
    if binary:
        return np.bitwise_count(own ^ other).sum(axis=1, dtype=np.float64)
    return np.square(own.astype(np.float32) - other).sum(axis=1).astype(np.float64)


def match_near(
    kind: int, pixels: Array, descriptors: Bytes, expected: Array, known: Bytes, radius_px: float
) -> Indices:
    """Returns, for each of (F, 2) features, the index of its landmark, or -1.

    ``expected`` (L, 2): predicted pixels of the landmarks with descriptors ``known`` (L, D); only
    those within ``radius_px`` of a feature are compared. A match must be clearly better (by a ratio
    of descriptor distances) than any candidate elsewhere, and each landmark matches once.
    """
    binary, result = kind != SIFT, np.full(len(pixels), -1)
    limit, ratio = (_BRISK_LIMIT, _RATIO) if binary else (_SIFT_LIMIT**2, _RATIO**2)
    if len(expected) == 0 or len(pixels) == 0:
        return result
    near = cKDTree(expected).query_ball_point(pixels, radius_px)
    counts = np.array([len(candidates) for candidates in near])
    feature, landmark = np.repeat(np.arange(len(pixels)), counts), np.concatenate(near).astype(int)
    if len(landmark) == 0:
        return result
    length = _descriptor_distances(descriptors[feature], known[landmark], binary)
    # the nearest of each feature first; of equals that of the first cell of the image
    column, row = ((expected - expected.min(axis=0)) // radius_px)[landmark].T
    order = np.lexsort((landmark, column, row, length, feature))
    feature, landmark, length = feature[order], landmark[order], length[order]
    best = np.flatnonzero(np.diff(feature, prepend=-1))
    own = np.repeat(best, counts[counts > 0])
    apart = np.square(expected[landmark] - expected[landmark[own]]).sum(axis=1) > _TWIN_PX**2
    rivalled = own[apart & (length[own] > ratio * length)]
    sure = np.setdiff1d(best[length[best] <= limit], rivalled)
    sure = sure[np.lexsort((length[sure], landmark[sure]))]
    sure = sure[np.diff(landmark[sure], prepend=-1) > 0]
    result[feature[sure]] = landmark[sure]
    return result
