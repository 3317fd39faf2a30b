"""Degeneracy of scans: weakly observed directions, and their removal."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True)
class LidarReport:
    """Result of an update by one scan, for the recording."""

    matched: int = 0
    rms_m: float = 0.0
    lateral_strength: Array = field(default_factory=lambda: np.zeros(3))
    """(3,) eigenvalues, ascending, of the lateral information after the Schur complement"""
    weak_translation: int = 0
    """number of degenerate directions of translation"""
    weak_rotation: int = 0
    """number of degenerate axes of rotation"""


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
