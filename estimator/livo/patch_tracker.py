"""Sub-pixel tracking of planar patches from a keyframe into the present image.

Each patch is warped by the homography that its own plane and the predicted motion induce, so that
what remains is a small translation, found by inverse-compositional Gauss-Newton on zero-mean grey
values (Baker and Matthews 2004), coarse to fine.
"""

from typing import NamedTuple

import cv2
import numpy as np
from numba import njit

from touchdown.estimator.filtering.error_state import Frame, Pinhole
from touchdown.sim.typing import Array, Bytes, Float32, Grey, Mask

HALF = 6
"""patches are 13 x 13"""
_SIDE = 2 * HALF + 1
_ROW = 16
"""values from row to row of what lies flat: a patch, its neighbours, and some to spare"""
_FLAT = _SIDE * _ROW
_WIDE = 2 * HALF + 3
"""width of a patch with its neighbours, whose differences are the gradients"""
_MAX = 64
"""pixels along either side of a warped patch"""
_INSIDE = np.tile(np.arange(_ROW) < _SIDE, _SIDE).astype(np.float32)
"""1 for values of a flat patch, 0 for those to spare"""
_COARSER = 0.4
"""ratio of the areas of a patch in the image and in the keyframe, below which the keyframe's next
coarser level has the right detail: between 1 and a quarter"""
_ANY_ORDER = {"reassoc", "contract", "nsz", "arcp"}
"""floating-point sums in any order, so that the processor takes a vector of pixels at a time"""


def grey_levels(image: Bytes) -> tuple[Grey, Grey, Grey]:
    """A grey image (H, W), or that of a coloured one, and its halves; a light blur first tames
    noise and texel steps."""
    plain = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    grey = cv2.GaussianBlur(plain, (3, 3), 0.7)
    half = cv2.pyrDown(grey)
    quarter = cv2.pyrDown(half)
    return np.asarray(grey, np.uint8), np.asarray(half, np.uint8), np.asarray(quarter, np.uint8)


class _Patch(NamedTuple):
    """A zero-mean patch of a keyframe and what it is compared with, flat; zero beside the patch."""

    values: Float32
    grad_u: Float32
    grad_v: Float32
    pixels: Float32  # of the image around
    seen: Float32  # interpolated


@njit(cache=True, error_model="numpy")
def _empty_patch() -> _Patch:
    maximum = (_WIDE + 1) * _ROW
    return _Patch(
        np.zeros(_FLAT, np.float32), np.zeros(_FLAT, np.float32), np.zeros(_FLAT, np.float32),
        np.zeros(_MAX * (_MAX + 1), np.float32), np.zeros(maximum, np.float32),
    )  # fmt: skip


@njit(cache=True, fastmath=_ANY_ORDER, forceinline=True, error_model="numpy")
def _load(part: Grey, pixels: Float32) -> None:
    """Writes the part (H, W) of an image into ``pixels``, row after row."""
    height, width = part.shape
    for j in range(height):
        for i in range(width):
            pixels[j * width + i] = np.float32(part[j, i])


@njit(cache=True, fastmath=_ANY_ORDER, forceinline=True, error_model="numpy")
def _template(image: Grey, u: float, v: float, warp: Array, patch: _Patch) -> bool:
    """Samples the keyframe at (u, v) + warp @ offset over the patch, and its gradient with respect
    to the offset; all zero-mean. False at the border."""
    values, grad_u, grad_v, pixels, seen = patch
    reach = HALF + 1
    span_u = reach * (abs(warp[0, 0]) + abs(warp[0, 1])) + 1.0
    span_v = reach * (abs(warp[1, 0]) + abs(warp[1, 1])) + 1.0
    height, width = image.shape
    if not (span_u <= u < width - 1 - span_u and span_v <= v < height - 1 - span_v):
        return False
    if max(span_u, span_v) > 0.5 * _MAX - 2.0:
        return False
    left, top = int(u - span_u), int(v - span_v)
    right, bottom = int(u + span_u) + 2, int(v + span_v) + 2
    _load(image[top:bottom, left:right], pixels)
    stride, one = np.uint32(right - left), np.uint32(1)
    step_u, step_v = np.float32(warp[0, 0]), np.float32(warp[1, 0])
    for j in range(_WIDE):
        # counted from the corner, float32 is fine enough
        row_u = np.float32(u - left - reach * warp[0, 0] + (j - reach) * warp[0, 1])
        row_v = np.float32(v - top - reach * warp[1, 0] + (j - reach) * warp[1, 1])
        for i in range(_WIDE):
            at_u, at_v = row_u + np.float32(i) * step_u, row_v + np.float32(i) * step_v
            x, y = np.int32(at_u), np.int32(at_v)
            fx, fy = at_u - np.float32(x), at_v - np.float32(y)
            at = np.uint32(y) * stride + np.uint32(x)
            upper = pixels[at] + fx * (pixels[at + one] - pixels[at])
            at += stride
            lower = pixels[at] + fx * (pixels[at + one] - pixels[at])
            seen[j * _ROW + i] = upper + fy * (lower - upper)
    half, area = np.float32(0.5), np.float32(_SIDE * _SIDE)
    mean, mean_u, mean_v = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for k in range(_FLAT):
        values[k] = _INSIDE[k] * seen[k + _ROW + 1]
        grad_u[k] = _INSIDE[k] * half * (seen[k + _ROW + 2] - seen[k + _ROW])
        grad_v[k] = _INSIDE[k] * half * (seen[k + 2 * _ROW + 1] - seen[k + 1])
        mean += values[k]
        mean_u += grad_u[k]
        mean_v += grad_v[k]
    mean, mean_u, mean_v = mean / area, mean_u / area, mean_v / area
    for k in range(_FLAT):
        values[k] -= _INSIDE[k] * mean
        grad_u[k] -= _INSIDE[k] * mean_u
        grad_v[k] -= _INSIDE[k] * mean_v
    return True


@njit(cache=True, fastmath=_ANY_ORDER, forceinline=True, error_model="numpy")
def _sample(image: Grey, u: float, v: float, patch: _Patch) -> None:
    """Interpolates the image over the patch around (u, v)."""
    pixels, seen = patch.pixels, patch.seen
    left, top = int(u) - HALF, int(v) - HALF
    part = image[top : top + _SIDE + 1, left : left + _SIDE + 1]
    for j in range(_SIDE + 1):
        for i in range(_SIDE + 1):
            pixels[j * _ROW + i] = np.float32(part[j, i])
    one, fx, fy = np.float32(1.0), np.float32(u - int(u)), np.float32(v - int(v))
    w00, w01, w10, w11 = (one - fx) * (one - fy), fx * (one - fy), (one - fx) * fy, fx * fy
    for k in range(_FLAT):
        upper = w00 * pixels[k] + w01 * pixels[k + 1]
        seen[k] = upper + w10 * pixels[k + _ROW] + w11 * pixels[k + _ROW + 1]


@njit(cache=True, fastmath=_ANY_ORDER, forceinline=True, error_model="numpy")
def _correlation(patch: _Patch, power: np.float32) -> float:
    """Of what is seen with the patch; ``power``: sum of the patch's squares."""
    values, seen = patch.values, patch.seen
    mean, cross, seen_power = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for k in range(_FLAT):
        mean += _INSIDE[k] * seen[k]
    mean = mean / np.float32(_SIDE * _SIDE)
    for k in range(_FLAT):
        value = _INSIDE[k] * (seen[k] - mean)
        cross += value * values[k]
        seen_power += value * value
    return cross / np.sqrt(max(power * seen_power, np.float32(1e-9)))


@njit(cache=True, fastmath=_ANY_ORDER, forceinline=True, error_model="numpy")
def _align(
    image: Grey, u: float, v: float, patch: _Patch, steps: int
) -> tuple[bool, float, float, float]:
    """Translation that aligns the patch, from the guess (u, v): success, u, v and correlation."""
    values, grad_u, grad_v, seen = patch.values, patch.grad_u, patch.grad_v, patch.seen
    zero = np.float32(0.0)
    huu, huv, hvv, power, still_u, still_v = zero, zero, zero, zero, zero, zero
    for k in range(_FLAT):
        huu += grad_u[k] * grad_u[k]
        huv += grad_u[k] * grad_v[k]
        hvv += grad_v[k] * grad_v[k]
        power += values[k] * values[k]
        still_u += grad_u[k] * values[k]
        still_v += grad_v[k] * values[k]
    a, b, c = np.float64(huu), np.float64(huv), np.float64(hvv)
    det = a * c - b * b
    # half a grey level per pixel in the weaker direction places a patch to a tenth of a pixel
    if det < 1.0 or det / (a + c) < 0.25 * _SIDE * _SIDE:
        return False, u, v, 0.0
    height, width = image.shape
    start_u, start_v = u, v
    for step in range(steps + 1):
        if not (HALF + 1 <= u < width - HALF - 2 and HALF + 1 <= v < height - HALF - 2):
            return False, u, v, 0.0
        _sample(image, u, v, patch)
        if step == steps:
            break
        # gradients sum to zero: the mean of what is seen drops out
        bu, bv = -still_u, -still_v
        for k in range(_FLAT):
            bu += grad_u[k] * seen[k]
            bv += grad_v[k] * seen[k]
        du, dv = (c * bu - b * bv) / det, (a * bv - b * bu) / det
        u, v = u - du, v - dv
        if abs(u - start_u) > HALF or abs(v - start_v) > HALF:
            return False, u, v, 0.0
        if du * du + dv * dv < 1e-4:
            break
    return True, u, v, _correlation(patch, power)


@njit(cache=True, error_model="numpy")
def track(
    source: tuple[Grey, Grey, Grey],
    target: tuple[Grey, Grey, Grey],
    pixels: Array,
    planes: Array,
    motion: Frame,
    lens: Pinhole,
    top_level: int = 1,
    min_correlation: float = 0.7,
) -> tuple[Mask, Array, Array]:
    """Tracks (N, 2) ``pixels`` of ``source`` into ``target``, images without distortion.

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
    patch, warp = _empty_patch(), np.empty((2, 2))
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
        # a keyframe that shows the ground much larger gives its patches from a level higher
        coarser = 1 if det < _COARSER else 0
        fraction = 1.0 / (1 << coarser)
        if not (0.2 * fraction * fraction < det < 5.0):
            continue
        warp[0, 0], warp[0, 1] = fraction * j11 / det, -fraction * j01 / det
        warp[1, 0], warp[1, 1] = -fraction * j10 / det, fraction * j00 / det
        good, correlation = True, 0.0
        for level in range(top_level, -1, -1):
            scale = 1.0 / (1 << level)
            fine = level == 0
            at_u, at_v = pixels[k, 0] * scale * fraction, pixels[k, 1] * scale * fraction
            ok = _template(source[level + coarser], at_u, at_v, warp, patch)
            if not ok:
                good = not fine
                continue
            ok, nu, nv, correlation = _align(
                target[level], u * scale, v * scale, patch, 8 if fine else 5
            )
            if ok:
                u, v = nu / scale, nv / scale
            good = ok or not fine
        if good and correlation >= min_correlation:
            found[k] = True
            tracked[k, 0], tracked[k, 1] = u, v
    return found, tracked, predicted
