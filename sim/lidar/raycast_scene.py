"""A MuJoCo scene for Embree: triangles, and the optical properties of every geom.

Geoms that cannot move share one ray-casting scene in world coordinates. Every moving body (a mocap
body, or one with joints, with all that hangs on it) has its own scene in its own frame, and rays
are carried into that frame. The vehicle, geom groups 3 and above, and invisible geoms are left out.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import mujoco
import numpy as np

from touchdown.scenes.api import LAND_CLASSES, GroundRaster, Scene, Surface
from touchdown.sim.frames import Pose
from touchdown.sim.geometry.ray_target import Hits, RayTarget, TargetParts, body_pose, geom_pose
from touchdown.sim.geometry.tessellation import POROUS_CHORD_RELATIVE, geom_mesh, is_seen
from touchdown.sim.lidar.heightfield import GroundGrid
from touchdown.sim.lidar.rays import ground_cells
from touchdown.sim.typing import Array, Bytes, Float32, Indices, Int32, Mask

VEHICLE_PREFIX = "vehicle/"
DEFAULT_SURFACE = Surface(land_class="other", reflectivity=0.3)
"""Surface of geoms that the scene does not describe."""

_BARE = Surface(land_class="water", reflectivity=0.0, spread=0.0)
"""Bottom of a water: no texture, no plants."""
_PLANE_MARGIN_M = 300.0
_BELOW_M = 0.01
_NO_GEOM = -1


class GroundTarget(RayTarget):
    """Geoms of which one may be terrain, where most rays meet nothing else."""

    def __init__(self, parts: TargetParts, ground: GroundGrid | None = None) -> None:
        self._ground = ground
        super().__init__(parts)

    def cast_apart(self, rays: Float32, hits: Hits) -> Indices:
        """As `RayTarget.cast_apart`."""
        if self._ground is None:
            return super().cast_apart(rays, hits)
        others = self._ground.land(rays, hits)
        self.cast_on(np.take(rays, others, axis=0), others, np.zeros(len(others), np.float32), hits)
        return others


@dataclass(frozen=True, slots=True)
class OpticalTable:
    """Surface properties by geom id, and the terrain's raster."""

    reflectivity: Float32
    """(G,) 0..1"""
    porosity: Float32
    """(G,) fraction of pulses that pass"""
    water: Mask
    """(G,)"""
    ground_geom: int
    """-1 where the scene has no raster"""
    ground_frame: Array
    """(3,) x and y of the raster's corner, cells per metre"""
    ground_reflectivity: Float32
    """(rows, cols), negative where there is water: large, and read in one place"""
    spread: Float32
    """(G,) relative standard deviation of the reflectivity"""
    canopy_m: Float32
    """(G,) mean height of plants"""
    leaf_area: Float32
    """(G,) leaf area index of plants"""
    ground_material: Bytes
    """(rows, cols) index into the following; empty where the raster has no materials"""
    material_spread: Float32
    """(M,)"""
    material_canopy_m: Float32
    """(M,)"""
    material_leaf_area: Float32
    """(M,)"""

    def cells(self, rays: Float32, hits: Hits) -> Int32:
        """Flat indices (N,) of the cells of the raster that rays (N, 6) hit, -1 elsewhere."""
        rows, cols = self.ground_reflectivity.shape
        return ground_cells(rays, hits, self.ground_geom, self.ground_frame, rows, cols)


class Crowns(NamedTuple):
    """Boxes of geoms, (G, 3) world frame, and (G,) heights of their tops above what lies below
    their centres."""

    low: Array
    high: Array
    height_m: Array


class LidarScene:
    """All surfaces of ``scene`` that a LIDAR can hit. It uses no MjData, so any thread may cast
    rays."""

    def __init__(self, scene: Scene, optics: OpticalTable | None = None) -> None:
        model = scene.model
        self.optics = optics or optical_table(model, scene)
        rest = mujoco.MjData(model)
        mujoco.mj_kinematics(model, rest)
        middle = np.array([*scene.bounds_xy_m.mean(axis=0), 0.0])
        reach = float(np.abs(scene.bounds_xy_m - middle[:2]).max()) + _PLANE_MARGIN_M
        blocks: dict[int, TargetParts] = {}
        for geom_id in range(model.ngeom):
            if not is_seen(model, geom_id) or _is_vehicle(model, geom_id):
                continue
            around = geom_pose(rest, geom_id).inverse().apply(middle)
            porous = bool(self.optics.porosity[geom_id] > 0.0)
            chord = POROUS_CHORD_RELATIVE if porous else None
            mesh = geom_mesh(model, geom_id, reach, chord, (around[0], around[1]))
            if mesh is None or not len(mesh[1]):
                continue
            root = moving_root(model, int(model.geom_bodyid[geom_id]))
            frame = Pose.identity() if root == 0 else body_pose(rest, root)
            local = frame.inverse() @ geom_pose(rest, geom_id)
            blocks.setdefault(root, TargetParts.none(model)).add(model, geom_id, local, mesh)
        self.static: GroundTarget | None = None
        static = blocks.pop(0, TargetParts.none(model))
        if static.geoms:
            self.static = GroundTarget(static, _ground_grid(model, rest, *static[:3]))
        self._boxes = {
            geom: (points.min(axis=0), points.max(axis=0))
            for geom, points in zip(static.geoms, static.vertices, strict=True)
        }
        self.moving = {_body_name(model, root): RayTarget(parts) for root, parts in blocks.items()}
        on_mover = np.zeros(model.ngeom, dtype=np.bool_)
        for target in self.moving.values():
            on_mover[target.geoms] = True
        self.on_mover = on_mover
        """(G,) geoms of bodies that move"""
        self.rest_poses = {_body_name(model, root): body_pose(rest, root) for root in blocks}

    def crowns(self, chosen: Mask) -> Crowns:
        """Boxes and heights of the ``chosen`` (G,) geoms that do not move."""
        low, high = np.zeros((2, len(chosen), 3))
        heights = np.zeros(len(chosen))
        geoms = [geom for geom in self._boxes if chosen[geom]]
        if geoms and self.static is not None:
            low[geoms] = [self._boxes[geom][0] for geom in geoms]
            high[geoms] = [self._boxes[geom][1] for geom in geoms]
            rays = np.zeros((len(geoms), 6), dtype=np.float32)
            rays[:, :2], rays[:, 5] = 0.5 * (low + high)[geoms, :2], -1.0
            rays[:, 2] = low[geoms, 2] - _BELOW_M
            below = self.static.cast_all(rays).distance
            ground = np.where(np.isfinite(below), rays[:, 2] - below, low[geoms, 2])
            heights[geoms] = high[geoms, 2] - ground
        return Crowns(low, high, heights)


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
    wet = ground.class_id == LAND_CLASSES.index("water")
    materials = (*ground.materials, _BARE)
    return OpticalTable(
        reflectivity=np.array([s.reflectivity for s in surfaces], dtype=np.float32),
        porosity=np.array([s.porosity for s in surfaces], dtype=np.float32),
        water=np.array([s.water for s in surfaces], dtype=np.bool_),
        ground_geom=names.index(ground.geom_name) if scene.ground is not None else _NO_GEOM,
        ground_frame=np.array([*ground.origin_xy_m, 1.0 / ground.cell_m], dtype=np.float64),
        ground_reflectivity=_dry(ground.reflectivity, wet, -1.0, np.float32),
        spread=_column(surfaces, "spread"),
        canopy_m=_column(surfaces, "canopy_m"),
        leaf_area=_column(surfaces, "leaf_area"),
        ground_material=_dry(ground.material, wet, len(ground.materials), np.uint8),
        material_spread=_column(materials, "spread"),
        material_canopy_m=_column(materials, "canopy_m"),
        material_leaf_area=_column(materials, "leaf_area"),
    )


def _dry(raster: Any, wet: Mask, under_water: float, kind: Any) -> Any:
    """``raster`` itself, 8 MB, where nothing is ``wet``; else a copy with ``under_water`` there."""
    if raster.size and wet.any():
        raster = np.where(wet, under_water, raster)
    return np.ascontiguousarray(raster, kind)


def _column(surfaces: Sequence[Surface], name: str) -> Float32:
    return np.array([getattr(surface, name) for surface in surfaces], dtype=np.float32)


def _is_vehicle(model: mujoco.MjModel, geom_id: int) -> bool:
    names = (model.geom(geom_id).name, _body_name(model, int(model.geom_bodyid[geom_id])))
    return any(name.startswith(VEHICLE_PREFIX) for name in names)


def _body_name(model: mujoco.MjModel, body_id: int) -> str:
    return str(model.body(body_id).name) or f"body {body_id}"
