"""Points, planes and states for tests of the LIDAR update."""

from __future__ import annotations

import numpy as np

from touchdown.estimator.filtering.imu_propagation import NavState
from touchdown.estimator.livo.anchored_update import anchored_information


def state_at(rotation: np.ndarray, position: np.ndarray) -> NavState:
    return NavState(0, rotation, position, np.zeros(3), np.zeros(3), np.zeros(3))


def plane_information(
    points: np.ndarray, beams: np.ndarray, rotation: np.ndarray, position: np.ndarray,
    found: np.ndarray, normals: np.ndarray, anchors: np.ndarray, variances: np.ndarray,
    *noise: float,
) -> tuple[np.ndarray, np.ndarray, int, float]:  # fmt: skip
    """That of planes that hang on nothing, of a rig taken for certain."""
    slots = np.full(len(points), -1, dtype=np.int64)
    planes = (found, normals, anchors, variances, np.zeros_like(anchors), slots)
    none = np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros((0, 6))
    return anchored_information(points, beams, rotation, position, planes, *none, 0, *noise)


def room_points(rng: np.random.Generator, walls: bool) -> np.ndarray:
    """Ground of 30 x 30 m, and two walls that stand on it."""
    ground = np.column_stack([rng.uniform(-15, 15, (20_000, 2)), np.zeros(20_000)])
    if not walls:
        return ground
    wall_x = np.column_stack(
        [np.full(3000, 6.3), rng.uniform(-5, 5, 3000), rng.uniform(0, 5, 3000)]
    )
    wall_y = np.column_stack(
        [rng.uniform(-5, 5, 3000), np.full(3000, -7.4), rng.uniform(0, 5, 3000)]
    )
    return np.vstack([ground, wall_x, wall_y])
