"""Residuals of Algorithm 1: distances from lines and planes (Eq. 10) and their normal equations."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from touchdown.estimator.filtering.anchors import AnchorFrames, Anchors
from touchdown.estimator.filtering.error_state import (
    MOUNT_DIM,
    MOUNT_ROTATION,
    MOUNT_TRANSLATION,
    POSE_DIM,
    POSITION,
    ROTATION,
    Frame,
)
from touchdown.estimator.filtering.imu_propagation import cross_into
from touchdown.estimator.typing import Array, Indices, Mask

# a residual's derivatives: pose, mount of the LIDAR, and the clone that the map point belongs to
_MOUNT, _CLONE = POSE_DIM, POSE_DIM + MOUNT_DIM
_WIDTH = _CLONE + POSE_DIM


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

    def select(self, keep: Mask) -> Matches:
        """The subset picked by a mask (M,)."""
        return Matches(
            self.points[keep], self.near[keep], self.axes[keep], self.is_edge[keep],
            self.owners[keep], self.sensors[keep], self.weights[keep], self.scatter[keep],
        )  # fmt: skip


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
    square, length2 = 0.0, 0.0
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        cross = (point[b] - first[b]) * (point[c] - last[c])
        cross -= (point[c] - first[c]) * (point[b] - last[b])
        square += cross * cross
        length2 += (first[a] - last[a]) ** 2
    return np.sqrt(square / length2)


@njit(cache=True, error_model="numpy")
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


Vector = tuple[float, float, float]
_UNIT = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@njit(cache=True, error_model="numpy")
def _vector(values: Array) -> Vector:
    """Three numbers as a tuple, which stays in registers."""
    return values[0], values[1], values[2]


@njit(cache=True, error_model="numpy")
def _along(start: Vector, length: float, direction: Vector) -> Vector:
    return (
        start[0] + length * direction[0],
        start[1] + length * direction[1],
        start[2] + length * direction[2],
    )


@njit(cache=True, error_model="numpy")
def _dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True, error_model="numpy")
def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(cache=True, error_model="numpy")
def _turned(r: Array, v: Vector) -> Vector:
    """``r @ v``"""
    return (
        r[0, 0] * v[0] + r[0, 1] * v[1] + r[0, 2] * v[2],
        r[1, 0] * v[0] + r[1, 1] * v[1] + r[1, 2] * v[2],
        r[2, 0] * v[0] + r[2, 1] * v[1] + r[2, 2] * v[2],
    )


@njit(cache=True, error_model="numpy")
def _turned_back(r: Array, v: Vector) -> Vector:
    """``r.T @ v``"""
    return (
        r[0, 0] * v[0] + r[1, 0] * v[1] + r[2, 0] * v[2],
        r[0, 1] * v[0] + r[1, 1] * v[1] + r[2, 1] * v[2],
        r[0, 2] * v[0] + r[1, 2] * v[1] + r[2, 2] * v[2],
    )


class _Sight(NamedTuple):
    """A point of the scan and what it is compared with, in the odom frame unless said."""

    rotation: Array  # (3, 3) odom_from_imu of the scan
    own: Array  # (3, 3) of the clone that the map point belongs to
    point: Vector  # IMU frame
    beam: Vector  # IMU frame, from the LIDAR
    reach: Vector  # from the clone
    arm: Vector  # to the map point, from where it was seen


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
    width = POSE_DIM if alone else _WIDTH
    information, vector = np.zeros((size, size)), np.zeros(size)
    noise, row = np.zeros((POSE_DIM, POSE_DIM)), np.zeros(_WIDTH)
    columns = np.arange(_WIDTH) if shared > 0 or alone else np.full(_WIDTH, -1)
    columns[:POSE_DIM] = np.arange(POSE_DIM)
    last, middle = found.near.shape[1] - 1, found.near.shape[1] // 2
    for i in range(found.points.shape[0]):
        p, axis = _vector(found.points[i]), _vector(found.axes[i])
        k, edge = found.owners[i], found.is_edge[i]
        first = _vector(found.near[i, 0])
        here = _along(_vector(pose.translation), 1.0, _turned(pose.rotation, p))
        offset, arm = _along(here, -1.0, first), _along(first, -1.0, _vector(found.sensors[i]))
        own, slot, reach, apart = pose.rotation, -1, here, offset
        if k >= 0:
            # where the present mount would have put the map point
            own, slot = anchors.clones.rotations[k], anchors.slots[k]
            reach = _along(here, -1.0, _vector(anchors.clones.translations[k]))
            change = anchors.mount_changes[k]
            turn = _turned(own, _vector(change[MOUNT_ROTATION]))
            apart = _along(offset, -1.0, _cross(turn, arm))
            apart = _along(apart, -1.0, _turned(own, _vector(change[MOUNT_TRANSLATION])))
        sight = _Sight(pose.rotation, own, p, _along(p, -1.0, _vector(lever)), reach, arm)
        along, square = _dot(offset, axis), _dot(offset, offset)
        square = square - along * along if edge else along * along
        variance = (sigmas[0] if edge else sigmas[1]) ** 2 + square / 9.0
        slopes, pull = _UNIT, axis
        if not edge:
            slopes = _slopes(first, _vector(found.near[i, middle]), _vector(found.near[i, last]))
            pull = slopes[0]
            for j in range(3):
                part = _dot(offset, slopes[j])
                share = 1.0 + part if j == 0 else part
                variance += found.scatter[i] * share * share
                pull = _along(pull, part, slopes[j])
        weight = found.weights[i] / variance
        for b in range(POSE_DIM):
            columns[_CLONE + b] = head + POSE_DIM * slot + b if slot >= 0 else -1
        for c in range(3 if edge else 1):
            direction = _along(_UNIT[c], -axis[c], axis) if edge else axis
            residual = _dot(apart, direction)
            _row_into(direction, sight, alone, row)
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
            _row_into(slopes[j], sight, True, row)
            for a in range(POSE_DIM):
                for b in range(POSE_DIM):
                    noise[a, b] += weight * found.scatter[i] * row[a] * row[b]
        _row_into(pull, sight, alone, row)
        for a in range(width):
            if columns[a] >= 0:
                vector[columns[a]] += weight * found.scatter[i] * row[a]
    for a in range(size):
        for b in range(a):
            information[b, a] = information[a, b]
    return ScanEquations(information, vector, noise)


@njit(cache=True, error_model="numpy")
def _row_into(direction: Vector, sight: _Sight, alone: bool, row: Array) -> None:
    """Writes the derivatives of a distance along ``direction`` by pose and, unless ``alone``, by
    mount and clone into ``row``."""
    turned = _turned_back(sight.rotation, direction)
    by_rotation = _cross(sight.point, turned)
    for a in range(3):
        row[ROTATION.start + a], row[POSITION.start + a] = by_rotation[a], direction[a]
    if alone:
        return
    then = _turned_back(sight.own, direction)
    beam = _cross(sight.beam, turned)
    moment = _turned_back(sight.own, _cross(sight.arm, direction))
    by_clone = _turned_back(sight.own, _cross(sight.reach, direction))
    for a in range(3):
        row[_MOUNT + MOUNT_ROTATION.start + a] = beam[a] - moment[a]
        row[_MOUNT + MOUNT_TRANSLATION.start + a] = turned[a] - then[a]
        row[_CLONE + ROTATION.start + a] = -by_clone[a]
        row[_CLONE + POSITION.start + a] = -direction[a]


@njit(cache=True, error_model="numpy")
def _slopes(first: Vector, middle: Vector, last: Vector) -> tuple[Vector, Vector, Vector]:
    """The gradients of the barycentric coordinates in a triangle, of each corner."""
    side, other = _along(middle, -1.0, first), _along(last, -1.0, first)
    normal, zero = _cross(side, other), (0.0, 0.0, 0.0)
    size = 1.0 / _dot(normal, normal)
    second = _along(zero, size, _cross(other, normal))
    third = _along(zero, size, _cross(normal, side))
    return _along(_along(zero, -1.0, second), -1.0, third), second, third
