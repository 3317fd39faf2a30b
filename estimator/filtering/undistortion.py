"""Undistortion of camera images."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from touchdown.estimator.typing import Bytes, Int32
from touchdown.sim.api import SensorRig


class Undistorter:
    """Resamples images to a pinhole camera with the same matrix; a lens without distortion leaves
    them as they are."""

    def __init__(self, rig: SensorRig) -> None:
        camera = rig.camera
        self._maps: tuple[NDArray[np.int16], NDArray[np.uint16]] | None = None
        if np.any(camera.distortion):
            size = (camera.width, camera.height)
            matrix = camera.matrix()
            maps = cv2.initUndistortRectifyMap(
                matrix, camera.distortion, None, matrix, size, cv2.CV_16SC2
            )
            self._maps = np.asarray(maps[0], np.int16), np.asarray(maps[1], np.uint16)
            self._table = _table(*self._maps)

    def __call__(self, image: Bytes) -> Bytes:
        """Returns the undistorted image (H, W, 3)."""
        if self._maps is None:
            return image
        return np.asarray(cv2.remap(image, *self._maps, cv2.INTER_LINEAR), dtype=np.uint8)

    def grey(self, rgb: Bytes) -> Bytes:
        """Returns the undistorted grey image (H, W), equal to the bit to that of OpenCV."""
        grey = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8)
        if self._maps is None:
            return grey
        out = np.empty_like(grey)
        _resample(np.pad(grey, 1).ravel(), self._table, out.ravel())
        return out


class _Table(NamedTuple):
    """Where each of the H W pixels comes from, in an image with a black border of one pixel."""

    runs: Int32  # (R, 3) of pixels side by side that come so: the first, its source, their number
    right: Bytes  # (H W,) in 32nds of a pixel, from the source on
    down: Bytes
    stride: int  # pixels of a row with the border


def _table(whole: NDArray[np.int16], parts: NDArray[np.uint16]) -> _Table:
    """The table of OpenCV's fixed-point maps."""
    height, width = parts.shape
    x, y = (whole[..., k].astype(np.int32) + 1 for k in range(2))
    inside = (x >= 0) & (x <= width) & (y >= 0) & (y <= height)
    source = np.where(inside, y * (width + 2) + x, 0)
    breaks = np.ones(source.shape, np.bool_)
    breaks[:, 1:] = source[:, 1:] != source[:, :-1] + 1
    first = np.flatnonzero(breaks)
    counts = np.diff(first, append=source.size)
    runs = np.column_stack([first, source.ravel()[first], counts]).astype(np.int32)
    right, down = (np.where(inside, part, 0).ravel() for part in (parts & 31, parts >> 5))
    return _Table(runs, right.astype(np.uint8), down.astype(np.uint8), width + 2)


@njit(cache=True, error_model="numpy")
def _resample(padded: Bytes, table: _Table, out: Bytes) -> None:
    """Interpolates the pixels of ``padded``, flat, by the table into ``out`` (H W,)."""
    for k in range(table.runs.shape[0]):
        to, at, count = table.runs[k, 0], table.runs[k, 1], table.runs[k, 2]
        right, down = table.right[to : to + count], table.down[to : to + count]
        above = padded[at : at + count + 1]
        below = padded[at + table.stride : at + table.stride + count + 1]
        part = out[to : to + count]
        for i in range(count):
            fx, fy = np.int32(right[i]), np.int32(down[i])
            upper = np.int32(above[i] << 5) + fx * (np.int32(above[i + 1]) - np.int32(above[i]))
            lower = np.int32(below[i] << 5) + fx * (np.int32(below[i + 1]) - np.int32(below[i]))
            part[i] = np.uint8((np.int32(upper << 5) + fy * (lower - upper) + 512) >> 10)
