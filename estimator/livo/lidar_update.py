"""Degeneracy of scans: information from noise, weakly observed directions, and their removal."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True)
class LidarReport:
    """Result of an update by one scan, for the recording."""

    matched: int
    rms_m: float
    lateral_strength: Array
    """(3,) eigenvalues, ascending, of the lateral information after the Schur complement"""
    weak_translation: int = 0
    """number of degenerate directions of translation"""
    weak_rotation: int = 0
    """number of degenerate axes of rotation"""


@njit(cache=True)
def normal_noise_information(
    points: Array,
    beams: Array,
    rotation: Array,
    position: Array,
    found: NDArray[np.bool_],
    normals: Array,
    anchors: Array,
    variances: Array,
    range_sigma: float,
    angle_sigma: float,
    plane_floor: float,
    gate: float,
) -> Array:
    """Noise information: the part (6, 6) of a scan's information that comes from the noise of the
    normals alone.

    The mapped normals of level ground scatter, so that a scan seems to measure lateral motion. A
    normal with an error e, of variance s^2 in the two directions t across it, adds e times the row
    of t to the row of n: in expectation ``w s^2 sum_t h_t^T h_t`` to the information. Parameters as
    in ``anchored_information``.
    """
    information = np.zeros((6, 6))
    row = np.zeros(6)
    t = np.zeros((2, 3))
    for i in range(points.shape[0]):
        if not found[i]:
            continue
        n = normals[i]
        p, beam = points[i], beams[i]
        height, along, length2 = 0.0, 0.0, 0.0
        for k in range(3):
            world, ray = 0.0, 0.0
            for j in range(3):
                world += rotation[k, j] * p[j]
                ray += rotation[k, j] * beam[j]
            height += n[k] * (world + position[k] - anchors[i, k])
            along += n[k] * ray
            length2 += ray * ray
        cosine2 = along * along / length2
        noise = range_sigma**2 * cosine2 + angle_sigma**2 * length2 * (1.0 - cosine2)
        variance = max(noise, variances[i, 0]) + variances[i, 1] + plane_floor**2
        scaled2 = height * height / variance
        if scaled2 > gate * gate:
            continue
        weight = variances[i, 2] / ((1.0 + 4.0 * scaled2 / (gate * gate)) * variance)
        # two unit vectors across the normal, from the axis that it leans on least
        least = 0
        for k in range(1, 3):
            if abs(n[k]) < abs(n[least]):
                least = k
        scale = 1.0 / np.sqrt(1.0 - n[least] * n[least])
        for k in range(3):
            t[0, k] = ((1.0 if k == least else 0.0) - n[least] * n[k]) * scale
        t[1, 0] = n[1] * t[0, 2] - n[2] * t[0, 1]
        t[1, 1] = n[2] * t[0, 0] - n[0] * t[0, 2]
        t[1, 2] = n[0] * t[0, 1] - n[1] * t[0, 0]
        for side in range(2):
            u = t[side]
            bx = rotation[0, 0] * u[0] + rotation[1, 0] * u[1] + rotation[2, 0] * u[2]
            by = rotation[0, 1] * u[0] + rotation[1, 1] * u[1] + rotation[2, 1] * u[2]
            bz = rotation[0, 2] * u[0] + rotation[1, 2] * u[1] + rotation[2, 2] * u[2]
            row[0] = p[1] * bz - p[2] * by
            row[1] = p[2] * bx - p[0] * bz
            row[2] = p[0] * by - p[1] * bx
            row[3], row[4], row[5] = u[0], u[1], u[2]
            for a in range(6):
                for b in range(6):
                    information[a, b] += weight * row[a] * row[b]
    return information


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
    weak = []
    for own, other, sigma in (
        (slice(0, 3), slice(3, 6), sigma_rad),
        (slice(3, 6), slice(0, 3), sigma_m),
    ):
        # the pseudo-inverse ignores unobserved directions of the other block
        rest = np.linalg.pinv(information[other, other], rcond=1e-9, hermitian=True)
        following = np.zeros((6, 3))
        following[own] = np.eye(3)
        following[other] = -rest @ information[other, own]
        schur = following.T @ information @ following
        values, vectors = np.linalg.eigh(0.5 * (schur + schur.T))
        noise_information = np.einsum(
            "ij,ik,kj->j", vectors, following.T @ noise @ following, vectors
        )
        weak.append(vectors[:, values - 2.0 * noise_information < 1.0 / sigma**2])
    return weak[0], weak[1]


def without_directions(information: Array, vector: Array, weak: Array) -> tuple[Array, Array]:
    """Returns the measurement with the orthonormal columns ``weak`` (6, k) marginalised as unknown,
    so that the remaining information holds for any value of them."""
    if weak.shape[1] == 0:
        return information, vector
    across = information @ weak
    explained = across @ np.linalg.pinv(weak.T @ across, rcond=1e-9, hermitian=True)
    keep = np.eye(len(vector)) - weak @ weak.T
    left = keep @ (information - explained @ across.T) @ keep
    return 0.5 * (left + left.T), keep @ (vector - explained @ (weak.T @ vector))


class DegeneracyWatch:
    """Reports when scans become degenerate and when they cease to be. A change must last for
    ``patience`` scans."""

    def __init__(self, patience: int = 10) -> None:
        self._patience = patience
        self._degenerate = False
        self._against = 0

    def events(self, report: LidarReport) -> list[str]:
        """Returns the messages caused by the newest scan."""
        weak = report.weak_translation + report.weak_rotation > 0
        self._against = self._against + 1 if weak != self._degenerate else 0
        if self._against < self._patience:
            return []
        self._degenerate, self._against = weak, 0
        if not weak:
            return ["the LIDAR measures the whole pose again"]
        counts = {
            "translation along": report.weak_translation,
            "rotation about": report.weak_rotation,
        }
        lost = [f"{what} {n} {'axis' if n == 1 else 'axes'}" for what, n in counts.items() if n]
        return [f"the LIDAR does not measure {' and '.join(lost)}"]
