"""Geodesic distances over edge energy: colour smoothness (Eq. 8) and landmark depth (Eq. 12).

The length of a path is the energy that it crosses, so that two returns on the same smooth surface
are close however far apart, and two on either side of a boundary are not. All returns are seeds of
one raster-scan transform (Toivanen 1996; Criminisi et al. 2008): two passes over the image give
every pixel its geodesically nearest seed, and where the regions of two seeds touch, the length of
the path between them.
"""

import cv2
import numpy as np
from numba import njit

from touchdown.estimator.filtering.error_state import Frame
from touchdown.estimator.filtering.landmark_depth import RecentReturns
from touchdown.estimator.filtering.vectors import along, turned, xyz
from touchdown.estimator.zou2024.structured_edges import EdgeDetector
from touchdown.estimator.zou2024.visual_map import NEAREST_DEPTH_M
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array, Bytes, Float32, Indices, Int32

Real = float | np.float32

STEP_ENERGY = np.float32(0.02)
"""energy of a pixel without any edge: keeps paths short where the energy is zero, so that the
nearest seed is also the nearest in the image"""
_FAR = np.float32(1e9)
_DIAGONAL = 1.4142135623730951
_MIN_WEIGHT = 0.4
"""weight of the nearest return in Eq. 12, below which a pixel has no depth"""


@njit(cache=True)
def path_energy(energy_a: Real, energy_b: Real, step: Real) -> Real:
    """The integral of Eq. 8 along one step between neighbouring pixels (trapezium rule)."""
    return step * (np.float32(0.5) * (energy_a + energy_b) + STEP_ENERGY)


@njit(cache=True)
def geodesic_transform(
    energy: Float32, seed_rows: Int32, seed_cols: Int32, sweeps: int
) -> tuple[Float32, Int32]:
    """Distance to the geodesically nearest seed and that seed's number, each (H, W).

    ``energy`` (H, W) in [0, 1]; ``seed_rows``, ``seed_cols`` (S,); of seeds on one pixel the first
    counts. One sweep is a forward and a backward pass; a path that turns back more often than there
    are sweeps comes out too long. Pixels that no seed reaches keep label -1.
    """
    height, width = energy.shape
    distance = np.full((height, width), _FAR, dtype=np.float32)
    label = np.full((height, width), -1, dtype=np.int32)
    for s in range(seed_rows.shape[0]):
        if label[seed_rows[s], seed_cols[s]] < 0:
            distance[seed_rows[s], seed_cols[s]] = 0.0
            label[seed_rows[s], seed_cols[s]] = s
    for sweep in range(2 * sweeps):
        sign = 1 if sweep % 2 == 0 else -1
        for r in range(height):
            row = r if sign == 1 else height - 1 - r
            if r > 0:
                passed = row - sign
                for shift in range(-1, 2):
                    _through(energy, distance, label, row, passed, shift)
            for c in range(1, width):
                col = c if sign == 1 else width - 1 - c
                step = path_energy(energy[row, col], energy[row, col - sign], np.float32(1.0))
                if distance[row, col - sign] + step < distance[row, col]:
                    distance[row, col] = distance[row, col - sign] + step
                    label[row, col] = label[row, col - sign]
    return distance, label


@njit(cache=True)
def _through(
    energy: Float32, distance: Float32, label: Int32, row: int, passed: int, shift: int
) -> None:
    """Takes the paths to the pixels of ``row`` that come from the row ``passed`` before, ``shift``
    columns away, where they are shorter. Without branches: several pixels at a time."""
    step = np.float32(1.0) if shift == 0 else np.float32(_DIAGONAL)
    first, end = max(0, -shift), energy.shape[1] - max(0, shift)
    here, there = energy[row, first:end], energy[passed, first + shift : end + shift]
    before, source = (
        distance[passed, first + shift : end + shift],
        label[passed, first + shift : end + shift],
    )
    own, mark = distance[row, first:end], label[row, first:end]
    for c in range(end - first):
        length = before[c] + path_energy(here[c], there[c], step)
        shorter = length < own[c]
        own[c] = length if shorter else own[c]
        mark[c] = source[c] if shorter else mark[c]


@njit(cache=True)
def _note(neighbours: Int32, lengths: Float32, seed: int, other: int, length: float) -> None:
    """Keeps ``other`` among the nearest neighbours of ``seed``."""
    k = neighbours.shape[1]
    worst, worst_length = 0, np.float32(-1.0)
    for slot in range(k):
        if neighbours[seed, slot] == other:
            lengths[seed, slot] = min(lengths[seed, slot], np.float32(length))
            return
        if lengths[seed, slot] > worst_length:
            worst, worst_length = slot, lengths[seed, slot]
    if length < worst_length:
        neighbours[seed, worst], lengths[seed, worst] = other, np.float32(length)


@njit(cache=True)
def geodesic_lengths(
    energy: Float32, distance: Float32, label: Int32, seeds: int, k: int
) -> tuple[Int32, Float32]:
    """L_G of Eq. 8, the least energy of a path, from each seed to its ``k`` nearest neighbours.

    Where the regions of two seeds touch, the path through the touching pixels is a path between
    them; the least over all such places is the infimum (exactly so while it passes through no third
    region). Returns neighbours (S, k), -1 where there are fewer, and lengths (S, k).
    """
    height, width = energy.shape
    neighbours = np.full((seeds, k), -1, dtype=np.int32)
    lengths = np.full((seeds, k), _FAR, dtype=np.float32)
    for row in range(height):
        for col in range(width):
            own = label[row, col]
            if own < 0:
                continue
            for side in range(2):
                nr, nc = row + side, col + 1 - side
                if nr >= height or nc >= width:
                    continue
                other = label[nr, nc]
                if other < 0 or other == own:
                    continue
                step = path_energy(energy[row, col], energy[nr, nc], np.float32(1.0))
                length = distance[row, col] + distance[nr, nc] + step
                _note(neighbours, lengths, own, other, length)
                _note(neighbours, lengths, other, own, length)
    return neighbours, lengths


@njit(cache=True)
def colour_smoothness(
    label: Int32, rows: Int32, cols: Int32, neighbours: Int32, lengths: Float32
) -> Array:
    """f_c of Eq. 8, ``sum_j L_G(uv_j, uv_i)`` over the k nearest, of each of the (S,) seeds.

    A seed with fewer than k neighbours counts their mean k times; one that shares its pixel with an
    earlier seed takes that one's value. NaN where a seed has no neighbour.
    """
    score = np.full(rows.shape[0], np.nan)
    for s in range(rows.shape[0]):
        seed, used, total = label[rows[s], cols[s]], 0, 0.0
        for j in range(neighbours.shape[1]):
            if neighbours[seed, j] >= 0:
                used += 1
                total += lengths[seed, j]
        if used:
            score[s] = total * neighbours.shape[1] / used
    return score


def geodesic_depth(
    rows: Int32,
    cols: Int32,
    distance: Float32,
    label: Int32,
    neighbours: Int32,
    lengths: Float32,
    depths: Array,
    similarity: float,
) -> tuple[Array, Array]:
    """Eq. 12: depth of (F,) pixels as the geodesically weighted mean of the returns around.

    The k returns are the pixel's own nearest and that one's neighbours, to which the path leads
    through it. As printed, Eq. 12 weighs by L_G itself and so favours what is *unlike* the pixel,
    against the sentence above it (similar colour, similar depth); the weight here is
    ``exp(-L_G / similarity)``. Returns depth (F,), NaN where no return is near, and the weighted
    standard deviation (F,) of the depths that went into it.
    """
    own, first = label[rows, cols], distance[rows, cols]
    around = np.column_stack([own, neighbours[own]])
    paths = np.column_stack([np.zeros_like(first), lengths[own]]) + first[:, None]
    weights = np.where(around >= 0, np.exp(-paths.astype(np.float64) / similarity), 0.0)
    weights[(own < 0) | (weights[:, 0] < _MIN_WEIGHT)] = np.nan
    total, seen = weights.sum(axis=1), depths[around]
    mean = (weights * seen).sum(axis=1) / total
    square = (weights * seen**2).sum(axis=1) / total
    return mean, np.sqrt(np.maximum(square - mean * mean, 0.0))


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
