"""Displacement of the camera between two images from the optical flow of the ground.

Directions are in the axes of the world and scaled to one metre of descent, ``(x, y, -1)``: rotated
by the attitude, so that the flow depends only on the displacement and the height above level
ground. (De-rotation by the gyroscope, as in every optical flow sensor.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from touchdown.estimator.baselines.aiding import update
from touchdown.estimator.filtering.error_state import CLONE_DIM, POSE_DIM, POSITION, ROTATION, after
from touchdown.estimator.filtering.eskf import Eskf
from touchdown.estimator.filtering.keyframes import bearing_rays
from touchdown.estimator.typing import Array
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.frames import skew

_MIN_DESCENT = 0.2
"""Directions flatter than this do not count as ground below."""


def level_directions(pixels: Array, camera: CameraIntrinsics, world_from_camera: Array) -> Array:
    """(N, 2) x and y of the directions of undistorted ``pixels`` (N, 2) one metre down; NaN where
    a direction does not point down."""
    world = bearing_rays(pixels, camera) @ world_from_camera.T
    down = np.where(world[:, 2] < -_MIN_DESCENT, -world[:, 2], np.nan)
    directions: Array = world[:, :2] / down[:, None]
    return directions


def pixels_of(directions: Array, camera: CameraIntrinsics, world_from_camera: Array) -> Array:
    """The inverse of ``level_directions``: (N, 2) pixels."""
    world = np.column_stack([directions, np.full(len(directions), -1.0)])
    rays = world @ world_from_camera
    pixels: Array = rays[:, :2] / rays[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    return pixels


@dataclass(frozen=True, kw_only=True, slots=True)
class Displacement:
    """The camera's motion since the previous image, and its derivatives by errors of attitude."""

    translation: Array
    """(3,) m, world axes: position before minus position now"""
    covariance: Array
    """(3, 3) m^2 from the noise of the flow alone"""
    by_rotation_before: Array
    """(3, 3) change of the true translation per rad of error of the attitude before, world axes"""
    by_rotation_now: Array
    used: int
    rms: float
    """root mean square of the residuals, metres on the ground"""


def _rotation_jacobian(directions: Array) -> Array:
    """(N, 2, 3) derivatives of level directions by a small world rotation of their frame."""
    x, y = directions[:, 0], directions[:, 1]
    one = np.ones_like(x)
    # d(ray) = theta x ray for ray (x, y, -1), back onto one metre of descent
    along_x = np.stack([x * y, -one - x * x, -y], axis=1)
    along_y = np.stack([one + y * y, -x * y, x], axis=1)
    return np.stack([along_x, along_y], axis=1)


def solve_displacement(
    before: Array,
    now: Array,
    height_m: float,
    sigma: float,
    min_used: int = 8,
) -> Displacement | None:
    """The displacement that carries ground points seen along ``before`` (N, 2) to ``now`` (N, 2),
    level directions. ``height_m``: of the camera above the ground when the first was taken;
    ``sigma``: of a direction's error.

    Points X = h (x, y, -1) reappear at X + t, so that every direction gives two equations linear in
    t: ``X_x + t_x + x' (X_z + t_z) = 0`` and the same of y. Least squares with Cauchy weights,
    whose scale is the median residual. None if fewer than ``min_used`` directions agree.
    """
    fine = np.isfinite(before).all(axis=1) & np.isfinite(now).all(axis=1)
    if int(fine.sum()) < min_used or not height_m > 0.0:
        return None
    before, now = before[fine], now[fine]
    rows = np.zeros((len(now), 2, 3))
    rows[:, 0, 0] = rows[:, 1, 1] = 1.0
    rows[:, :, 2] = now
    target = -height_m * (before - now)
    noise = sigma * height_m
    translation = np.array([*np.median(target, axis=0), 0.0])
    weights = np.ones(len(now))
    normal = np.eye(3)
    for _ in range(5):
        residuals = np.hypot(*(target - rows @ translation).T)
        scale = max(2.0 * float(np.median(residuals)), 2.0 * noise)
        weights = 1.0 / (1.0 + (residuals / scale) ** 2)
        weighted = weights[:, None, None] * rows / noise**2
        normal = np.einsum("nij,nik->jk", weighted, rows)
        translation = np.linalg.solve(normal, np.einsum("nij,ni->j", weighted, target))
    residuals = np.hypot(*(target - rows @ translation).T)
    scale = max(2.0 * float(np.median(residuals)), 2.0 * noise)
    agree = residuals < 2.0 * scale
    if int(agree.sum()) < min_used:
        return None
    weighted = weights[:, None, None] * rows / noise**2
    inverse: Array = np.asarray(np.linalg.inv(normal), np.float64)
    lower = height_m - translation[2]
    rotation_before = np.einsum("nij,nik->jk", weighted, _rotation_jacobian(before)) * height_m
    rotation_now = np.einsum("nij,nik->jk", weighted, _rotation_jacobian(now)) * lower
    return Displacement(
        translation=translation, covariance=inverse, by_rotation_before=-inverse @ rotation_before,
        by_rotation_now=inverse @ rotation_now, used=int(agree.sum()),
        rms=float(np.sqrt(np.mean(residuals[agree] ** 2))),
    )  # fmt: skip


def update_with_displacement(
    eskf: Eskf,
    measured: Displacement,
    lever_imu: Array,
    *,
    floor_m: float,
    scale_sigma: float,
    gate: float,
) -> float:
    """Updates the filter by a displacement since its only clone, the pose of the previous image.

    ``lever_imu`` (3,): position of the camera in the IMU frame. ``floor_m`` and ``scale_sigma``:
    errors that do not average out over directions, in metres and as a fraction of the displacement
    (the ground is not level, the height is that of one spot). Returns the normalised innovation in
    standard deviations.
    """
    state, clone = eskf.state, eskf.clones[0]
    arm, arm_before = state.rotation @ lever_imu, clone.rotation @ lever_imu
    expected = clone.translation + arm_before - state.position - arm
    jacobian = np.zeros((3, POSE_DIM + CLONE_DIM))
    then_rotation, then_position = after(POSE_DIM, ROTATION), after(POSE_DIM, POSITION)
    lever = skew(lever_imu)
    jacobian[:, ROTATION] = state.rotation @ lever - measured.by_rotation_now @ state.rotation
    jacobian[:, POSITION] = -np.eye(3)
    jacobian[:, then_rotation] = (
        -clone.rotation @ lever - measured.by_rotation_before @ clone.rotation
    )
    jacobian[:, then_position] = np.eye(3)
    translation = measured.translation
    covariance = measured.covariance + floor_m**2 * np.eye(3)
    covariance = covariance + scale_sigma**2 * np.outer(translation, translation)
    return update(eskf, eskf.touched([0]), jacobian, translation - expected, covariance, gate)
