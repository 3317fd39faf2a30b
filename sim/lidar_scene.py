"""A MuJoCo scene as Embree sees it: triangles, and the optical properties of every geom.

Geoms that cannot move share one ray-casting scene in world coordinates. Every moving body (a mocap
body, or one with joints, with all that hangs on it) has its own scene in its own frame, and rays
are carried into that frame. The vehicle, geom groups 3 and above, and invisible geoms are left out.
"""

from __future__ import annotations

import os
from dataclasses import dataclass

# Open3D would otherwise probe for a display when it is first imported.
os.environ.setdefault("OPEN3D_CPU_RENDERING", "true")

import mujoco
import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from scenes.api import LAND_CLASSES, GroundRaster, Scene, Surface
from sim.frames import Pose
from sim.tessellation import geom_mesh

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]
Int32 = NDArray[np.int32]

VEHICLE_PREFIX = "vehicle/"
FIRST_HIDDEN_GROUP = 3
DEFAULT_SURFACE = Surface(land_class="other", reflectivity=0.3)
"""Of geoms that the scene says nothing about."""

_PLANE_MARGIN_M = 300.0
_MISS = np.uint32(0xFFFFFFFF)
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


class RayTarget:
    """Triangles of some geoms, rigid in one frame, under one Embree acceleration structure."""

    def __init__(self, vertices: list[Array], triangles: list[Int32], geoms: list[int]) -> None:
        offsets = np.cumsum([0] + [len(block) for block in vertices])[:-1]
        points = np.concatenate(vertices).astype(np.float32)
        indices = [block + start for block, start in zip(triangles, offsets, strict=True)]
        self._geom_of_triangle = np.repeat(
            np.array(geoms, dtype=np.int32), [len(block) for block in triangles]
        )
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
        """(N, 6) float32 origins and unit directions in the target's frame."""
        answer = self._scene.cast_rays(o3d.core.Tensor.from_numpy(rays), nthreads=1)
        triangle = answer["primitive_ids"].numpy()
        missed = triangle == _MISS
        triangle[missed] = 0
        geom = self._geom_of_triangle[triangle]
        geom[missed] = _NO_GEOM
        normals = answer["primitive_normals"].numpy()
        cosine = -np.einsum("ij,ij->i", normals, rays[:, 3:])
        return Hits(answer["t_hit"].numpy(), geom, cosine)


@dataclass(frozen=True, slots=True)
class OpticalTable:
    """Surface properties by geom id, and the terrain's raster."""

    reflectivity: Float32
    """(G,) 0..1"""
    porosity: Float32
    """(G,) share of pulses that pass"""
    water: NDArray[np.bool_]
    """(G,)"""
    ground_geom: int
    """-1 where the scene has no raster"""
    ground_origin_xy_m: Array
    ground_cell_m: float
    ground_reflectivity: Float32
    """(rows, cols)"""
    ground_water: NDArray[np.bool_]
    """(rows, cols)"""


class LidarScene:
    """Everything a LIDAR can hit in ``scene``. Never touches an MjData: safe in any thread."""

    def __init__(self, scene: Scene) -> None:
        model = scene.model
        self.optics = optical_table(model, scene)
        rest = mujoco.MjData(model)
        mujoco.mj_kinematics(model, rest)
        reach = float(np.abs(scene.bounds_xy_m).max()) + _PLANE_MARGIN_M
        blocks: dict[int, tuple[list[Array], list[Int32], list[int]]] = {}
        for geom_id in _visible_geoms(model):
            mesh = geom_mesh(model, geom_id, reach, bool(self.optics.porosity[geom_id] > 0.0))
            if mesh is None or not len(mesh[1]):
                continue
            root = moving_root(model, int(model.geom_bodyid[geom_id]))
            frame = Pose.identity() if root == 0 else _body_pose(rest, root)
            local = frame.inverse() @ _geom_pose(rest, geom_id)
            vertices, triangles, geoms = blocks.setdefault(root, ([], [], []))
            vertices.append(local.apply(mesh[0]))
            triangles.append(mesh[1])
            geoms.append(geom_id)
        self.static = RayTarget(*blocks.pop(0)) if 0 in blocks else None
        self.moving = {_body_name(model, root): RayTarget(*block) for root, block in blocks.items()}
        self.rest_poses = {_body_name(model, root): _body_pose(rest, root) for root in blocks}


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
        ground_origin_xy_m=np.asarray(ground.origin_xy_m, dtype=np.float64),
        ground_cell_m=float(ground.cell_m),
        ground_reflectivity=np.ascontiguousarray(ground.reflectivity, dtype=np.float32),
        ground_water=np.ascontiguousarray(ground.class_id == LAND_CLASSES.index("water")),
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
