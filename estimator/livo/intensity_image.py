"""Images of the LIDAR's intensity from above, one for each clone of the filter.

A pulse's intensity is a property of the place that it hits, calibrated by the sensor to
reflectivity, so that returns of many scans form an orthographic image of the ground: without
perspective, shadows or darkness. An image lies in the horizontal plane of its clone and moves with
it. Values are logarithms: texture scales the reflectivity of what it is on.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit

from touchdown.estimator.typing import Array, Bytes, Float32
from touchdown.sim.frames import Pose

SIDE = 384
"""cells of a row"""
_CELL_FRACTION = 0.006
"""side of a cell relative to the height: a few returns of a second fall into each"""
_MIN_CELL_M = 0.02
_FAINTEST = 4.0
"""weaker intensities count as this: the logarithm of single digits is mostly rounding"""
_MAX_RETURNS = 8
"""a cell takes no further ones: the oldest carry the least drift"""
_BRIGHTNESS = np.log(np.maximum(np.arange(256.0), _FAINTEST))
_WEIGHTS = np.array([0.25, 0.5, 0.25])
FEWEST = 1.5
"""returns that a smoothed cell needs (weighted mean over its neighbourhood)"""


def brightness(intensity: Bytes) -> Array:
    """Returns the logarithm of intensities (N,)."""
    return _BRIGHTNESS[intensity]


@njit(cache=True, error_model="numpy")
def add_returns(
    sums: Float32, counts: Bytes, points: Array, values: Array, axes: Array, centre: Array
) -> None:
    """Adds returns to an image (rows, columns): ``points`` (N, 3), ``axes`` (2, 3) of the image in
    their frame, a cell long, and its ``centre`` (2,) in cells from their origin. Returns beside the
    image are left out."""
    rows, columns = sums.shape
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        u = axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z + centre[0]
        v = axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z + centre[1]
        column, row = int(np.floor(u)) + columns // 2, int(np.floor(v)) + rows // 2
        if 0 <= row < rows and 0 <= column < columns and counts[row, column] < _MAX_RETURNS:
            sums[row, column] += values[i]
            counts[row, column] += 1


@dataclass(eq=False)
class IntensityImage:
    """The image of one clone."""

    axes: Array
    """(2, 3) horizontal axes of the image in the clone's IMU frame"""
    cell_m: float
    calibration: Array
    """(C,) shared calibration that its returns were placed with"""
    sums: Float32
    counts: Bytes
    _smoothed: tuple[Float32, Float32] | None = None

    @staticmethod
    def of(rotation: Array, height_m: float, calibration: Array) -> IntensityImage:
        """An empty image of a clone, with ``rotation`` odom_from_imu, ``height_m`` above the
        ground."""
        sums, counts = (np.zeros((SIDE, SIDE), dtype) for dtype in (np.float32, np.uint8))
        cell = max(_CELL_FRACTION * height_m, _MIN_CELL_M)
        return IntensityImage(rotation[:2].copy(), cell, calibration.copy(), sums, counts)

    def add(self, points: Array, values: Array, pose: Pose | None = None) -> None:
        """Adds ``points`` (N, 3) of the brightness ``values`` (N,); ``pose`` moves them to the
        clone's frame."""
        pose = pose or Pose.identity()
        scaled = self.axes / self.cell_m
        add_returns(
            self.sums, self.counts, points, values, scaled @ pose.rotation,
            scaled @ pose.translation,
        )  # fmt: skip
        self._smoothed = None

    def smoothed(self) -> tuple[Float32, Float32]:
        """Mean and number of returns (SIDE, SIDE) of each cell and its neighbours, weighted 1, 2, 1
        along either axis; mean 0 where there is none."""
        if self._smoothed is None:
            sums, weights = (
                np.asarray(cv2.sepFilter2D(layer, cv2.CV_32F, _WEIGHTS, _WEIGHTS), np.float32)
                for layer in (self.sums, self.counts)
            )
            means = np.divide(sums, weights, out=np.zeros_like(sums), where=weights > 0.0)
            self._smoothed = means, weights
        return self._smoothed

    def share_known(self, points: Array) -> float:
        """Share of ``points`` (N, 3), the clone's frame, that lie on known cells."""
        at = np.floor(points @ self.axes.T / self.cell_m).astype(np.int64) + SIDE // 2
        inside = ((at >= 0) & (at < SIDE)).all(axis=1)
        known = self.counts[at[inside, 1], at[inside, 0]] > 0
        return float(known.sum()) / max(len(points), 1)
