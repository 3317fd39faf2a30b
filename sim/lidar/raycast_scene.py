"""A MuJoCo scene for Embree: triangles, and the optical properties of every geom.

Geoms that cannot move share one ray-casting scene in world coordinates. Every moving body (a mocap
body, or one with joints, with all that hangs on it) has its own scene in its own frame, and rays
are carried into that frame. The vehicle, geom groups 3 and above, and invisible geoms are left out.
"""

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

from touchdown.scenes.api import LAND_CLASSES, GroundRaster, Scene, Surface
from touchdown.sim.frames import Pose
from touchdown.sim.lidar.heightfield import GroundGrid
from touchdown.sim.lidar.quadrics import ShapeTable, settle
from touchdown.sim.lidar.tessellation import geom_mesh
from touchdown.sim.typing import Array, Bools, Float32, Indices, Int32

VEHICLE_PREFIX = "vehicle/"
FIRST_HIDDEN_GROUP = 3
DEFAULT_SURFACE = Surface(land_class="other", reflectivity=0.3)
"""Surface of geoms that the scene does not describe."""

_PLANE_MARGIN_M = 300.0
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
        ground: GroundGrid | None = None,
    ) -> None:
        offsets = np.cumsum([0] + [len(block) for block in vertices])[:-1]
        points = np.concatenate(vertices).astype(np.float32)
        indices = [block + start for block, start in zip(triangles, offsets, strict=True)]
        self._geom_of_triangle = np.repeat(
            np.array(geoms, dtype=np.int32), [len(block) for block in triangles]
        )
        self._shapes = shapes
        self._ground = ground
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
        """Nearest hits, and the indices of the rays that passed near anything but open ground."""
        if self._ground is None:
            return self.cast_all(rays), np.arange(len(rays))
        hits = Hits.none(len(rays))
        others = self._ground.march(rays, hits.distance, hits.geom, hits.cosine)
        if others.size:
            hits.put(others, self.cast_all(rays[others]))
        return hits, others

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


@dataclass(frozen=True, slots=True)
class OpticalTable:
    """Surface properties by geom id, and the terrain's raster."""

    reflectivity: Float32
    """(G,) 0..1"""
    porosity: Float32
    """(G,) share of pulses that pass"""
    water: Bools
    """(G,)"""
    ground_geom: int
    """-1 where the scene has no raster"""
    ground_frame: Array
    """(3,) x and y of the raster's corner, cells per metre"""
    ground_reflectivity: Float32
    """(rows, cols), negative where there is water: large, and read in one place"""


class LidarScene:
    """All surfaces of ``scene`` that a LIDAR can hit. It uses no MjData, so any thread may cast
    rays."""

    def __init__(self, scene: Scene) -> None:
        model = scene.model
        self.optics = optical_table(model, scene)
        rest = mujoco.MjData(model)
        mujoco.mj_kinematics(model, rest)
        reach = float(np.abs(scene.bounds_xy_m).max()) + _PLANE_MARGIN_M
        blocks: dict[int, tuple[list[Array], list[Int32], list[int], ShapeTable]] = {}
        for geom_id in _visible_geoms(model):
            mesh = geom_mesh(model, geom_id, reach, bool(self.optics.porosity[geom_id] > 0.0))
            if mesh is None or not len(mesh[1]):
                continue
            root = moving_root(model, int(model.geom_bodyid[geom_id]))
            frame = Pose.identity() if root == 0 else _body_pose(rest, root)
            local = frame.inverse() @ _geom_pose(rest, geom_id)
            block = blocks.setdefault(root, ([], [], [], ShapeTable.empty(model.ngeom)))
            block[0].append(local.apply(mesh[0]))
            block[1].append(mesh[1])
            block[2].append(geom_id)
            block[3].add(model, geom_id, local)
        self.static: RayTarget | None = None
        if 0 in blocks:
            ground = _ground_grid(model, rest, *blocks[0][:3])
            self.static = RayTarget(*blocks.pop(0), ground)
        self.moving = {_body_name(model, root): RayTarget(*block) for root, block in blocks.items()}
        self.rest_poses = {_body_name(model, root): _body_pose(rest, root) for root in blocks}


def _ground_grid(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    vertices: list[Array],
    triangles: list[Int32],
    geoms: list[int],
) -> GroundGrid | None:
    """The largest of the fixed height fields that stand upright, or None."""
    fields = [
        geom
        for geom in geoms
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_HFIELD
        and np.array_equal(data.geom_xmat[geom].reshape(3, 3), np.eye(3))
    ]
    if not fields:
        return None
    field = max(
        fields, key=lambda geom: float(np.prod(model.hfield_size[_hfield(model, geom), :2]))
    )
    index = _hfield(model, field)
    rows, cols = int(model.hfield_nrow[index]), int(model.hfield_ncol[index])
    size = model.hfield_size[index]
    others = [k for k, geom in enumerate(geoms) if geom != field]
    clutter = [vertices[k][triangles[k]] for k in others]
    nodes = vertices[geoms.index(field)][: rows * cols]
    return GroundGrid.of(
        field,
        nodes[0, :2],
        2.0 * size[:2] / [cols - 1, rows - 1],
        nodes[:, 2].reshape(rows, cols),
        np.concatenate(clutter) if clutter else np.zeros((0, 3, 3)),
    )


def _hfield(model: mujoco.MjModel, geom_id: int) -> int:
    return int(model.geom_dataid[geom_id])


def moving_root(model: mujoco.MjModel, body_id: int) -> int:
    """The outermost ancestor that can move (mocap or jointed), or 0 for what is fixed."""
    root = 0
    while body_id != 0:
        if model.body_mocapid[body_id] >= 0 or model.body_jntnum[body_id] > 0:
            root = body_id
        body_id = int(model.body_parentid[body_id])
    return root


def optical_table(model: mujoco.MjModel, scene: Scene) -> OpticalTable:
    """Gathers ``scene.surfaces`` and ``scene.ground`` into arrays indexed by geom id."""
    names = [model.geom(i).name for i in range(model.ngeom)]
    surfaces = [scene.surfaces.get(name, DEFAULT_SURFACE) for name in names]
    ground = scene.ground or GroundRaster(
        geom_name="",
        origin_xy_m=np.zeros(2),
        cell_m=1.0,
        class_id=np.zeros((0, 0), dtype=np.uint8),
        reflectivity=np.zeros((0, 0), dtype=np.float32),
    )
    if scene.ground is not None and ground.geom_name not in names:
        raise ValueError(
            f"scene '{scene.name}': its ground raster names the geom '{ground.geom_name}', which "
            "the model does not have; name the terrain geom so"
        )
    return OpticalTable(
        reflectivity=np.array([s.reflectivity for s in surfaces], dtype=np.float32),
        porosity=np.array([s.porosity for s in surfaces], dtype=np.float32),
        water=np.array([s.water for s in surfaces], dtype=np.bool_),
        ground_geom=names.index(ground.geom_name) if scene.ground is not None else _NO_GEOM,
        ground_frame=np.array([*ground.origin_xy_m, 1.0 / ground.cell_m], dtype=np.float64),
        ground_reflectivity=np.where(
            ground.class_id == LAND_CLASSES.index("water"), -1.0, ground.reflectivity
        ).astype(np.float32),
    )


def _visible_geoms(model: mujoco.MjModel) -> list[int]:
    return [
        geom_id
        for geom_id in range(model.ngeom)
        if model.geom_group[geom_id] < FIRST_HIDDEN_GROUP
        and _alpha(model, geom_id) > 0.0
        and not _is_vehicle(model, geom_id)
    ]


def _is_vehicle(model: mujoco.MjModel, geom_id: int) -> bool:
    names = (model.geom(geom_id).name, _body_name(model, int(model.geom_bodyid[geom_id])))
    return any(name.startswith(VEHICLE_PREFIX) for name in names)


def _alpha(model: mujoco.MjModel, geom_id: int) -> float:
    material = int(model.geom_matid[geom_id])
    return float(model.mat_rgba[material, 3] if material >= 0 else model.geom_rgba[geom_id, 3])


def _body_name(model: mujoco.MjModel, body_id: int) -> str:
    return str(model.body(body_id).name) or f"body {body_id}"


def _body_pose(data: mujoco.MjData, body_id: int) -> Pose:
    return Pose(data.xmat[body_id].reshape(3, 3).copy(), data.xpos[body_id].copy())


def _geom_pose(data: mujoco.MjData, geom_id: int) -> Pose:
    return Pose(data.geom_xmat[geom_id].reshape(3, 3).copy(), data.geom_xpos[geom_id].copy())
