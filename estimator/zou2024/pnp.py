"""Projection into the image (paper, section 3.2) and the camera pose from landmarks of known
position (Eq. 11); Eq. 1 is `Pose.apply`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from touchdown.estimator.filtering.error_state import error_between, moved_by
from touchdown.estimator.filtering.reprojection import MountedCamera, reprojection_information
from touchdown.estimator.typing import Array, Mask
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.frames import Pose

NEAREST_DEPTH_M = 0.05


def project(points_camera: Array, matrix: Array) -> tuple[Array, Mask]:
    """Eq. 2: pixels (N, 2) of camera points (N, 3) by the intrinsic matrix K (3, 3), skew included.

    The paper leaves the division by depth implicit (its ``uv`` has a third component 1). Also
    returns the mask (N,) of points in front of the camera; the pixels of the others are
    meaningless.
    """
    depth = points_camera[:, 2]
    front = depth > NEAREST_DEPTH_M
    rays = points_camera / np.where(front, depth, 1.0)[:, None]
    return rays @ matrix[:2].T, front


def inside_image(pixels: Array, front: Mask, size: tuple[int, int], margin: float = 0.0) -> Mask:
    """Mask (N,) of the pixels (N, 2) inside an image of ``size`` (width, height)."""
    u, v = pixels[:, 0], pixels[:, 1]
    inside = front & (u >= margin) & (v >= margin)
    inside &= (u <= size[0] - 1 - margin) & (v <= size[1] - 1 - margin)
    return inside


_GATES_PX = (24.0, 12.0, 6.0, 4.0, 3.0, 3.0)


@dataclass(frozen=True, kw_only=True, slots=True)
class CameraPose:
    """``pose``: global_from_imu; ``information`` (6, 6) around it; ``inliers`` (N,)."""

    pose: Pose
    information: Array
    inliers: Mask
    rms_px: float


def reprojection_errors(
    pixels: Array,
    landmarks: Array,
    global_from_imu: Pose,
    imu_from_camera: Pose,
    camera: CameraIntrinsics,
) -> Array:
    """(N, 2) measured pixels minus predicted ones of the landmarks (N, 3); infinite behind the
    camera."""
    points = (global_from_imu @ imu_from_camera).inverse().apply(landmarks)
    predicted, front = project(points, camera.matrix())
    return np.where(front[:, None], pixels - predicted, np.inf)


def solve_pnp(
    pixels: Array,
    landmarks: Array,
    sigmas_px: Array,
    guess: Pose,
    guess_information: Array,
    imu_from_camera: Pose,
    camera: CameraIntrinsics,
    min_inliers: int = 15,
) -> CameraPose | None:
    """Solves Eq. 11 for the pose: robust Gauss-Newton on the reprojection errors from ``guess``.

    ``pixels`` (N, 2), ``landmarks`` (N, 3) global, ``sigmas_px`` (N,). The predicted pose is
    accurate enough that neither a closed form nor random sampling is needed: the gates of the
    Cauchy weights tighten step by step. ``guess_information`` (6, 6) keeps directions that the
    pixels leave unobserved (over a plane tilt and lateral motion look alike) at the guess; the
    returned information excludes it. None with fewer than ``min_inliers`` landmarks within 3 pixels
    at the end.
    """
    mounted = MountedCamera(camera, imu_from_camera)
    # the landmarks are global: their frame takes the place of the keyframe's
    origin = Pose.identity()
    groups = [(s, np.flatnonzero(sigmas_px == s)) for s in np.unique(sigmas_px)]

    def accumulate(pose: Pose, gate: float) -> tuple[Array, Array, int]:
        information, vector, used = np.zeros((6, 6)), np.zeros(6), 0
        for sigma, members in groups:
            part = reprojection_information(
                pixels[members], landmarks[members], pose, origin, mounted,
                sigma_px=sigma, gate_px=gate,
            )  # fmt: skip
            information += part.information[:6, :6]
            vector += part.vector[:6]
            used += part.used
        return information, vector, used

    pose = guess
    for gate in _GATES_PX:
        information, vector, used = accumulate(pose, gate)
        if used < min_inliers:
            return None
        gradient = vector - guess_information @ error_between(guess, pose)
        step: Array = np.linalg.solve(information + guess_information, gradient).astype(np.float64)
        pose = moved_by(pose, step)
    information, _, used = accumulate(pose, _GATES_PX[-1])
    errors = reprojection_errors(pixels, landmarks, pose, imu_from_camera, camera)
    length = np.hypot(errors[:, 0], errors[:, 1])
    inliers = length < _GATES_PX[-1]
    if int(inliers.sum()) < min_inliers:
        return None
    rms = float(np.sqrt(np.mean(length[inliers] ** 2)))
    return CameraPose(pose=pose, information=information, inliers=inliers, rms_px=rms)
