"""Depth of features while the LIDAR is silent: level ground below the rangefinder's beam, then
parallax.

The ground that the beam hits is where a new keyframe's features are assumed to be, with an error of
a good share of the distance: trees and roofs stand on it. Each later image then moves a feature
along its ray to where it is seen (inverse depth by a scalar Kalman filter each, as in Forster et
al., SVO, ICRA 2014). Parallax shows the relief; the scale is common to all features and stays that
of the filter. Errors of tracking repeat from image to image, so that an assumed depth never counts
as known better than to a floor.
"""

from __future__ import annotations

import numpy as np

from touchdown.estimator.filtering.error_state import Frame, Pinhole
from touchdown.estimator.filtering.keyframes import Keyframe, bearing_rays
from touchdown.estimator.filtering.reprojection import LandmarkViews, PixelNoise, depth_corrections
from touchdown.estimator.typing import Array, Indices
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.frames import Pose

_MIN_HEIGHT_M = 0.5
"""height of the camera above the ground; below it, the beam's error would be much of the depth"""
_STEEPEST = 0.2
"""cosine between a ray and the vertical: flatter rays meet level ground far away, if at all"""
_MIN_FRACTION = 0.2
"""fraction of its depth that a feature keeps in one step"""


def assume_level_ground(
    keyframe: Keyframe,
    camera_from_odom: Pose,
    ground_m: float,
    camera: CameraIntrinsics,
    share: float,
) -> int:
    """Assigns the plane z = ``ground_m`` of the odometry frame to the features without one, with a
    standard deviation of ``share`` of their distance; returns their number."""
    missing = np.flatnonzero(~keyframe.valid)
    height = float(camera_from_odom.inverse().translation[2]) - ground_m
    if height < _MIN_HEIGHT_M:
        return 0
    plane = -camera_from_odom.rotation[:, 2] / height
    rays = bearing_rays(keyframe.pixels[missing], camera)
    lengths = np.linalg.norm(rays, axis=1)
    met = rays @ plane * height > _STEEPEST * lengths
    which = missing[met]
    keyframe.valid[which] = keyframe.assumed[which] = True
    keyframe.planes[which] = plane
    keyframe.sigmas[which] = share * lengths[met] / (rays[met] @ plane)
    if keyframe.valid.any():
        keyframe.depth_m = float(np.median(keyframe.landmarks_camera(camera)[keyframe.valid, 2]))
    return len(which)


def move_along_rays(
    keyframe: Keyframe,
    which: Indices,
    views: LandmarkViews,
    poses: tuple[Frame, Frame],
    twist: Array,
    camera: tuple[Pose, Pinhole],
    floor: float,
    noise: PixelNoise,
) -> None:
    """Moves the assumed ones among the features ``which`` (N,) to where their ``views`` show them.

    ``poses``: odom_from_imu now and at the keyframe; ``twist`` (6,): of the IMU now; ``camera``:
    imu_from_camera and the lens, as estimated; ``floor``: of the standard deviation, relative to
    the keyframe's depth.
    """
    chosen = np.flatnonzero(keyframe.assumed[which])
    if len(chosen) == 0:
        return
    part, sigmas = which[chosen], keyframe.sigmas[which[chosen]]
    pixels, rows, landmarks, jacobians, _ = (of[chosen] for of in views)
    mount, lens = camera
    arms = landmarks - mount.translation
    relative = sigmas / np.linalg.norm(arms, axis=1)
    moved, left = depth_corrections(
        LandmarkViews(pixels, rows, landmarks, jacobians, arms * relative[:, None]),
        *poses, twist, Frame.of(mount.inverse()), lens, noise,
    ).T  # fmt: skip
    keyframe.planes[part] /= np.maximum(1.0 + moved * relative, _MIN_FRACTION)[:, None]
    least = np.minimum(sigmas, floor * keyframe.depth_m)
    keyframe.sigmas[part] = np.maximum(sigmas * np.sqrt(left), least)
