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
from touchdown.estimator.filtering.imu_propagation import (
    cross_into,
    rotate_back_into,
    rotate_into,
)

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# a residual's derivatives: pose, mount of the LIDAR, and the clone that the map point belongs to
_MOUNT, _CLONE = POSE_DIM, POSE_DIM + MOUNT_DIM
_WIDTH = _CLONE + POSE_DIM


class Matches(NamedTuple):
    """Feature points of a scan with a line or plane nearby."""

    points: Array  # (M, 3) IMU frame
    near: Array  # (M, 5, 3) their neighbours p_1 ... p_5, odom frame
    axes: Array  # (M, 3) directions of the lines, normals of the planes
    is_edge: Mask  # (M,)
    owners: NDArray[np.int64]  # (M,) clone of the filter that p_1 belongs to; -1: none
    sensors: Array  # (M, 3) where p_1 was seen from, odom frame

    def select(self, keep: Mask) -> Matches:
        """The subset picked by a mask (M,)."""
        return Matches(
            self.points[keep], self.near[keep], self.axes[keep], self.is_edge[keep],
            self.owners[keep], self.sensors[keep],
        )  # fmt: skip


NO_ANCHORS = Anchors().frames([], np.zeros(0), np.zeros(0, np.int64))


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
def relative_equations(
    found: Matches, lever: Array, pose: Frame, anchors: AnchorFrames, touched: int, shared: int,
    sigmas: Array,
) -> tuple[Array, Array]:  # fmt: skip
    """Normal equations of the residuals of Eq. 10 over pose, shared calibration and the touched
    clones, Cauchy weighted (scale 3 sigma). ``lever`` (3,): of the LIDAR, IMU frame; ``sigmas``
    (2,): of edges and of planes.

    A map point was seen along a beam of its own, which turns with the LIDAR's mount as that of the
    scan does, and moves with its clone.
    """
    head = POSE_DIM + shared
    size = head + POSE_DIM * touched
    width = POSE_DIM if size == POSE_DIM else _WIDTH
    information, vector = np.zeros((size, size)), np.zeros(size)
    row, columns = np.zeros(_WIDTH), np.empty(_WIDTH, np.int64)
    x, m, offset, beam, arm = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    direction, now, then, reach = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    moment = np.zeros(3)
    for i in range(found.points.shape[0]):
        p, axis, k, edge = found.points[i], found.axes[i], found.owners[i], found.is_edge[i]
        own, slot = pose.rotation, -1
        rotate_into(pose.rotation, p, x)
        m[:] = found.near[i, 0]
        if k >= 0:
            own, slot = anchors.clones.rotations[k], anchors.slots[k]
            rotate_into(anchors.moves.rotations[k], found.near[i, 0], m)
        along, square = 0.0, 0.0
        for c in range(3):
            if k >= 0:
                m[c] += anchors.moves.translations[k, c]
                reach[c] = x[c] + pose.translation[c] - anchors.clones.translations[k, c]
            offset[c] = x[c] + pose.translation[c] - m[c]
            arm[c], beam[c] = m[c] - found.sensors[i, c], p[c] - lever[c]
            along += offset[c] * axis[c]
            square += offset[c] * offset[c]
        square = square - along * along if edge else along * along
        weight = 1.0 / ((sigmas[0] if edge else sigmas[1]) ** 2 + square / 9.0)
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
            rotate_back_into(pose.rotation, direction, now)
            rotate_back_into(own, direction, then)
            cross_into(p, now, row, ROTATION.start)
            cross_into(beam, now, row, _MOUNT + MOUNT_ROTATION.start)
            _moment_into(own, reach, then, moment)
            for a in range(3):
                row[POSITION.start + a] = direction[a]
                row[_CLONE + ROTATION.start + a] = -moment[a]
                row[_CLONE + POSITION.start + a] = -direction[a]
            _moment_into(own, arm, then, moment)
            for a in range(3):
                if k >= 0:
                    change = anchors.mount_changes[k]
                    residual -= moment[a] * change[MOUNT_ROTATION.start + a]
                    residual -= then[a] * change[MOUNT_TRANSLATION.start + a]
                row[_MOUNT + MOUNT_ROTATION.start + a] -= moment[a]
                row[_MOUNT + MOUNT_TRANSLATION.start + a] = now[a] - then[a]
            for a in range(width):
                if columns[a] < 0:
                    continue
                scaled = weight * row[a]
                vector[columns[a]] -= scaled * residual
                for b in range(width):
                    if columns[b] >= 0:
                        information[columns[a], columns[b]] += scaled * row[b]
    return information, vector


@njit(cache=True)
def _moment_into(rotation: Array, arm: Array, then: Array, out: Array) -> None:
    """Writes ``(R^T arm) x then`` into ``out``."""
    inside = np.empty(3)
    rotate_back_into(rotation, arm, inside)
    cross_into(inside, then, out, 0)
