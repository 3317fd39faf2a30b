"""Undistortion of camera images."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.typing import Bytes
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

    def __call__(self, image: Bytes) -> Bytes:
        """Returns the undistorted image (H, W) or (H, W, 3)."""
        if self._maps is None:
            return image
        return np.asarray(cv2.remap(image, *self._maps, cv2.INTER_LINEAR), dtype=np.uint8)

    def grey(self, rgb: Bytes) -> Bytes:
        """Returns the undistorted grey image (H, W)."""
        return self(np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8))
