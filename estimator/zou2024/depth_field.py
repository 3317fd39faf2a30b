"""Geodesic neighbourhoods in one image: edge energy, projected returns, colour smoothness and
depth."""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit

from touchdown.estimator.filtering.error_state import Frame
from touchdown.estimator.filtering.landmark_depth import RecentReturns
from touchdown.estimator.filtering.vectors import along, turned, xyz
from touchdown.estimator.typing import Array, Bytes, Float32, Indices, Int32
from touchdown.estimator.zou2024.geodesic import (
    colour_smoothness,
    geodesic_depth,
    geodesic_lengths,
    geodesic_transform,
)
from touchdown.estimator.zou2024.projection import NEAREST_DEPTH_M
from touchdown.estimator.zou2024.structured_edges.detector import EdgeDetector
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.frames import Pose

NEIGHBOURS = 6
"""k of Eqs. 8 and 12"""
_SIMILARITY = 0.15
"""energy along a path at which depths count as unrelated"""


def half_size_energy(rgb: Bytes, detector: EdgeDetector) -> Float32:
    """Edge energy (H/2, W/2) of an image."""
    half = cv2.resize(rgb, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    return detector(np.asarray(half, dtype=np.uint8))


def _half_pixels(pixels: Array, shape: tuple[int, ...]) -> tuple[Int32, Int32]:
    """Rows and columns (N,) int32 at half size of (N, 2) full-size pixels."""
    at = np.rint(0.5 * (pixels - 0.5)).astype(np.int32)
    rows = np.clip(at[:, 1], 0, shape[0] - 1)
    cols = np.clip(at[:, 0], 0, shape[1] - 1)
    return np.ascontiguousarray(rows), np.ascontiguousarray(cols)


def scan_colour_smoothness(
    energy: Float32, points_camera: Array, camera: CameraIntrinsics, sweeps: int = 1
) -> Array:
    """f_c (Eq. 8) of (N, 3) returns in the camera's frame; NaN outside the image."""
    size, shape = (camera.width, camera.height), (energy.shape[0], energy.shape[1])
    inside, rows, cols = _pixels_inside(points_camera, camera.matrix(), size, shape)
    result = np.full(len(points_camera), np.nan)
    if len(inside) < 2:
        return result
    # only the strip that the scan covers can hold paths between its returns
    top, bottom = max(int(rows.min()) - 2, 0), int(rows.max()) + 3
    part = np.ascontiguousarray(energy[top:bottom])
    distance, label = geodesic_transform(part, rows - top, cols, sweeps)
    neighbours, lengths = geodesic_lengths(part, distance, label, len(rows), NEIGHBOURS)
    result[inside] = colour_smoothness(label, rows - top, cols, neighbours, lengths)
    return result


@njit(cache=True)
def _pixels_inside(
    points: Array, matrix: Array, size: tuple[int, int], shape: tuple[int, int]
) -> tuple[Indices, Int32, Int32]:
    """Which of (N, 3) points in the camera's frame an image of ``size`` (width, height) shows, and
    their rows and columns at half size, within ``shape``: `project`, `inside_image` and
    `_half_pixels` at once."""
    inside = np.empty(points.shape[0], np.int64)
    at, used = np.empty((2, points.shape[0]), np.int32), 0
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        if z <= NEAREST_DEPTH_M:
            continue
        u = x / z * matrix[0, 0] + y / z * matrix[0, 1] + matrix[0, 2]
        v = y / z * matrix[1, 1] + matrix[1, 2]
        if u >= 0.0 and v >= 0.0 and u <= size[0] - 1 and v <= size[1] - 1:
            inside[used] = i
            row, col = np.rint(0.5 * (v - 0.5)), np.rint(0.5 * (u - 0.5))
            at[0, used] = min(max(int(row), 0), shape[0] - 1)
            at[1, used] = min(max(int(col), 0), shape[1] - 1)
            used += 1
    return inside[:used], at[0, :used], at[1, :used]


@njit(cache=True)
def _nearest_per_pixel(
    points: Float32, camera_from_odom: Frame, matrix: Array, shape: tuple[int, int]
) -> Float32:
    """Depth of the nearest return at every half-size pixel; 0 where there is none."""
    depth, offset = np.zeros(shape, np.float32), xyz(camera_from_odom.translation)
    for i in range(len(points)):
        x, y, z = along(turned(camera_from_odom.rotation, xyz(points[i])), 1.0, offset)
        if z < 0.1:
            continue
        u = (matrix[0, 0] * x + matrix[0, 1] * y) / z + matrix[0, 2]
        v = matrix[1, 1] * y / z + matrix[1, 2]
        col, row = int(np.floor(0.5 * u + 0.25)), int(np.floor(0.5 * v + 0.25))
        if row < 0 or row >= shape[0] or col < 0 or col >= shape[1]:
            continue
        if depth[row, col] == 0.0 or z < depth[row, col]:
            depth[row, col] = z
    return depth


class DepthField:
    """Depth anywhere in an image from recent registered returns, by Eq. 12."""

    def __init__(
        self,
        energy: Float32,
        recent: RecentReturns,
        camera_from_odom: Pose,
        camera: CameraIntrinsics,
    ) -> None:
        shape, frame = (energy.shape[0], energy.shape[1]), Frame.of(camera_from_odom)
        nearest = _nearest_per_pixel(recent.points(), frame, camera.matrix(), shape)
        rows, cols = np.nonzero(nearest)
        self._depths = nearest[rows, cols].astype(np.float64)
        self._distance, self._label = geodesic_transform(
            energy, rows.astype(np.int32), cols.astype(np.int32), 1
        )
        self._neighbours, self._lengths = geodesic_lengths(
            energy, self._distance, self._label, len(rows), NEIGHBOURS
        )

    @property
    def returns(self) -> int:
        """Number of pixels with a return."""
        return len(self._depths)

    def depth(self, pixels: Array) -> tuple[Array, Array]:
        """Returns the depth (N,) m along the optical axis of (N, 2) full-size pixels, NaN where
        unknown, and the spread (N,) of the returns that it is averaged from."""
        rows, cols = _half_pixels(pixels, self._distance.shape)
        return geodesic_depth(
            rows, cols, self._distance, self._label, self._neighbours, self._lengths,
            self._depths, _SIMILARITY,
        )  # fmt: skip
