"""Algorithm 1 of the paper: the pose of a scan from its edge and planar points."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from touchdown.estimator.filtering.error_state import (
    POSITION,
    ROTATION,
    Frame,
    Frames,
    error_between,
    moved_by,
)
from touchdown.estimator.filtering.eskf import Eskf
from touchdown.estimator.filtering.imu_propagation import cross_into, rotate_back_into
from touchdown.estimator.filtering.plane_map import smallest_eigen
from touchdown.estimator.livo.anchors import Anchors
from touchdown.estimator.paper.feature_map import FeatureMap, Seen
from touchdown.sim.frames import Pose

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

EIGENVALUE_RATIO = 3.0
_FIRST_STEPS = 2
_KEPT_SHARE = 0.8
_SAME_NEIGHBOURS_M = 0.02
"""displacement of the scan's outermost points up to which their neighbours are not sought again"""
_LEAST_SINE = 0.25
"""of the angle between two sides of the three plane points, below which they are one line"""


@dataclass(frozen=True, slots=True)
class ScanFeatures:
    """Feature points of one scan, IMU frame, m."""

    edges: Array
    """(E, 3)"""
    planes: Array
    """(P, 3)"""
    lever: Array = field(default_factory=lambda: np.zeros(3))
    """(3,) the LIDAR"""


@dataclass(frozen=True, slots=True)
class FeatureMaps:
    """The global maps of both kinds of feature points. Their parts belong to clones of the
    filter."""

    edges: FeatureMap
    planes: FeatureMap
    anchors: Anchors = field(default_factory=Anchors)

    def insert(self, features: ScanFeatures, eskf: Eskf) -> None:
        """Adds a scan's points at the present pose, to the part of the newest clone."""
        pose = eskf.state.pose
        terms = self.anchors.kept_from_now(eskf.clones, eskf.state.calibration, pose.rotation)
        moves = Frames(terms.rotations, terms.translations)
        seen = Seen(pose.apply(features.lever), len(self.anchors) - 1, moves)
        self.edges.insert(pose.apply(features.edges), seen)
        self.planes.insert(pose.apply(features.planes), seen)

    def hand_over(self, k: int, eskf: Eskf) -> None:
        """Gives the part of clone ``k``, which is about to go, to the clone nearest to it."""
        successor, move = self.anchors.reassignment(k, eskf.clones)
        for kind in (self.edges, self.planes):
            kind.reassign(k, successor, move)
        self.anchors.remove(k)


class Matches(NamedTuple):
    """Feature points with a line or plane nearby."""

    points: Array  # (M, 3) IMU frame
    near: Array  # (M, 5, 3) odom frame
    is_edge: Mask  # (M,)
    owners: NDArray[np.int64]  # (M,) clone that p_1 belongs to; -1: none
    sensors: Array  # (M, 3) where p_1 was seen from, odom frame

    def select(self, keep: Mask) -> Matches:
        """The subset picked by a mask (M,)."""
        return Matches(*(part[keep] for part in self))


@dataclass(frozen=True, slots=True)
class PosePrior:
    """odom_from_imu before the measurement."""

    pose: Pose
    information: Array
    """(6, 6) of rotation (right perturbation) and position"""


@dataclass(frozen=True, kw_only=True, slots=True)
class ScanPose:
    """Result of Algorithm 1: ``pose`` is odom_from_imu; ``information`` (6, 6) and ``vector`` (6,)
    are those of the scan alone at this pose (rotation by right perturbation, position)."""

    pose: Pose
    information: Array
    vector: Array
    matches: Matches
    edges: int
    planes: int
    rms_m: float
    converged: bool


@njit(cache=True)
def edge_distance(point: Array, first: Array, last: Array) -> float:
    """Eq. 10, d_eps: distance of ``point`` from the line through p_1 and p_k, each (3,)."""
    square, length2 = 0.0, 0.0
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        cross = (point[b] - first[b]) * (point[c] - last[c])
        cross -= (point[c] - first[c]) * (point[b] - last[b])
        square += cross * cross
        length2 += (first[a] - last[a]) ** 2
    return np.sqrt(square / length2)


@njit(cache=True)
def plane_distance(point: Array, first: Array, middle: Array, last: Array) -> float:
    """Eq. 10, d_H: signed distance of ``point`` from the plane of p_1, p_k/2 and p_k, each (3,)."""
    total, length2 = 0.0, 0.0
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        normal = (middle[b] - last[b]) * (middle[c] - first[c])
        normal -= (middle[c] - last[c]) * (middle[b] - first[b])
        total += (point[a] - first[a]) * normal
        length2 += normal * normal
    return total / np.sqrt(length2)


@njit(cache=True)
def neighbourhood_shapes(near: Array, found: Mask) -> tuple[Mask, Mask]:
    """Masks (N,) of the neighbourhoods (N, 5, 3) that are lines (largest eigenvalue of the
    covariance three times the second) and that are planes (smallest three times below the
    second)."""
    count, k = near.shape[0], near.shape[1]
    lines = np.zeros(count, dtype=np.bool_)
    planes = np.zeros(count, dtype=np.bool_)
    cov, mean = np.empty((3, 3)), np.empty(3)
    for i in range(count):
        if not found[i]:
            continue
        for a in range(3):
            mean[a] = 0.0
            for j in range(k):
                mean[a] += near[i, j, a] / k
        for a in range(3):
            for b in range(3):
                cov[a, b] = 0.0
                for j in range(k):
                    cov[a, b] += (near[i, j, a] - mean[a]) * (near[i, j, b] - mean[b]) / k
        low, mid, high, _, _, _ = smallest_eigen(cov)
        lines[i] = high > EIGENVALUE_RATIO * mid
        planes[i] = mid > EIGENVALUE_RATIO * max(low, 1e-9)
    return lines, planes


@njit(cache=True)
def _distances(points: Array, near: Array, is_edge: Mask) -> Array:
    """Eq. 10 for (N, 3) global points and their neighbourhoods."""
    out = np.empty(points.shape[0])
    last = near.shape[1] - 1
    middle = near.shape[1] // 2
    for i in range(points.shape[0]):
        if is_edge[i]:
            out[i] = edge_distance(points[i], near[i, 0], near[i, last])
        else:
            out[i] = abs(plane_distance(points[i], near[i, 0], near[i, middle], near[i, last]))
    return out


@njit(cache=True)
def line_and_plane_axes(near: Array, is_edge: Mask) -> Array:
    """(N, 3) unit directions of the lines and normals of the planes."""
    out, a, b = np.empty((near.shape[0], 3)), np.empty(3), np.empty(3)
    last = near.shape[1] - 1
    middle = near.shape[1] // 2
    for i in range(near.shape[0]):
        for c in range(3):
            out[i, c] = near[i, last, c] - near[i, 0, c]
            a[c] = near[i, middle, c] - near[i, last, c]
            b[c] = near[i, middle, c] - near[i, 0, c]
        if not is_edge[i]:
            cross_into(a, b, out[i], 0)
        out[i] /= np.sqrt(out[i, 0] ** 2 + out[i, 1] ** 2 + out[i, 2] ** 2)
    return out


@njit(cache=True)
def _normal_equations(
    local: Array,
    anchors: Array,
    axes: Array,
    is_edge: Mask,
    rotation: Array,
    position: Array,
    sigmas: Array,
) -> tuple[Array, Array]:
    """Information and vector of the residuals of Eq. 10, Cauchy weighted (scale 3 sigma).

    ``anchors`` (N, 3): p_1. The squared distance from a line is that of the part of ``p - p_1``
    across it, which, unlike the distance, has a derivative on the line.
    """
    information, vector = np.zeros((6, 6)), np.zeros(6)
    row, offset, direction, turned = np.zeros(6), np.zeros(3), np.zeros(3), np.zeros(3)
    for i in range(local.shape[0]):
        q, axis = local[i], axes[i]
        along, square = 0.0, 0.0
        for c in range(3):
            offset[c] = position[c] - anchors[i, c]
            for k in range(3):
                offset[c] += rotation[c, k] * q[k]
            along += offset[c] * axis[c]
            square += offset[c] * offset[c]
        square = square - along * along if is_edge[i] else along * along
        sigma2 = (sigmas[0] if is_edge[i] else sigmas[1]) ** 2
        weight = 1.0 / (sigma2 + square / 9.0)
        for c in range(3 if is_edge[i] else 1):
            for k in range(3):
                direction[k] = -axis[c] * axis[k] if is_edge[i] else axis[k]
            residual = along
            if is_edge[i]:
                direction[c] += 1.0
                residual = offset[c] - along * axis[c]
            for k in range(3):
                row[POSITION.start + k] = direction[k]
            rotate_back_into(rotation, direction, turned)
            cross_into(q, turned, row, ROTATION.start)
            for a in range(6):
                scaled = weight * row[a]
                vector[a] -= scaled * residual
                for b in range(6):
                    information[a, b] += scaled * row[b]
    return information, vector


@njit(cache=True)
def _flat_triangles(near: Array) -> Mask:
    """Mask (N,) of the neighbourhoods (N, 5, 3) whose p_1, p_k/2 and p_k span a plane."""
    out = np.zeros(near.shape[0], dtype=np.bool_)
    last, middle = near.shape[1] - 1, near.shape[1] // 2
    a, b, cross = np.empty(3), np.empty(3), np.empty(3)
    for i in range(near.shape[0]):
        cross2, a2, b2 = 0.0, 0.0, 0.0
        for c in range(3):
            a[c] = near[i, middle, c] - near[i, last, c]
            b[c] = near[i, middle, c] - near[i, 0, c]
        cross_into(a, b, cross, 0)
        for c in range(3):
            cross2, a2, b2 = cross2 + cross[c] ** 2, a2 + a[c] ** 2, b2 + b[c] ** 2
        out[i] = cross2 > _LEAST_SINE**2 * a2 * b2 and cross2 > 1e-12
    return out


def _associate(features: ScanFeatures, maps: FeatureMaps, pose: Pose) -> Matches:
    """Steps 3 to 9: the points placed by Eq. 9, those with a line or plane nearby."""
    edges = maps.edges.nearest(pose.apply(features.edges))
    lines, _ = neighbourhood_shapes(edges.near, edges.found)
    planes = maps.planes.nearest(pose.apply(features.planes))
    _, flats = neighbourhood_shapes(planes.near, planes.found)
    flats &= _flat_triangles(planes.near)

    def of_both(edge_part: Array, plane_part: Array) -> Array:
        return np.concatenate([edge_part[lines], plane_part[flats]])

    return Matches(
        of_both(features.edges, features.planes), of_both(edges.near, planes.near),
        np.arange(lines.sum() + flats.sum()) < lines.sum(),
        np.concatenate([edges.owners[lines], planes.owners[flats]]),
        of_both(edges.sensors, planes.sensors),
    )  # fmt: skip


def _keep_best(distances: Array, is_edge: Mask) -> Mask:
    """Mask of all but the largest 20 % of the residuals, of edges and of planes separately: edges
    scatter more, and a common ranking would remove edges alone."""
    keep = np.zeros(len(distances), dtype=np.bool_)
    for kind in (True, False):
        members = np.flatnonzero(is_edge == kind)
        order = members[np.argsort(distances[members], kind="stable")]
        keep[order[: int(np.ceil(_KEPT_SHARE * len(order)))]] = True
    return keep


def register_scan(
    features: ScanFeatures,
    maps: FeatureMaps,
    prior: PosePrior,
    *,
    edge_sigma_m: float,
    plane_sigma_m: float,
    rounds: int = 3,
    steps: int = 6,
    min_matches: int = 30,
) -> ScanPose | None:
    """Algorithm 1: returns odom_from_imu of a scan, or None with fewer than ``min_matches`` matched
    points.

    ``prior``: the pose of the last scan propagated by the IMU (the paper starts from the last pose
    itself). Over a plane a scan leaves x, y and yaw open, and the solution stays at the prior
    there. The returned information is that of the scan alone.
    """
    guess, guess_information = prior.pose, prior.information
    pose = guess
    sigmas = np.array([edge_sigma_m, plane_sigma_m])
    converged = False
    every = np.concatenate([features.edges, features.planes, np.zeros((1, 3))])
    extent = np.array([every.min(axis=0), every.max(axis=0)])
    for _ in range(rounds):
        start = pose
        matches = _associate(features, maps, pose)
        if len(matches.points) < min_matches:
            return None

        def step(pose: Pose, found: Matches, axes: Array) -> tuple[Pose, float]:
            information, vector = _normal_equations(
                found.points, found.near[:, 0], axes, found.is_edge, *Frame.of(pose), sigmas
            )
            vector = vector - guess_information @ error_between(guess, pose)
            delta = np.linalg.solve(information + guess_information, vector)
            return moved_by(pose, np.asarray(delta, dtype=np.float64)), float(np.abs(delta).max())

        axes = line_and_plane_axes(matches.near, matches.is_edge)
        for _ in range(_FIRST_STEPS):
            pose, _ = step(pose, matches, axes)
        keep = _keep_best(
            _distances(pose.apply(matches.points), matches.near, matches.is_edge), matches.is_edge
        )
        matches, axes = matches.select(keep), axes[keep]
        for _ in range(steps):
            pose, size = step(pose, matches, axes)
            if size < 1e-5:
                break
        moved = np.abs(pose.apply(extent) - start.apply(extent)).max()
        converged = bool(moved < _SAME_NEIGHBOURS_M)
        if converged:
            break
    information, vector = _normal_equations(
        matches.points, matches.near[:, 0], axes, matches.is_edge, *Frame.of(pose), sigmas
    )
    distances = _distances(pose.apply(matches.points), matches.near, matches.is_edge)
    edges = int(matches.is_edge.sum())
    return ScanPose(
        pose=pose, information=information, vector=vector, matches=matches, edges=edges,
        planes=len(distances) - edges, rms_m=float(np.sqrt(np.mean(distances**2))),
        converged=converged,
    )  # fmt: skip
