"""Offscreen OpenGL: MuJoCo's renderer with a pinhole's frustum."""

import contextlib
from dataclasses import dataclass, fields
from typing import Any

import mujoco
import numpy as np

from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.camera.gl_contexts import gl_context, put_back, renderer_name
from touchdown.sim.camera.ground_picture import GroundPicture
from touchdown.sim.camera.vegetation import Vegetation
from touchdown.sim.camera.visible import Frustum, Terrain, TerrainTiles, VisibleGeoms
from touchdown.sim.geometry.tessellation import FIRST_HIDDEN_GROUP
from touchdown.sim.typing import Array, Bytes, Float32, Int32

_SEGMENT_FLAGS = (int(mujoco.mjtRndFlag.mjRND_SEGMENT), int(mujoco.mjtRndFlag.mjRND_IDCOLOR))
_SKY = int(mujoco.mjtRndFlag.mjRND_SKYBOX)
_GEOM_TYPE = int(mujoco.mjtObj.mjOBJ_GEOM)
_FIELD = int(mujoco.mjtGeom.mjGEOM_HFIELD)


@dataclass(frozen=True, slots=True)
class Snapshot:
    """The part of an MjData that images depend on, copied: world positions (K, 3) and rotation
    matrices (K, 9) of geoms and sites, position and direction of lights, pose of every camera."""

    geom_xpos: Array
    geom_xmat: Array
    light_xpos: Array
    light_xdir: Array
    cam_xpos: Array
    cam_xmat: Array

    @staticmethod
    def of(data: mujoco.MjData) -> "Snapshot":
        return Snapshot(*(getattr(data, field.name).copy() for field in fields(Snapshot)))


@dataclass(frozen=True, slots=True)
class InverseDepth:
    """1 / depth along the optical axis is ``far + per_level * levels``, 1/m; levels (h, w)."""

    levels: Float32
    far: float
    per_level: float

    def metres(self) -> Float32:
        """(h, w) depths, ``inf`` where nothing is drawn."""
        inverse = self.far + self.per_level * self.levels.astype(np.float64)
        return np.where(self.levels > 0.0, 1.0 / inverse, np.inf).astype(np.float32)


class Stage:
    """GL context, MuJoCo scene and buffers of one rendering thread, for rasters of ``pinhole`` or
    bands of their rows. ``samples``: of multisampling, in colour images only. ``vegetation``: on
    the ground, seen by cameras that do not stand in it.

    Everything comes bottom row first.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        pinhole: CameraIntrinsics,
        samples: int,
        vegetation: Vegetation | None = None,
    ) -> None:
        self._model = model
        self._vegetation = vegetation
        self._terrains = Terrain.all_of(model)
        self._tiles: dict[tuple[int, bool], TerrainTiles] = {}  # by field, with or without plants
        self._geoms: VisibleGeoms | None = None
        self._data = mujoco.MjData(model)
        self._pinhole = pinhole
        self._samples = samples
        self._gl = gl_context(pinhole.width, pinhole.height)
        self._gl.make_current()
        self.renderer = renderer_name()
        self._pictures = {
            field: GroundPicture.of(model, terrain.geom, terrain.half_m, 1.0 / pinhole.fx)
            for field, terrain in self._terrains.items()
        }
        self._context = self._new_context(samples)
        self._plain = self._context  # without multisampling, which would blend ids
        fields = np.count_nonzero(model.geom_type == _FIELD)
        self._scene = mujoco.MjvScene(model, maxgeom=model.ngeom + fields + 100)
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self._scene.flags[flag] = 0
        self._option = mujoco.MjvOption()
        self._option.geomgroup[FIRST_HIDDEN_GROUP:] = 0
        self._option.sitegroup[:] = 0
        self._perturb = mujoco.MjvPerturb()
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._pixels = np.empty((pinhole.height, pinhole.width, 3), dtype=np.uint8)
        self._levels: Float32 | None = None

    def colour(self, snapshot: Snapshot, camera_id: int, first: int, last: int) -> Bytes:
        """(last - first, W, 3) uint8, rows ``first`` to ``last`` (exclusive, counted from the top)
        of the raster; the buffer is reused by the next call."""
        viewport = self._look(snapshot, camera_id, first, last)
        _select(self._context)
        frustum = self._frustum(snapshot, camera_id, first, last)
        self._leave_out(frustum, snapshot)
        self._lay_ground(self._context, frustum)
        mujoco.mjr_render(viewport, self._scene, self._context)
        self._scene.flags[_SKY] = 1
        pixels = self._pixels[: last - first]
        mujoco.mjr_readPixels(pixels, None, viewport, self._context)
        return pixels

    def inverse_depth_of_last(self, rows: int) -> InverseDepth:
        """Inverse depths of the ``colour`` just drawn, bottom row first; the buffer is reused by
        the next call."""
        if self._levels is None:
            self._levels = np.empty((self._pinhole.height, self._pinhole.width), dtype=np.float32)
        viewport = mujoco.MjrRect(0, 0, self._pinhole.width, rows)
        mujoco.mjr_readPixels(None, self._levels[:rows], viewport, self._context)
        return _inverse(self._levels[:rows], self._scene.camera[0])

    def depth(self, snapshot: Snapshot, camera_id: int) -> Float32:
        """(H, W) float32 metres along the optical axis, ``inf`` where nothing is drawn."""
        viewport = self._draw_ids(snapshot, camera_id)
        buffer = np.empty(self._pixels.shape[:2], dtype=np.float32)
        mujoco.mjr_readPixels(None, buffer, viewport, self._plain)
        return _inverse(buffer, self._scene.camera[0]).metres()

    def geom_ids(self, snapshot: Snapshot, camera_id: int) -> Int32:
        """(H, W) int32 id of the geom that each pixel shows, -1 where there is none."""
        viewport = self._draw_ids(snapshot, camera_id)
        pixels = np.empty_like(self._pixels)
        mujoco.mjr_readPixels(pixels, None, viewport, self._plain)
        code = pixels.astype(np.int32) @ np.array([1, 1 << 8, 1 << 16], dtype=np.int32)
        geom_of_code = np.full(self._scene.ngeom + 1, -1, dtype=np.int32)
        for drawn in self._scene.geoms[: self._scene.ngeom]:
            if drawn.segid >= 0 and drawn.objtype == _GEOM_TYPE:
                geom_of_code[drawn.segid + 1] = drawn.objid
        return geom_of_code[code]

    def close(self) -> None:
        """Frees context and buffers; call it in the thread that drew."""
        self._gl.make_current()
        for tiles in self._tiles.values():
            tiles.free()
        for picture in filter(None, self._pictures.values()):
            picture.free()
        if self._plain is not self._context:
            self._plain.free()
        self._context.free()
        put_back(self._gl)

    def _new_context(self, samples: int) -> mujoco.MjrContext:
        with contextlib.ExitStack() as stack:
            for picture in filter(None, self._pictures.values()):
                stack.enter_context(picture.small(self._model))
            return _mujoco_context(self._model, self._pinhole, samples)

    def _look(self, snapshot: Snapshot, camera_id: int, first: int, last: int) -> Any:
        """Sets the MuJoCo scene up for a band of rows; returns its viewport."""
        for field in fields(Snapshot):
            getattr(self._data, field.name)[:] = getattr(snapshot, field.name)
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
        self._set_frustum(first, last)
        return mujoco.MjrRect(0, 0, self._pinhole.width, last - first)

    def _leave_out(self, frustum: Frustum, snapshot: Snapshot) -> None:
        """Takes out of the scene what ``frustum`` does not see."""
        if self._geoms is None:
            self._geoms = VisibleGeoms(self._model, self._scene)
        self._geoms.keep(self._scene, frustum, snapshot.geom_xpos)
        filled = any(terrain.fills(frustum) for terrain in self._terrains.values())
        self._scene.flags[_SKY] = not filled

    def _lay_ground(self, context: mujoco.MjrContext, frustum: Frustum) -> None:
        """The tiles of terrain in view, with or without plants as ``frustum`` sees them."""
        vegetation = self._vegetation
        for field, terrain in self._terrains.items():
            planted = (
                vegetation is not None
                and vegetation.terrain.field == field
                and not vegetation.hides(frustum.eye)
            )
            if (field, planted) not in self._tiles:
                model = vegetation.model if vegetation is not None and planted else self._model
                self._tiles[field, planted] = TerrainTiles(terrain, model, self._pictures[field])
            self._tiles[field, planted].show(context, frustum)

    def _frustum(self, snapshot: Snapshot, camera_id: int, first: int, last: int) -> Frustum:
        eye, axes = snapshot.cam_xpos[camera_id], snapshot.cam_xmat[camera_id]
        return Frustum.of(self._pinhole, eye, axes, first, last)

    def _set_frustum(self, first: int, last: int) -> None:
        """Sets the frustum's width, which MuJoCo would derive from its height (square pixels)."""
        k = self._pinhole
        for eye in self._scene.camera:
            per_row = eye.frustum_near / k.fy
            eye.frustum_top = per_row * (0.5 * k.height - first)
            eye.frustum_bottom = per_row * (0.5 * k.height - last)
            eye.frustum_width = eye.frustum_near * 0.5 * k.width / k.fx
            eye.frustum_center = 0.0

    def _draw_ids(self, snapshot: Snapshot, camera_id: int) -> Any:
        """Draws every geom in the colour of its number; flat colours write exact depths too."""
        viewport = self._look(snapshot, camera_id, 0, self._pinhole.height)
        if self._samples and self._plain is self._context:
            self._plain = self._new_context(0)
        _select(self._plain)
        frustum = self._frustum(snapshot, camera_id, 0, self._pinhole.height)
        self._lay_ground(self._plain, frustum)
        for flag in _SEGMENT_FLAGS:
            self._scene.flags[flag] = 1
        mujoco.mjr_render(viewport, self._scene, self._plain)
        for flag in _SEGMENT_FLAGS:
            self._scene.flags[flag] = 0
        return viewport


def _inverse(buffer: Float32, eye: Any) -> InverseDepth:
    """Depths out of a depth buffer that holds 1 at the near and 0 at the far plane (reversed, with
    most of its precision far away): 1 / z runs linearly between the planes."""
    far = 1.0 / float(eye.frustum_far)
    return InverseDepth(buffer, far, 1.0 / float(eye.frustum_near) - far)


def _mujoco_context(
    model: mujoco.MjModel, pinhole: CameraIntrinsics, samples: int
) -> mujoco.MjrContext:
    """The context reads its sizes from the model, which is shared: they are put back."""
    quality, buffer = model.vis.quality, model.vis.global_
    kept = quality.offsamples, quality.shadowsize, buffer.offwidth, buffer.offheight
    quality.offsamples, quality.shadowsize = samples, 0
    buffer.offwidth, buffer.offheight = pinhole.width, pinhole.height
    try:
        context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
    finally:
        quality.offsamples, quality.shadowsize, buffer.offwidth, buffer.offheight = kept
    context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
    if samples == 0:
        _leave_out_stencil(context, pinhole)
    _filter_by_the_nearest_level(context)
    _select(context)
    return context


def _leave_out_stencil(context: mujoco.MjrContext, pinhole: CameraIntrinsics) -> None:
    """The stencil beside each depth, for reflections, which are not drawn, costs a rasterizer in
    software a sixth of its time, and reading depths a conversion."""
    from OpenGL import GL

    target, buffer = GL.GL_FRAMEBUFFER, (GL.GL_RENDERBUFFER, context.offDepthStencil)
    GL.glBindFramebuffer(target, context.offFBO)
    GL.glBindRenderbuffer(*buffer)
    size = pinhole.width, pinhole.height
    GL.glRenderbufferStorage(GL.GL_RENDERBUFFER, GL.GL_DEPTH_COMPONENT32F, *size)
    GL.glFramebufferRenderbuffer(target, GL.GL_STENCIL_ATTACHMENT, GL.GL_RENDERBUFFER, 0)
    GL.glFramebufferRenderbuffer(target, GL.GL_DEPTH_ATTACHMENT, *buffer)


def _filter_by_the_nearest_level(context: mujoco.MjrContext) -> None:
    """Textures are interpolated in one mip level in place of two: half the texels a pixel."""
    from OpenGL import GL

    kinds = context.textureType[: context.ntexture]
    for texture, kind in zip(context.texture, kinds, strict=False):
        if kind == int(mujoco.mjtTexture.mjTEXTURE_2D):
            GL.glBindTexture(GL.GL_TEXTURE_2D, int(texture))
            GL.glTexParameteri(
                GL.GL_TEXTURE_2D, GL.GL_TEXTURE_MIN_FILTER, GL.GL_LINEAR_MIPMAP_NEAREST
            )


def _select(context: mujoco.MjrContext) -> None:
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
