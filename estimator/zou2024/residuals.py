"""Residuals of Algorithm 1: distances from lines and planes (Eq. 10) and their normal equations."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

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
from touchdown.estimator.filtering.imu_propagation import cross_into, rotate_back_into, rotate_into

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# a residual's derivatives: pose, mount of the LIDAR, and the clone that the map point belongs to
_MOUNT, _CLONE = POSE_DIM, POSE_DIM + MOUNT_DIM
_WIDTH = _CLONE + POSE_DIM


class Matches(NamedTuple):
    """Feature points of a scan with a line or plane nearby."""

    points: Array  # (M, 3) IMU frame
    near: Array  # (M, 5, 3) their neighbours p_1 ... p_5, odom frame, where they are now
    axes: Array  # (M, 3) directions of the lines, normals of the planes
    is_edge: Mask  # (M,)
    owners: NDArray[np.int64]  # (M,) clone of the filter that p_1 belongs to; -1: none
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


class _Sight(NamedTuple):
    """A point of the scan and what it is compared with, in the odom frame unless said."""

    rotation: Array  # (3, 3) odom_from_imu of the scan
    own: Array  # (3, 3) of the clone that the map point belongs to
    point: Array  # (3,) IMU frame
    beam: Array  # (3,) IMU frame, from the LIDAR
    reach: Array  # (3,) from the clone
    arm: Array  # (3,) to the map point, from where it was seen


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
    width = POSE_DIM if size == POSE_DIM else _WIDTH
    information, vector = np.zeros((size, size)), np.zeros(size)
    noise = np.zeros((POSE_DIM, POSE_DIM))
    row, columns, slopes = np.zeros(_WIDTH), np.empty(_WIDTH, np.int64), np.zeros((3, 3))
    sight = _Sight(pose.rotation, pose.rotation, np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3))
    m, offset, direction, pull = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    then, moment = np.zeros(3), np.zeros(3)
    last, middle = found.near.shape[1] - 1, found.near.shape[1] // 2
    for i in range(found.points.shape[0]):
        p, axis, k, edge = found.points[i], found.axes[i], found.owners[i], found.is_edge[i]
        own, slot = pose.rotation, -1
        rotate_into(pose.rotation, p, offset)
        m[:] = found.near[i, 0]
        if k >= 0:
            own, slot = anchors.clones.rotations[k], anchors.slots[k]
        sight = _Sight(pose.rotation, own, p, sight.beam, sight.reach, sight.arm)
        along, square = 0.0, 0.0
        for c in range(3):
            offset[c] += pose.translation[c]
            if k >= 0:
                sight.reach[c] = offset[c] - anchors.clones.translations[k, c]
            offset[c] -= m[c]
            sight.arm[c], sight.beam[c] = m[c] - found.sensors[i, c], p[c] - lever[c]
            along += offset[c] * axis[c]
            square += offset[c] * offset[c]
        square = square - along * along if edge else along * along
        variance = (sigmas[0] if edge else sigmas[1]) ** 2 + square / 9.0
        if not edge:
            near = found.near[i]
            _slopes_into(near[0], near[middle], near[last], slopes)
            pull[:] = slopes[0]
            for j in range(3):
                share = 1.0 if j == 0 else 0.0
                for c in range(3):
                    share += offset[c] * slopes[j, c]
                variance += found.scatter[i] * share * share
                for c in range(3):
                    pull[c] += (share - (j == 0)) * slopes[j, c]
        weight = found.weights[i] / variance
        for b in range(POSE_DIM):
            columns[b] = b
            columns[_MOUNT + b] = _MOUNT + b if shared > 0 else -1
            columns[_CLONE + b] = head + POSE_DIM * slot + b if slot >= 0 else -1
        for c in range(3 if edge else 1):
            residual = along
            for a in range(3):
                direction[a] = -axis[c] * axis[a] if edge else axis[a]
            if edge:
                direction[c] += 1.0
                residual = offset[c] - along * axis[c]
            _row_into(direction, sight, row, then, moment)
            for a in range(3):
                if k >= 0:
                    change = anchors.mount_changes[k]
                    residual -= moment[a] * change[MOUNT_ROTATION.start + a]
                    residual -= then[a] * change[MOUNT_TRANSLATION.start + a]
            for a in range(width):
                if columns[a] < 0:
                    continue
                scaled = weight * row[a]
                vector[columns[a]] -= scaled * residual
                for b in range(width):
                    if columns[b] >= 0:
                        information[columns[a], columns[b]] += scaled * row[b]
        if edge:
            continue
        for j in range(3 if with_noise else 0):
            _row_into(slopes[j], sight, row, then, moment)
            for a in range(POSE_DIM):
                for b in range(POSE_DIM):
                    noise[a, b] += weight * found.scatter[i] * row[a] * row[b]
        _row_into(pull, sight, row, then, moment)
        for a in range(width):
            if columns[a] >= 0:
                vector[columns[a]] += weight * found.scatter[i] * row[a]
    return ScanEquations(information, vector, noise)


@njit(cache=True, error_model="numpy")
def _row_into(direction: Array, sight: _Sight, row: Array, then: Array, moment: Array) -> None:
    """Writes the derivatives of a distance along ``direction`` (3,) by pose, mount and clone into
    ``row``; into ``then`` the direction in the clone's IMU frame, and into ``moment`` that of the
    map point about where it was seen from."""
    turned = np.empty(3)
    cross_into(sight.reach, direction, moment, 0)
    rotate_back_into(sight.own, moment, turned)
    for a in range(3):
        row[POSITION.start + a] = direction[a]
        row[_CLONE + ROTATION.start + a] = -turned[a]
        row[_CLONE + POSITION.start + a] = -direction[a]
    cross_into(sight.arm, direction, turned, 0)
    rotate_back_into(sight.own, turned, moment)
    rotate_back_into(sight.own, direction, then)
    rotate_back_into(sight.rotation, direction, turned)
    cross_into(sight.point, turned, row, ROTATION.start)
    cross_into(sight.beam, turned, row, _MOUNT + MOUNT_ROTATION.start)
    for a in range(3):
        row[_MOUNT + MOUNT_ROTATION.start + a] -= moment[a]
        row[_MOUNT + MOUNT_TRANSLATION.start + a] = turned[a] - then[a]


@njit(cache=True, error_model="numpy")
def _slopes_into(first: Array, middle: Array, last: Array, out: Array) -> None:
    """Writes the gradients (3, 3) of the barycentric coordinates in a triangle, a row a corner."""
    normal, square = np.empty(3), 0.0
    side, other = np.empty(3), np.empty(3)
    for a in range(3):
        side[a], other[a] = middle[a] - first[a], last[a] - first[a]
    cross_into(side, other, normal, 0)
    for a in range(3):
        square += normal[a] * normal[a]
    cross_into(other, normal, out[1], 0)
    cross_into(normal, side, out[2], 0)
    for a in range(3):
        out[1, a] /= square
        out[2, a] /= square
        out[0, a] = -out[1, a] - out[2, a]
