"""What of a scene is drawn: geoms and tiles of terrain in a camera's frustum, sky where it shows.

MuJoCo draws every geom, the whole of a height field and the sky box behind it, whatever the camera
sees. A rasterizer in software spends most of its time on that.
"""

from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np

from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.camera.ground_picture import GroundPicture
from touchdown.sim.geometry.tessellation import may_move
from touchdown.sim.typing import Array, Float32, Indices, Mask

_GEOM = int(mujoco.mjtObj.mjOBJ_GEOM)
_FIELD = int(mujoco.mjtGeom.mjGEOM_HFIELD)
_NOT_DRAWN = int(mujoco.mjtGeom.mjGEOM_NONE)
_MEMBERS = tuple(name for name in dir(mujoco.MjvGeom) if not name.startswith("_"))
_TILE_CELLS, _TILE_M = 16, 10.0
"""A tile is at least as wide as both: each costs a change of texture."""
_FINE_CELLS = 130.0
"""Beyond this many cells of distance every second node is drawn: a cell is at most 4 pixels wide at
a focal length of 500 pixels"""
_SMOOTH_COSINE = 0.98
"""Triangles that differ by more from the mean of a node's have an edge, as MuJoCo draws them
(determined on its pictures)"""
_MARGIN_M = 0.05
"""of a tile's sphere"""


@dataclass(frozen=True, slots=True)
class Frustum:
    """The view of a camera: ``eye`` (3,), ``axes`` (3, 3) with columns right, up and back, and the
    slopes of its left, right, bottom and top edges."""

    eye: Array
    axes: Array
    slopes: tuple[float, float, float, float]

    @staticmethod
    def of(k: CameraIntrinsics, eye: Array, axes: Array, first: int, last: int) -> "Frustum":
        """Of rows ``first`` to ``last`` (exclusive)."""
        side = 0.5 * k.width / k.fx
        bottom, top = (0.5 * k.height - last) / k.fy, (0.5 * k.height - first) / k.fy
        return Frustum(eye, axes.reshape(3, 3), (-side, side, bottom, top))

    def holds(self, centers: Array, radii: Array) -> Mask:
        """(N,) True for spheres (N, 3), (N,) that may be in view."""
        x, y, z = ((centers - self.eye) @ self.axes).T
        seen = z <= radii
        for across, (low, high) in ((x, self.slopes[:2]), (y, self.slopes[2:])):
            seen &= across + high * z <= radii * np.hypot(1.0, high)
            seen &= -across - low * z <= radii * np.hypot(1.0, low)
        return seen

    def corners(self) -> Array:
        """(4, 3) directions of its corners, world frame."""
        left, right, bottom, top = self.slopes
        rays = [[x, y, -1.0] for x in (left, right) for y in (bottom, top)]
        return np.array(rays) @ self.axes.T


class VisibleGeoms:
    """Keeps the geoms of an updated ``scene`` that lie beside a frustum from being drawn. Height
    fields are drawn last, so that what stands on them hides them."""

    def __init__(self, model: mujoco.MjModel, scene: mujoco.MjvScene) -> None:
        self._geoms, self._count = scene.geoms, scene.ngeom
        geoms = self._geoms[: scene.ngeom]
        self._ids = np.array([g.objid if g.objtype == _GEOM else -1 for g in geoms])
        self._radii = np.where(self._ids >= 0, model.geom_rbound[self._ids], 0.0)
        fields = np.array([g.type == _FIELD for g in geoms], dtype=np.bool_)
        # planes have no bounds
        self._always = (self._radii <= 0.0) & ~fields
        self._fields = np.flatnonzero(fields).tolist()
        self._radii[fields] = -np.inf

    def keep(self, scene: mujoco.MjvScene, frustum: Frustum, places: Array) -> None:
        """``places``: (G, 3) of the model's geoms. ``scene`` has room for its height fields once
        more."""
        if scene.ngeom != self._count:
            return
        for last, field in enumerate(self._fields, scene.ngeom):
            for name in _MEMBERS:
                setattr(self._geoms[last], name, getattr(self._geoms[field], name))
        seen = frustum.holds(places[self._ids], self._radii) | self._always
        for hidden in np.flatnonzero(~seen).tolist():
            self._geoms[hidden].type = _NOT_DRAWN
        scene.ngeom += len(self._fields)


@dataclass(frozen=True, slots=True)
class Terrain:
    """A level height field along the world's axes that one fixed geom shows."""

    field: int
    """id of the height field"""
    geom: int
    origin_m: Array
    """(3,) world, of the field's frame"""
    half_m: Array
    """(2,)"""
    lowest_m: float

    @staticmethod
    def all_of(model: mujoco.MjModel) -> dict[int, "Terrain"]:
        """Those of a model by the ids of their fields."""
        geoms = np.flatnonzero(model.geom_type == _FIELD)
        shown = model.geom_dataid[geoms].tolist()
        rest = mujoco.MjData(model)
        mujoco.mj_kinematics(model, rest)
        found = {}
        for geom, field in zip(geoms.tolist(), shown, strict=True):
            level = np.allclose(rest.geom_xmat[geom].reshape(3, 3), np.eye(3), atol=1e-9)
            if shown.count(field) > 1 or may_move(model, geom) or not level:
                continue
            origin, size = rest.geom_xpos[geom].copy(), model.hfield_size[field]
            low = float(origin[2] + size[2] * heights_of(model, field).min())
            found[field] = Terrain(field, geom, origin, size[:2].copy(), low)
        return found

    def fills(self, frustum: Frustum) -> bool:
        """True where nothing but the terrain and what stands on it is in view: rays that come down
        to its lowest height within its sides have met it before."""
        rays, above = frustum.corners(), frustum.eye[2] - self.lowest_m
        inside = np.abs(frustum.eye[:2] - self.origin_m[:2]) < self.half_m
        if above <= 0.0 or not inside.all() or (rays[:, 2] >= 0.0).any():
            return False
        ends = frustum.eye[:2] + rays[:, :2] * (above / -rays[:, 2:])
        return bool((np.abs(ends - self.origin_m[:2]) < self.half_m).all())


class TerrainTiles:
    """Display lists of the tiles of a ``terrain`` with heights of ``model``, in place of the one
    list that MuJoCo draws, which has walls around the field as well. Make and use them in the
    thread of the GL context. ``picture``: their texture, part by part."""

    def __init__(
        self, terrain: Terrain, model: mujoco.MjModel, picture: GroundPicture | None = None
    ) -> None:
        from OpenGL import GL

        self._gl, self._terrain, self._picture = GL, terrain, picture
        size = model.hfield_size[terrain.field]
        self._vertices = _vertices(size[2] * heights_of(model, terrain.field), size)
        self._cell_m = 2.0 * size[0] / (self._vertices.shape[1] - 1)
        self._tile = max(_TILE_CELLS, 2 * round(0.5 * _TILE_M / self._cell_m))
        whole = (np.array(self._vertices.shape[:2]) % 2 == 1).all()
        self._strides = (1, 2) if whole else (1,)
        self._lists: dict[int, int] = {}
        self._lists[1], self._boxes = self._compiled(1)
        half = 0.5 * (self._boxes[:, 1] - self._boxes[:, 0])
        self._radii = np.linalg.norm(half, axis=1) + _MARGIN_M
        self._centers = self._boxes.mean(axis=1) + terrain.origin_m

    def _compiled(self, stride: int) -> tuple[int, Array]:
        """Compiles the tiles with every ``stride``-th node. Returns the first display list, and the
        lowest and highest corner of each tile (N, 2, 3)."""
        GL, vertices = self._gl, self._vertices[::stride, ::stride]
        rows, cols = vertices.shape[:2]
        tiles = _tiles(rows, cols, self._tile // stride)
        points = vertices.reshape(-1, 3)
        nodes = np.concatenate(_triangles(rows, cols))
        normals, corners = _normals(points, nodes)
        lists, boxes = int(GL.glGenLists(len(tiles))), np.empty((len(tiles), 2, 3))
        GL.glPushClientAttrib(GL.GL_CLIENT_VERTEX_ARRAY_BIT)
        GL.glEnableClientState(GL.GL_VERTEX_ARRAY)
        GL.glEnableClientState(GL.GL_NORMAL_ARRAY)
        for k, triangles in enumerate(tiles):
            _, first, order = np.unique(corners[triangles], return_index=True, return_inverse=True)
            own = points[nodes[triangles].ravel()[first]]
            GL.glVertexPointer(3, GL.GL_FLOAT, 0, own)
            GL.glNormalPointer(GL.GL_FLOAT, 0, normals[triangles].reshape(-1, 3)[first])
            GL.glNewList(lists + k, GL.GL_COMPILE)
            order = order.ravel().astype(np.uint32)
            GL.glDrawElements(GL.GL_TRIANGLES, len(order), GL.GL_UNSIGNED_INT, order)
            GL.glEndList()
            boxes[k] = own.min(axis=0), own.max(axis=0)
        GL.glPopClientAttrib()
        return lists, boxes

    def show(self, context: mujoco.MjrContext, frustum: Frustum) -> None:
        """Makes the tiles in view what ``context`` draws for the height field."""
        GL = self._gl
        seen = np.flatnonzero(frustum.holds(self._centers, self._radii))
        # By all tiles, as the rows of a rolling shutter see others: two strides would not meet.
        eye = frustum.eye - self._terrain.origin_m
        beside = np.maximum(self._boxes[:, 0] - eye, eye - self._boxes[:, 1]).clip(0.0)
        is_far = np.linalg.norm(beside, axis=1).min() > _FINE_CELLS * self._cell_m
        stride = self._strides[-1] if is_far else 1
        if stride not in self._lists:
            self._lists[stride], _ = self._compiled(stride)
        lists = seen + self._lists[stride]
        if self._picture is not None:
            boxes, ahead = self._boxes[seen], -frustum.axes[:, 2]
            depths = (self._centers[seen] - frustum.eye) @ ahead
            reach = 0.5 * (boxes[:, 1] - boxes[:, 0]) @ np.abs(ahead)
            depths = np.array([depths - reach, depths + reach])
            lists = self._picture.on(lists, boxes[..., :2], depths)
        GL.glNewList(context.baseHField + self._terrain.field, GL.GL_COMPILE)
        if seen.size:
            GL.glCallLists(len(lists), GL.GL_UNSIGNED_INT, lists.astype(np.uint32))
        GL.glEndList()

    def free(self) -> None:
        """Deletes the tiles."""
        for lists in self._lists.values():
            self._gl.glDeleteLists(lists, len(self._boxes))


def heights_of(model: mujoco.MjModel, field: int) -> Float32:
    """(rows, cols) of a height field, as a fraction of its size."""
    rows, cols = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
    start = int(model.hfield_adr[field])
    return model.hfield_data[start : start + rows * cols].reshape(rows, cols)


def _vertices(heights: Float32, size: Array) -> Float32:
    """(rows, cols, 3) nodes in the field's frame."""
    rows, cols = heights.shape
    x, y = np.linspace(-size[0], size[0], cols), np.linspace(-size[1], size[1], rows)
    return np.dstack([*np.meshgrid(x, y), heights]).astype(np.float32)


class _Normals(NamedTuple):
    """At the corners of triangles."""

    units: Float32
    """(T, 3, 3)"""
    corners: Indices
    """(T, 3) numbers, the same where point and normal are the same node's"""


def _normals(points: Float32, nodes: Indices) -> _Normals:
    """Normals of triangles (T, 3) of ``points``: the mean of the triangles around a node, or the
    triangle's own where it differs much from that, as MuJoCo does."""
    a, b, c = np.moveaxis(points[nodes].astype(np.float64), 1, 0)
    own = np.cross(b - a, c - a)
    own /= np.linalg.norm(own, axis=1, keepdims=True)
    total = np.zeros(points.shape)
    np.add.at(total, nodes, own[:, None])
    total /= np.linalg.norm(total, axis=1, keepdims=True)
    mean = total[nodes]
    smooth = np.einsum("tkc,tc->tk", mean, own) > _SMOOTH_COSINE
    units = np.where(smooth[..., None], mean, own[:, None]).astype(np.float32)
    return _Normals(
        units, np.where(smooth, nodes, len(points) + np.arange(nodes.size).reshape(-1, 3))
    )


def _triangles(rows: int, cols: int) -> tuple[Indices, Indices]:
    """Twice (cells, 3) nodes of a field's triangles, right of and above the cells' diagonals."""
    node = (np.arange(rows - 1)[:, None] * cols + np.arange(cols - 1)).ravel()
    right = np.column_stack([node, node + 1, node + cols + 1])
    return right, np.column_stack([node, node + cols + 1, node + cols])


def _tiles(rows: int, cols: int, side: int) -> list[Indices]:
    """Indices (T,) of the triangles of each tile of ``side`` by ``side`` cells, those right of the
    diagonals first."""
    cells = np.arange((rows - 1) * (cols - 1)).reshape(rows - 1, cols - 1)
    found = []
    for row in range(0, rows - 1, side):
        for col in range(0, cols - 1, side):
            own = cells[row : row + side, col : col + side].ravel()
            found.append(np.concatenate([own, own + cells.size]))
    return found
