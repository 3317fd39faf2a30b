"""Reprojection residuals of landmarks as a measurement of two poses and the calibration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

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
from touchdown.estimator.typing import Array
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.frames import Pose


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


@njit(cache=True, error_model="numpy")
def _see(
    landmark: Array, poses: tuple[Frame, Frame], late_s: float, twist: Array,
    camera_from_imu: Frame, offset: Array, turned: Array, seen: Array,
) -> None:  # fmt: skip
    """Writes the landmark of a keyframe in the present IMU frame (``offset``), the rotation until
    its row ``late_s`` after the exposure (``turned``), and its position in the camera then
    (``seen``). ``poses``: of the keyframe and now."""
    world, turn = np.empty(3), np.empty(3)
    keyframe, now = poses
    rotate_into(keyframe.rotation, landmark, world)
    for a in range(3):
        moved = now.translation[a] + late_s * twist[POSITION.start + a]
        world[a] += keyframe.translation[a] - moved
        turn[a] = -late_s * twist[ROTATION.start + a]
    rotate_back_into(now.rotation, world, offset)
    exp_so3_into(turn, turned)
    rotate_into(turned, offset, turn)
    rotate_into(camera_from_imu.rotation, turn, seen)
    for a in range(3):
        seen[a] += camera_from_imu.translation[a]


@njit(cache=True, error_model="numpy")
def depth_corrections(
    views: LandmarkViews, now: Frame, keyframe: Frame, twist: Array, camera_from_imu: Frame,
    lens: Pinhole, noise: PixelNoise,
) -> Array:  # fmt: skip
    """Returns by how many of their ``spreads`` landmarks lie further along their rays, by the
    parallax since their keyframe, and the share of the variance that is left, (N, 2).

    A scalar Kalman filter each, with the poses as given; other arguments as in
    ``calibrated_information``. Landmarks off by ``gate_px`` and more stay.
    """
    out, c, far = np.zeros((len(views.pixels), 2)), np.empty(3), np.empty(3)
    offset, turned, further = np.empty(3), np.empty((3, 3)), np.empty(3)
    poses = (keyframe, now)
    for i in range(len(views.pixels)):
        out[i, 1] = 1.0
        for a in range(3):
            further[a] = views.landmarks[i, a] + views.spreads[i, a]
        late = views.row_times[i]
        _see(views.landmarks[i], poses, late, twist, camera_from_imu, offset, turned, c)
        _see(further, poses, late, twist, camera_from_imu, offset, turned, far)
        if c[2] < 1e-2 or far[2] < 1e-2:
            continue
        u, v = lens.fx * c[0] / c[2] + lens.cx, lens.fy * c[1] / c[2] + lens.cy
        ru, rv = views.pixels[i, 0] - u, views.pixels[i, 1] - v
        du = lens.fx * far[0] / far[2] + lens.cx - u
        dv = lens.fy * far[1] / far[2] + lens.cy - v
        power = du * du + dv * dv
        total = power + noise.sigma_px * noise.sigma_px
        if ru * ru + rv * rv - (du * ru + dv * rv) ** 2 / total > noise.gate_px * noise.gate_px:
            continue
        out[i, 0] = (du * ru + dv * rv) / total
        out[i, 1] = 1.0 - power / total
    return out


@njit(cache=True, error_model="numpy")
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
    ``gate_px``, by the length of a residual in units of its standard deviation, times
    ``sigma_px``: along the epipolar line an uncertain depth explains it.
    """
    pixels, row_times, landmarks, jacobians, spreads = views
    camera_rotation = camera_from_imu.rotation
    fx, fy, cx, cy = lens
    sigma_px, gate_px = noise
    shared = jacobians.shape[2]
    calibration, key = POSE_DIM, POSE_DIM + shared
    size = key + POSE_DIM
    # in units of their standard deviations, two for a landmark
    rows, residuals = np.empty((2 * len(pixels), size)), np.empty(2 * len(pixels))
    jacobian, turned = np.zeros((2, size)), np.empty((3, 3))
    mount, m = np.empty((2, 3)), np.empty((2, 3))
    to_world, to_key = np.empty((2, 3)), np.empty((2, 3))
    offset, turn, ray, c = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    used, squares, poses = 0, 0.0, (keyframe, now)
    for i in range(len(pixels)):
        q, late = landmarks[i], row_times[i]
        _see(q, poses, late, twists[0], camera_from_imu, offset, turned, c)
        if c[2] < 1e-2:
            continue
        x, y = c[0] / c[2], c[1] / c[2]
        ru, rv = pixels[i, 0] - (fx * x + cx), pixels[i, 1] - (fy * y + cy)
        for b in range(3):
            mount[0, b] = fx / c[2] * (camera_rotation[0, b] - x * camera_rotation[2, b])
            mount[1, b] = fy / c[2] * (camera_rotation[1, b] - y * camera_rotation[2, b])
        for a in range(2):
            rotate_back_into(turned, mount[a], m[a])
            rotate_into(now.rotation, m[a], to_world[a])
            rotate_back_into(keyframe.rotation, to_world[a], to_key[a])
        # an error of the landmark's depth moves its pixel along the epipolar line
        du, dv = 0.0, 0.0
        for k in range(3):
            du += to_key[0, k] * spreads[i, k]
            dv += to_key[1, k] * spreads[i, k]
        rest = 1.0 / (sigma_px * sigma_px + du * du + dv * dv)
        error2 = ru * ru + rv * rv - rest * (du * ru + dv * rv) ** 2
        if error2 > gate_px * gate_px:
            continue
        for a in range(2):
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
        # root of the weight: less along that line
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
    rows, residuals = rows[: 2 * used], residuals[: 2 * used]
    rms = np.sqrt(squares / used) if used > 0 else 0.0
    return NormalEquations(rows.T @ rows, rows.T @ residuals, used, rms)
