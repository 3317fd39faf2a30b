"""Degradations of camera images: fog, rain, dust, dirt on the lens, a low sun.

- air: the light of a pixel at the distance d is L exp(-e d) + A (1 - exp(-e d)), with the
  extinction e of ``sim.faults.disturbances`` and the airlight A of an evenly lit, bright sky
  (Koschmieder, 1924; Narasimhan and Nayar, "Vision and the atmosphere", IJCV 48, 2002);
- dirt: blobs that stay where they are in the image. What is seen through one is dimmer and, since
  it lies far out of focus, blurred (Gu, Ramamoorthi, Belhumeur and Nayar, "Removing image artifacts
  due to dirty camera lenses and thin occluders", ACM TOG 28, 2009). Blobs are where smooth noise
  exceeds its own quantile, so that they cover the fraction asked for;
- glare: where the sun shines on the front lens, a fraction of its light strays over the whole image
  (veiling glare, ISO 9358), in proportion to the cosine of its angle to the optical axis. A camera
  that looks down is hit when the vehicle tilts by more than the sun's elevation.

Air and glare are added in linear light; grey levels are display levels, a power law of 2.2.
"""

import math
from dataclasses import dataclass
from typing import Any
from zlib import crc32

import cv2
import mujoco
import numpy as np
from numba import njit

from touchdown.sim.api import CameraIntrinsics, CameraParams, FaultParams
from touchdown.sim.camera.gl import Snapshot
from touchdown.sim.camera.optics import GAMMA, LIGHT
from touchdown.sim.dust import DustCloud
from touchdown.sim.effects import Effects
from touchdown.sim.faults.disturbances import Happening, Weather
from touchdown.sim.typing import Array, Bytes, Float32

AIRLIGHT_LEVEL = 190.0
"""grey level of endless fog"""

_LEVELS = 4096
"""steps of the table from light to grey level"""
_SHRINK = 8
"""blur is made in images this much smaller"""
_DISPLAY: Bytes = np.rint(255.0 * (np.arange(_LEVELS) / (_LEVELS - 1)) ** (1.0 / GAMMA)).astype(
    np.uint8
)


@dataclass(frozen=True, slots=True)
class ImageDefects:
    """Degradations of the image of one tick."""

    extinction: float
    """1/m"""
    dirty: bool
    glaring: bool
    air: tuple[str, ...] = ()
    """names of what makes the extinction"""


class CameraDegradations:
    """Degradations of a camera that draws rasters of ``raster`` in ``model``. The dirt is a
    function of (seed, camera)."""

    def __init__(
        self,
        faults: FaultParams,
        tick_hz: int,
        params: CameraParams,
        raster: CameraIntrinsics,
        model: Any,
        seed: int,
        camera_name: str,
        *,
        dust: DustCloud | None = None,
    ) -> None:
        self._dust, self.effects = dust, Effects()
        self._faults, self._model, self._raster = faults, model, raster
        self._camera_id = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, camera_name)
        self._weather = Weather(faults, tick_hz)
        self._dirty = Happening(faults, "lens_dirt", tick_hz)
        self._sun_id = sun_light(model) if faults.glare > 0.0 else -1
        self._low_sun = bool(Happening(faults, "low_sun", tick_hz).faults) and self._sun_id >= 0
        if self._dirty.faults:
            key = [seed, crc32(b"dirt of " + camera_name.encode())]
            self._blobs = dirt_map(params, faults.dirt_fraction, faults.dirt_size, key)
        if self._weather.ever or dust is not None:
            self._stretch = ray_stretch(raster)

    def at(self, tick: int) -> ImageDefects | None:
        """Degradations at ``tick``; None: a clear image."""
        air = self._weather.at(tick)
        dirty = self._dirty.since(tick) is not None
        extinction, names = (0.0, ()) if air is None else (air.extinction(), air.faults)
        if self._dust is not None and (dust := self._dust.at(tick).extinction) > 0.0:
            extinction, names = extinction + dust, (*names, "dust")
        if extinction <= 0.0 and not dirty and not self._low_sun:
            return None
        return ImageDefects(extinction, dirty, self._low_sun, names)

    def through_air(self, defects: ImageDefects, drawn: Bytes, depth: Float32, first: int) -> Bytes:
        """(h, W, 3) raster rows from ``first`` on through fog and rain, bottom row first, like
        ``depth`` (h, W), in metres along the optical axis."""
        stretch = self._stretch[first : first + len(drawn)][::-1]
        airlight = (AIRLIGHT_LEVEL / 255.0) ** GAMMA
        hazy = np.empty_like(drawn)
        _veil(drawn, depth, stretch, defects.extinction, airlight, LIGHT, _DISPLAY, hazy)
        self.effects.note_image(defects.air, drawn, hazy)
        return hazy

    def through_lens(
        self, defects: ImageDefects, image: Bytes, instant: Snapshot, white: float = 1.0
    ) -> Bytes:
        """(H, W, 3) image with dirt and stray light; ``image`` itself is not changed. ``white``:
        exposure of a white level surface, 1 for saturation."""
        if defects.dirty:
            clean, image = image, self._through_dirt(image)
            self.effects.note_image(("lens_dirt",), clean, image)
        if defects.glaring:
            clean, stray = image, self.stray_light(instant)
            if stray is not None:
                image = np.stack(
                    [cv2.LUT(image[..., c], glare_table(white * stray[c])) for c in range(3)],
                    axis=-1,
                )
            self.effects.note_image(("low_sun",), clean, image)
        return image

    def stray_light(self, instant: Snapshot) -> Array | None:
        """(3,) linear light that glare adds, 1 for that of a white level surface; None: the sun is
        behind the lens."""
        backward = instant.cam_xmat[self._camera_id].reshape(3, 3)[:, 2]
        cosine = float(backward @ instant.light_xdir[self._sun_id])
        if cosine <= 0.0:
            return None
        colour = np.array(self._model.light_diffuse[self._sun_id], dtype=np.float64)
        # a low sun gives level ground half of its light, the sky the other half
        # (scenes/authoring/light.py)
        beam = 0.5 / math.sin(math.radians(self._faults.low_sun_deg))
        return self._faults.glare * beam * cosine * colour / colour.max()

    def _through_dirt(self, image: Bytes) -> Bytes:
        height, width = image.shape[:2]
        size = (max(1, width // _SHRINK), max(1, height // _SHRINK))
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        sigma = max(1.0, self._faults.dirt_size * size[0])
        blurred = cv2.resize(cv2.GaussianBlur(small, (0, 0), sigma), (width, height))
        dimmed = self._faults.dirt_transmission ** (1.0 / GAMMA)
        where = self._blobs > 1.0 / 512.0
        fraction = self._blobs[where][:, None]
        out = image.copy()
        mixed = (1.0 - fraction) * image[where] + fraction * np.float32(dimmed) * blurred[where]
        out[where] = np.rint(mixed).astype(np.uint8)
        return out


def sun_light(model: Any) -> int:
    """Id of the light ``sun``, else of the first directional one; -1: there is none."""
    named = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_LIGHT, "sun")
    if named >= 0:
        return int(named)
    kinds = np.asarray(model.light_type)
    directional = np.flatnonzero(kinds == int(mujoco.mjtLightType.mjLIGHT_DIRECTIONAL))
    return int(directional[0]) if directional.size else -1


def sun_elevation_deg(model: Any) -> float | None:
    """Degrees above the horizon of `sun_light`; None without one."""
    light = sun_light(model)
    return None if light < 0 else math.degrees(math.asin(-model.light_dir[light][2]))


def ray_stretch(raster: CameraIntrinsics) -> Float32:
    """(H, W) distance along a pixel's ray for one metre along the optical axis."""
    x = (np.arange(raster.width) - raster.cx) / raster.fx
    y = (np.arange(raster.height) - raster.cy) / raster.fy
    return np.sqrt(1.0 + x**2 + y[:, None] ** 2).astype(np.float32)


def dirt_map(params: CameraParams, fraction: float, size: float, key: list[int]) -> Float32:
    """(H, W) fraction of each pixel's light that comes through dirt; its mean is ``fraction``, its
    edges are soft. ``size``: correlation length of the blobs over the image's width."""
    sigma = size * params.width
    shape = (params.height, params.width)
    noise = np.random.default_rng(key).standard_normal(shape, dtype=np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), sigma)
    blobs = (smooth > np.quantile(smooth, 1.0 - fraction)).astype(np.float32)
    return np.asarray(cv2.GaussianBlur(blobs, (0, 0), sigma / 3.0), dtype=np.float32)


def glare_table(light: float) -> Bytes:
    """(256,) grey level of every old one with this much linear light added."""
    return np.rint(255.0 * np.minimum(LIGHT + light, 1.0) ** (1.0 / GAMMA)).astype(np.uint8)


@njit(cache=True, nogil=True, error_model="numpy")
def _veil(
    drawn: Bytes,
    depth: Float32,
    stretch: Float32,
    extinction: float,
    airlight: float,
    light: Float32,
    display: Bytes,
    out: Bytes,
) -> None:
    rows, cols, channels = drawn.shape
    top = display.shape[0] - 1
    for i in range(rows):
        for j in range(cols):
            clear = math.exp(-extinction * depth[i, j] * stretch[i, j])
            veil = airlight * (1.0 - clear)
            for c in range(channels):
                level = clear * light[drawn[i, j, c]] + veil
                out[i, j, c] = display[int(min(level, 1.0) * top + 0.5)]
