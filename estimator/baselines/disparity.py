"""Depth from a stereo pair whose baseline is short for its height.

Disparity is inverse depth times ``scale`` = focal length times baseline, pixels times metres.
"""

from __future__ import annotations

import math

import numpy as np

from touchdown.estimator.api import StereoParams
from touchdown.estimator.baselines.corner_flow import follow
from touchdown.estimator.typing import Array, Grey, Indices
from touchdown.sim.frames import Pose

_MIN_DEPTH_M = 0.03
_ROWS_PX = 1.0
"""largest difference of a corner's rows in the two images"""


def disparities(
    left: Grey, right: Grey, pixels: Array, expected_m: Array, scale: float
) -> tuple[Indices, Array]:
    """Returns the indices (M,) of the matched corners (N, 2) of the left image and their sub-pixel
    disparities (M,). ``expected_m`` (N,): initial depths."""
    guess = pixels.copy()
    guess[:, 0] -= scale / np.maximum(expected_m, _MIN_DEPTH_M)
    found, reached = follow(left, right, pixels, guess)
    level = np.abs(reached[:, 1] - pixels[found, 1]) < _ROWS_PX
    found, reached = found[level], reached[level]
    return found, pixels[found, 0] - reached[:, 0]


class GroundHeight:
    """Mean height of the ground in view, odometry frame: a random walk in time, measured by every
    pair through all its corners."""

    def __init__(self, start_m: float, params: StereoParams) -> None:
        self._params = params
        self.height_m = start_m
        self._variance = 1e-4
        self._time_s = 0.0

    @property
    def sigma_m(self) -> float:
        """Standard deviation of the height."""
        return math.sqrt(self._variance)

    def depths(self, rays: Array, odom_from_camera: Pose) -> Array:
        """(N,) depths at which rays (N, 3), z = 1, meet the ground; NaN where they do not."""
        down = -(rays @ odom_from_camera.rotation[2])
        height = max(float(odom_from_camera.translation[2]) - self.height_m, _MIN_DEPTH_M)
        depths: Array = height / np.where(down > 0.2, down, np.nan)
        return depths

    def take(
        self, rays: Array, shifts: Array, odom_from_camera: Pose, scale: float, time_s: float
    ) -> None:
        """Updates by disparities (N,) along rays (N, 3): level ground at height h below the camera
        has the disparity ``scale * down / h``, so that one number, 1 / h, is fitted robustly."""
        self._variance += self._params.ground_density**2 * max(time_s - self._time_s, 0.0)
        self._time_s = time_s
        if len(shifts) < 10:
            return
        design = -scale * (rays @ odom_from_camera.rotation[2])
        camera_z = float(odom_from_camera.translation[2])
        inverse = 1.0 / max(camera_z - self.height_m, _MIN_DEPTH_M)
        sigma = self._params.disparity_sigma
        weights = np.ones(len(shifts))
        for _ in range(5):
            inverse = float((weights * design) @ shifts / ((weights * design) @ design))
            residuals = np.abs(shifts - design * inverse)
            spread = max(2.0 * float(np.median(residuals)), sigma)
            weights = 1.0 / (1.0 + (residuals / spread) ** 2)
        if inverse <= 0.0:
            return
        noise = sigma**2 / float((weights * design) @ design)
        noise += (self._params.disparity_floor_sigma / float(np.mean(design))) ** 2
        measured = camera_z - 1.0 / inverse
        variance = noise / inverse**4
        gain = self._variance / (self._variance + variance)
        self.height_m += gain * (measured - self.height_m)
        self._variance *= 1.0 - gain


def inverse_depths(
    found: Indices, shifts: Array, ground_m: Array, scale: float, params: StereoParams
) -> tuple[Array, Array]:
    """(N,) inverse depths of corners and their variances: those of the ground ``ground_m`` (N,),
    updated by the disparities ``shifts`` (M,) of the corners ``found`` (M,), as far as these
    resolve relief. In inverse depth the noise of disparities is the same at all ranges. NaN where
    there is no ground."""
    inverse = 1.0 / ground_m
    variance = (params.relief_sigma_m * inverse**2) ** 2
    own = (params.disparity_sigma / scale) ** 2
    gain = variance[found] / (variance[found] + own)
    inverse[found] += gain * (shifts / scale - inverse[found])
    variance[found] *= 1.0 - gain
    return inverse, variance
