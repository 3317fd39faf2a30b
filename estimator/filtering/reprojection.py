"""Reprojection residuals of landmarks as a measurement of two poses and the calibration."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from touchdown.estimator.filtering.error_state import (
    CAMERA_ROTATION,
    CAMERA_TRANSLATION,
    CENTER,
    CLOCK,
    FOCAL,
    POSE_DIM,
    POSITION,
    ROTATION,
    Frame,
    Pinhole,
)
from touchdown.estimator.filtering.imu_propagation import (
    cross_into,
    exp_so3_into,
    rotate_back_into,
    rotate_into,
)
from touchdown.estimator.filtering.information import NormalEquations
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.frames import Pose

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class MountedCamera:
    """A pinhole camera and its mount."""

    intrinsics: CameraIntrinsics
    imu_from_camera: Pose


class LandmarkViews(NamedTuple):
    """Landmarks of one keyframe found in the present image."""

    pixels: Array  # (N, 2) in the present image
    row_times: Array  # (N,) s, instants of their rows less that of the exposure
    landmarks: Array  # (N, 3) in the keyframe's IMU frame
    jacobians: Array  # (N, 3, C) by the shared calibration, C = 0 or 17
    spreads: Array  # (N, 3) one standard deviation along their rays


class PixelNoise(NamedTuple):
    """Noise of the pixels and the gate of their residuals."""

    sigma_px: float
    gate_px: float


def reprojection_information(
    pixels: Array,
    landmarks: Array,
    odom_from_imu: Pose,
    odom_from_keyframe: Pose,
    camera: MountedCamera,
    *,
    sigma_px: float,
    gate_px: float,
) -> NormalEquations:
    """Returns ``calibrated_information`` for a fixed calibration: (12, 12) and (12,), present pose
    and keyframe.

    ``pixels`` (N, 2); ``landmarks`` (N, 3) in the frame of the keyframe's IMU.
    """
    count = len(pixels)
    views = LandmarkViews(
        pixels, np.zeros(count), landmarks, np.zeros((count, 3, 0)), np.zeros((count, 3))
    )
    return calibrated_information(
        views, Frame.of(odom_from_imu), Frame.of(odom_from_keyframe), np.zeros((2, 6)),
        Frame.of(camera.imu_from_camera.inverse()), Pinhole.of(camera.intrinsics),
        PixelNoise(sigma_px, gate_px),
    )  # fmt: skip


def calibrated_information(
    views: LandmarkViews,
    now: Frame,
    keyframe: Frame,
    twists: Array,
    camera_from_imu: Frame,
    lens: Pinhole,
    noise: PixelNoise,
) -> NormalEquations:
    """Returns the normal equations, (12 + C, 12 + C), of the reprojection residuals of one
    keyframe: present pose, calibration, the keyframe's pose.

    ``now``, ``keyframe``: odom_from_imu at the exposures; ``twists`` (2, 6): angular rate and
    velocity now and at the keyframe. Cauchy weights of scale ``gate_px`` / 2, zero beyond
    ``gate_px``.
    """
    rows, residuals, used, squares = _whitened(
        views, now, keyframe, twists, camera_from_imu, lens, noise
    )
    rms = math.sqrt(squares / used) if used else 0.0
    return NormalEquations(rows.T @ rows, rows.T @ residuals, used, rms)


class _Whitened(NamedTuple):
    """Residuals within the gate in units of their standard deviations, two for a landmark."""

    rows: Array  # (2 U, 12 + C) derivatives
    residuals: Array  # (2 U,)
    used: int  # U
    squares: float  # sum of U squared distances, pixels^2


@njit(cache=True, error_model="numpy")
def _whitened(
    views: LandmarkViews,
    now: Frame,
    keyframe: Frame,
    twists: Array,
    camera_from_imu: Frame,
    lens: Pinhole,
    noise: PixelNoise,
) -> _Whitened:
    """The residuals that ``calibrated_information`` sums up."""
    pixels, row_times, landmarks, jacobians, spreads = views
    camera_rotation, camera_position = camera_from_imu
    fx, fy, cx, cy = lens
    sigma_px, gate_px = noise
    shared = jacobians.shape[2]
    calibration, key = POSE_DIM, POSE_DIM + shared
    size = key + POSE_DIM
    rows, residuals = np.empty((2 * len(pixels), size)), np.empty(2 * len(pixels))
    jacobian, turned = np.zeros((2, size)), np.empty((3, 3))
    mount, m, to_world, to_key = (
        np.empty((2, 3)),
        np.empty((2, 3)),
        np.empty((2, 3)),
        np.empty((2, 3)),
    )
    world, offset, turn, ray, c = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    used, squares = 0, 0.0
    for i in range(len(pixels)):
        q, late = landmarks[i], row_times[i]
        rotate_into(keyframe.rotation, q, world)
        for a in range(3):
            moved = now.translation[a] + late * twists[0, POSITION.start + a]
            world[a] += keyframe.translation[a] - moved
            turn[a] = -late * twists[0, ROTATION.start + a]
        rotate_back_into(now.rotation, world, offset)
        exp_so3_into(turn, turned)
        rotate_into(turned, offset, ray)
        rotate_into(camera_rotation, ray, c)
        for a in range(3):
            c[a] += camera_position[a]
        if c[2] < 1e-2:
            continue
        x, y = c[0] / c[2], c[1] / c[2]
        ru, rv = pixels[i, 0] - (fx * x + cx), pixels[i, 1] - (fy * y + cy)
        error2 = ru * ru + rv * rv
        if error2 > gate_px * gate_px:
            continue
        for b in range(3):
            mount[0, b] = fx / c[2] * (camera_rotation[0, b] - x * camera_rotation[2, b])
            mount[1, b] = fy / c[2] * (camera_rotation[1, b] - y * camera_rotation[2, b])
        for a in range(2):
            rotate_back_into(turned, mount[a], m[a])
            rotate_into(now.rotation, m[a], to_world[a])
            rotate_back_into(keyframe.rotation, to_world[a], to_key[a])
            cross_into(m[a], offset, jacobian[a], ROTATION.start)
            cross_into(q, to_key[a], jacobian[a], key + ROTATION.start)
            for b in range(3):
                jacobian[a, POSITION.start + b] = -to_world[a, b]
                jacobian[a, key + POSITION.start + b] = to_world[a, b]
            for b in range(shared):
                jacobian[a, calibration + b] = (
                    to_key[a, 0] * jacobians[i, 0, b]
                    + to_key[a, 1] * jacobians[i, 1, b]
                    + to_key[a, 2] * jacobians[i, 2, b]
                )
        if shared > 0:
            focal, center = calibration + FOCAL.start, calibration + CENTER.start
            jacobian[0, focal] += fx * x
            jacobian[1, focal + 1] += fy * y
            jacobian[0, center] += 1.0
            jacobian[1, center + 1] += 1.0
            rotate_back_into(camera_rotation, c, ray)
            for a in range(2):
                for b in range(POSE_DIM):
                    jacobian[a, calibration + CLOCK] -= jacobian[a, b] * twists[0, b]
                    jacobian[a, calibration + CLOCK] -= jacobian[a, key + b] * twists[1, b]
                cross_into(mount[a], ray, turn, 0)
                for b in range(3):
                    jacobian[a, calibration + CAMERA_ROTATION.start + b] += turn[b]
                    jacobian[a, calibration + CAMERA_TRANSLATION.start + b] -= mount[a, b]
        weight = 1.0 / ((1.0 + 4.0 * error2 / (gate_px * gate_px)) * sigma_px * sigma_px)
        # an error of the landmark's depth moves its pixel along the epipolar line
        du, dv = 0.0, 0.0
        for k in range(3):
            du += to_key[0, k] * spreads[i, k]
            dv += to_key[1, k] * spreads[i, k]
        # root of the weight: less along that line
        rest = 1.0 / (sigma_px * sigma_px + du * du + dv * dv)
        less = rest / (1.0 + np.sqrt(rest) * sigma_px)
        root = np.sqrt(weight)
        wuu, wuv = root * (1.0 - less * du * du), -root * less * du * dv
        wvv = root * (1.0 - less * dv * dv)
        for b in range(size):
            rows[2 * used, b] = wuu * jacobian[0, b] + wuv * jacobian[1, b]
            rows[2 * used + 1, b] = wuv * jacobian[0, b] + wvv * jacobian[1, b]
        residuals[2 * used], residuals[2 * used + 1] = wuu * ru + wuv * rv, wuv * ru + wvv * rv
        used += 1
        squares += error2
    return _Whitened(rows[: 2 * used], residuals[: 2 * used], used, squares)
