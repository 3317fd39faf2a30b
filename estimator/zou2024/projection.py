"""Projection of LIDAR points into the image (paper, section 3.2); Eq. 1 is `Pose.apply`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from touchdown.estimator.typing import Array, Mask
from touchdown.sim.api import CameraImage

NEAREST_DEPTH_M = 0.05


def project(points_camera: Array, matrix: Array) -> tuple[Array, Mask]:
    """Eq. 2: pixels (N, 2) of camera points (N, 3) by the intrinsic matrix K (3, 3), skew included.

    The paper leaves the division by depth implicit (its ``uv`` has a third component 1). Also
    returns the mask (N,) of points in front of the camera; the pixels of the others are
    meaningless.
    """
    depth = points_camera[:, 2]
    front = depth > NEAREST_DEPTH_M
    rays = points_camera / np.where(front, depth, 1.0)[:, None]
    return rays @ matrix[:2].T, front


def inside_image(pixels: Array, front: Mask, size: tuple[int, int], margin: float = 0.0) -> Mask:
    """Mask (N,) of the pixels (N, 2) inside an image of ``size`` (width, height)."""
    u, v = pixels[:, 0], pixels[:, 1]
    inside = front & (u >= margin) & (v >= margin)
    inside &= (u <= size[0] - 1 - margin) & (v <= size[1] - 1 - margin)
    return inside


def nearest_image(
    images: Sequence[CameraImage], tick: int, most_ticks_apart: int
) -> CameraImage | None:
    """Returns the image nearest in time to a scan's ``tick`` (section 3.2), the earlier of two;
    None if none is within ``most_ticks_apart``."""
    near = [image for image in images if abs(image.tick - tick) <= most_ticks_apart]
    return min(near, key=lambda image: (abs(image.tick - tick), image.tick), default=None)
