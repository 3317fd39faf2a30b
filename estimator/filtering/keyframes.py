"""Keyframes, their feature planes, and the choice of keyframes to track."""

import math
from dataclasses import dataclass, field

import cv2
import numpy as np
from numba import njit

from touchdown.estimator.filtering.error_state import Frame, Pinhole
from touchdown.estimator.filtering.landmark_depth import RecentReturns, feature_planes
from touchdown.estimator.filtering.vectors import along, dot, turned, xyz
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array, Grey, Mask


@dataclass(slots=True)
class Keyframe:
    """An image, its features and their planes; the pose is a clone in the filter."""

    tick: int
    levels: tuple[Grey, Grey, Grey]
    pixels: Array
    """(N, 2)"""
    valid: Mask = field(init=False)
    """(N,) True where the plane is known"""
    planes: Array = field(init=False)
    """(N, 3) ``n . P = 1`` in this keyframe's camera frame"""
    sigmas: Array = field(init=False)
    """(N,) m along the ray, of features on no plane; 0 for the others"""
    assumed: Mask = field(init=False)
    """(N,) True where no return has shown the depth"""
    depth_m: float = field(init=False)
    """median depth of the landmarks"""
    calibration: Array
    """(C,) of the filter when the planes were measured"""
    twist: Array
    """(6,) angular rate in the IMU's frame and velocity in the odometry frame at the clone"""
    delay_s: float = 0.0
    """stamp of the image less the instant of the clone"""

    def __post_init__(self) -> None:
        count = len(self.pixels)
        self.valid, self.assumed = np.zeros(count, np.bool_), np.zeros(count, np.bool_)
        self.planes, self.sigmas, self.depth_m = np.zeros((count, 3)), np.zeros(count), 0.0

    def landmarks_camera(self, camera: CameraIntrinsics) -> Array:
        """(N, 3) in the camera frame; zeros where the plane is unknown."""
        rays = bearing_rays(self.pixels, camera)
        depth_inverse = np.einsum("ij,ij->i", rays, self.planes)
        depth = np.where(self.valid, 1.0 / np.where(self.valid, depth_inverse, 1.0), 0.0)
        return rays * depth[:, None]

    def measure_depth(self, camera: CameraIntrinsics) -> None:
        """Renews ``depth_m`` by the landmarks known now."""
        if self.valid.any():
            self.depth_m = float(np.median(self.landmarks_camera(camera)[self.valid, 2]))


def bearing_rays(pixels: Array, camera: CameraIntrinsics) -> Array:
    """(N, 3) rays with z = 1 of (N, 2) undistorted pixels."""
    rays = np.ones((len(pixels), 3))
    rays[:, 0] = (pixels[:, 0] - camera.cx) / camera.fx
    rays[:, 1] = (pixels[:, 1] - camera.cy) / camera.fy
    return rays


def detect_features(
    grey: Grey, max_count: int, spacing_px: int = 22, border_px: int = 12, near: Array | None = None
) -> Array:
    """Corners (N, 2) spread over the image: the best of every cell of a grid of ``spacing_px``,
    the strongest ``max_count`` of them (Shi and Tomasi's smallest eigenvalue). ``near`` (M, 2):
    pixels in whose cells they lie; without it in any."""
    response = cv2.cornerMinEigenVal(grey, 5, ksize=3)
    response[:border_px] = response[-border_px:] = 0.0
    response[:, :border_px] = response[:, -border_px:] = 0.0
    rows, cols = grey.shape[0] // spacing_px, grey.shape[1] // spacing_px
    blocks = response[: rows * spacing_px, : cols * spacing_px]
    blocks = blocks.reshape(rows, spacing_px, cols, spacing_px).swapaxes(1, 2)
    flat = blocks.reshape(rows * cols, spacing_px * spacing_px)
    best = np.argmax(flat, axis=1)
    strength = flat[np.arange(rows * cols), best]
    if near is not None:
        where = np.zeros((rows, cols), bool)
        where[tuple((near[:, ::-1] / spacing_px).astype(int).T)] = True
        strength = np.where(where.ravel(), strength, 0.0)
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
    keyframe.assumed[which] = False
    keyframe.measure_depth(camera)


@dataclass(frozen=True, slots=True)
class Overlap:
    """Predicted overlap of keyframe ``index`` with the present view."""

    index: int
    fraction: float
    """fraction of the keyframe's landmarks"""
    scale: float
    """keyframe depth over present depth"""


def overlaps(
    keyframes: list[Keyframe],
    camera_poses: list[Pose],
    odom_from_camera: Pose,
    camera: CameraIntrinsics,
    min_scale: float,
    min_visible: int = 20,
) -> list[Overlap]:
    """Overlaps of the keyframes (poses odom_from_camera) with a predicted view, of those whose
    scale is between ``min_scale`` and its inverse."""
    found = []
    inverse, lens = odom_from_camera.inverse(), Pinhole.of(camera)
    x, y, _ = odom_from_camera.translation.tolist()
    half_diagonal = 0.5 * math.hypot(camera.width / camera.fx, camera.height / camera.fy)
    for index, (keyframe, pose) in enumerate(zip(keyframes, camera_poses, strict=True)):
        far = math.hypot(pose.translation[0] - x, pose.translation[1] - y)
        if far > 4.0 * half_diagonal * keyframe.depth_m:
            continue
        visible, depth = _in_view(
            keyframe.pixels, keyframe.planes, keyframe.valid, Frame.of(inverse @ pose), lens,
            (camera.width, camera.height),
        )  # fmt: skip
        if visible < min_visible:
            continue
        scale = keyframe.depth_m / depth
        if min_scale < scale < 1.0 / min_scale:
            fraction = visible / np.count_nonzero(keyframe.valid)
            found.append(Overlap(index, fraction, scale))
    return found


@njit(cache=True, error_model="numpy")
def _in_view(
    pixels: Array,
    planes: Array,
    valid: Mask,
    view_from_keyframe: Frame,
    lens: Pinhole,
    size: tuple[int, int],
) -> tuple[int, float]:
    """How many of a keyframe's ``valid`` landmarks lie within a view of ``size`` pixels, and their
    median depth there."""
    margin, count = 12.0, 0
    depths, place = np.empty(len(pixels)), xyz(view_from_keyframe.translation)
    for i in range(len(pixels)):
        if not valid[i]:
            continue
        ray = ((pixels[i, 0] - lens.cx) / lens.fx, (pixels[i, 1] - lens.cy) / lens.fy, 1.0)
        depth = 1.0 / dot(ray, xyz(planes[i]))
        seen = along(place, depth, turned(view_from_keyframe.rotation, ray))
        if seen[2] <= 0.1:
            continue
        u, v = lens.fx * seen[0] / seen[2] + lens.cx, lens.fy * seen[1] / seen[2] + lens.cy
        if margin < u < size[0] - margin and margin < v < size[1] - margin:
            depths[count] = seen[2]
            count += 1
    return count, np.median(depths[:count]) if count > 0 else 0.0


def choose(
    candidates: list[Overlap], variances: Array, maximum: int, min_fraction: float
) -> list[int]:
    """Returns up to ``maximum`` keyframes to track: the one of smallest position variance among
    those with enough overlap, the one with the largest overlap, then the next by variance."""
    if not candidates:
        return []
    fair = [c for c in candidates if c.fraction >= min_fraction]
    by_variance = sorted(fair or candidates, key=lambda c: (variances[c.index], c.index))
    largest = max(candidates, key=lambda c: (c.fraction * min(c.scale, 1.0 / c.scale), c.index))
    picked = [by_variance[0].index]
    for index in [largest.index, *(c.index for c in by_variance[1:])]:
        if len(picked) < maximum and index not in picked:
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
