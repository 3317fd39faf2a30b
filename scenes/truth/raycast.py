"""Casts rays straight down on a compiled scene without the vehicle and the moving bodies."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.api import LAND_CLASSES, OTHER_CLASS_ID, Array, Scene
from touchdown.scenes.truth.static_surface import static_surface

_OFF_EDGE_M = np.array([1.37e-4, 2.11e-4])
"""Beside the edges of objects that lie on a regular grid, as generated ones often do."""


def cast_down(
    scene: Scene, origin_xy_m: Array, cell_m: float, shape: tuple[int, int]
) -> tuple[Array, NDArray[np.int32]]:
    """Returns heights of the top surface at cell centres and the geoms that were hit.

    origin_xy_m: (2,) corner of cell (0, 0); shape: (rows, cols), row = y. Returns (rows, cols)
    float64 metres, NaN where nothing lies below, and (rows, cols) geom ids, -1 there.
    """
    x = origin_xy_m[0] + (np.arange(shape[1]) + 0.5) * cell_m
    y = origin_xy_m[1] + (np.arange(shape[0]) + 0.5) * cell_m
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    heights, geoms = cast_points(scene, points)
    return heights.reshape(shape), geoms.reshape(shape)


def cast_points(scene: Scene, xy_m: Array) -> tuple[Array, NDArray[np.int32]]:
    """Returns heights (N,) of the top surface at (N, 2) world points and the geoms (N,) that were
    hit; NaN and -1 where nothing lies below."""
    hits = static_surface(scene).cast(np.asarray(xy_m, np.float64) + _OFF_EDGE_M)
    return hits.height_m, hits.geom


def raise_thin_things(scene: Scene, heights: Array, origin_xy_m: Array, cell_m: float) -> None:
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
    """Height (...) of the height fields, or the planes of a scene without such, at (..., 2) world
    points; ``otherwise_m`` where there is neither."""
    heights = static_surface(scene).bare_ground(np.reshape(xy_m, (-1, 2)))
    heights = np.where(np.isfinite(heights), heights, otherwise_m)
    return heights.reshape(np.shape(xy_m)[:-1])
