"""Algorithm 1 of the paper: the pose of a scan from its edge and planar points, by their
distances from lines and planes (Eq. 10).
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numba import njit

from touchdown.estimator.filtering.anchors import (
    ANCHORED_DIM,
    CLONE_AT,
    AnchorFrames,
    Anchors,
    Sight,
    derivatives_into,
)
from touchdown.estimator.filtering.error_state import (
    MOUNT_ROTATION,
    MOUNT_TRANSLATION,
    POSE_DIM,
    Frame,
    Frames,
    error_between,
    moved_by,
)
from touchdown.estimator.filtering.eskf import Eskf, weak_columns, without_directions
from touchdown.estimator.filtering.plane_map import smallest_eigen
from touchdown.estimator.filtering.vectors import (
    UNIT,
    ZERO,
    Vector,
    along,
    cross,
    dot,
    turned,
    turned_back,
    xyz,
)
from touchdown.estimator.zou2024.feature_map import FeatureMap, Seen
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array, Indices, Mask


class Matches(NamedTuple):
    """Feature points of a scan with a line or plane nearby."""

    points: Array  # (M, 3) IMU frame
    near: Array  # (M, 5, 3) their neighbours p_1 ... p_5, odom frame, where they are now
    axes: Array  # (M, 3) directions of the lines, normals of the planes
    is_edge: Mask  # (M,)
    owners: Indices  # (M,) clone of the filter that p_1 belongs to; -1: none
    sensors: Array  # (M, 3) where p_1 was seen from, odom frame
    weights: Array  # (M,) 0 to 1, of the neighbourhood's shape
    scatter: Array  # (M,) m^2, of the neighbours about their plane

    def select(self, keep: Mask) -> "Matches":
        """The subset picked by a mask (M,)."""
        return Matches._make(part[keep] for part in self)


class ScanEquations(NamedTuple):
    """Normal equations of a scan, (D,) coordinates: pose, shared calibration, touched clones."""

    information: Array  # (D, D)
    vector: Array  # (D,)
    noise_information: Array
    """(6, 6) part of the pose's information that comes from the noise of the normals alone"""


NO_ANCHORS = Anchors().frames([], np.zeros(0), np.zeros(0, np.int64))


@njit(cache=True, error_model="numpy")
def edge_distance(point: Array, first: Array, last: Array) -> float:
    """Eq. 10, d_eps: distance of ``point`` from the line through p_1 and p_k, each (3,)."""
    p, a, b = xyz(point), xyz(first), xyz(last)
    normal, base = cross(along(p, -1.0, a), along(p, -1.0, b)), along(a, -1.0, b)
    return np.sqrt(dot(normal, normal) / dot(base, base))


@njit(cache=True, error_model="numpy")
def plane_distance(point: Array, first: Array, middle: Array, last: Array) -> float:
    """Eq. 10, d_H: signed distance of ``point`` from the plane of p_1, p_k/2 and p_k, each (3,)."""
    a, b, c = xyz(first), xyz(middle), xyz(last)
    normal = cross(along(b, -1.0, c), along(b, -1.0, a))
    return dot(along(xyz(point), -1.0, a), normal) / np.sqrt(dot(normal, normal))


@njit(cache=True, error_model="numpy")
def distances(points: Array, near: Array, is_edge: Mask) -> Array:
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


@njit(cache=True, error_model="numpy")
def line_and_plane_axes(near: Array, is_edge: Mask) -> Array:
    """(N, 3) unit directions of the lines and normals of the planes."""
    out, last, middle = np.empty((near.shape[0], 3)), near.shape[1] - 1, near.shape[1] // 2
    for i in range(near.shape[0]):
        first, then = xyz(near[i, 0]), xyz(near[i, middle])
        axis = along(xyz(near[i, last]), -1.0, first)
        if not is_edge[i]:
            axis = cross(along(then, -1.0, xyz(near[i, last])), along(then, -1.0, first))
        length = np.sqrt(dot(axis, axis))
        for a in range(3):
            out[i, a] = axis[a] / length
    return out


@njit(cache=True, error_model="numpy")
def relative_equations(
    found: Matches, lever: Array, pose: Frame, anchors: AnchorFrames, touched: int, shared: int,
    sigmas: Array, with_noise: bool,
) -> ScanEquations:  # fmt: skip
    """Normal equations of the residuals of Eq. 10 over pose, shared calibration and the touched
    clones, Cauchy weighted (scale 3 sigma). ``lever`` (3,): of the LIDAR, IMU frame; ``sigmas``
    (2,): of edges and of planes. ``with_noise``: with the noise's
    information, most of the time.

    A map point was seen along a beam of its own, which turns with the LIDAR's mount as that of the
    scan does, and moves with its clone.

    Map points of level ground scatter, by s, so that their planes lean, and a scan seems to measure
    lateral motion. With the barycentric coordinates b_j of a point in the triangle of its plane and
    their gradients g_j, an error e_j of a corner changes the residual by ``-b_j e_j`` and the
    normal by ``-e_j g_j``. In expectation this adds ``w s^2 sum_j h(g_j)^T h(g_j)`` to the
    information, which is returned, and ``-w s^2 h(sum_j b_j g_j)^T`` to the vector, a pull towards
    the middle of the triangle, which is taken off. A residual's variance has ``s^2 sum_j b_j^2``.
    """
    head = POSE_DIM + shared
    size = head + POSE_DIM * touched
    alone = size == POSE_DIM
    width = POSE_DIM if alone else ANCHORED_DIM
    information, vector = np.zeros((size, size)), np.zeros(size)
    noise, row = np.zeros((POSE_DIM, POSE_DIM)), np.zeros(ANCHORED_DIM)
    columns = np.arange(ANCHORED_DIM) if shared > 0 or alone else np.full(ANCHORED_DIM, -1)
    columns[:POSE_DIM] = np.arange(POSE_DIM)
    last, middle = found.near.shape[1] - 1, found.near.shape[1] // 2
    for i in range(found.points.shape[0]):
        p, axis = xyz(found.points[i]), xyz(found.axes[i])
        k, edge = found.owners[i], found.is_edge[i]
        first = xyz(found.near[i, 0])
        here = along(xyz(pose.translation), 1.0, turned(pose.rotation, p))
        offset, arm = along(here, -1.0, first), along(first, -1.0, xyz(found.sensors[i]))
        own, slot, reach, apart = pose.rotation, -1, here, offset
        if k >= 0:
            # where the present mount would have put the map point
            own, slot = anchors.clones.rotations[k], anchors.slots[k]
            reach = along(here, -1.0, xyz(anchors.clones.translations[k]))
            change = anchors.mount_changes[k]
            turn = turned(own, xyz(change[MOUNT_ROTATION]))
            apart = along(offset, -1.0, cross(turn, arm))
            apart = along(apart, -1.0, turned(own, xyz(change[MOUNT_TRANSLATION])))
        beam = along(p, -1.0, xyz(lever))
        sight = Sight(p, beam, turned_back(own, arm), turned_back(own, reach))
        height, square = dot(offset, axis), dot(offset, offset)
        square = square - height * height if edge else height * height
        variance = (sigmas[0] if edge else sigmas[1]) ** 2 + square / 9.0
        slopes, pull = UNIT, axis
        if not edge:
            slopes = _slopes(first, xyz(found.near[i, middle]), xyz(found.near[i, last]))
            pull = slopes[0]
            for j in range(3):
                part = dot(offset, slopes[j])
                fraction = 1.0 + part if j == 0 else part
                variance += found.scatter[i] * fraction * fraction
                pull = along(pull, part, slopes[j])
        weight = found.weights[i] / variance
        for b in range(POSE_DIM):
            columns[CLONE_AT + b] = head + POSE_DIM * slot + b if slot >= 0 else -1
        for c in range(3 if edge else 1):
            direction = along(UNIT[c], -axis[c], axis) if edge else axis
            residual = dot(apart, direction)
            _row_into(row, direction, pose.rotation, own, sight, alone)
            for a in range(width):
                if columns[a] < 0:
                    continue
                scaled = weight * row[a]
                vector[columns[a]] -= scaled * residual
                for b in range(a + 1):
                    if columns[b] >= 0:
                        information[columns[a], columns[b]] += scaled * row[b]
        if edge:
            continue
        for j in range(3 if with_noise else 0):
            _row_into(row, slopes[j], pose.rotation, own, sight, True)
            for a in range(POSE_DIM):
                for b in range(POSE_DIM):
                    noise[a, b] += weight * found.scatter[i] * row[a] * row[b]
        _row_into(row, pull, pose.rotation, own, sight, alone)
        for a in range(width):
            if columns[a] >= 0:
                vector[columns[a]] += weight * found.scatter[i] * row[a]
    for a in range(size):
        for b in range(a):
            information[b, a] = information[a, b]
    return ScanEquations(information, vector, noise)


@njit(cache=True, error_model="numpy")
def _row_into(
    row: Array, direction: Vector, imu: Array, clone: Array, sight: Sight, alone: bool
) -> None:
    """`derivatives_into`, with the direction turned to the frames ``imu`` and ``clone`` (3, 3)."""
    in_imu, in_clone = turned_back(imu, direction), turned_back(clone, direction)
    derivatives_into(row, direction, in_imu, in_clone, sight, alone)


@njit(cache=True, error_model="numpy")
def _slopes(first: Vector, middle: Vector, last: Vector) -> tuple[Vector, Vector, Vector]:
    """The gradients of the barycentric coordinates in a triangle, of each corner."""
    side, other = along(middle, -1.0, first), along(last, -1.0, first)
    normal = cross(side, other)
    size = 1.0 / dot(normal, normal)
    second = along(ZERO, size, cross(other, normal))
    third = along(ZERO, size, cross(normal, side))
    return along(along(ZERO, -1.0, second), -1.0, third), second, third


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
    """Result of Algorithm 1: ``pose`` is odom_from_imu."""

    pose: Pose
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
    return 1.0 - EIGENVALUE_RATIO * values[:, 1] / values[:, 2]


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
    lines, _, values = neighbourhood_shapes(edges.near, edges.found)
    planes = maps.planes.nearest(pose.apply(features.planes), moves)
    shapes = neighbourhood_shapes(planes.near, planes.found)
    flats = shapes.planes & _flat_triangles(planes.near)

    near = np.concatenate([edges.near[lines], planes.near[flats]])
    count = int(lines.sum())
    is_edge = np.arange(len(near)) < count
    weights, scatter = np.ones(len(near)), np.zeros(len(near))
    weights[:count] = line_weights(values[lines])
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
        pose=pose, weak=weak, matches=found, converged=converged,
        edges=int(edges.sum()), planes=int((~edges).sum()),
        rms_m=float(np.sqrt(np.mean(lengths**2))),
    )  # fmt: skip
