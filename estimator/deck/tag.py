"""A printed AprilTag in the middle of a deck, read from images."""

import cv2
import numpy as np

from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array, Bytes

FAMILY, NUMBER = cv2.aruco.DICT_APRILTAG_36h11, 0


class TagReader:
    """Reads number 0 of the family 36h11."""

    def __init__(self, camera: CameraIntrinsics, side_m: float) -> None:
        """``camera``: a pinhole without distortion; ``side_m``: of the black square."""
        self._matrix, half = camera.matrix(), 0.5 * side_m
        self._corners = half * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]], float)
        settings = cv2.aruco.DetectorParameters()
        settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        dictionary = cv2.aruco.getPredefinedDictionary(FAMILY)
        self._detector = cv2.aruco.ArucoDetector(dictionary, settings)

    def read(self, grey: Bytes, camera_in_odom: Pose) -> Array | None:
        """Returns the middle of the tag, (3,) in the odom frame; None where it is not seen."""
        found, numbers, _ = self._detector.detectMarkers(grey)
        for corners, number in zip(found, () if numbers is None else numbers.ravel(), strict=True):
            if number == NUMBER:
                _, _, middle = cv2.solvePnP(
                    self._corners, corners.reshape(4, 2), self._matrix, None,
                    flags=cv2.SOLVEPNP_IPPE_SQUARE,
                )  # fmt: skip
                return camera_in_odom.apply(np.asarray(middle, np.float64).ravel())
        return None
