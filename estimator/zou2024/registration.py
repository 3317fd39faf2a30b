"""Algorithm 1 of the paper: the pose of a scan from its edge and planar points."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numba import njit

from touchdown.estimator.filtering.anchors import AnchorFrames, Anchors
from touchdown.estimator.filtering.error_state import Frame, Frames, error_between, moved_by
from touchdown.estimator.filtering.eskf import Eskf, weak_columns, without_directions
from touchdown.estimator.filtering.plane_map import smallest_eigen
from touchdown.estimator.filtering.vectors import along, cross, dot, xyz
from touchdown.estimator.typing import Array, Mask
from touchdown.estimator.zou2024.feature_map import FeatureMap, Seen
from touchdown.estimator.zou2024.residuals import (
    NO_ANCHORS,
    Matches,
    ScanEquations,
    distances,
    line_and_plane_axes,
    relative_equations,
)
from touchdown.sim.frames import Pose

EIGENVALUE_RATIO = 3.0
WEAK_SIGMAS = float(np.radians(0.3)), 0.1
"""rad and m: of a scan, directions known less well than these are degenerate"""
_ROUNDS = 3
_FIRST_STEPS = 2
_MAX_STEPS = 6
_KEPT_FRACTION = 0.8
_SAME_NEIGHBOURS_M = 0.05
"""displacement of the scan's outermost points up to which their neighbours are not sought again"""
_MIN_STEP = 1e-4
"""rad and m"""
_SCATTER_OF_FIVE = 5.0 / 2.0
"""ratio of the variance of points about a plane to the smallest eigenvalue of five: three of their
degrees of freedom place the plane"""
_MIN_SINE = 0.25
"""sine of the angle between two sides of the three plane points, below which they are one line"""


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
        moves = self.anchors.moves_to_kept(eskf.clones)
        seen = Seen(pose.apply(features.lever), len(self.anchors) - 1, moves)
        self.edges.insert(pose.apply(features.edges), seen)
        self.planes.insert(pose.apply(features.planes), seen)

    def hand_over(self, k: int, eskf: Eskf) -> None:
        """Gives the part of clone ``k``, which is about to go, to the clone nearest to it."""
        successor, move = self.anchors.reassignment(k, eskf.clones)
        for kind in (self.edges, self.planes):
            kind.reassign(k, successor, move)
        self.anchors.remove(k)


@dataclass(frozen=True, kw_only=True, slots=True)
class ScanPose:
    """Result of Algorithm 1: ``pose`` is odom_from_imu; ``information`` (6, 6) is
    that of the scan alone at this pose (rotation by right perturbation, position)."""

    pose: Pose
    information: Array
    weak: Array
    """(6, k) degenerate directions, orthonormal"""
    matches: Matches
    edges: int
    planes: int
    rms_m: float
    converged: bool


class Shapes(NamedTuple):
    """What N neighbourhoods are."""

    lines: Mask  # (N,) largest eigenvalue of the covariance three times the second
    planes: Mask  # (N,) smallest three times below the second
    values: Array  # (N, 3) m^2, the eigenvalues, ascending


@njit(cache=True, error_model="numpy")
def neighbourhood_shapes(near: Array, found: Mask) -> Shapes:
    """The shapes of neighbourhoods (N, 5, 3)."""
    count, k = near.shape[0], near.shape[1]
    lines = np.zeros(count, dtype=np.bool_)
    planes = np.zeros(count, dtype=np.bool_)
    values = np.zeros((count, 3))
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
        values[i, 0], values[i, 1], values[i, 2] = max(low, 0.0), mid, high
    return Shapes(lines, planes, values)


def line_weights(values: Array) -> Array:
    """Weights (N,) of lines by the eigenvalues (N, 3) of their neighbourhoods: from 0, where the
    largest is three times the second, to 1 for a thin line. Of points scattered over a plane many
    five happen to lie so. They are always those around the point that is placed, wherever it is
    placed, and say nothing of where it belongs."""
    weights: Array = 1.0 - EIGENVALUE_RATIO * values[:, 1] / values[:, 2]
    return weights


@njit(cache=True, error_model="numpy")
def _flat_triangles(near: Array) -> Mask:
    """Mask (N,) of the neighbourhoods (N, 5, 3) whose p_1, p_k/2 and p_k span a plane."""
    out = np.zeros(near.shape[0], dtype=np.bool_)
    last, middle = near.shape[1] - 1, near.shape[1] // 2
    for i in range(near.shape[0]):
        corner = xyz(near[i, middle])
        a = along(corner, -1.0, xyz(near[i, last]))
        b = along(corner, -1.0, xyz(near[i, 0]))
        normal = cross(a, b)
        square = dot(normal, normal)
        out[i] = square > _MIN_SINE**2 * dot(a, a) * dot(b, b) and square > 1e-12
    return out


def _associate(features: ScanFeatures, maps: FeatureMaps, pose: Pose, moves: Frames) -> Matches:
    """Steps 3 to 9: the points placed by Eq. 9, those with a line or plane nearby."""
    edges = maps.edges.nearest(pose.apply(features.edges), moves)
    shape_of_edges = neighbourhood_shapes(edges.near, edges.found)
    lines = shape_of_edges.lines
    planes = maps.planes.nearest(pose.apply(features.planes), moves)
    shapes = neighbourhood_shapes(planes.near, planes.found)
    flats = shapes.planes & _flat_triangles(planes.near)

    near = np.concatenate([edges.near[lines], planes.near[flats]])
    count = int(lines.sum())
    is_edge = np.arange(len(near)) < count
    weights, scatter = np.ones(len(near)), np.zeros(len(near))
    weights[:count] = line_weights(shape_of_edges.values[lines])
    scatter[count:] = _SCATTER_OF_FIVE * shapes.values[flats, 0]
    return Matches(
        np.concatenate([features.edges[lines], features.planes[flats]]), near,
        line_and_plane_axes(near, is_edge), is_edge,
        np.concatenate([edges.owners[lines], planes.owners[flats]]),
        np.concatenate([edges.sensors[lines], planes.sensors[flats]]), weights, scatter,
    )  # fmt: skip


def _keep_best(distances: Array, is_edge: Mask) -> Mask:
    """Mask of all but the largest 20 % of the residuals, of edges and of planes separately: edges
    scatter more, and a common ranking would remove edges alone."""
    keep = np.zeros(len(distances), dtype=np.bool_)
    for kind in (True, False):
        members = np.flatnonzero(is_edge == kind)
        order = members[np.argsort(distances[members], kind="stable")]
        keep[order[: int(np.ceil(_KEPT_FRACTION * len(order)))]] = True
    return keep


def register_scan(
    features: ScanFeatures,
    maps: FeatureMaps,
    guess: Pose,
    guess_information: Array,
    *,
    edge_sigma_m: float,
    plane_sigma_m: float,
    anchors: AnchorFrames = NO_ANCHORS,
    min_matches: int = 30,
) -> ScanPose | None:
    """Algorithm 1: returns odom_from_imu of a scan, or None with fewer than ``min_matches`` matched
    points.

    ``guess``: odom_from_imu of the last scan propagated by the IMU (the paper starts from the last
    pose itself), and its information (6, 6). Over a plane a scan leaves x, y and yaw open, and the
    solution stays at the guess there (``weak_columns``). ``anchors``: the clones that parts of the
    map belong to, at their present estimate.
    """
    pose, sigmas = guess, np.array([edge_sigma_m, plane_sigma_m])
    every = np.concatenate([features.edges, features.planes, np.zeros((1, 3))])
    extent = np.array([every.min(axis=0), every.max(axis=0)])

    def equations(pose: Pose, found: Matches, noise: bool = False) -> ScanEquations:
        frame = Frame.of(pose)
        return relative_equations(found, features.lever, frame, anchors, 0, 0, sigmas, noise)

    def step(pose: Pose, found: Matches, weak: Array) -> tuple[Pose, float]:
        information, vector, _ = equations(pose, found)
        information, vector = without_directions(information, vector, weak)
        vector = vector - guess_information @ error_between(guess, pose)
        delta = np.linalg.solve(information + guess_information, vector)
        return moved_by(pose, np.asarray(delta, dtype=np.float64)), float(np.abs(delta).max())

    for _ in range(_ROUNDS):
        start, found = pose, _associate(features, maps, pose, anchors.moves)
        if len(found.points) < min_matches:
            return None
        seen = equations(pose, found, noise=True)
        weak = weak_columns(seen.information, seen.noise_information, WEAK_SIGMAS)
        for _ in range(_FIRST_STEPS):
            pose, _ = step(pose, found, weak)
        lengths = distances(pose.apply(found.points), found.near, found.is_edge)
        found = found.select(_keep_best(lengths, found.is_edge))
        for _ in range(_MAX_STEPS):
            pose, size = step(pose, found, weak)
            if size < _MIN_STEP:
                break
        moved = np.abs(pose.apply(extent) - start.apply(extent)).max()
        converged = bool(moved < _SAME_NEIGHBOURS_M)
        if converged:
            break
    lengths, edges = distances(pose.apply(found.points), found.near, found.is_edge), found.is_edge
    return ScanPose(
        pose=pose, information=equations(pose, found).information, weak=weak, matches=found,
        edges=int(edges.sum()), planes=int((~edges).sum()), converged=converged,
        rms_m=float(np.sqrt(np.mean(lengths**2))),
    )  # fmt: skip
