"""Keyframes, their feature planes, and the choice of keyframes to track."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.filtering.landmark_depth import RecentReturns, feature_planes
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.frames import Pose

Array = NDArray[np.float64]
Grey = NDArray[np.uint8]


@dataclass(slots=True)
class Keyframe:
    """An image, its features and their planes; the pose is a clone in the filter."""

    tick: int
    levels: tuple[Grey, Grey, Grey]
    pixels: Array
    """(N, 2)"""
    valid: NDArray[np.bool_]
    """(N,) True where the plane is known"""
    planes: Array
    """(N, 3) ``n . P = 1`` in this keyframe's camera frame"""
    sigmas: Array
    """(N,) m along the ray, of features on no plane; 0 for the others"""
    depth_m: float
    """median depth of the landmarks"""
    calibration: Array
    """(C,) of the filter when the planes were measured"""
    twist: Array
    """(6,) angular rate in the IMU's frame and velocity in the odometry frame at the clone"""
    delay_s: float = 0.0
    """stamp of the image less the instant of the clone"""

    def landmarks_camera(self, camera: CameraIntrinsics) -> Array:
        """(N, 3) in the camera frame; zeros where the plane is unknown."""
        rays = bearing_rays(self.pixels, camera)
        depth_inverse = np.einsum("ij,ij->i", rays, self.planes)
        depth = np.where(self.valid, 1.0 / np.where(self.valid, depth_inverse, 1.0), 0.0)
        return rays * depth[:, None]


def bearing_rays(pixels: Array, camera: CameraIntrinsics) -> Array:
    """(N, 3) rays with z = 1 of (N, 2) undistorted pixels."""
    rays = np.ones((len(pixels), 3))
    rays[:, 0] = (pixels[:, 0] - camera.cx) / camera.fx
    rays[:, 1] = (pixels[:, 1] - camera.cy) / camera.fy
    return rays


def detect_features(grey: Grey, max_count: int, spacing_px: int = 22, border_px: int = 12) -> Array:
    """Corners (N, 2) spread over the image: the best of every cell of a grid of ``spacing_px``,
    the strongest ``max_count`` of them (Shi and Tomasi's smallest eigenvalue)."""
    response = cv2.cornerMinEigenVal(grey, 5, ksize=3)
    response[:border_px] = response[-border_px:] = 0.0
    response[:, :border_px] = response[:, -border_px:] = 0.0
    rows, cols = grey.shape[0] // spacing_px, grey.shape[1] // spacing_px
    blocks = response[: rows * spacing_px, : cols * spacing_px]
    blocks = blocks.reshape(rows, spacing_px, cols, spacing_px).swapaxes(1, 2)
    flat = blocks.reshape(rows * cols, spacing_px * spacing_px)
    best = np.argmax(flat, axis=1)
    strength = flat[np.arange(rows * cols), best]
    corner_row, corner_col = np.divmod(np.arange(rows * cols), cols)
    inner_row, inner_col = np.divmod(best, spacing_px)
    pixels = np.column_stack(
        [corner_col * spacing_px + inner_col, corner_row * spacing_px + inner_row]
    ).astype(np.float64)
    order = np.argsort(-strength, kind="stable")[:max_count]
    order = order[strength[order] > 1e-4 * max(1e-6, float(strength.max()))]
    return pixels[np.sort(order)]


def measure_planes(
    keyframe: Keyframe, recent: RecentReturns, camera_from_odom: Pose, camera: CameraIntrinsics
) -> None:
    """Measures the planes of features that have none or an uncertain one, from recent returns."""
    missing = np.flatnonzero(~keyframe.valid | (keyframe.sigmas > 0.0))
    if len(missing) == 0:
        return
    rays = bearing_rays(keyframe.pixels[missing], camera)[:, :2]
    half_view = (0.5 * camera.width / camera.fx, 0.5 * camera.height / camera.fy)
    valid, planes, sigmas = feature_planes(
        rays, recent, camera_from_odom, half_view, radius=16.0 / camera.fx
    )
    better = valid & (~keyframe.valid[missing] | (sigmas < keyframe.sigmas[missing]))
    which = missing[better]
    keyframe.valid[which] = True
    keyframe.planes[which], keyframe.sigmas[which] = planes[better], sigmas[better]
    if keyframe.valid.any():
        keyframe.depth_m = float(np.median(keyframe.landmarks_camera(camera)[keyframe.valid, 2]))


@dataclass(frozen=True, slots=True)
class Overlap:
    """Predicted overlap of keyframe ``index`` with the present view."""

    index: int
    visible: int
    share: float
    """of the keyframe's landmarks"""
    scale: float
    """keyframe depth over present depth"""


def overlaps(
    keyframes: list[Keyframe],
    camera_poses: list[Pose],
    odom_from_camera: Pose,
    camera: CameraIntrinsics,
    min_visible: int = 20,
    scale_range: tuple[float, float] = (0.5, 2.0),
) -> list[Overlap]:
    """Overlaps of the keyframes (poses odom_from_camera) with a predicted view."""
    found = []
    inverse = odom_from_camera.inverse()
    margin = 12.0
    half_diagonal = 0.5 * np.hypot(camera.width / camera.fx, camera.height / camera.fy)
    for index, (keyframe, pose) in enumerate(zip(keyframes, camera_poses, strict=True)):
        offset = pose.translation - odom_from_camera.translation
        if np.hypot(offset[0], offset[1]) > 4.0 * half_diagonal * keyframe.depth_m:
            continue
        landmarks = keyframe.landmarks_camera(camera)[keyframe.valid]
        if len(landmarks) < min_visible:
            continue
        points = (inverse @ pose).apply(landmarks)
        depth = np.maximum(points[:, 2], 1e-3)
        u = camera.fx * points[:, 0] / depth + camera.cx
        v = camera.fy * points[:, 1] / depth + camera.cy
        inside = (points[:, 2] > 0.1) & (u > margin) & (u < camera.width - margin)
        inside &= (v > margin) & (v < camera.height - margin)
        visible = int(inside.sum())
        if visible < min_visible:
            continue
        scale = keyframe.depth_m / float(np.median(points[inside, 2]))
        if scale_range[0] < scale < scale_range[1]:
            found.append(Overlap(index, visible, visible / len(landmarks), scale))
    return found


def choose(candidates: list[Overlap], variances: Array, most: int, min_share: float) -> list[int]:
    """Returns up to ``most`` keyframes to track: the one of smallest position variance among those
    with enough overlap, the one with the largest overlap, then the next by variance."""
    if not candidates:
        return []
    fair = [c for c in candidates if c.share >= min_share and 0.7 < c.scale < 1.45]
    by_variance = sorted(fair or candidates, key=lambda c: (variances[c.index], c.index))
    largest = max(candidates, key=lambda c: (c.share * min(c.scale, 1.0 / c.scale), c.index))
    picked = [by_variance[0].index]
    for index in [largest.index, *(c.index for c in by_variance[1:])]:
        if len(picked) < most and index not in picked:
            picked.append(index)
    return picked


def most_redundant(poses: list[Pose], depths: list[float], keep_last: int = 3) -> int:
    """Returns the index of the most redundant keyframe: the nearest to another one in position,
    relative to its viewing distance, and in scale. The newest ``keep_last`` stay."""
    positions = np.array([pose.translation for pose in poses])
    reach = np.array(depths)
    gap = np.linalg.norm(positions[:, None] - positions[None], axis=2)
    gap /= np.maximum(reach[:, None], reach[None])
    gap += np.abs(np.log(reach[:, None] / reach[None]))
    np.fill_diagonal(gap, np.inf)
    # of a close pair the younger one goes: the older has the smaller variance
    nearest_older = np.where(np.tri(len(poses), k=-1, dtype=bool), gap, np.inf).min(axis=1)
    return int(np.argmin(nearest_older[: len(poses) - keep_last]))
