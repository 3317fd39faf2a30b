"""An offscreen camera: MuJoCo's renderer with the intrinsics, noise and threading of a sensor.

The physics thread takes a ``Snapshot`` (a few array copies); one thread, the physics' own or a
worker, turns snapshots into pictures with an MjData, a GL context and a scene of its own. The GIL
is free while pixels are drawn and read.
"""

from __future__ import annotations

import importlib
import math
import os
import threading
from dataclasses import dataclass
from typing import Any
from zlib import crc32

import mujoco
import numpy as np
from numba import njit
from numpy.typing import NDArray

from scenes.api import Scene
from sim.api import CameraIntrinsics, CameraParams

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]

CAMERA_NAME = "vehicle/camera"
VEHICLE_GROUP = 4
"""Geom group of the vehicle's own geoms, which its camera does not see."""

_FIRST_HIDDEN_GROUP = 3
_BACKENDS = ("egl", "osmesa")
_TILE_MARGIN = 128
_ROUNDING_VARIANCE = 1.0 / 12.0


@dataclass(frozen=True, slots=True)
class Snapshot:
    """What a picture depends on, copied out of an MjData: world positions (K, 3) and rotation
    matrices (K, 9) of geoms and sites, position and direction of lights, pose of every camera."""

    geom_xpos: Array
    geom_xmat: Array
    light_xpos: Array
    light_xdir: Array
    cam_xpos: Array
    cam_xmat: Array


_SNAPSHOT_FIELDS = ("geom_xpos", "geom_xmat", "light_xpos", "light_xdir", "cam_xpos", "cam_xmat")


class CameraSensor:
    """The camera ``camera_name`` of ``scene``, with the resolution and field of view of ``params``
    (the model's own are not looked at).

    ``render`` may run in any one thread: the GL context is made at the first picture and belongs
    to the thread that asked for it. Grey noise depends on (seed, camera, tick) alone.

    Raises ValueError when the model has no such camera; ``render`` raises RuntimeError when there
    is no way to render on this machine, or when called from a second thread.
    """

    def __init__(
        self,
        scene: Scene,
        params: CameraParams,
        seed: int,
        camera_name: str = CAMERA_NAME,
    ) -> None:
        self._model = scene.model
        self._params = params
        self._camera_id = mujoco.mj_name2id(self._model, mujoco.mjtObj.mjOBJ_CAMERA, camera_name)
        if self._camera_id < 0:
            names = [self._model.camera(i).name for i in range(self._model.ncam)]
            raise ValueError(
                f"scene '{scene.name}' has no camera '{camera_name}': its cameras are "
                f"{', '.join(names) or 'none'}"
            )
        self._noise_key = [seed, crc32(camera_name.encode())]
        self._noise = _noise_tile(params, self._noise_key)
        self._stage: _Stage | None = None
        self._thread: int | None = None

    def intrinsics(self) -> CameraIntrinsics:
        """Pinhole whose focal lengths follow from the two fields of view."""
        p = self._params
        return CameraIntrinsics(
            width=p.width,
            height=p.height,
            fx=0.5 * p.width / math.tan(0.5 * math.radians(p.fov_x_deg)),
            fy=0.5 * p.height / math.tan(0.5 * math.radians(p.fov_y_deg)),
            cx=0.5 * (p.width - 1),
            cy=0.5 * (p.height - 1),
        )

    def snapshot(self, data: mujoco.MjData) -> Snapshot:
        """Copies what a picture needs; call it in the physics thread, after the kinematics."""
        return Snapshot(*(getattr(data, name).copy() for name in _SNAPSHOT_FIELDS))

    def render(self, snapshot: Snapshot, tick: int) -> Bytes:
        """(H, W, 3) uint8 RGB picture, read-only, with the grey noise of ``tick``."""
        stage = self._own_stage()
        raw = stage.draw(snapshot, self._camera_id)
        picture = np.empty_like(raw)
        row, col, sign = self._noise_place(tick)
        _develop(raw, self._noise, row, col, sign, picture)
        picture.setflags(write=False)
        return picture

    def close(self) -> None:
        """Frees the GL context; call it in the thread that rendered."""
        if self._stage is not None:
            self._stage.close()
        self._stage, self._thread = None, None

    def _own_stage(self) -> _Stage:
        thread = threading.get_ident()
        if self._stage is None:
            self._stage = _Stage(self._model, self._params, self.intrinsics())
            self._thread = thread
        if self._thread != thread:
            raise RuntimeError(
                "a camera renders in one thread only: call close() there before another takes over"
            )
        return self._stage

    def _noise_place(self, tick: int) -> tuple[int, int, int]:
        rng = np.random.default_rng([*self._noise_key, tick])
        row, col = rng.integers(0, _TILE_MARGIN + 1, size=2)
        return int(row), int(col), int(2 * rng.integers(0, 2) - 1)


class _Stage:
    """GL context, MuJoCo scene and buffers of one rendering thread."""

    def __init__(
        self,
        model: mujoco.MjModel,
        params: CameraParams,
        intrinsics: CameraIntrinsics,
    ) -> None:
        self._model = model
        self._data = mujoco.MjData(model)
        self._intrinsics = intrinsics
        self._gl = _gl_context(params.width, params.height)
        self._gl.make_current()
        self._context = _mujoco_context(model, params)
        self._scene = mujoco.MjvScene(model, maxgeom=model.ngeom + 100)
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self._scene.flags[flag] = 0
        self._option = mujoco.MjvOption()
        self._option.geomgroup[_FIRST_HIDDEN_GROUP:] = 0
        self._option.sitegroup[:] = 0
        self._perturb = mujoco.MjvPerturb()
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._viewport = mujoco.MjrRect(0, 0, params.width, params.height)
        self._pixels = np.empty((params.height, params.width, 3), dtype=np.uint8)

    def draw(self, snapshot: Snapshot, camera_id: int) -> Bytes:
        """(H, W, 3) uint8, bottom row first; the buffer is reused by the next call."""
        for name in _SNAPSHOT_FIELDS:
            getattr(self._data, name)[:] = getattr(snapshot, name)
        self._gl.make_current()
        self._camera.fixedcamid = camera_id
        mujoco.mjv_updateScene(
            self._model,
            self._data,
            self._option,
            self._perturb,
            self._camera,
            mujoco.mjtCatBit.mjCAT_ALL,
            self._scene,
        )
        self._set_frustum()
        mujoco.mjr_render(self._viewport, self._scene, self._context)
        mujoco.mjr_readPixels(self._pixels, None, self._viewport, self._context)
        return self._pixels

    def _set_frustum(self) -> None:
        """MuJoCo derives the width of the frustum from its height (square pixels) unless told."""
        k = self._intrinsics
        for eye in self._scene.camera:
            eye.frustum_top = eye.frustum_near * 0.5 * k.height / k.fy
            eye.frustum_bottom = -eye.frustum_top
            eye.frustum_width = eye.frustum_near * 0.5 * k.width / k.fx
            eye.frustum_center = 0.0

    def close(self) -> None:
        self._gl.make_current()
        self._context.free()
        self._gl.free()


def _mujoco_context(model: mujoco.MjModel, params: CameraParams) -> mujoco.MjrContext:
    """The context reads its sizes from the model, which is shared: they are put back."""
    quality, buffer = model.vis.quality, model.vis.global_
    kept = quality.offsamples, quality.shadowsize, buffer.offwidth, buffer.offheight
    quality.offsamples, quality.shadowsize = params.samples, 0
    buffer.offwidth, buffer.offheight = params.width, params.height
    try:
        context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
    finally:
        quality.offsamples, quality.shadowsize, buffer.offwidth, buffer.offheight = kept
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
    return context


def _gl_context(width: int, height: int) -> Any:
    """The first GL context that works: the one MUJOCO_GL names, else EGL, else OSMesa.

    MuJoCo's library reads MUJOCO_GL when it loads its GL functions, so it is set for the choice.
    """
    asked = os.environ.get("MUJOCO_GL", "").lower()
    failures = []
    for backend in (asked,) if asked else _BACKENDS:
        os.environ["MUJOCO_GL"] = backend
        try:
            return importlib.import_module(f"mujoco.{backend}").GLContext(width, height)
        except Exception as failure:  # every backend fails in its own way
            failures.append(f"{backend}: {failure}")
    if not asked:
        del os.environ["MUJOCO_GL"]
    raise RuntimeError(
        f"no offscreen rendering on this machine ({'; '.join(failures)}): install EGL "
        "(Debian: libegl1 libgl1-mesa-dri) or OSMesa (libosmesa6), or set MUJOCO_GL to egl or "
        "osmesa"
    )


def _noise_tile(params: CameraParams, key: list[int]) -> NDArray[np.int8]:
    """Rounded Gaussian grey noise, a margin larger than the picture. Rounding adds its own
    variance, which is taken off beforehand."""
    sigma = math.sqrt(max(params.noise_sigma**2 - _ROUNDING_VARIANCE, 0.0))
    shape = (params.height + _TILE_MARGIN, params.width + _TILE_MARGIN)
    noise = sigma * np.random.default_rng(key).standard_normal(shape, dtype=np.float32)
    return np.clip(np.rint(noise), -127, 127).astype(np.int8)


@njit(cache=True, nogil=True)
def _develop(
    raw: Bytes, noise: NDArray[np.int8], row: int, col: int, sign: int, picture: Bytes
) -> None:
    """Turns the picture the right way up and adds the noise tile from (row, col) on."""
    height, width, channels = raw.shape
    for i in range(height):
        for j in range(width):
            grain = sign * noise[row + i, col + j]
            for c in range(channels):
                value = raw[height - 1 - i, j, c] + grain
                picture[i, j, c] = min(max(value, 0), 255)
