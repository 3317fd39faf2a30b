"""Lens, exposure and noise: from a drawn raster to the image of a camera."""

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from touchdown.sim.api import CameraIntrinsics, CameraParams
from touchdown.sim.geometry.lens import distorted, undistorted
from touchdown.sim.typing import Bytes, Float32

NOISE_MARGIN = 128
"""The noise tile is larger than an image by this, and shifted at random."""

_ROUNDING_VARIANCE = 1.0 / 12.0
GAMMA = 2.2
"""display levels are the power 1 / 2.2 of linear light"""
LIGHT: Float32 = ((np.arange(256) / 255.0) ** GAMMA).astype(np.float32)
"""linear light of a grey level, 1 for white"""
_MIDDLE_GREY = 110.0
_MAX_AUTO_GAIN = 4.0
_MAX_RESIDUAL_PX = 1e-3
_MAX_WIDENING = 3.0
_BORDER_PX = 2


@dataclass(frozen=True, slots=True)
class Lens:
    """``raster`` is the pinhole that is drawn; pixel (u, v) of the image shows the raster at
    (map_x, map_y)[v, u], both (H, W) float32. Without distortion the maps are None, and the image
    lies ``margin`` pixels inside the raster."""

    image: CameraIntrinsics
    raster: CameraIntrinsics
    map_x: Float32 | None
    map_y: Float32 | None
    margin: int = 0


def intrinsics_of(params: CameraParams) -> CameraIntrinsics:
    """Focal lengths that follow from the two fields of view, which hold without distortion, and
    the distortion. ValueError: a fisheye with a fifth coefficient."""
    fisheye = params.lens == "fisheye"
    if fisheye and params.distortion[4]:
        raise ValueError("camera.distortion of a fisheye has four terms; make the fifth number 0")
    half_x, half_y = (0.5 * math.radians(deg) for deg in (params.fov_x_deg, params.fov_y_deg))
    radius_x, radius_y = (half_x, half_y) if fisheye else (math.tan(half_x), math.tan(half_y))
    return CameraIntrinsics(
        width=params.width,
        height=params.height,
        fx=0.5 * params.width / radius_x,
        fy=0.5 * params.height / radius_y,
        cx=0.5 * (params.width - 1),
        cy=0.5 * (params.height - 1),
        distortion=np.array(params.distortion, dtype=np.float64),
        lens=params.lens,
    )


def make_lens(params: CameraParams) -> Lens:
    """The drawn pinhole keeps the focal lengths and is as much wider as the lens bends outwards.

    ValueError: the distortion folds the image over itself, or needs a raster of more than three
    times the image's width or height.
    """
    image = intrinsics_of(params)
    if not image.distortion.any() and image.lens == "pinhole":
        return Lens(image=image, raster=image, map_x=None, map_y=None)
    cols, rows = np.meshgrid(np.arange(params.width), np.arange(params.height))
    seen = np.stack([(cols - image.cx) / image.fx, (rows - image.cy) / image.fy], -1)
    ideal = undistorted(seen, image)
    residual = distorted(ideal, image) - seen
    worst = np.abs(residual * [image.fx, image.fy]).max()
    if not worst < _MAX_RESIDUAL_PX:
        raise ValueError(
            f"camera.distortion {params.distortion} folds the image over itself: use smaller "
            "coefficients or a smaller field of view"
        )
    u, v = ideal[..., 0] * image.fx, ideal[..., 1] * image.fy
    width, height = (2 * (math.ceil(np.abs(axis).max()) + _BORDER_PX) + 1 for axis in (u, v))
    if width > _MAX_WIDENING * params.width or height > _MAX_WIDENING * params.height:
        raise ValueError(
            f"camera.distortion {params.distortion} of a {params.lens} needs a raster of {width} x "
            f"{height} pixels: use smaller coefficients or a smaller field of view"
        )
    raster = CameraIntrinsics(
        width=width,
        height=height,
        fx=image.fx,
        fy=image.fy,
        cx=0.5 * (width - 1),
        cy=0.5 * (height - 1),
    )
    return Lens(
        image=image,
        raster=raster,
        map_x=(u + raster.cx).astype(np.float32),
        map_y=(v + raster.cy).astype(np.float32),
    )


def with_margin(lens: Lens, pixels: int) -> Lens:
    """The lens with a raster that is wider by ``pixels`` at each side."""
    old = lens.raster
    raster = dataclasses.replace(
        old,
        width=old.width + 2 * pixels,
        height=old.height + 2 * pixels,
        cx=old.cx + pixels,
        cy=old.cy + pixels,
    )
    shifted = None if lens.map_x is None else lens.map_x + np.float32(pixels)
    lowered = None if lens.map_y is None else lens.map_y + np.float32(pixels)
    return Lens(
        image=lens.image, raster=raster, map_x=shifted, map_y=lowered, margin=lens.margin + pixels
    )


def through_lens(
    lens: Lens, drawn: NDArray[Any], first_row: int, rows: slice, smooth: bool
) -> NDArray[Any]:
    """Rows ``rows`` of the image out of ``drawn``, which begins at raster row ``first_row``.
    ``smooth`` interpolates (colours); else the nearest pixel is taken (depths, ids)."""
    if lens.map_x is None or lens.map_y is None:
        m = lens.margin
        return np.ascontiguousarray(drawn[m : -m or None, m : -m or None]) if m else drawn
    flag = cv2.INTER_LINEAR if smooth else cv2.INTER_NEAREST
    map_y = lens.map_y[rows] - np.float32(first_row)
    return cv2.remap(drawn, lens.map_x[rows], map_y, flag)


def raster_rows(lens: Lens, rows: slice) -> tuple[int, int]:
    """First and past-the-last raster row that rows ``rows`` of the image show."""
    if lens.map_y is None:
        return rows.start, rows.stop
    shown = lens.map_y[rows]
    first = max(math.floor(shown.min()) - 1, 0)
    return first, min(math.ceil(shown.max()) + 2, lens.raster.height)


def exposure_table(params: CameraParams, image: Bytes) -> Bytes | None:
    """(256,) new grey level of every old one, or None where nothing changes.

    The gain multiplies light; levels are display levels, which a power law of 2.2 turns into light.
    Automatic exposure is ideal: it knows the image that it exposes.
    """
    factor = params.gain ** (1.0 / GAMMA)
    if params.auto_exposure:
        limit = _MAX_AUTO_GAIN ** (1.0 / GAMMA)
        level = max(float(image.mean()), 1e-3)
        factor *= min(max(_MIDDLE_GREY / (level * factor), 1.0 / limit), limit)
    if factor == 1.0:
        return None
    return np.clip(np.rint(factor * np.arange(256)), 0, 255).astype(np.uint8)


def noise_tile(params: CameraParams, key: list[int]) -> NDArray[np.int8]:
    """Rounded Gaussian grey noise, a margin larger than the image, (rows, 3 * columns): every
    value thrice, once a channel. Rounding adds its own variance, which is taken off beforehand."""
    sigma = math.sqrt(max(params.noise_sigma**2 - _ROUNDING_VARIANCE, 0.0))
    shape = (params.height + NOISE_MARGIN, params.width + NOISE_MARGIN)
    noise = sigma * np.random.default_rng(key).standard_normal(shape, dtype=np.float32)
    return np.repeat(np.clip(np.rint(noise), -127, 127).astype(np.int8), 3, axis=1)


def develop(
    raw: Bytes, noise: NDArray[np.int8], row: int, col: int, sign: int, flip: bool, image: Bytes
) -> None:
    """Turns the image (H, W, 3) the right way up where ``flip`` says so, and adds the noise tile
    from (row, col) on. Both images are contiguous."""
    lines = (raw.shape[0], raw.shape[1] * raw.shape[2])
    _add_noise(raw.reshape(lines), noise, row, 3 * col, sign, flip, image.reshape(lines))


@njit(cache=True, nogil=True, error_model="numpy")
def _add_noise(
    raw: Bytes, noise: NDArray[np.int8], row: int, first: int, sign: int, flip: bool, out: Bytes
) -> None:
    height, width = raw.shape
    polarity = np.int16(sign)
    for i in range(height):
        source = raw[height - 1 - i if flip else i]
        grain = noise[row + i, first : first + width]
        target = out[i]
        for j in range(width):
            # 16 bits, so that the loop becomes vector instructions
            value = np.int16(source[j]) + np.int16(polarity * np.int16(grain[j]))
            target[j] = np.uint8(min(max(value, np.int16(0)), np.int16(255)))
