"""Geoms under one Embree acceleration structure, and what rays meet of them."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

# Open3D would otherwise probe for a display when it is first imported.
os.environ.setdefault("OPEN3D_CPU_RENDERING", "true")

import mujoco
import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from touchdown.sim.frames import Pose
from touchdown.sim.geometry.quadrics import ShapeTable, settle
from touchdown.sim.typing import Array, Float32, Indices, Int32

_MOST_LAYERS = 8
"""Wrappings of round shapes that one ray may graze."""
_LAYER_STEP_M = 1e-4
_NO_GEOM = -1


@dataclass(frozen=True, slots=True)
class Hits:
    """Nearest hit of each ray."""

    distance: Float32
    """(N,) metres, inf for a miss"""
    geom: Int32
    """(N,) MuJoCo geom id, -1 for a miss"""
    cosine: Float32
    """(N,) of the angle between the surface's outward normal and the way back along the ray;
    negative when the ray meets the surface from inside"""

    @staticmethod
    def none(count: int) -> Hits:
        return Hits(
            np.full(count, np.inf, dtype=np.float32),
            np.full(count, _NO_GEOM, dtype=np.int32),
            np.zeros(count, dtype=np.float32),
        )

    @staticmethod
    def joined(*groups: Hits) -> Hits:
        return Hits(
            np.concatenate([group.distance for group in groups]),
            np.concatenate([group.geom for group in groups]),
            np.concatenate([group.cosine for group in groups]),
        )

    def at(self, rays: NDArray[Any]) -> Hits:
        return Hits(self.distance[rays], self.geom[rays], self.cosine[rays])

    def put(self, rays: NDArray[Any], hits: Hits) -> None:
        self.distance[rays] = hits.distance
        self.geom[rays] = hits.geom
        self.cosine[rays] = hits.cosine


class RayTarget:
    """Some geoms, rigid in one frame, under one Embree acceleration structure."""

    def __init__(
        self,
        vertices: list[Array],
        triangles: list[Int32],
        geoms: list[int],
        shapes: ShapeTable,
    ) -> None:
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
        self._scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        self._scene.add_triangles(
            o3d.core.Tensor.from_numpy(points),
            o3d.core.Tensor.from_numpy(np.concatenate(indices).astype(np.uint32)),
        )
        # Embree builds its hierarchy at the first ray: now, rather than in the middle of a flight.
        self.cast(np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 1.0]], dtype=np.float32))

    def cast(self, rays: Float32) -> Hits:
        """Nearest hits of (N, 6) float32 origins and unit directions in the target's frame."""
        return self.cast_apart(rays)[0]

    def cast_apart(self, rays: Float32) -> tuple[Hits, Indices]:
        """Nearest hits, and the indices of the rays that passed near anything but open ground: all
        of them, where nothing is known of the ground."""
        return self.cast_all(rays), np.arange(len(rays))

    def embree(self, rays: Float32) -> dict[str, o3d.core.Tensor]:
        """The bare cast against the triangles, as Open3D answers it."""
        answer: dict[str, o3d.core.Tensor] = self._scene.cast_rays(
            o3d.core.Tensor.from_numpy(rays), nthreads=1
        )
        return answer

    def cast_all(self, rays: Float32) -> Hits:
        """Nearest hits without the shortcut for open ground: for rays that start or end near
        objects."""
        hits, again, reached = self._cast_once(rays)
        for _ in range(_MOST_LAYERS):
            if not again.size:
                break
            onward, travelled = rays_behind(rays[again], reached + np.float32(_LAYER_STEP_M))
            behind, more, reached = self._cast_once(onward)
            behind.distance[:] += travelled
            nearer = behind.distance < hits.distance[again]
            hits.put(again[nearer], behind.at(nearer))
            reached += travelled[more]
            again = again[more]
            # What is known lies before all that is still to come.
            open_ended = hits.distance[again] > reached
            again, reached = again[open_ended], reached[open_ended]
        return hits

    def _cast_once(self, rays: Float32) -> tuple[Hits, Indices, Float32]:
        """Hits, the rays that have to be cast on, and how far those came."""
        answer = self.embree(rays)
        hits = Hits.none(len(rays))
        reached = answer["t_hit"].numpy()
        again = settle(
            rays,
            reached,
            answer["primitive_ids"].numpy(),
            answer["primitive_normals"].numpy(),
            self._geom_of_triangle,
            self._shapes.kind,
            self._shapes.rotation,
            self._shapes.center,
            self._shapes.size,
            hits.distance,
            hits.geom,
            hits.cosine,
        )
        return hits, again, reached[again]


def rays_behind(rays: Float32, distance: Float32) -> tuple[Float32, Float32]:
    """Copies of (N, 6) rays that start ``distance`` (N,) further on, and those distances."""
    onward = rays.copy()
    onward[:, :3] += distance[:, None] * onward[:, 3:]
    return onward, distance


def body_pose(data: mujoco.MjData, body_id: int) -> Pose:
    """world_from_body of one body."""
    return Pose(data.xmat[body_id].reshape(3, 3).copy(), data.xpos[body_id].copy())


def geom_pose(data: mujoco.MjData, geom_id: int) -> Pose:
    """world_from_geom of one geom."""
    return Pose(data.geom_xmat[geom_id].reshape(3, 3).copy(), data.geom_xpos[geom_id].copy())
