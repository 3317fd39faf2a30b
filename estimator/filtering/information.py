"""Measurements in information form: normal equations and operations on them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg.lapack import dpstrf

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
