"""Point-to-plane update of the filter by one scan, against planes anchored to its clones."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numba import njit
from numpy.typing import NDArray

from touchdown.estimator.filtering.anchors import Anchors
from touchdown.estimator.filtering.deskew import PlacedScan
from touchdown.estimator.filtering.error_state import POSE, POSE_DIM, POSITION, ROTATION, Frame
from touchdown.estimator.filtering.eskf import Eskf, IteratedUpdate
from touchdown.estimator.filtering.information import lateral_strength
from touchdown.estimator.filtering.plane_map import PlaneMap
from touchdown.estimator.livo.plane_equations import Returns, ScanNoise, plane_equations

Array = NDArray[np.float64]

_PLANE_FLOOR_M = 0.003
_SAME_PLANE_M = 0.02
"""displacement of a return up to which its plane is not looked up again"""
_GATES = (6.0, 4.0)
"""standard deviations, of the first iteration and of the others"""


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


@dataclass(frozen=True, kw_only=True, slots=True)
class ScanErrors:
    """Error model of a scan."""

    range_sigma_m: float
    """of one return"""
    angle_sigma_rad: float
    """of one beam"""
    floor_sigmas: Array
    """(6,) rad and m: information floor, errors of the scan, and of each clone's part of the map,
    that do not average out (``limit_information``)"""
    weak_sigmas: tuple[float, float] | None = None
    """rad and m: directions known less well than these are left out of the update
    (``weak_directions``); None: none are"""


def update_with_scan(
    eskf: Eskf,
    plane_map: PlaneMap,
    anchors: Anchors,
    scan: PlacedScan,
    errors: ScanErrors,
    *,
    share: float = 1.0,
    iterations: int = 3,
    min_matches: int = 30,
) -> LidarReport:
    """Iterated update by a scan that ends at the filter's present time.

    Planes are looked up in the first iteration, and in the second if the first has moved the
    returns. With fewer than ``min_matches`` matches nothing is changed. ``share``: of the
    correction that mounts and lens take.
    """
    update = IteratedUpdate(eskf, share)
    returns, shared = Returns(scan.points, scan.beams), eskf.shared
    weak, raw = (np.zeros((3, 0)), np.zeros((3, 0))), np.zeros((6, 6))
    matched, keys, used, rms = None, np.zeros(0, np.int64), 0, 0.0
    looked_up = np.full_like(scan.points, np.inf)
    for iteration in range(iterations):
        state = eskf.state
        placed = scan.points @ state.rotation.T + state.position
        fresh = iteration < 2 and np.abs(placed - looked_up).max() > _SAME_PLANE_M
        if fresh or matched is None:
            matched, looked_up = plane_map.match(placed), placed
            keys = np.unique(matched.anchors[matched.found])
            keys = keys[keys >= 0].astype(np.int64)
        noise = ScanNoise(
            errors.range_sigma_m, errors.angle_sigma_rad, _PLANE_FLOOR_M,
            _GATES[min(iteration, len(_GATES) - 1)],
        )  # fmt: skip
        found = plane_equations(
            returns, Frame(state.rotation, state.position), matched,
            anchors.frames(eskf.clones, state.calibration, keys), len(keys), shared, noise,
        )  # fmt: skip
        used, rms = found.used, found.rms
        if used < min_matches:
            update.abandon()
            return LidarReport(matched=used, rms_m=rms)
        raw = found.information[POSE, POSE].copy()
        if errors.weak_sigmas is not None and fresh:
            weak = weak_directions(raw, found.noise_information, *errors.weak_sigmas)
        columns = np.zeros((len(found.vector), weak[0].shape[1] + weak[1].shape[1]))
        columns[ROTATION, : weak[0].shape[1]] = weak[0]
        columns[POSITION, weak[0].shape[1] :] = weak[1]
        information, vector = without_directions(found.information, found.vector, columns)
        # each clone's part of the map has a floor of its own: otherwise the number of points
        # would tie the clones to each other too firmly
        floor = errors.floor_sigmas
        floors = np.concatenate([floor, np.zeros(shared), np.tile(floor, len(keys))])
        if update.step(keys.tolist(), information, vector, floors) and iteration > 0:
            break
    update.finish()
    return LidarReport(
        matched=used,
        rms_m=rms,
        lateral_strength=lateral_strength(raw),
        weak_rotation=weak[0].shape[1],
        weak_translation=weak[1].shape[1],
    )


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
