"""The origin of an imported scene: content far from it, as in map coordinates, is moved there.

Single precision, in which images are drawn and LIDAR rays are cast, resolves half a metre at the
northing of a map grid.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.api import Array

FAR_M = 1000.0
"""Single precision is exact to a tenth of a millimetre up to there."""
_COARSE_M = 0.005


def far_origin(model: Any, data: Any, takeoff_xy_m: Array | None) -> Array:
    """The point (2,) of the file, in whole metres, that becomes the world's origin: the take-off
    spot, or the middle of everything where the file names none. Zero where that is not far off, or
    where the origin lies amid things."""
    if takeoff_xy_m is not None:
        middle = takeoff_xy_m
    else:
        box = finite_box(model, data)
        if box is None or bool(((box[0] <= 0.0) & (box[1] >= 0.0)).all()):
            return np.zeros(2)
        middle = box.mean(axis=0)
    far = float(np.abs(middle).max()) > FAR_M
    return np.round(middle) if far else np.zeros(2)


def finite_box(model: Any, data: Any) -> Array | None:
    """[[x_min, y_min], [x_max, y_max]] of all geoms but infinite planes; None without such."""
    planes = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    finite = ~infinite_planes(model)
    if not finite.any():
        return None
    # Of a plane MuJoCo's box is that of the solid half space below it.
    centres = np.where(planes[:, None], 0.0, model.geom_aabb[:, :3])
    half = np.where(planes[:, None], model.geom_size * [1.0, 1.0, 0.0], model.geom_aabb[:, 3:])
    rotations = data.geom_xmat.reshape(-1, 3, 3)
    world = np.einsum("nij,nj->ni", rotations, centres) + data.geom_xpos
    reach = np.einsum("nij,nj->ni", np.abs(rotations), half)
    low, high = (world - reach)[finite].min(axis=0), (world + reach)[finite].max(axis=0)
    return np.stack([low[:2], high[:2]])


def infinite_planes(model: Any) -> NDArray[np.bool_]:
    """(G,) planes that are unbounded in at least one direction."""
    planes = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    unbounded: NDArray[np.bool_] = planes & (model.geom_size[:, :2] == 0.0).any(axis=1)
    return unbounded


def coarse_meshes(model: Any) -> list[str]:
    """Meshes whose own vertices lie so far from their origin that MuJoCo, which reads them in
    single precision, keeps them to more than 5 mm; with that precision."""
    far = np.abs(model.mesh_pos).max(axis=1).astype(np.float32)
    return [
        f"'{model.mesh(index).name}' to {step:.2g} m"
        for index, step in enumerate(np.spacing(far).tolist())
        if step > _COARSE_M
    ]


def move_world(spec: Any, offset_m: Array) -> None:
    """Moves all elements of the world by (3,) metres."""
    world = spec.worldbody
    for element in (*world.geoms, *world.bodies, *world.sites, *world.cameras, *world.lights):
        if element.frame is not None:
            continue
        ends = getattr(element, "fromto", np.full(6, np.nan))
        if np.isfinite(ends[0]):
            element.fromto = ends + np.tile(offset_m, 2)
        else:
            element.pos = element.pos + offset_m
    for frame in world.frames:
        if frame.frame is None:
            frame.pos = frame.pos + offset_m
