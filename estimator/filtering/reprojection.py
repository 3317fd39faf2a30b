"""Reprojection residuals of landmarks as a measurement of two poses and the calibration."""

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
from touchdown.estimator.filtering.eskf import NormalEquations
from touchdown.estimator.filtering.imu_propagation import exp_so3_into
from touchdown.estimator.filtering.vectors import (
    ZERO,
    Vector,
    along,
    cross,
    dot,
    turned,
    turned_back,
    xyz,
)
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array


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

    @staticmethod
    def fixed(pixels: Array, landmarks: Array, spreads: Array) -> "LandmarkViews":
        """The views of an image without rolling shutter, the calibration taken for exact."""
        rows, jacobians = np.zeros(len(pixels)), np.zeros((len(pixels), 3, 0))
        return LandmarkViews(pixels, rows, landmarks, jacobians, spreads)


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
    views = LandmarkViews.fixed(pixels, landmarks, np.zeros((len(pixels), 3)))
    return calibrated_information(
        views, Frame.of(odom_from_imu), Frame.of(odom_from_keyframe), np.zeros((2, 6)),
        Frame.of(camera.imu_from_camera.inverse()), Pinhole.of(camera.intrinsics),
        PixelNoise(sigma_px, gate_px),
    )  # fmt: skip


@njit(cache=True, error_model="numpy")
def _see(
    landmark: Vector, poses: tuple[Frame, Frame], late_s: float, twist: Array,
    camera_from_imu: Frame, until_row: Array,
) -> tuple[Vector, Vector]:  # fmt: skip
    """The landmark of a keyframe in the present IMU frame, and in the camera ``late_s`` after the
    exposure, by the rotation ``until_row`` then, which it writes. ``poses``: of the keyframe and
    now."""
    keyframe, now = poses
    moved = along(xyz(now.translation), late_s, xyz(twist[POSITION]))
    step = along(xyz(keyframe.translation), -1.0, moved)
    world = along(turned(keyframe.rotation, landmark), 1.0, step)
    offset = turned_back(now.rotation, world)
    exp_so3_into(along(ZERO, -late_s, xyz(twist[ROTATION])), until_row)
    seen = turned(camera_from_imu.rotation, turned(until_row, offset))
    return offset, along(seen, 1.0, xyz(camera_from_imu.translation))


@njit(cache=True, error_model="numpy")
def depth_corrections(
    views: LandmarkViews, now: Frame, keyframe: Frame, twist: Array, camera_from_imu: Frame,
    lens: Pinhole, noise: PixelNoise,
) -> Array:  # fmt: skip
    """Returns by how many of their ``spreads`` landmarks lie further along their rays, by the
    parallax since their keyframe, and the fraction of the variance that is left, (N, 2).

    A scalar Kalman filter each, with the poses as given; other arguments as in
    ``calibrated_information``. Landmarks off by ``gate_px`` and more stay.
    """
    out, until_row = np.zeros((len(views.pixels), 2)), np.empty((3, 3))
    poses = (keyframe, now)
    for i in range(len(views.pixels)):
        out[i, 1] = 1.0
        landmark, late = xyz(views.landmarks[i]), views.row_times[i]
        further = along(landmark, 1.0, xyz(views.spreads[i]))
        _, c = _see(landmark, poses, late, twist, camera_from_imu, until_row)
        _, far = _see(further, poses, late, twist, camera_from_imu, until_row)
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
    jacobian, until_row = np.zeros((2, size)), np.empty((3, 3))
    used, squares, poses = 0, 0.0, (keyframe, now)
    for i in range(len(pixels)):
        q = xyz(landmarks[i])
        offset, c = _see(q, poses, row_times[i], twists[0], camera_from_imu, until_row)
        if c[2] < 1e-2:
            continue
        x, y = c[0] / c[2], c[1] / c[2]
        ru, rv = pixels[i, 0] - (fx * x + cx), pixels[i, 1] - (fy * y + cy)
        ahead = xyz(camera_rotation[2])
        right = along(xyz(camera_rotation[0]), -x, ahead)
        down = along(xyz(camera_rotation[1]), -y, ahead)
        # of the pixel by the point, in the IMU frames of its row and now, the world, the keyframe's
        mount = along(ZERO, fx / c[2], right), along(ZERO, fy / c[2], down)
        m = turned_back(until_row, mount[0]), turned_back(until_row, mount[1])
        to_world = turned(now.rotation, m[0]), turned(now.rotation, m[1])
        back = keyframe.rotation
        to_key = turned_back(back, to_world[0]), turned_back(back, to_world[1])
        # an error of the landmark's depth moves its pixel along the epipolar line
        spread = xyz(spreads[i])
        du, dv = dot(to_key[0], spread), dot(to_key[1], spread)
        rest = 1.0 / (sigma_px * sigma_px + du * du + dv * dv)
        error2 = ru * ru + rv * rv - rest * (du * ru + dv * rv) ** 2
        if error2 > gate_px * gate_px:
            continue
        for a in range(2):
            by_turn, by_key_turn = cross(m[a], offset), cross(q, to_key[a])
            for b in range(3):
                jacobian[a, ROTATION.start + b] = by_turn[b]
                jacobian[a, POSITION.start + b] = -to_world[a][b]
                jacobian[a, key + ROTATION.start + b] = by_key_turn[b]
                jacobian[a, key + POSITION.start + b] = to_world[a][b]
            for b in range(shared):
                jacobian[a, calibration + b] = dot(to_key[a], xyz(jacobians[i, :, b]))
        if shared > 0:
            focal, center = calibration + FOCAL.start, calibration + CENTER.start
            jacobian[0, focal] += fx * x
            jacobian[1, focal + 1] += fy * y
            jacobian[0, center] += 1.0
            jacobian[1, center + 1] += 1.0
            ray = turned_back(camera_rotation, c)
            for a in range(2):
                for b in range(POSE_DIM):
                    jacobian[a, calibration + CLOCK] -= jacobian[a, b] * twists[0, b]
                    jacobian[a, calibration + CLOCK] -= jacobian[a, key + b] * twists[1, b]
                turn = cross(mount[a], ray)
                for b in range(3):
                    jacobian[a, calibration + CAMERA_ROTATION.start + b] += turn[b]
                    jacobian[a, calibration + CAMERA_TRANSLATION.start + b] -= mount[a][b]
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
