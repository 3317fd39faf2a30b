"""Residuals of Algorithm 1: distances from lines and planes (Eq. 10) and their normal equations."""

from __future__ import annotations

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
)
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
from touchdown.estimator.typing import Array, Indices, Mask


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
