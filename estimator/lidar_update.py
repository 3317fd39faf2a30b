"""Point-to-plane update of the filter by one scan."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from estimator.eskf import Eskf
from estimator.plane_map import PlaneMap

Array = NDArray[np.float64]

_LEVEL = np.array([0, 1, 5])
"""rotation x, rotation y, position z: what level ground measures"""
_LATERAL = np.array([2, 3, 4])
"""rotation z, position x, y: what needs slopes and walls"""


@dataclass(frozen=True, kw_only=True, slots=True)
class LidarReport:
    """What one scan did, for the recording."""

    matched: int
    rms_m: float
    lateral_strength: Array
    """(3,) eigenvalues, ascending, of the lateral information after the Schur split"""


@njit(cache=True)
def plane_information(
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
) -> tuple[Array, Array, int, float]:
    """Information (6, 6) and vector (6,) of the residuals ``n . (R p + t - c)``.

    ``points`` and ``beams`` (N, 3) in the IMU frame. A residual's variance is the beam's (range and
    angle noise seen along the normal), or the plane's thickness if that is larger, plus the plane's
    uncertainty. Weights are Cauchy's with scale ``gate``/2 standard deviations, zero beyond
    ``gate``. Returns also the number used and their rms in metres. Error order: rotation (right
    perturbation), position.
    """
    information = np.zeros((6, 6))
    vector = np.zeros(6)
    row = np.zeros(6)
    used, total = 0, 0.0
    for i in range(points.shape[0]):
        if not found[i]:
            continue
        n = normals[i]
        # the normal in the IMU frame
        bx = rotation[0, 0] * n[0] + rotation[1, 0] * n[1] + rotation[2, 0] * n[2]
        by = rotation[0, 1] * n[0] + rotation[1, 1] * n[1] + rotation[2, 1] * n[2]
        bz = rotation[0, 2] * n[0] + rotation[1, 2] * n[1] + rotation[2, 2] * n[2]
        p = points[i]
        height = bx * p[0] + by * p[1] + bz * p[2]
        for k in range(3):
            height += n[k] * (position[k] - anchors[i, k])
        beam = beams[i]
        length2 = beam[0] ** 2 + beam[1] ** 2 + beam[2] ** 2
        along = bx * beam[0] + by * beam[1] + bz * beam[2]
        cosine2 = along * along / length2
        noise = range_sigma**2 * cosine2 + angle_sigma**2 * length2 * (1.0 - cosine2)
        variance = max(noise, variances[i, 0]) + variances[i, 1] + plane_floor**2
        scaled2 = height * height / variance
        if scaled2 > gate * gate:
            continue
        weight = 1.0 / ((1.0 + 4.0 * scaled2 / (gate * gate)) * variance)
        # d height / d rotation error = (p x n_imu)
        row[0] = p[1] * bz - p[2] * by
        row[1] = p[2] * bx - p[0] * bz
        row[2] = p[0] * by - p[1] * bx
        row[3], row[4], row[5] = n[0], n[1], n[2]
        for a in range(6):
            vector[a] -= weight * row[a] * height
            for b in range(6):
                information[a, b] += weight * row[a] * row[b]
        used += 1
        total += height * height
    rms = np.sqrt(total / used) if used > 0 else 0.0
    return information, vector, used, rms


def floored(information: Array, vector: Array, floor_sigmas: Array) -> tuple[Array, Array]:
    """The same measurement with independent errors of ``floor_sigmas`` (6,) added to it.

    The planes were made with this filter's own poses, so that their errors repeat from scan to
    scan; taking each scan for independent would freeze the drift in. With ``F`` the added
    covariance, ``(A^-1 + F)^-1 = (I + A F)^-1 A``, which holds for a singular ``A`` as well.
    """
    widened = np.eye(6) + information * floor_sigmas**2
    solved = np.linalg.solve(widened, np.column_stack([information, vector]))
    symmetric: Array = 0.5 * (solved[:, :6] + solved[:, :6].T)
    return symmetric, np.asarray(solved[:, 6], dtype=np.float64)


def lateral_strength(information: Array) -> Array:
    """Eigenvalues (3,), ascending, of what a scan says of x, y (1/m^2) and yaw (1/rad^2) once
    height, roll and pitch are allowed to follow (Schur complement): near zero, the scan is
    degenerate in that direction, as over a plane."""
    level = information[np.ix_(_LEVEL, _LEVEL)] + 1e-9 * np.eye(3)
    cross = information[np.ix_(_LATERAL, _LEVEL)]
    schur = information[np.ix_(_LATERAL, _LATERAL)] - cross @ np.linalg.solve(level, cross.T)
    return np.linalg.eigvalsh(0.5 * (schur + schur.T))


def update_with_scan(
    eskf: Eskf,
    plane_map: PlaneMap,
    points: Array,
    beams: Array,
    *,
    range_sigma_m: float,
    angle_sigma_rad: float,
    floor_sigmas: Array,
    iterations: int = 3,
    min_matches: int = 30,
) -> LidarReport:
    """Iterated update by (N, 3) points and beams, IMU frame of the filter's present time.

    Planes are looked up at the first and the second iteration. With fewer than ``min_matches``
    matches nothing is changed. ``floor_sigmas`` (6,): see ``floored``; rad, then m.
    """
    prior, clones = eskf.state, eskf.clones
    touched = eskf.touched([])
    raw, information, used, rms = np.zeros((6, 6)), np.zeros((6, 6)), 0, 0.0
    planes = None
    for iteration in range(iterations):
        state = eskf.state
        if iteration < 2 or planes is None:
            planes = plane_map.match(points @ state.rotation.T + state.position)
        raw, vector, used, rms = plane_information(
            points, beams, state.rotation, state.position, *planes,
            range_sigma_m, angle_sigma_rad, 0.003, 6.0 if iteration == 0 else 4.0,
        )  # fmt: skip
        if used < min_matches:
            eskf.state, eskf.clones = prior, clones
            return LidarReport(matched=used, rms_m=rms, lateral_strength=np.zeros(3))
        information, vector = floored(raw, vector, floor_sigmas)
        offset = eskf.deviation(prior, clones, [])
        delta = eskf.gain(touched, information, vector + information @ offset)
        eskf.state, eskf.clones = eskf.boxplus(prior, clones, delta)
    eskf.absorb(touched, information)
    return LidarReport(matched=used, rms_m=rms, lateral_strength=lateral_strength(raw))
