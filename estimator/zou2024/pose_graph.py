"""Pose graph of the keyframes: odometry and closures, solved by Gauss-Newton on SE(3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix
from scipy.sparse.linalg import splu

from touchdown.estimator.filtering.error_state import (
    POSE_DIM,
    POSITION,
    ROTATION,
    after,
    error_between,
    moved_by,
)
from touchdown.estimator.typing import Array
from touchdown.sim.frames import Pose, skew, so3_log


@dataclass(slots=True)
class Edge:
    """Measured pose ``source_from_target``; ``information`` (6, 6) of the errors (rotation of the
    target, right perturbation; translation in the source frame)."""

    source: int
    target: int
    measured: Pose
    information: Array
    robust: bool
    """True for closures, which may be false; odometry is not robustified"""


def edge_residual(edge: Edge, source: Pose, target: Pose) -> Array:
    """(6,) ``log(M^T R_s^T R_t)`` and ``R_s^T (p_t - p_s) - m``."""
    rotation = edge.measured.rotation.T @ source.rotation.T @ target.rotation
    translation = source.rotation.T @ (target.translation - source.translation)
    return np.concatenate([so3_log(rotation), translation - edge.measured.translation])


_TARGET_ROTATION, _TARGET_POSITION = after(POSE_DIM, ROTATION), after(POSE_DIM, POSITION)
"""coordinates of the target among an edge's twelve, the source's six first"""


class PoseGraph:
    """Pose graph; nodes by number, in the order of addition. The first one fixes the map."""

    def __init__(
        self, anchor_sigmas: Array, level_sigmas: Array, robust_scale: float = 3.0
    ) -> None:
        """``anchor_sigmas`` (6,): of the first node; ``level_sigmas`` (6,): how well every node's
        rotation and position are known beforehand (rad, m; infinite where they are not): LIDAR and
        gravity measure height and tilt of each, whatever the path."""
        self.poses: dict[int, Pose] = {}
        self.edges: list[Edge] = []
        self._priors: dict[int, tuple[Pose, Array]] = {}
        self._anchor = 1.0 / anchor_sigmas**2
        self._level = 1.0 / level_sigmas**2
        self._robust_scale = robust_scale

    def add_node(self, number: int, guess: Pose, measured: Pose) -> None:
        """``measured``: pose whose height and tilt count (all six coordinates at the first)."""
        self._priors[number] = (measured, self._level if self.poses else self._anchor)
        self.poses[number] = guess

    def measure_node(self, number: int, measured: Pose) -> None:
        """Replaces the ``measured`` pose of a node."""
        self._priors[number] = (measured, self._priors[number][1])

    def add_edge(self, edge: Edge) -> None:
        """Raises KeyError if one of its ends is not a node."""
        for number in (edge.source, edge.target):
            if number not in self.poses:
                raise KeyError(f"the pose graph has no node {number}")
        self.edges.append(edge)

    def remove_node(self, number: int) -> None:
        """Removes a node and joins its two odometry edges into one."""
        before = [e for e in self.edges if e.target == number and not e.robust]
        after = [e for e in self.edges if e.source == number and not e.robust]
        self.edges = [e for e in self.edges if number not in (e.source, e.target)]
        del self._priors[number]
        first = next(iter(self.poses)) == number
        del self.poses[number]
        if before and after:
            covariance = np.linalg.inv(before[0].information) + np.linalg.inv(after[0].information)
            self.edges.append(
                Edge(
                    before[0].source, after[0].target, before[0].measured @ after[0].measured,
                    np.linalg.inv(covariance), False,
                )
            )  # fmt: skip
        if first and self.poses:
            successor = next(iter(self.poses))
            self._priors[successor] = (self.poses[successor], self._anchor)

    def optimise(self, iterations: int = 2) -> None:
        """Minimises the weighted sum of squares over the nodes."""
        for _ in range(iterations):
            matrix, vector = self._system()
            steps = splu(matrix).solve(vector).reshape(-1, 6)
            for number, step in zip(list(self.poses), steps, strict=True):
                self.poses[number] = moved_by(self.poses[number], step)

    def position_covariance(self, number: int) -> Array:
        """(3, 3) m^2 of a node's position given everything in the graph."""
        matrix, _ = self._system()
        row = 6 * list(self.poses).index(number)
        units = np.zeros((matrix.shape[0], 3))
        units[row + 3 + np.arange(3), np.arange(3)] = 1.0
        block: Array = splu(matrix).solve(units)[row + 3 : row + 6]
        return 0.5 * (block + block.T)

    def _system(self) -> tuple[csc_matrix, Array]:
        order = {number: i for i, number in enumerate(self.poses)}
        size = 6 * len(order)
        vector = np.zeros(size)
        diagonal = np.zeros(size)
        for number, (pose, weights) in self._priors.items():
            at = 6 * order[number]
            diagonal[at : at + 6] = weights
            vector[at : at + 6] = -weights * error_between(pose, self.poses[number])
        values, rows, cols = diagonal, np.arange(size), np.arange(size)
        if self.edges:
            blocks, vectors = self._edge_blocks()
            ends = np.array([(order[e.source], order[e.target]) for e in self.edges])
            where = (6 * ends[:, :, None] + np.arange(6)).reshape(-1, 12)
            np.add.at(vector, where, vectors)
            values = np.concatenate([blocks.ravel(), values])
            rows = np.concatenate([np.repeat(where, 12, axis=1).ravel(), rows])
            cols = np.concatenate([np.tile(where, (1, 12)).ravel(), cols])
        return coo_matrix((values, (rows, cols)), shape=(size, size)).tocsc(), vector

    def _edge_blocks(self) -> tuple[Array, Array]:
        """Blocks (E, 12, 12) and vectors (E, 12), the source's six coordinates first."""
        poses = self.poses
        residuals = np.array(
            [edge_residual(e, poses[e.source], poses[e.target]) for e in self.edges]
        )
        back = np.array([poses[e.source].rotation.T for e in self.edges])
        target = np.array([poses[e.target].rotation for e in self.edges])
        translations = residuals[:, 3:] + np.array([e.measured.translation for e in self.edges])
        # inverse of the right Jacobian, to first order of the (small) rotation residual
        curl = np.eye(3) + 0.5 * np.array([skew(r) for r in residuals[:, ROTATION]])
        jacobians = np.zeros((len(self.edges), POSE_DIM, 2 * POSE_DIM))
        jacobians[:, ROTATION, ROTATION] = -curl @ (back @ target).transpose(0, 2, 1)
        jacobians[:, ROTATION, _TARGET_ROTATION] = curl
        jacobians[:, POSITION, ROTATION] = [skew(translation) for translation in translations]
        jacobians[:, POSITION, POSITION] = -back
        jacobians[:, POSITION, _TARGET_POSITION] = back
        informations = np.array([e.information for e in self.edges])
        square = np.einsum("ei,eij,ej->e", residuals, informations, residuals)
        robust = np.array([e.robust for e in self.edges])
        weights = np.where(robust, 1.0 / (1.0 + square / self._robust_scale**2), 1.0)
        weighted = jacobians.transpose(0, 2, 1) @ informations * weights[:, None, None]
        return weighted @ jacobians, -(weighted @ residuals[:, :, None])[:, :, 0]
