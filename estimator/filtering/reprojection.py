"""Reprojection residuals of landmarks as a measurement of two poses and the calibration."""

from __future__ import annotations

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
from touchdown.estimator.filtering.imu_propagation import cross_into, exp_so3
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


@njit(cache=True)
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
    pixels, row_times, landmarks, jacobians, spreads = views
    rotation, position = now
    key_rotation, key_position = keyframe
    camera_rotation, camera_position = camera_from_imu
    fx, fy, cx, cy = lens
    sigma_px, gate_px = noise
    shared = jacobians.shape[2]
    calibration, key = POSE_DIM, POSE_DIM + shared
    size = key + POSE_DIM
    information = np.zeros((size, size))
    vector = np.zeros(size)
    jacobian = np.zeros((2, size))
    projection = np.zeros((2, 3))
    key_now = np.ascontiguousarray(rotation.T) @ key_rotation
    back = np.ascontiguousarray(rotation.T)
    lever, world, offset = np.zeros(3), np.zeros(3), np.zeros(3)
    used, total = 0, 0.0
    for i in range(pixels.shape[0]):
        q, late = landmarks[i], row_times[i]
        for a in range(3):
            world[a] = key_position[a] - position[a] - late * twists[0, POSITION.start + a]
            for b in range(3):
                world[a] += key_rotation[a, b] * q[b]
        for a in range(3):
            offset[a] = back[a, 0] * world[0] + back[a, 1] * world[1] + back[a, 2] * world[2]
        rotated = exp_so3(-late * twists[0, ROTATION])
        to_camera = camera_rotation @ rotated
        c = to_camera @ offset + camera_position
        if c[2] < 1e-2:
            continue
        ru = pixels[i, 0] - (fx * c[0] / c[2] + cx)
        rv = pixels[i, 1] - (fy * c[1] / c[2] + cy)
        error2 = ru * ru + rv * rv
        if error2 > gate_px * gate_px:
            continue
        projection[0, 0], projection[0, 2] = fx / c[2], -fx * c[0] / (c[2] * c[2])
        projection[1, 1], projection[1, 2] = fy / c[2], -fy * c[1] / (c[2] * c[2])
        m = projection @ to_camera
        to_key = m @ key_now
        to_world = m @ back
        for a in range(2):
            cross_into(m[a], offset, jacobian[a], ROTATION.start)
            cross_into(q, to_key[a], jacobian[a], key + ROTATION.start)
            for b in range(3):
                jacobian[a, POSITION.start + b] = -to_world[a, b]
                jacobian[a, key + POSITION.start + b] = to_world[a, b]
            for b in range(shared):
                jacobian[a, calibration + b] = 0.0
                for k in range(3):
                    jacobian[a, calibration + b] += to_key[a, k] * jacobians[i, k, b]
        if shared > 0:
            focal, center = calibration + FOCAL.start, calibration + CENTER.start
            jacobian[0, focal] += fx * c[0] / c[2]
            jacobian[1, focal + 1] += fy * c[1] / c[2]
            jacobian[0, center] += 1.0
            jacobian[1, center + 1] += 1.0
            for k in range(3):
                lever[k] = 0.0
                for b in range(3):
                    lever[k] += camera_rotation[b, k] * c[b]
            mount = projection @ camera_rotation
            turn = calibration + CAMERA_ROTATION.start
            for a in range(2):
                for b in range(POSE_DIM):
                    jacobian[a, calibration + CLOCK] -= jacobian[a, b] * twists[0, b]
                    jacobian[a, calibration + CLOCK] -= jacobian[a, key + b] * twists[1, b]
                cross_into(mount[a], lever, world, 0)
                for b in range(3):
                    jacobian[a, turn + b] += world[b]
                    jacobian[a, calibration + CAMERA_TRANSLATION.start + b] -= mount[a, b]
        weight = 1.0 / ((1.0 + 4.0 * error2 / (gate_px * gate_px)) * sigma_px * sigma_px)
        # an error of the landmark's depth moves its pixel along the epipolar line
        du, dv = 0.0, 0.0
        for k in range(3):
            du += to_key[0, k] * spreads[i, k]
            dv += to_key[1, k] * spreads[i, k]
        rest = 1.0 / (sigma_px * sigma_px + du * du + dv * dv)
        wuu = weight * (1.0 - rest * du * du)
        wuv = -weight * rest * du * dv
        wvv = weight * (1.0 - rest * dv * dv)
        for a in range(size):
            left_u = wuu * jacobian[0, a] + wuv * jacobian[1, a]
            left_v = wuv * jacobian[0, a] + wvv * jacobian[1, a]
            vector[a] += left_u * ru + left_v * rv
            for b in range(a + 1):
                information[a, b] += left_u * jacobian[0, b] + left_v * jacobian[1, b]
        used += 1
        total += error2
    for a in range(size):
        for b in range(a):
            information[b, a] = information[a, b]
    rms = np.sqrt(total / used) if used > 0 else 0.0
    return NormalEquations(information, vector, used, rms)
