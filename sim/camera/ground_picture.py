"""The ground's texture at the resolution at which a camera sees it.

A scene's ground has one large texture. A renderer in software would hold it with all its mip
levels, 140 MB, of which an image shows a small part. Here the levels lie in a file, and each tile
of terrain in view has a part of them: the level that its pixels need, or, where its depths differ
much, the levels from that of its nearest point on. A renderer in software takes a third longer to
choose a level pixel by pixel.
"""

import contextlib
import tempfile
from collections.abc import Iterator
from typing import Any, NamedTuple

import cv2
import mujoco
import numpy as np

from touchdown.sim.typing import Array, Bytes, Indices

_ROLE = int(mujoco.mjtTextureRole.mjTEXROLE_RGB)
_LEVELS = 4
"""of a part whose depths differ: from its nearest point to its farthest"""
_ALIKE = 1.3
"""Greatest over least depth of a tile that has one level"""
_EDGE = 1 << _LEVELS - 1
"""Texels around a part, so that a texel is left at its last level; parts begin at their
multiples."""
_OBLIQUE = 0.7
"""Texels along the sides of the texture a pixel, at least, over those in its own direction"""
_WHOLE_SIDE = 1024
"""Textures up to this size are left whole."""
_MAX_TEXELS = 3 << 20
"""held with those of tiles out of view"""


class _Part(NamedTuple):
    texture: int
    shown: int
    """the display list that draws the tile with it"""
    texels: int


class GroundPicture:
    """The texture of the one geom ``geom`` of a model, a height field of ``half_m`` (2,), for a
    camera whose pixels have the slope ``pixel``. Make parts in the thread of the GL context."""

    @staticmethod
    def of(model: Any, geom: int, half_m: Array, pixel: float) -> "GroundPicture | None":
        """None where the texture is small, repeats, or covers other geoms as well."""
        material = int(model.geom_matid[geom])
        texture = int(model.mat_texid[material, _ROLE]) if material >= 0 else -1
        if texture < 0 or int(model.tex_type[texture]) != int(mujoco.mjtTexture.mjTEXTURE_2D):
            return None
        users = np.isin(model.geom_matid, np.flatnonzero(model.mat_texid[:, _ROLE] == texture))
        once = (model.mat_texrepeat[material] == 1.0).all() and not model.mat_texuniform[material]
        shape = model.tex_height[texture], model.tex_width[texture], model.tex_nchannel[texture]
        if users.sum() > 1 or not once or min(shape[:2]) <= _WHOLE_SIDE or shape[2] != 3:
            return None
        start = int(model.tex_adr[texture])
        image = model.tex_data[start : start + int(np.prod(shape))].reshape(shape)
        try:
            return GroundPicture(texture, _in_file(image), half_m, pixel)
        except OSError:  # there is no room for the file
            return None

    def __init__(self, texture: int, levels: list[Bytes], half_m: Array, pixel: float) -> None:
        self._texture, self._levels, self._half_m = texture, levels, half_m
        size = np.array(levels[0].shape[1::-1])
        self._per_m = pixel * float((size / (2.0 * half_m)).max())
        self._parts: dict[tuple[int, int, int], _Part] = {}
        """by display list, level and number of levels; last used last"""
        self._undo = 0

    @contextlib.contextmanager
    def small(self, model: Any) -> Iterator[None]:
        """The texture of ``model`` is a small one while the context lasts."""
        image = next(level for level in self._levels if max(level.shape) <= _WHOLE_SIDE)
        start, size = int(model.tex_adr[self._texture]), image.size
        kept = model.tex_data[start : start + size].copy()
        sides = model.tex_height[self._texture], model.tex_width[self._texture]
        model.tex_data[start : start + size] = image.ravel()
        model.tex_height[self._texture], model.tex_width[self._texture] = image.shape[:2]
        try:
            yield
        finally:
            model.tex_data[start : start + size] = kept
            model.tex_height[self._texture], model.tex_width[self._texture] = sides

    def on(self, lists: Indices, boxes: Array, depths_m: Array) -> Indices:
        """Display lists that draw the tiles ``lists`` (N,) with their parts of the texture.
        ``boxes``: (N, 2, 2) lowest and highest x and y, field frame; ``depths_m``: (2, N) least and
        maximum ones along the optical axis."""
        minimum, maximum = depths_m
        alike = (minimum > 0.0) & (maximum < _ALIKE * minimum)
        depths = np.where(alike, 0.5 * (minimum + maximum), _OBLIQUE * minimum)
        texels = np.maximum(self._per_m * depths, 1.0)  # a pixel
        levels = np.minimum((np.log2(texels) + 0.5).astype(int), len(self._levels) - 1)
        counts = np.where(alike, 1, _LEVELS)
        found = []
        keys = zip(lists.tolist(), levels.tolist(), counts.tolist(), strict=True)
        for key, box in zip(keys, boxes, strict=True):
            part = self._parts.pop(key, None) or self._made(*key, box)
            self._parts[key] = part
            found.append(part.shown)
        self._forget(len(found), _MAX_TEXELS)
        return np.array([*found, self._undo])

    def _made(self, geometry: int, first: int, count: int, box: Array) -> _Part:
        from OpenGL import GL

        size = np.array(self._levels[first].shape[1::-1])
        # Columns run along x, rows against y.
        low, high = (0.5 + 0.5 * box / self._half_m) * [1.0, -1.0] + [0.0, 1.0]
        low[1], high[1] = high[1], low[1]
        start = np.maximum(np.floor(low * size / _EDGE - 1.0) * _EDGE, 0.0).astype(int)
        end = np.minimum(np.ceil(high * size / _EDGE + 1.0) * _EDGE, size).astype(int)
        texture = int(GL.glGenTextures(1))
        GL.glBindTexture(GL.GL_TEXTURE_2D, texture)
        used = self._levels[first : first + count]
        for name, value in (
            (GL.GL_TEXTURE_MIN_FILTER, GL.GL_LINEAR if count == 1 else GL.GL_LINEAR_MIPMAP_NEAREST),
            (GL.GL_TEXTURE_WRAP_S, GL.GL_CLAMP_TO_EDGE),
            (GL.GL_TEXTURE_WRAP_T, GL.GL_CLAMP_TO_EDGE),
            (GL.GL_TEXTURE_MAX_LEVEL, len(used) - 1),
        ):
            GL.glTexParameteri(GL.GL_TEXTURE_2D, name, value)
        GL.glPixelStorei(GL.GL_UNPACK_ALIGNMENT, 1)
        for k, level in enumerate(used):
            (left, top), (cols, rows) = start >> k, end - start >> k
            part = np.ascontiguousarray(level[top : top + rows, left : left + cols])
            GL.glTexImage2D(
                GL.GL_TEXTURE_2D, k, GL.GL_RGB8, cols, rows, 0, GL.GL_RGB, GL.GL_UNSIGNED_BYTE, part
            )
        # MuJoCo's coordinates run from -1 to 0.
        matrix = np.diag([*(size / (end - start)), 1.0, 1.0]).astype(np.float32)
        matrix[3, :2] = (size - start) / (end - start)
        shown = int(GL.glGenLists(1))
        GL.glNewList(shown, GL.GL_COMPILE)
        GL.glBindTexture(GL.GL_TEXTURE_2D, texture)
        _load(GL, matrix)
        GL.glCallList(geometry)
        GL.glEndList()
        if not self._undo:
            self._undo = int(GL.glGenLists(1))
            GL.glNewList(self._undo, GL.GL_COMPILE)
            _load(GL, np.eye(4, dtype=np.float32))
            GL.glEndList()
        return _Part(texture, shown, int(np.prod(end - start)))

    def free(self) -> None:
        """Deletes all parts."""
        self._forget(0, 0)
        if self._undo:
            from OpenGL import GL

            GL.glDeleteLists(self._undo, 1)
            self._undo = 0

    def _forget(self, used: int, maximum: int) -> None:
        """Drops parts, the longest unused first, but for the ``used`` last ones, until ``maximum``
        texels are left."""
        from OpenGL import GL

        total = sum(part.texels for part in self._parts.values())
        for key in list(self._parts)[: len(self._parts) - used]:
            if total <= maximum:
                return
            part = self._parts.pop(key)
            GL.glDeleteTextures([part.texture])
            GL.glDeleteLists(part.shown, 1)
            total -= part.texels


def _load(GL: Any, matrix: Any) -> None:
    GL.glMatrixMode(GL.GL_TEXTURE)
    GL.glLoadMatrixf(matrix)
    GL.glMatrixMode(GL.GL_MODELVIEW)


def _in_file(image: Bytes) -> list[Bytes]:
    """The mip levels of ``image``, for reading, in a file that has no name."""
    with tempfile.TemporaryFile() as file:
        found, start = [], 0
        while min(image.shape[:2]) > 1:
            image.tofile(file)
            found.append((start, image.shape))
            start += image.size
            half = image.shape[1] // 2, image.shape[0] // 2
            image = np.asarray(cv2.resize(image, half, interpolation=cv2.INTER_AREA), np.uint8)
        file.flush()
        return [np.memmap(file, np.uint8, "r", offset, shape) for offset, shape in found]
