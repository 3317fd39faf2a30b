"""Geoms under one Embree acceleration structure, and what rays meet of them."""

import importlib
import os
import sys
from types import ModuleType
from typing import Any, NamedTuple

import mujoco
import numpy as np

from touchdown.sim.frames import Pose
from touchdown.sim.geometry.quadrics import ShapeTable, rays_behind, settle
from touchdown.sim.geometry.tessellation import Mesh
from touchdown.sim.typing import Array, Float32, Indices, Int32

_MAX_LAYERS = 9
_LAYER_STEP_M = np.float32(1e-4)
"""Wrappings of round shapes that one ray may graze."""
_NO_GEOM = -1


class Hits(NamedTuple):
    """Nearest hit of each ray."""

    distance: Float32
    """(N,) metres, inf for a miss"""
    geom: Int32
    """(N,) MuJoCo geom id, -1 for a miss"""
    cosine: Float32
    """(N,) of the angle between the surface's outward normal and the way back along the ray;
    negative when the ray meets the surface from inside"""

    @staticmethod
    def of(count: int) -> "Hits":
        """Memory for so many."""
        distance, cosine = np.empty((2, count), dtype=np.float32)
        return Hits(distance, np.empty(count, dtype=np.int32), cosine)

    @staticmethod
    def none(count: int) -> "Hits":
        """So many misses."""
        hits = Hits.of(count)
        hits.clear()
        return hits

    def clear(self) -> None:
        """Makes all of them misses."""
        self.distance.fill(np.inf)
        self.geom.fill(_NO_GEOM)
        self.cosine.fill(0.0)

    def move(self, rows: Indices, start: int) -> None:
        """Moves ``rows`` (K,) to the rows from ``start`` on."""
        for values in self:
            values[start : start + len(rows)] = values[rows]

    def part(self, start: int, end: int) -> "Hits":
        """Those of the rays from ``start`` to ``end``, in the same memory."""
        rows = slice(start, end)
        return Hits(self.distance[rows], self.geom[rows], self.cosine[rows])


class TargetParts(NamedTuple):
    """What a `RayTarget` is made of, in its frame."""

    vertices: list[Array]
    triangles: list[Int32]
    geoms: list[int]
    shapes: ShapeTable

    @staticmethod
    def none(model: mujoco.MjModel) -> "TargetParts":
        return TargetParts([], [], [], ShapeTable.empty(model.ngeom))

    def add(
        self, model: mujoco.MjModel, geom: int, frame_from_geom: Pose, mesh: Mesh | None
    ) -> None:
        """Adds a geom with its ``mesh``, if that has triangles."""
        if mesh is None or not len(mesh[1]):
            return
        self.vertices.append(frame_from_geom.apply(mesh[0]))
        self.triangles.append(mesh[1])
        self.geoms.append(geom)
        self.shapes.add(model, geom, frame_from_geom)


class RayTarget:
    """Some geoms, rigid in one frame, under one Embree acceleration structure."""

    def __init__(self, parts: TargetParts) -> None:
        vertices, triangles, geoms, shapes = parts
        offsets = np.cumsum([0] + [len(block) for block in vertices])[:-1]
        points = np.concatenate(vertices).astype(np.float32)
        indices = [block + start for block, start in zip(triangles, offsets, strict=True)]
        self._geom_of_triangle = np.repeat(
            np.array(geoms, dtype=np.int32), [len(block) for block in triangles]
        )
        self._shapes = shapes
        self.geoms = np.unique(self._geom_of_triangle)
        """ids of the geoms"""
        self.center = 0.5 * (points.min(axis=0) + points.max(axis=0)).astype(np.float64)
        self.radius = float(np.linalg.norm(points - self.center, axis=1).max())
        self.triangle_count = len(self._geom_of_triangle)
        o3d = load_open3d()
        self._tensor = o3d.core.Tensor.from_numpy
        self._scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        self._scene.add_triangles(
            self._tensor(points), self._tensor(np.concatenate(indices).astype(np.uint32))
        )
        # Embree builds its hierarchy at the first ray: now, rather than in the middle of a flight.
        self.cast(np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 1.0]], dtype=np.float32))

    def cast(self, rays: Float32) -> Hits:
        """Nearest hits of (N, 6) float32 origins and unit directions in the target's frame."""
        hits = Hits.none(len(rays))
        self.cast_apart(rays, hits)
        return hits

    def cast_all(self, rays: Float32) -> Hits:
        """Nearest hits without the shortcut for open ground: for rays that start or end near
        objects."""
        hits = Hits.none(len(rays))
        self.fill(rays, hits)
        return hits

    def cast_apart(self, rays: Float32, hits: Hits) -> Indices:
        """Fills ``hits`` (N,) with the nearest hits of ``rays`` (N, 6), and returns the indices of
        those that passed near anything but open ground: all of them, where nothing is known of the
        ground."""
        return self.fill(rays, hits)

    def fill(self, rays: Float32, hits: Hits) -> Indices:
        """As `cast_apart`, without the shortcut for open ground."""
        hits.clear()
        rows = np.arange(len(rays))
        self.cast_on(rays, rows, np.zeros(len(rays), np.float32), hits)
        return rows

    def cast_on(self, rays: Float32, rows: Indices, travelled: Float32, hits: Hits) -> None:
        """Puts the hits of ``rays`` (K, 6), which have come ``travelled`` (K,) already, to ``rows``
        (K,) of ``hits`` where they are nearer than what is there."""
        for _ in range(_MAX_LAYERS):
            answer, again = self.embree(rays), np.empty(len(rays), dtype=np.int64)
            wrapped, triangle = answer["t_hit"].numpy(), answer["primitive_ids"].numpy()
            count = settle(
                rays, rows, travelled, wrapped, triangle, answer["primitive_normals"].numpy(),
                self._geom_of_triangle, self._shapes, hits, again,
            )  # fmt: skip
            if not count:
                return
            again, onward = again[:count], np.empty((count, 6), dtype=np.float32)
            rows, travelled = rows[again], travelled[again]
            rays_behind(rays, again, wrapped[again] + _LAYER_STEP_M, onward, travelled)
            rays = onward

    def embree(self, rays: Float32) -> dict[str, Any]:
        """The bare cast against the triangles, as Open3D answers it in tensors."""
        return self._scene.cast_rays(self._tensor(rays), nthreads=1)


def body_pose(data: mujoco.MjData, body_id: int) -> Pose:
    """world_from_body of one body."""
    return Pose(data.xmat[body_id].reshape(3, 3).copy(), data.xpos[body_id].copy())


def geom_pose(data: mujoco.MjData, geom_id: int) -> Pose:
    """world_from_geom of one geom."""
    return Pose(data.geom_xmat[geom_id].reshape(3, 3).copy(), data.geom_xpos[geom_id].copy())


_VIEWERS = "open3d.visualization"


def load_open3d() -> Any:
    """The package ``open3d``; its ``visualization``, 600 modules of web servers and notebooks, is
    imported at its first use. RuntimeError or ImportError as of the import."""
    if "open3d" in sys.modules:
        return importlib.import_module("open3d")  # whole, also if another thread imports it now
    # It would otherwise probe for a display when it is first imported.
    os.environ.setdefault("OPEN3D_CPU_RENDERING", "true")
    sys.modules[_VIEWERS] = ModuleType(_VIEWERS)  # found by the import, so not looked for
    try:
        package: Any = importlib.import_module("open3d")
    finally:
        del sys.modules[_VIEWERS]
    package.__getattr__ = _viewers
    return package


def _viewers(name: str) -> ModuleType:
    if name != "visualization":
        raise AttributeError(f"module 'open3d' has no attribute '{name}'")
    return importlib.import_module(_VIEWERS)
