"""Degenerate directions of a scan, such as lateral motion over level ground, and their removal."""

from __future__ import annotations

import numpy as np
from numba import njit

from touchdown.estimator.filtering.error_state import POSE_DIM, POSITION, ROTATION
from touchdown.estimator.typing import Array


def weak_directions(
    information: Array, noise: Array, sigma_rad: float, sigma_m: float
) -> tuple[Array, Array]:
    """Returns the degenerate axes of rotation (3, r) and directions of translation (3, t) as unit
    columns: those whose standard deviation under ``information`` (6, 6), less twice its share of
    ``noise`` (6, 6), exceeds the limits.

    Rotation and translation are treated separately, each after marginalisation of the other (Schur
    complement), so that metres are never weighed against radians. Leaving out such directions
    follows Zhang, Kaess and Singh 2016 ("On degeneracy of optimization-based state estimation
    problems"), here with thresholds in the units of the state.
    """
    return (
        _weak_axes(information, noise, ROTATION, POSITION, sigma_rad),
        _weak_axes(information, noise, POSITION, ROTATION, sigma_m),
    )


def weak_columns(information: Array, noise: Array, sigmas: tuple[float, float]) -> Array:
    """The same as orthonormal columns (6, r + t) over a pose. ``sigmas``: rad and m."""
    axes, directions = weak_directions(information, noise, *sigmas)
    columns = np.zeros((POSE_DIM, axes.shape[1] + directions.shape[1]))
    columns[ROTATION, : axes.shape[1]] = axes
    columns[POSITION, axes.shape[1] :] = directions
    return columns


def rotations_among(weak: Array) -> int:
    """Number of axes of rotation among the columns of ``weak_columns``."""
    return int(weak[ROTATION].any(axis=0).sum())


@njit(cache=True, error_model="numpy")
def _weak_axes(information: Array, noise: Array, own: slice, other: slice, sigma: float) -> Array:
    """The degenerate directions of the three coordinates ``own``, the three others marginalised."""
    # the pseudo-inverse ignores unobserved directions of the other block
    known, axes = np.linalg.eigh(information[other, other].copy())
    following = np.zeros((POSE_DIM, 3))
    for k in range(3):
        following[own.start + k, k] = 1.0
        if known[k] <= 1e-9 * known[2]:
            continue
        for b in range(3):
            share = 0.0
            for a in range(3):
                share += axes[a, k] * information[other.start + a, own.start + b] / known[k]
            for a in range(3):
                following[other.start + a, b] -= axes[a, k] * share
    values, vectors = np.linalg.eigh(_carried(information, following))
    noisy = _carried(_carried(noise, following), vectors)
    weak = np.empty((3, 3))
    count = 0
    for k in range(3):
        if values[k] - 2.0 * noisy[k, k] < 1.0 / sigma**2:
            for a in range(3):
                weak[a, count] = vectors[a, k]
            count += 1
    return weak[:, :count]


@njit(cache=True, error_model="numpy")
def _carried(matrix: Array, columns: Array) -> Array:
    """``columns.T @ matrix @ columns`` of a symmetric (N, N) matrix and (N, 3) columns."""
    out, size = np.zeros((3, 3)), matrix.shape[0]
    for a in range(3):
        for b in range(a + 1):
            for i in range(size):
                for j in range(size):
                    out[a, b] += columns[i, a] * matrix[i, j] * columns[j, b]
            out[b, a] = out[a, b]
    return out


def without_directions(information: Array, vector: Array, weak: Array) -> tuple[Array, Array]:
    """Returns the measurement (D, D), (D,) with the orthonormal columns ``weak`` (6, k), D >= 6,
    marginalised as unknown, so that the remaining information holds for any value of them."""
    if weak.shape[1] == 0:
        return information, vector
    if len(weak) < len(vector):
        weak = np.concatenate([weak, np.zeros((len(vector) - len(weak), weak.shape[1]))])
    across = information @ weak
    explained = across @ np.linalg.pinv(weak.T @ across, rcond=1e-9, hermitian=True)
    keep = np.eye(len(vector)) - weak @ weak.T
    left = keep @ (information - explained @ across.T) @ keep
    return 0.5 * (left + left.T), keep @ (vector - explained @ (weak.T @ vector))
