"""Sub-pixel tracking of planar patches from a keyframe into the present image.

Each patch is warped by the homography that its own plane and the predicted motion induce, so that
what remains is a small translation, found by inverse-compositional Gauss-Newton on zero-mean grey
values (Baker and Matthews 2004), coarse to fine.
"""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from touchdown.estimator.filtering.error_state import Frame, Pinhole
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.frames import Pose

Array = NDArray[np.float64]
Grey = NDArray[np.uint8]

HALF = 6
"""patches are 13 x 13"""
_SIDE = 2 * HALF + 1


def grey_levels(image: NDArray[np.uint8]) -> tuple[Grey, Grey, Grey]:
    """A grey image (H, W), or that of a coloured one, and its halves; a light blur first tames
    noise and texel steps."""
    plain = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    grey = cv2.GaussianBlur(plain, (3, 3), 0.7)
    half = cv2.pyrDown(grey)
    quarter = cv2.pyrDown(half)
    return np.asarray(grey, np.uint8), np.asarray(half, np.uint8), np.asarray(quarter, np.uint8)


@njit(cache=True)
def _bilinear(image: Grey, u: float, v: float) -> float:
    x, y = int(u), int(v)
    fx, fy = u - x, v - y
    upper = (1.0 - fx) * image[y, x] + fx * image[y, x + 1]
    lower = (1.0 - fx) * image[y + 1, x] + fx * image[y + 1, x + 1]
    return (1.0 - fy) * upper + fy * lower


@njit(cache=True)
def _template(
    image: Grey, u: float, v: float, warp: Array, patch: Array, grad_u: Array, grad_v: Array
) -> bool:
    """Samples the keyframe at (u, v) + warp @ offset over the patch, and its gradient with respect
    to the offset; all zero-mean. False at the border or without texture."""
    reach = HALF + 1
    span_u = reach * (abs(warp[0, 0]) + abs(warp[0, 1])) + 1.0
    span_v = reach * (abs(warp[1, 0]) + abs(warp[1, 1])) + 1.0
    height, width = image.shape
    if not (span_u <= u < width - 1 - span_u and span_v <= v < height - 1 - span_v):
        return False
    wide = np.empty((_SIDE + 2, _SIDE + 2))
    for j in range(_SIDE + 2):
        for i in range(_SIDE + 2):
            di, dj = i - reach, j - reach
            wide[j, i] = _bilinear(
                image, u + warp[0, 0] * di + warp[0, 1] * dj, v + warp[1, 0] * di + warp[1, 1] * dj
            )
    mean, mean_u, mean_v = 0.0, 0.0, 0.0
    for j in range(_SIDE):
        for i in range(_SIDE):
            patch[j, i] = wide[j + 1, i + 1]
            grad_u[j, i] = 0.5 * (wide[j + 1, i + 2] - wide[j + 1, i])
            grad_v[j, i] = 0.5 * (wide[j + 2, i + 1] - wide[j, i + 1])
            mean += patch[j, i]
            mean_u += grad_u[j, i]
            mean_v += grad_v[j, i]
    area = _SIDE * _SIDE
    for j in range(_SIDE):
        for i in range(_SIDE):
            patch[j, i] -= mean / area
            grad_u[j, i] -= mean_u / area
            grad_v[j, i] -= mean_v / area
    return True


@njit(cache=True)
def _align(
    image: Grey, u: float, v: float, patch: Array, grad_u: Array, grad_v: Array, steps: int
) -> tuple[bool, float, float, float]:
    """Translation that aligns the patch, from the guess (u, v): success, u, v and correlation."""
    huu, huv, hvv, power = 0.0, 0.0, 0.0, 0.0
    for j in range(_SIDE):
        for i in range(_SIDE):
            huu += grad_u[j, i] * grad_u[j, i]
            huv += grad_u[j, i] * grad_v[j, i]
            hvv += grad_v[j, i] * grad_v[j, i]
            power += patch[j, i] * patch[j, i]
    det = huu * hvv - huv * huv
    # half a grey level per pixel in the weaker direction places a patch to a tenth of a pixel
    if det < 1.0 or det / (huu + hvv) < 0.25 * _SIDE * _SIDE:
        return False, u, v, 0.0
    height, width = image.shape
    seen = np.empty((_SIDE, _SIDE))
    correlation = 0.0
    start_u, start_v = u, v
    for step in range(steps + 1):
        if not (HALF + 1 <= u < width - HALF - 2 and HALF + 1 <= v < height - HALF - 2):
            return False, u, v, 0.0
        x, y = int(u), int(v)
        fx, fy = u - x, v - y
        w00, w01, w10, w11 = (1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy
        mean = 0.0
        for j in range(_SIDE):
            for i in range(_SIDE):
                a, b = y + j - HALF, x + i - HALF
                value = (
                    w00 * image[a, b]
                    + w01 * image[a, b + 1]
                    + w10 * image[a + 1, b]
                    + w11 * image[a + 1, b + 1]
                )
                seen[j, i] = value
                mean += value
        mean /= _SIDE * _SIDE
        bu, bv, cross, seen_power = 0.0, 0.0, 0.0, 0.0
        for j in range(_SIDE):
            for i in range(_SIDE):
                value = seen[j, i] - mean
                error = value - patch[j, i]
                bu += grad_u[j, i] * error
                bv += grad_v[j, i] * error
                cross += value * patch[j, i]
                seen_power += value * value
        correlation = cross / np.sqrt(max(power * seen_power, 1e-9))
        if step == steps:
            break
        du = (hvv * bu - huv * bv) / det
        dv = (huu * bv - huv * bu) / det
        u, v = u - du, v - dv
        if abs(u - start_u) > HALF or abs(v - start_v) > HALF:
            return False, u, v, 0.0
        if du * du + dv * dv < 1e-4:
            break
    return True, u, v, correlation


@njit(cache=True)
def track_patches(
    source: tuple[Grey, Grey, Grey],
    target: tuple[Grey, Grey, Grey],
    pixels: Array,
    planes: Array,
    motion: Frame,
    lens: Pinhole,
    top_level: int,
    min_correlation: float,
) -> tuple[NDArray[np.bool_], Array, Array]:
    """Tracks (N, 2) ``pixels`` of ``source`` into ``target``.

    ``planes`` (N, 3): the plane ``n . P = 1`` of each patch in the source camera's frame;
    ``motion``: predicted target_camera_from_source_camera. Returns found
    (N,), the tracked pixels (N, 2) and the predicted ones (N, 2).
    """
    fx, fy, cx, cy = lens
    rotation, translation = motion
    count = pixels.shape[0]
    found = np.zeros(count, dtype=np.bool_)
    tracked = np.zeros((count, 2))
    predicted = np.zeros((count, 2))
    patch = np.empty((_SIDE, _SIDE))
    grad_u = np.empty((_SIDE, _SIDE))
    grad_v = np.empty((_SIDE, _SIDE))
    warp = np.empty((2, 2))
    height, width = target[0].shape
    for k in range(count):
        x, y = (pixels[k, 0] - cx) / fx, (pixels[k, 1] - cy) / fy
        depth_inverse = planes[k, 0] * x + planes[k, 1] * y + planes[k, 2]
        h = rotation.copy()
        for a in range(3):
            for b in range(3):
                h[a, b] += translation[a] * planes[k, b]
        px = h[0, 0] * x + h[0, 1] * y + h[0, 2]
        py = h[1, 0] * x + h[1, 1] * y + h[1, 2]
        pz = h[2, 0] * x + h[2, 1] * y + h[2, 2]
        if not (pz > 1e-3 and depth_inverse > 0.0):
            continue
        ux, uy = px / pz, py / pz
        u, v = fx * ux + cx, fy * uy + cy
        predicted[k, 0], predicted[k, 1] = u, v
        if not (HALF + 2 <= u < width - HALF - 3 and HALF + 2 <= v < height - HALF - 3):
            continue
        # d target pixel / d source pixel, then its inverse
        j00 = (h[0, 0] - ux * h[2, 0]) / pz
        j01 = (h[0, 1] - ux * h[2, 1]) / pz * fx / fy
        j10 = (h[1, 0] - uy * h[2, 0]) / pz * fy / fx
        j11 = (h[1, 1] - uy * h[2, 1]) / pz
        det = j00 * j11 - j01 * j10
        if not (0.2 < det < 5.0):
            continue
        warp[0, 0], warp[0, 1] = j11 / det, -j01 / det
        warp[1, 0], warp[1, 1] = -j10 / det, j00 / det
        good, correlation = True, 0.0
        for level in range(top_level, -1, -1):
            scale = 1.0 / (1 << level)
            fine = level == 0
            ok = _template(
                source[level], pixels[k, 0] * scale, pixels[k, 1] * scale, warp,
                patch, grad_u, grad_v,
            )  # fmt: skip
            if not ok:
                good = not fine
                continue
            ok, nu, nv, correlation = _align(
                target[level], u * scale, v * scale, patch, grad_u, grad_v, 8 if fine else 5
            )
            if ok:
                u, v = nu / scale, nv / scale
            good = ok or not fine
        if good and correlation >= min_correlation:
            found[k] = True
            tracked[k, 0], tracked[k, 1] = u, v
    return found, tracked, predicted


def track(
    source: tuple[Grey, Grey, Grey],
    target: tuple[Grey, Grey, Grey],
    pixels: Array,
    planes: Array,
    target_from_source: Pose,
    camera: CameraIntrinsics,
    top_level: int = 1,
    min_correlation: float = 0.7,
) -> tuple[NDArray[np.bool_], Array, Array]:
    """See ``track_patches``; images without distortion."""
    return track_patches(
        source, target, pixels, planes, Frame.of(target_from_source), Pinhole.of(camera),
        top_level, min_correlation,
    )  # fmt: skip
