"""OpenCV's two models of a lens: pinhole with radial and tangential terms, and fisheye.

Ideal coordinates are those of the undistorted pinhole at depth 1; distorted ones are pixels without
the camera matrix. The fisheye maps the angle from the axis to the radius, times a polynomial
(Kannala and Brandt, PAMI 28, 2006).
"""

from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.sim.typing import Array

_STEPS = 30
_NO_ANGLE = 1e-9


class Intrinsics(Protocol):
    """What of ``CameraIntrinsics`` a projection needs."""

    @property
    def fx(self) -> float: ...
    @property
    def fy(self) -> float: ...
    @property
    def cx(self) -> float: ...
    @property
    def cy(self) -> float: ...
    @property
    def distortion(self) -> Array: ...
    @property
    def lens(self) -> str: ...


def project(camera: Intrinsics, points: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Pixels (..., 2) of points (..., 3) in the camera's frame, and the mask of those ahead of
    it."""
    ahead = points[..., 2] > 1e-6
    depth = np.where(ahead, points[..., 2], 1.0)
    seen = distorted(points[..., :2] / depth[..., None], camera)
    return seen * [camera.fx, camera.fy] + [camera.cx, camera.cy], ahead


def bearing(camera: Intrinsics, pixels: Array) -> Array:
    """(..., 3) directions of pixels (..., 2) in the camera's frame, z = 1."""
    seen = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    return np.concatenate([undistorted(seen, camera), np.ones((*pixels.shape[:-1], 1))], axis=-1)


def distorted(ideal: Array, camera: Intrinsics) -> Array:
    """(..., 2) distorted coordinates of ideal ones."""
    if camera.lens == "fisheye":
        radius = np.maximum(np.linalg.norm(ideal, axis=-1, keepdims=True), _NO_ANGLE)
        angle = np.arctan(radius)
        powers = np.polyval([*camera.distortion[3::-1], 1.0], angle**2)
        return np.asarray(ideal * angle * powers / radius)
    return _with_jacobian(ideal, camera.distortion)[0]


def undistorted(seen: Array, camera: Intrinsics) -> Array:
    """(..., 2) inverse of `distorted`; to be verified where the lens may fold."""
    if camera.lens == "fisheye":
        flat = np.ascontiguousarray(seen.reshape(1, -1, 2), float)
        found = cv2.fisheye.undistortPoints(flat, np.eye(3), camera.distortion[:4])
        return np.asarray(found, float).reshape(seen.shape)
    ideal = seen.copy()
    with np.errstate(all="ignore"):  # a folding lens may run away, which the check finds
        for _ in range(_STEPS):
            bent, xx, xy, yy = _with_jacobian(ideal, camera.distortion)
            error = bent - seen
            determinant = xx * yy - xy * xy
            ideal[..., 0] -= (yy * error[..., 0] - xy * error[..., 1]) / determinant
            ideal[..., 1] -= (xx * error[..., 1] - xy * error[..., 0]) / determinant
            if np.nanmax(np.abs(error)) < 1e-12:
                break
    return ideal


def _with_jacobian(ideal: Array, k: Array) -> tuple[Array, Array, Array, Array]:
    """The points (..., 2) distorted by k1, k2, p1, p2, k3, and the symmetric Jacobian's xx, xy and
    yy parts (...)."""
    x, y = ideal[..., 0], ideal[..., 1]
    k1, k2, p1, p2, k3 = k
    square = x * x + y * y
    radial = 1.0 + square * (k1 + square * (k2 + square * k3))
    slope = 2.0 * (k1 + square * (2.0 * k2 + square * 3.0 * k3))
    bent = np.stack(
        [
            x * radial + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x),
            y * radial + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y,
        ],
        axis=-1,
    )
    xx = radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x
    xy = slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y
    yy = radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x
    return bent, xx, xy, yy
