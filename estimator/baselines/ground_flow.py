"""Motion between two images: corners tracked by pyramidal Lucas-Kanade (Bouguet 2001), the shift by
phase correlation from coarse to fine, and the displacement of the camera by the flow of the ground.

The inverse transform of the normalised cross-power spectrum of two shifted images has a single peak
at the shift (Kuglin and Hines 1975). A coarse image finds shifts of up to half its side reliably;
finer ones, cropped along the shift found so far, refine it.

Directions are in the axes of the world and scaled to one metre of descent, ``(x, y, -1)``: rotated
by the attitude, so that the flow depends only on the displacement and the height above level
ground. (De-rotation by the gyroscope, as in every optical flow sensor.)
"""

from dataclasses import dataclass

import cv2
import numpy as np

from touchdown.estimator.baselines.aiding import update
from touchdown.estimator.filtering.error_state import (
    CAMERA_ROTATION,
    CAMERA_TRANSLATION,
    CLOCK,
    CLONE_DIM,
    POSE,
    POSE_DIM,
    POSITION,
    ROTATION,
    after,
)
from touchdown.estimator.filtering.eskf import Eskf
from touchdown.estimator.filtering.keyframes import bearing_rays
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.frames import skew
from touchdown.sim.typing import Array, Float32, Grey, Indices

_WINDOW = (15, 15)
_LEVELS = 2
_STOP = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 15, 0.01)


def follow(before: Grey, now: Grey, pixels: Array, guess: Array) -> tuple[Indices, Array]:
    """Tracks corners ``pixels`` (N, 2) of ``before`` into ``now``, from ``guess`` (N, 2): returns
    the indices (M,) of those found, and their pixels (M, 2)."""
    if len(pixels) == 0:
        return np.zeros(0, np.int64), np.zeros((0, 2))
    found, good, _ = cv2.calcOpticalFlowPyrLK(
        before, now, pixels.astype(np.float32)[:, None], guess.astype(np.float32)[:, None].copy(),
        winSize=_WINDOW, maxLevel=_LEVELS, criteria=_STOP, flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    reached = found[:, 0].astype(np.float64)
    height, width = now.shape
    inside = (reached >= 0.0).all(axis=1) & (reached <= [width - 1, height - 1]).all(axis=1)
    kept = np.flatnonzero((good[:, 0] > 0) & inside)
    return kept, reached[kept]


_MIN_RESPONSE = 0.05
"""fraction of the energy in the peak's neighbourhood below which a scale is rejected"""

_MIN_CONTRAST = 0.5
"""grey levels, standard deviation"""


@dataclass(frozen=True, slots=True)
class Shift:
    """``pixels`` (2,): x and y motion of the content from the first image to the second;
    ``response``: fraction of the energy in the peak of the finest accepted scale, 0 for none."""

    pixels: Array
    response: float


def phase_shift(before: Grey, now: Grey, levels: int = 3) -> Shift:
    """Returns the shift between two images of equal, even shape (H, W), to a fraction of a pixel.

    ``levels``: number of halvings of the side for the coarsest scale, plus one. A scale is rejected
    where its response is low, or where it moves the result by more than two of the coarser pixels.
    """
    scales = [(before, now)]
    for _ in range(levels - 1):
        first, second = (np.asarray(cv2.pyrDown(image), np.uint8) for image in scales[-1])
        scales.append((first, second))
    shift, response = np.zeros(2), 0.0
    for level in range(levels - 1, -1, -1):
        factor = float(1 << level)
        whole = np.rint(shift / factor).astype(int)
        pair = _common(*scales[level], whole)
        if pair is None:
            continue
        # Hann's window suppresses the image border in the spectrum
        window = cv2.createHanningWindow(pair[0].shape[::-1], cv2.CV_32F)
        (dx, dy), peak = cv2.phaseCorrelate(*pair, window)
        found = factor * (whole + np.array([dx, dy]))
        coarsest = level == levels - 1
        if peak > _MIN_RESPONSE and (coarsest or np.abs(found - shift).max() < 4.0 * factor):
            shift, response = found, float(peak)
    return Shift(shift, response)


def _common(before: Grey, now: Grey, shift: Indices) -> tuple[Float32, Float32] | None:
    """Returns the common part of both images once ``now`` is moved back by ``shift``, without the
    mean; None if it is too small or has no contrast."""
    height, width = before.shape
    dx, dy = int(shift[0]), int(shift[1])
    if width - abs(dx) < 24 or height - abs(dy) < 24:
        return None
    first = before[max(-dy, 0) : height - max(dy, 0), max(-dx, 0) : width - max(dx, 0)]
    second = now[max(dy, 0) : height - max(-dy, 0), max(dx, 0) : width - max(-dx, 0)]
    pair = first.astype(np.float32), second.astype(np.float32)
    if min(float(image.std()) for image in pair) < _MIN_CONTRAST:
        return None
    return pair[0] - pair[0].mean(), pair[1] - pair[1].mean()


_MIN_DESCENT = 0.2
"""Directions flatter than this do not count as ground below."""


def level_directions(pixels: Array, camera: CameraIntrinsics, world_from_camera: Array) -> Array:
    """(N, 2) x and y of the directions of undistorted ``pixels`` (N, 2) one metre down; NaN where
    a direction does not point down."""
    world = bearing_rays(pixels, camera) @ world_from_camera.T
    down = np.where(world[:, 2] < -_MIN_DESCENT, -world[:, 2], np.nan)
    return world[:, :2] / down[:, None]


def pixels_of(directions: Array, camera: CameraIntrinsics, world_from_camera: Array) -> Array:
    """The inverse of ``level_directions``: (N, 2) pixels."""
    world = np.column_stack([directions, np.full(len(directions), -1.0)])
    rays = world @ world_from_camera
    return rays[:, :2] / rays[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]


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
    twist_before: Array,
    *,
    floor_m: float,
    scale_sigma: float,
    gate: float,
) -> float:
    """Updates the filter by a displacement since its only clone, the pose of the previous image.

    ``lever_imu`` (3,): position of the camera in the IMU frame; ``twist_before`` (6,): of the
    filter then. ``floor_m`` and ``scale_sigma``: errors that do not average out over directions, in
    metres and as a fraction of the displacement (the ground is not level, the height is that of one
    spot). The camera's mount and clock, if estimated, are corrected: the mount turns both images
    alike, the clock moves both along their twists. Returns the normalised innovation in standard
    deviations.
    """
    state, clone = eskf.state, eskf.clones[0]
    arm, arm_before = state.rotation @ lever_imu, clone.rotation @ lever_imu
    expected = clone.translation + arm_before - state.position - arm
    before = POSE_DIM + eskf.shared
    jacobian = np.zeros((3, before + CLONE_DIM))
    then_rotation, then_position = after(before, ROTATION), after(before, POSITION)
    lever = skew(lever_imu)
    jacobian[:, ROTATION] = state.rotation @ lever - measured.by_rotation_now @ state.rotation
    jacobian[:, POSITION] = -np.eye(3)
    jacobian[:, then_rotation] = (
        -clone.rotation @ lever - measured.by_rotation_before @ clone.rotation
    )
    jacobian[:, then_position] = np.eye(3)
    if eskf.shared:
        turned = measured.by_rotation_now @ state.rotation
        turned = turned + measured.by_rotation_before @ clone.rotation
        jacobian[:, after(POSE_DIM, CAMERA_ROTATION)] = -turned
        jacobian[:, after(POSE_DIM, CAMERA_TRANSLATION)] = clone.rotation - state.rotation
        moved = jacobian[:, POSE] @ eskf.twist + jacobian[:, after(before, POSE)] @ twist_before
        jacobian[:, POSE_DIM + CLOCK] = -moved
    translation = measured.translation
    covariance = measured.covariance + floor_m**2 * np.eye(3)
    covariance = covariance + scale_sigma**2 * np.outer(translation, translation)
    return update(eskf, eskf.touched([0]), jacobian, translation - expected, covariance, gate)
