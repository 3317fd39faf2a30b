"""The top surface of everything in a scene that cannot move, under vertical rays, and its classes.

Rays are cast with Embree at the triangles and shapes that the LIDAR sees too, whatever body a geom
hangs on, without the vehicle and the moving bodies. Infinite planes are solved exactly.
"""

import weakref
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np
from numpy.typing import NDArray

from touchdown.scenes import api
from touchdown.sim.frames import Pose
from touchdown.sim.geometry.ray_target import RayTarget, TargetParts, geom_pose
from touchdown.sim.geometry.tessellation import geom_mesh

Indices = NDArray[np.int32]

_STRIP_REACH_M = 5000.0
"""Half length of planes that are unbounded in one direction only."""
_BLOCK = 1 << 18
"""Rays that are cast at once, which bounds the memory."""
_THIN_M = 0.1
"""Least height over what can be touched at which a geom that cannot be touched is no ground"""
_KEPT = 2
_recent: list[tuple[weakref.ref[api.Scene], "StaticSurface"]] = []


@dataclass(frozen=True, slots=True)
class TopHits:
    """The top surface at points."""

    height_m: api.Array
    """(N,) world, NaN where nothing lies below"""
    geom: Indices
    """(N,) the geom that is seen there, -1 for none"""


@dataclass(frozen=True, slots=True)
class _Plane:
    geom: int
    point: api.Array
    normal: api.Array

    def height(self, xy_m: api.Array) -> api.Array:
        """(N,) world heights at (N, 2) world points."""
        slope: api.Array = (xy_m - self.point[:2]) @ self.normal[:2]
        return self.point[2] - slope / self.normal[2]


class StaticSurface:
    """All geoms of ``scene`` but those of the vehicle and of moving bodies, at time 0.

    Geoms that can be seen count, and unseen ones that the vehicle can touch; such a one has a
    height and no class: what is seen below it has.
    """

    def __init__(self, scene: api.Scene) -> None:
        self._model = scene.model
        self._data = mujoco.MjData(scene.model)
        mujoco.mj_kinematics(scene.model, self._data)
        self.geoms = _static_geoms(scene)
        """(G,) geom ids, in ascending order"""
        self._unseen = np.array([not _visible(scene.model, int(g)) for g in self.geoms], bool)
        solid = scene.model.geom_contype[self.geoms] | scene.model.geom_conaffinity[self.geoms]
        self._untouched = solid == 0
        # Near the take-off spot single precision is exact to hundredths of a millimetre.
        self._origin = np.round(scene.takeoff_xy_m).astype(np.float64)
        self._all = self._caster(self.geoms)

    def cast(self, xy_m: api.Array) -> TopHits:
        """The top surface at (N, 2) world points."""
        hits = self._all.cast(xy_m)
        if self._unseen.any():
            below = np.flatnonzero(np.isin(hits.geom, self.geoms[self._unseen]))
            hits.geom[below] = self._seen.cast(xy_m[below]).geom
        return hits

    def floats(self, xy_m: api.Array, hits: TopHits) -> NDArray[np.bool_]:
        """(N,) of what `cast` hit: it cannot be touched, nor can anything within 0.1 m below it,
        as below paint: no ground."""
        above = np.isin(hits.geom, self.geoms[self._untouched])
        if above.any():
            depth = hits.height_m[above] - self._solid.cast(xy_m[above]).height_m
            above[above] = ~(depth <= _THIN_M)
        return above

    def bare_ground(self, xy_m: api.Array) -> api.Array:
        """(N,) heights of the height fields, or of the planes of a scene without such; NaN where
        there is neither."""
        return self._terrain.cast(xy_m).height_m

    def box(self, geom: int) -> tuple[api.Array, api.Array]:
        """Centre (3,) of a geom's bounding box and its half axes (3, 3) as columns, world."""
        rotation = self._data.geom_xmat[geom].reshape(3, 3)
        aabb = self._model.geom_aabb[geom]
        return rotation @ aabb[:3] + self._data.geom_xpos[geom], rotation * aabb[3:]

    @cached_property
    def _seen(self) -> "_Caster":
        return self._caster(self.geoms[~self._unseen])

    @cached_property
    def _solid(self) -> "_Caster":
        return self._caster(self.geoms[~self._untouched])

    @cached_property
    def _terrain(self) -> "_Caster":
        kinds = self._model.geom_type[self.geoms]
        fields = kinds == mujoco.mjtGeom.mjGEOM_HFIELD
        planes = kinds == mujoco.mjtGeom.mjGEOM_PLANE
        return self._caster(self.geoms[fields if fields.any() else planes])

    def _caster(self, geoms: Indices) -> "_Caster":
        return _Caster(self._model, self._data, geoms, self._origin)


class _Caster:
    """Vertical rays at some geoms."""

    def __init__(
        self, model: mujoco.MjModel, data: mujoco.MjData, geoms: Indices, origin_xy_m: api.Array
    ) -> None:
        self._origin = origin_xy_m
        self._planes: list[_Plane] = []
        shift = Pose(np.eye(3), -np.array([*origin_xy_m, 0.0]))
        parts = TargetParts.none(model)
        for geom in geoms.tolist():
            pose = geom_pose(data, geom)
            if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE:
                if pose.rotation[2, 2] <= 0.0:
                    continue  # seen from behind, where MuJoCo has no surface
                if not model.geom_size[geom, :2].any():
                    self._planes.append(_Plane(geom, pose.translation, pose.rotation[:, 2]))
                    continue
            around = pose.inverse().apply(np.array([*origin_xy_m, 0.0]))
            mesh = geom_mesh(model, geom, _STRIP_REACH_M, around=(around[0], around[1]))
            parts.add(model, geom, shift @ pose, mesh)
        top = max([0.0, *(float(points[:, 2].max()) for points in parts.vertices)])
        self._start_z = float(np.ceil(top) + 1.0)
        self._target = RayTarget(parts) if parts.geoms else None

    def cast(self, xy_m: api.Array) -> TopHits:
        """The top surface at (N, 2) world points."""
        heights = np.full(len(xy_m), np.nan)
        geoms = np.full(len(xy_m), -1, np.int32)
        if self._target is not None:
            for start in range(0, len(xy_m), _BLOCK):
                block = slice(start, start + _BLOCK)
                hits = self._target.cast(self._rays(xy_m[block]))
                distance = hits.distance.astype(np.float64)
                heights[block] = np.where(hits.geom >= 0, self._start_z - distance, np.nan)
                geoms[block] = hits.geom
        for plane in self._planes:
            level = plane.height(xy_m)
            above = ~(level <= heights)
            heights[above], geoms[above] = level[above], plane.geom
        return TopHits(heights, geoms)

    def _rays(self, xy_m: api.Array) -> NDArray[np.float32]:
        """(N, 6) downward rays that start above everything, in the caster's frame."""
        rays = np.zeros((len(xy_m), 6), np.float32)
        rays[:, :2] = xy_m - self._origin
        rays[:, 2], rays[:, 5] = self._start_z, -1.0
        return rays


def static_surface(scene: api.Scene) -> StaticSurface:
    """The surface of ``scene``; those of the last scenes are kept as long as the scenes are, since
    they take a while to build. The model's geometry must not change any more."""
    for reference, surface in _recent:
        known = reference()
        if known and known.model is scene.model and known.moving is scene.moving:
            return surface
    surface = StaticSurface(scene)
    _recent[:] = [(weakref.ref(scene, _forget), surface), *_recent[: _KEPT - 1]]
    return surface


def _forget(scene: weakref.ref[api.Scene]) -> None:
    """Model, textures and rays of a scene take a hundred megabytes."""
    _recent[:] = [known for known in _recent if known[0] is not scene]


def _static_geoms(scene: api.Scene) -> Indices:
    """Ids of the geoms that hang neither on the vehicle nor on a moving body, however deep, and
    that can be seen or touched."""
    model = scene.model
    roots = {model.body(moving.body_name).rootid[0] for moving in scene.moving}
    vehicle = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, api.VEHICLE_BODY)
    if vehicle >= 0:
        roots.add(model.body_rootid[vehicle])
    return np.array(
        [
            geom
            for geom in range(model.ngeom)
            if model.body_rootid[model.geom_bodyid[geom]] not in roots
            and model.geom_group[geom] != api.VEHICLE_GROUP
            and (_visible(model, geom) or model.geom_contype[geom] or model.geom_conaffinity[geom])
        ],
        np.int32,
    )


def _visible(model: mujoco.MjModel, geom: int) -> bool:
    material = int(model.geom_matid[geom])
    return bool((model.mat_rgba[material, 3] if material >= 0 else model.geom_rgba[geom, 3]) > 0.0)


_OFF_EDGE_M = np.array([1.37e-4, 2.11e-4])
"""Beside the edges of objects that lie on a regular grid, as generated ones often do."""


def cast_down(
    scene: api.Scene, origin_xy_m: api.Array, cell_m: float, shape: tuple[int, int]
) -> tuple[api.Array, NDArray[np.int32]]:
    """Returns heights of the top surface at cell centres and the geoms that were hit.

    origin_xy_m: (2,) corner of cell (0, 0); shape: (rows, cols), row = y. Returns (rows, cols)
    float64 metres, NaN where nothing lies below, and (rows, cols) geom ids, -1 there.
    """
    heights, geoms = cast_points(scene, _centres(origin_xy_m, cell_m, shape).reshape(-1, 2))
    return heights.reshape(shape), geoms.reshape(shape)


def _centres(origin_xy_m: api.Array, cell_m: float, shape: tuple[int, int]) -> api.Array:
    """(rows, cols, 2) world points."""
    x = origin_xy_m[0] + (np.arange(shape[1]) + 0.5) * cell_m
    y = origin_xy_m[1] + (np.arange(shape[0]) + 0.5) * cell_m
    return np.stack(np.meshgrid(x, y), axis=-1)


def cast_points(scene: api.Scene, xy_m: api.Array) -> tuple[api.Array, NDArray[np.int32]]:
    """Returns heights (N,) of the top surface at (N, 2) world points and the geoms (N,) that were
    hit; NaN and -1 where nothing lies below."""
    hits = static_surface(scene).cast(np.asarray(xy_m, np.float64) + _OFF_EDGE_M)
    return hits.height_m, hits.geom


def raise_thin_things(
    scene: api.Scene, heights: api.Array, origin_xy_m: api.Array, cell_m: float
) -> None:
    """Lifts the cells (in place) that hold geoms too narrow for the grid of `cast_down`, by rays
    along each such geom's horizontal middle line."""
    surface = static_surface(scene)
    lines = [np.zeros((0, 2))]
    for geom in surface.geoms.tolist():
        centre, axes = surface.box(geom)
        reach = np.linalg.norm(axes[:2], axis=0)
        longest = int(np.argmax(reach))
        others = np.delete(reach, longest)
        if scene.model.geom_rbound[geom] == 0.0 or others.max() > 1.5 * cell_m:
            continue
        steps = np.linspace(-1.0, 1.0, 2 * int(np.ceil(reach[longest] / (0.4 * cell_m))) + 1)
        lines.append(centre[:2] + 0.999 * steps[:, None] * axes[:2, longest])
    line = np.concatenate(lines)
    cells = np.floor((line - origin_xy_m) / cell_m).astype(int)
    inside = ((cells >= 0) & (cells < np.array(heights.shape)[::-1])).all(axis=1)
    col, row = cells[inside].T
    np.fmax.at(heights, (row, col), cast_points(scene, line[inside])[0])


def geom_classes(scene: api.Scene) -> Indices:
    """(G + 1,) land-class ids of the geoms; `OTHER_CLASS_ID` for the rest, and at the end, which
    stands for no geom."""
    table = np.full(scene.model.ngeom + 1, api.OTHER_CLASS_ID, np.int32)
    for geom in range(scene.model.ngeom):
        surface = scene.surfaces.get(scene.model.geom(geom).name)
        if surface is not None and surface.land_class in api.LAND_CLASSES:
            table[geom] = api.LAND_CLASSES.index(surface.land_class)
    return table


def class_ids(
    scene: api.Scene,
    origin_xy_m: api.Array,
    cell_m: float,
    heights: api.Array,
    geoms: NDArray[np.int32],
) -> NDArray[np.uint8]:
    """Returns the land-class ids of the geoms that `cast_down` hit, (rows, cols); `OTHER_CLASS_ID`
    for the rest, and where the vehicle would fall through a class that is safe."""
    ids = geom_classes(scene).astype(np.uint8)[geoms]
    ground = scene.ground
    centres = _centres(origin_xy_m, cell_m, geoms.shape)
    if ground is not None:
        on_ground = geoms == scene.model.geom(ground.geom_name).id
        cell = np.floor((centres[on_ground] - ground.origin_xy_m) / ground.cell_m).astype(int)
        limit = np.array(ground.class_id.shape)[::-1] - 1
        cell = np.clip(cell, 0, limit)
        ids[on_ground] = ground.class_id[cell[:, 1], cell[:, 0]]
    safe = np.isin(ids, [api.LAND_CLASSES.index(name) for name in sorted(api.SAFE_CLASSES)])
    hits = TopHits(heights[safe], geoms[safe])
    ids[safe] = np.where(
        static_surface(scene).floats(centres[safe] + _OFF_EDGE_M, hits),
        api.OTHER_CLASS_ID,
        ids[safe],
    )
    return ids


def bare_ground(scene: api.Scene, xy_m: api.Array, otherwise_m: float) -> api.Array:
    """Height (...) of the height fields, or the planes of a scene without such, at (..., 2) world
    points; ``otherwise_m`` where there is neither."""
    heights = static_surface(scene).bare_ground(np.reshape(xy_m, (-1, 2)))
    heights = np.where(np.isfinite(heights), heights, otherwise_m)
    return heights.reshape(np.shape(xy_m)[:-1])
