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
    weak_translation: int = 0
    """directions of translation that the scan did not measure"""
    weak_rotation: int = 0
    """axes of rotation about which it did not"""


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
    """What the noise of the normals alone adds to the information of ``plane_information``, (6, 6).

    A map of level ground has normals that lean a little, each its own way, and so seems to measure
    sideways motion. A normal that errs by e, of variance s^2 in the two directions t across it,
    puts the row of t, times e, on that of n: in expectation ``w s^2 sum_t h_t^T h_t`` on the
    information. Arguments as there.
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
    """Axes of rotation (3, r) and directions of translation (3, t), unit columns, of which a
    measurement with ``information`` (6, 6) knows less than the given standard deviations once twice
    its share of ``noise`` (6, 6) is taken off.

    Rotation and translation are judged apart, each once the other is allowed to follow (Schur
    complement), so that metres are never weighed against radians. The idea of leaving out such
    directions is that of Zhang, Kaess and Singh 2016 ("On degeneracy of optimization-based state
    estimation problems"), here with thresholds in the units of the state.
    """
    weak = []
    for own, other, sigma in (
        (slice(0, 3), slice(3, 6), sigma_rad),
        (slice(3, 6), slice(0, 3), sigma_m),
    ):
        # a direction of the rest that is not measured itself explains nothing away
        rest = np.linalg.pinv(information[other, other], rcond=1e-9, hermitian=True)
        following = np.zeros((6, 3))
        following[own] = np.eye(3)
        following[other] = -rest @ information[other, own]
        schur = following.T @ information @ following
        values, vectors = np.linalg.eigh(0.5 * (schur + schur.T))
        feigned = np.einsum("ij,ik,kj->j", vectors, following.T @ noise @ following, vectors)
        weak.append(vectors[:, values - 2.0 * feigned < 1.0 / sigma**2])
    return weak[0], weak[1]


def without_directions(information: Array, vector: Array, weak: Array) -> tuple[Array, Array]:
    """The measurement with the orthonormal columns ``weak`` (6, k) taken for unknown: they are
    marginalised, so that what remains is sure for any value of them."""
    if weak.shape[1] == 0:
        return information, vector
    across = information @ weak
    explained = across @ np.linalg.pinv(weak.T @ across, rcond=1e-9, hermitian=True)
    keep = np.eye(6) - weak @ weak.T
    left = keep @ (information - explained @ across.T) @ keep
    return 0.5 * (left + left.T), keep @ (vector - explained @ (weak.T @ vector))


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
    weak_sigmas: tuple[float, float] | None = None,
    iterations: int = 3,
    min_matches: int = 30,
) -> LidarReport:
    """Iterated update by (N, 3) points and beams, IMU frame of the filter's present time.

    Planes are looked up at the first and the second iteration. With fewer than ``min_matches``
    matches nothing is changed. ``floor_sigmas`` (6,): see ``floored``; rad, then m.
    ``weak_sigmas``: rad and m, directions known less well than these are left out of the update
    (``weak_directions``, less what the normals' noise feigns); None: none are.
    """
    prior, clones = eskf.state, eskf.clones
    touched = eskf.touched([])
    raw, information, used, rms = np.zeros((6, 6)), np.zeros((6, 6)), 0, 0.0
    weak = (np.zeros((3, 0)), np.zeros((3, 0)))
    planes = None
    for iteration in range(iterations):
        state = eskf.state
        fresh = iteration < 2 or planes is None
        if fresh or planes is None:
            planes = plane_map.match(points @ state.rotation.T + state.position)
        arguments = (
            points, beams, state.rotation, state.position, *planes,
            range_sigma_m, angle_sigma_rad, 0.003, 6.0 if iteration == 0 else 4.0,
        )  # fmt: skip
        raw, vector, used, rms = plane_information(*arguments)
        if used < min_matches:
            eskf.state, eskf.clones = prior, clones
            return LidarReport(matched=used, rms_m=rms, lateral_strength=np.zeros(3))
        if weak_sigmas is not None and fresh:
            noise = normal_noise_information(*arguments)
            weak = weak_directions(raw, noise, *weak_sigmas)
        information, vector = without_directions(raw, vector, _blocks(*weak))
        information, vector = floored(information, vector, floor_sigmas)
        offset = eskf.deviation(prior, clones, [])
        delta = eskf.gain(touched, information, vector + information @ offset)
        eskf.state, eskf.clones = eskf.boxplus(prior, clones, delta)
    eskf.absorb(touched, information)
    return LidarReport(
        matched=used,
        rms_m=rms,
        lateral_strength=lateral_strength(raw),
        weak_rotation=weak[0].shape[1],
        weak_translation=weak[1].shape[1],
    )


def _blocks(rotation: Array, translation: Array) -> Array:
    """(6, r + t) from axes (3, r) and directions (3, t)."""
    columns = np.zeros((6, rotation.shape[1] + translation.shape[1]))
    columns[:3, : rotation.shape[1]] = rotation
    columns[3:, rotation.shape[1] :] = translation
    return columns


class DegeneracyWatch:
    """Tells in words when scans begin and cease to measure all of the pose. A change must last for
    ``patience`` scans."""

    def __init__(self, patience: int = 10) -> None:
        self._patience = patience
        self._degenerate = False
        self._against = 0

    def events(self, report: LidarReport) -> list[str]:
        weak = report.weak_translation + report.weak_rotation > 0
        self._against = self._against + 1 if weak != self._degenerate else 0
        if self._against < self._patience:
            return []
        self._degenerate, self._against = weak, 0
        if not weak:
            return ["the LIDAR measures the whole pose again"]
        return [
            f"the LIDAR no longer measures {report.weak_translation} directions of translation and "
            f"{report.weak_rotation} of rotation"
        ]
