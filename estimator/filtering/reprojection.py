"""Reprojection residuals of landmarks as a measurement of two poses and the calibration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from touchdown.estimator.filtering.imu_propagation import exp_so3
from touchdown.estimator.filtering.information import NormalEquations
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.frames import Pose

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class MountedCamera:
    """A pinhole camera and its mount."""

    intrinsics: CameraIntrinsics
    imu_from_camera: Pose

    @property
    def focal_and_center(self) -> Array:
        """(4,) fx, fy, cx, cy in pixels."""
        camera = self.intrinsics
        return np.array([camera.fx, camera.fy, camera.cx, camera.cy])


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
    """Returns ``calibrated_information`` for a fixed calibration: (12, 12) and (12,).

    ``pixels`` (N, 2); ``landmarks`` (N, 3) in the frame of the keyframe's IMU.
    """
    camera_from_imu = camera.imu_from_camera.inverse()
    fixed, exact = np.zeros((len(pixels), 3, 0)), np.zeros((len(pixels), 3))
    return calibrated_information(
        pixels, np.zeros(len(pixels)), landmarks, fixed, exact,
        odom_from_imu.rotation, odom_from_imu.translation,
        odom_from_keyframe.rotation, odom_from_keyframe.translation, np.zeros(12),
        camera_from_imu.rotation, camera_from_imu.translation, camera.focal_and_center,
        sigma_px, gate_px,
    )  # fmt: skip


@njit(cache=True)
def calibrated_information(
    pixels: Array,
    row_times: Array,
    landmarks: Array,
    jacobians: Array,
    spreads: Array,
    rotation: Array,
    position: Array,
    key_rotation: Array,
    key_position: Array,
    twists: Array,
    camera_rotation: Array,
    camera_position: Array,
    intrinsics: Array,
    sigma_px: float,
    gate_px: float,
) -> NormalEquations:
    """Returns the normal equations, (12 + C, 12 + C), of the reprojection residuals of one
    keyframe.

    ``pixels`` (N, 2): measured now; ``row_times`` (N,): instants of their rows less that of the
    exposure, s; ``landmarks`` (N, 3): in the keyframe's IMU frame, with their ``jacobians``
    (N, 3, C) by the shared calibration, C = 0 or 17, and ``spreads`` (N, 3), one standard deviation
    along their rays; ``rotation``, ``position``: odom_from_imu at the exposure; ``key_*``: the same
    of the keyframe; ``twists`` (12,): angular rate and velocity now, then those of the keyframe;
    ``camera_*``: camera_from_imu; ``intrinsics``: fx, fy, cx, cy.
    Error order: present rotation (right perturbation) and position, then the keyframe's, then the
    calibration. Cauchy weights of scale ``gate_px`` / 2, zero beyond ``gate_px``.
    """
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    shared = jacobians.shape[2]
    size = 12 + shared
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
            world[a] = key_position[a] - position[a] - late * twists[3 + a]
            for b in range(3):
                world[a] += key_rotation[a, b] * q[b]
        for a in range(3):
            offset[a] = back[a, 0] * world[0] + back[a, 1] * world[1] + back[a, 2] * world[2]
        rotated = exp_so3(-late * twists[:3])
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
            jacobian[a, 0] = m[a, 1] * offset[2] - m[a, 2] * offset[1]
            jacobian[a, 1] = m[a, 2] * offset[0] - m[a, 0] * offset[2]
            jacobian[a, 2] = m[a, 0] * offset[1] - m[a, 1] * offset[0]
            jacobian[a, 6] = -(to_key[a, 1] * q[2] - to_key[a, 2] * q[1])
            jacobian[a, 7] = -(to_key[a, 2] * q[0] - to_key[a, 0] * q[2])
            jacobian[a, 8] = -(to_key[a, 0] * q[1] - to_key[a, 1] * q[0])
            for b in range(3):
                jacobian[a, 3 + b] = -to_world[a, b]
                jacobian[a, 9 + b] = to_world[a, b]
            for b in range(shared):
                jacobian[a, 12 + b] = 0.0
                for k in range(3):
                    jacobian[a, 12 + b] += to_key[a, k] * jacobians[i, k, b]
        if shared > 0:
            jacobian[0, 18] += fx * c[0] / c[2]
            jacobian[1, 19] += fy * c[1] / c[2]
            jacobian[0, 20] += 1.0
            jacobian[1, 21] += 1.0
            for k in range(3):
                lever[k] = 0.0
                for b in range(3):
                    lever[k] += camera_rotation[b, k] * c[b]
            mount = projection @ camera_rotation
            for a in range(2):
                for b in range(12):
                    jacobian[a, 22] -= jacobian[a, b] * twists[b]
                jacobian[a, 23] += mount[a, 1] * lever[2] - mount[a, 2] * lever[1]
                jacobian[a, 24] += mount[a, 2] * lever[0] - mount[a, 0] * lever[2]
                jacobian[a, 25] += mount[a, 0] * lever[1] - mount[a, 1] * lever[0]
                for b in range(3):
                    jacobian[a, 26 + b] -= mount[a, b]
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
