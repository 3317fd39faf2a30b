"""What the vehicle touches in the scene of a file: meshes where they are seen, not at their convex
hull, and planes only where they are drawn."""

from __future__ import annotations

from collections.abc import Container
from typing import Any, NamedTuple

import mujoco
import numpy as np

from touchdown.scenes.api import Array
from touchdown.scenes.importers.top_view import Place, grounds, largest, top_view

MIN_AREA_M2 = 25.0
"""Smaller surfaces stay as they are."""
MAX_NODES = 801
"""along a side of a height field"""
_NODE_M = 0.25
_HOLE_M = 3.0
_MAX_HOLES = 0.2
_HALF_THICK_M = 0.1
"""of what collides of a plane that ends"""
_ENDLESS_M = 1000.0
"""half width of a plane along an axis on which it has no end"""
_BEHIND_M = 0.05
"""below a plane, of what is seen there"""
_HIDDEN_GROUP = 3


class Sampled(NamedTuple):
    """Heights of a geom at nodes."""

    height_m: Array
    """(rows, cols) world; holes lie below all else"""
    low_xy_m: Array
    high_xy_m: Array
    """corners"""


def touch_meshes(spec: Any, place: Place, others: Container[int]) -> None:
    """Gives ground meshes an unseen height field to be touched by, but those among ``others`` and
    those full of holes."""
    label = grounds(place.seen)
    area = place.seen_m2()
    for geom in np.unique(place.seen.geom[label == largest(label)]).tolist():
        wide = area[geom] >= MIN_AREA_M2
        if not (place.is_kind(geom, "MESH") and place.collides(geom) and wide) or geom in others:
            continue
        if (terrain := sampled(place, geom)) is not None:
            own = spec.geom(place.name(geom))
            own.contype = own.conaffinity = 0
            add_field(spec, f"{own.name}_touched", terrain, group=_HIDDEN_GROUP)


def end_planes(spec: Any, place: Place, others: Container[str]) -> list[str]:
    """MuJoCo draws a plane as wide as its size, but everything behind it collides with it (XML
    reference, geom): a vehicle that stands behind a sloping one is thrown away. Those with ground
    behind them then collide only where they are drawn, by an unseen box; returns their names."""
    points, ended = place.points(), []
    for geom in range(place.model.ngeom):
        name, normal = place.name(geom), place.rotation(geom)[:, 2]
        if not (place.is_kind(geom, "PLANE") and place.collides(geom)) or name in others:
            continue
        middle = place.data.geom_xpos[geom]
        if ((points - middle) @ normal < -_BEHIND_M).any():
            own, size = spec.geom(name), place.model.geom_size[geom, :2]
            own.contype = own.conaffinity = 0
            spec.worldbody.add_geom(
                name=f"{name}_touched", type=mujoco.mjtGeom.mjGEOM_BOX, group=_HIDDEN_GROUP,
                size=[*np.where(size > 0.0, size, _ENDLESS_M), _HALF_THICK_M],
                pos=middle - _HALF_THICK_M * normal, quat=quat_of(place.rotation(geom)),
            )  # fmt: skip
            ended.append(name)
    return ended


def sampled(place: Place, geom: int) -> Sampled | None:
    """Heights of one geom over its part of the bounds. None where a fifth is holes."""
    middle, reach = place.box(geom)
    low = np.maximum(middle[:2] - reach[:2], place.bounds_xy_m[0])
    high = np.minimum(middle[:2] + reach[:2], place.bounds_xy_m[1])
    if (high - low < 2.0).any():
        return None
    step = max(_NODE_M, float((high - low).max()) / (MAX_NODES - 1))
    # Rays go through nodes, a hair inside of the rim.
    inner = np.stack([low - 0.5 * step + 1e-3, high + 0.5 * step - 1e-3])
    count = np.maximum(np.round((high - low) / step).astype(int) + 1, 3)
    step = float(((high - low - 2e-3) / (count - 1)).max())
    inner[1] = inner[0] + step * count
    seen = top_view(place.model, place.data, inner, step, only=geom)
    holes = np.isnan(seen.height_m)
    if holes.mean() > _MAX_HOLES:
        return None
    heights = np.where(holes, np.nanmin(seen.height_m) - _HOLE_M * holes.any(), seen.height_m)
    first = seen.centres()[0, 0]
    return Sampled(heights, first, first + step * (np.array(heights.shape)[::-1] - 1))


def add_field(spec: Any, name: str, terrain: Sampled, **more: Any) -> None:
    """Adds ``terrain`` as a height field."""
    heights, low, high = terrain
    field = field_asset(spec, name, heights - heights.min(), high - low, 1.0)
    spec.worldbody.add_geom(
        name=name, type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname=field,
        pos=[*(0.5 * (low + high)), float(heights.min())], **more,
    )  # fmt: skip


def field_asset(spec: Any, name: str, heights: Array, extent: Array, base_m: float) -> str:
    """Adds the heights (rows, cols) from 0 up over ``extent`` (2,) metres; returns their name."""
    top = max(float(heights.max()), 1e-3)
    field = spec.add_hfield(name=f"{name}_dressed")
    field.nrow, field.ncol = heights.shape
    field.size = [0.5 * extent[0], 0.5 * extent[1], top, base_m]
    # MuJoCo stretches what it reads to [0, 1]: one node of each end keeps the scale.
    unit = (heights / top).astype(np.float32)
    unit[0, 0], unit[-1, -1] = 0.0, 1.0
    field.userdata = unit.ravel()
    return str(field.name)


def quat_of(rotation: Array) -> Array:
    """Quaternion wxyz of a (3, 3) rotation."""
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.ascontiguousarray(rotation).ravel())
    return quat
