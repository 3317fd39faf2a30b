"""Measurements in information form: normal equations, and operations on them; degenerate directions
of a scan, such as lateral motion over level ground, and their removal."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg.lapack import dpstrf

from touchdown.estimator.filtering.error_state import POSE_DIM, POSITION, ROTATION
from touchdown.estimator.typing import Array

_LEVEL = np.array([0, 1, 5])
"""rotation x, rotation y, position z: observable over level ground"""
_LATERAL = np.array([2, 3, 4])
"""rotation z, position x, y: observable with slopes and walls"""


class NormalEquations(NamedTuple):
    """Weighted least squares over D error coordinates. Kernels return it, too."""

    information: Array  # (D, D) ``sum h^T h / var``
    vector: Array  # (D,) ``sum h^T r / var``
    used: int  # residuals within the gate
    rms: float  # of these residuals, m or pixels


def limit_information(information: Array, errors: Array) -> Array:
    """Applies an information floor: returns the ``information`` A (D, D) of a measurement with
    independent ``errors`` of covariance F (D, D) added, which do not average out over its
    residuals. ``(A^-1 + F)^-1 = (I + A F)^-1 A`` holds for a singular A as well."""
    limited = np.linalg.solve(np.eye(len(errors)) + information @ errors, information)
    symmetric: Array = 0.5 * (limited + limited.T)
    return symmetric


def square_root(matrix: Array) -> Array:
    """Returns R (D, r) with ``R R^T = matrix`` (D, D), positive semi-definite of rank r: Cholesky
    factors with pivots, which end where what is left is rounding."""
    factors, order, rank, _ = dpstrf(0.5 * (matrix + matrix.T), lower=1)
    root = np.zeros((len(matrix), rank))
    root[order - 1] = np.tril(factors[:, :rank])
    return root


def lateral_strength(information: Array) -> Array:
    """Eigenvalues (3,), ascending, of the information (6, 6) about x, y (1/m^2) and yaw (1/rad^2)
    after marginalisation of height, roll and pitch (Schur complement). Near zero, the measurement
    is degenerate in that direction, as over a plane."""
    level = information[np.ix_(_LEVEL, _LEVEL)] + 1e-9 * np.eye(3)
    cross = information[np.ix_(_LATERAL, _LEVEL)]
    schur = information[np.ix_(_LATERAL, _LATERAL)] - cross @ np.linalg.solve(level, cross.T)
    return np.linalg.eigvalsh(0.5 * (schur + schur.T))


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


def _weak_axes(information: Array, noise: Array, own: slice, other: slice, sigma: float) -> Array:
    """The degenerate directions of the three coordinates ``own``, the three others marginalised."""
    following = np.zeros((POSE_DIM, 3))
    following[own] = np.eye(3)
    # the pseudo-inverse ignores unobserved directions of the other block
    inverse = np.linalg.pinv(information[other, other], rcond=1e-9, hermitian=True)
    following[other] = -inverse @ information[other, own]
    values, vectors = np.linalg.eigh(following.T @ information @ following)
    noisy = np.diag((following @ vectors).T @ noise @ following @ vectors)
    return vectors[:, values - 2.0 * noisy < 1.0 / sigma**2]


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
