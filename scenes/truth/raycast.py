"""Casts rays straight down on a compiled scene without the vehicle and the moving bodies."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.api import LAND_CLASSES, OTHER_CLASS_ID, Scene
from touchdown.scenes.authoring.height_field import HeightField
from touchdown.scenes.compose import VEHICLE_GROUP

Array = NDArray[np.float64]


_EYE_M = 4000.0
_TILE_M = 4.0
_OFF_EDGE_M = np.array([1.37e-4, 2.11e-4])
"""A ray that runs exactly along the edge of two triangles can slip through: aim beside it."""


def cast_down(
    scene: Scene, origin_xy_m: Array, cell_m: float, shape: tuple[int, int]
) -> tuple[Array, NDArray[np.int32]]:
    """Returns heights of the top surface at cell centres and the geoms that were hit.

    origin_xy_m: (2,) corner of cell (0, 0); shape: (rows, cols), row = y. Returns (rows, cols)
    float64 metres, NaN where nothing lies below, and (rows, cols) geom ids, -1 there.
    MuJoCo casts many rays from one point only: tiles of 4 m seen from 4 km up, where the rays lean
    by at most 0.7 mm per metre of height.
    """
    model, data = scene.model, _static_data(scene)
    heights = np.full(shape, np.nan)
    geoms = np.full(shape, -1, np.int32)
    tile = max(1, round(_TILE_M / cell_m))
    for row in range(0, shape[0], tile):
        for col in range(0, shape[1], tile):
            rows = np.arange(row, min(row + tile, shape[0]))
            cols = np.arange(col, min(col + tile, shape[1]))
            x = origin_xy_m[0] + (cols + 0.5) * cell_m
            y = origin_xy_m[1] + (rows + 0.5) * cell_m
            z, hit = _cast_tile(model, data, x, y)
            heights[row : row + tile, col : col + tile] = z
            geoms[row : row + tile, col : col + tile] = hit
    return heights, geoms


def raise_thin_things(scene: Scene, heights: Array, origin_xy_m: Array, cell_m: float) -> None:
    """Lifts the cells (in place) that hold geoms too narrow for the grid of `cast_down`, by rays
    along each such geom's horizontal middle line."""
    model, data = scene.model, _static_data(scene)
    for geom in range(model.ngeom):
        if (
            model.geom_group[geom] == VEHICLE_GROUP
            or model.body_mocapid[model.geom_bodyid[geom]] >= 0
        ):
            continue
        rotation = data.geom_xmat[geom].reshape(3, 3)
        centre = rotation @ model.geom_aabb[geom, :3] + data.geom_xpos[geom]
        axes = rotation * model.geom_aabb[geom, 3:]
        reach = np.linalg.norm(axes[:2], axis=0)
        longest = int(np.argmax(reach))
        others = np.delete(reach, longest)
        if model.geom_rbound[geom] == 0.0 or others.max() > 1.5 * cell_m:
            continue
        steps = np.linspace(-1.0, 1.0, 2 * int(np.ceil(reach[longest] / (0.4 * cell_m))) + 1)
        line = centre[:2] + 0.999 * steps[:, None] * axes[:2, longest]
        cells = np.floor((line - origin_xy_m) / cell_m).astype(int)
        inside = ((cells >= 0) & (cells < np.array(heights.shape)[::-1])).all(axis=1)
        for (col, row), (x, y) in zip(cells[inside], line[inside], strict=True):
            z, _ = _cast_tile(model, data, np.array([x]), np.array([y]))
            heights[row, col] = np.fmax(heights[row, col], z[0, 0])


def _static_data(scene: Scene) -> mujoco.MjData:
    """Kinematics at time 0 with the moving bodies far below the ground."""
    model = scene.model
    data = mujoco.MjData(model)
    for moving in scene.moving:
        data.mocap_pos[model.body(moving.body_name).mocapid[0]] = [0.0, 0.0, -1e5]
    mujoco.mj_kinematics(model, data)
    return data


def _cast_tile(
    model: mujoco.MjModel, data: mujoco.MjData, x_m: Array, y_m: Array
) -> tuple[Array, NDArray[np.int32]]:
    """Heights and geom ids on the grid ``y_m`` x ``x_m``; rays aim at the level z = 0."""
    groups = np.ones(6, np.uint8)
    groups[VEHICLE_GROUP] = 0
    eye = np.array([0.5 * (x_m[0] + x_m[-1]), 0.5 * (y_m[0] + y_m[-1]), _EYE_M])
    grid = np.stack(np.meshgrid(x_m, y_m), axis=-1).reshape(-1, 2) + _OFF_EDGE_M
    rays = np.column_stack([grid - eye[:2], np.full(len(grid), -_EYE_M)])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    distance = np.empty(len(rays))
    hit = np.full(len(rays), -1, np.int32)
    mujoco.mj_multiRay(
        model, data, eye, rays.ravel(), groups, 1, -1, hit, distance, None, len(rays), 1e9
    )
    z = np.where(hit >= 0, _EYE_M + distance * rays[:, 2], np.nan)
    shape = (len(y_m), len(x_m))
    return z.reshape(shape), hit.reshape(shape)


def class_ids(
    scene: Scene, origin_xy_m: Array, cell_m: float, geoms: NDArray[np.int32]
) -> NDArray[np.uint8]:
    """Returns the land-class ids of the geoms that `cast_down` hit, (rows, cols); `OTHER_CLASS_ID`
    for the rest."""
    table = np.full(scene.model.ngeom + 1, OTHER_CLASS_ID, np.uint8)
    for geom in range(scene.model.ngeom):
        surface = scene.surfaces.get(scene.model.geom(geom).name)
        if surface is not None and surface.land_class in LAND_CLASSES:
            table[geom] = LAND_CLASSES.index(surface.land_class)
    ids = table[geoms]
    ground = scene.ground
    if ground is not None:
        rows, cols = np.indices(geoms.shape)
        centres = np.stack([cols, rows], axis=-1) * cell_m + 0.5 * cell_m + origin_xy_m
        on_ground = geoms == scene.model.geom(ground.geom_name).id
        cell = np.floor((centres[on_ground] - ground.origin_xy_m) / ground.cell_m).astype(int)
        limit = np.array(ground.class_id.shape)[::-1] - 1
        cell = np.clip(cell, 0, limit)
        ids[on_ground] = ground.class_id[cell[:, 1], cell[:, 0]]
    return ids


def bare_ground(scene: Scene, xy_m: Array, otherwise_m: float) -> Array:
    """Height (...) of the height field or level plane at (..., 2) world points; ``otherwise_m``
    where the scene has neither."""
    model = scene.model
    for geom in range(model.ngeom):
        z = float(model.geom_pos[geom, 2])
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_HFIELD:
            field = int(model.geom_dataid[geom])
            rows, cols = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
            size = model.hfield_size[field]
            if rows == cols and size[0] == size[1]:
                start = int(model.hfield_adr[field])
                unit = model.hfield_data[start : start + rows * cols].reshape(rows, cols)
                heights = unit.astype(np.float64) * size[2] + z
                local = xy_m - model.geom_pos[geom, :2]
                return HeightField(heights_m=heights, half_m=float(size[0])).at(local)
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE:
            return np.full(xy_m.shape[:-1], z)
    return np.full(xy_m.shape[:-1], otherwise_m)
