"""Dresses featureless ground of a file: the look of real ground, and relief of centimetres.

A level plane, box or mesh of one colour or a regular pattern becomes a height field of the same
outline with a texture of its own. Its surface lies up to `RELIEF_M` below the one in the file, so
that thin things on it stay seen. A height field keeps its heights and gets the texture alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple
from zlib import crc32

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.authoring.builder import RGB_ROLE, add_texture
from touchdown.scenes.authoring.ground import Canvas, Ground, shade_ground
from touchdown.scenes.authoring.noise import fractal_noise
from touchdown.scenes.importers.above import flat_top, from_above

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]
Image = NDArray[np.uint8]

RELIEF_M = 0.06
"""Greatest depth of the relief; its standard deviation is a fifth of that."""
TEXEL_M = 0.03
LEAST_M2 = 25.0
"""Smaller surfaces stay as they are."""
MOST = 12
"""geoms, the largest first"""
_WAVES_M = 9.0
_NODE_M = 0.4
_MESH_NODE_M = 0.25
_MOST_NODES, _MOST_TEXELS = 801, 5120
"""along a side of one; the texels of all textures together are no more than a square of these"""
_BACKDROP_M = 0.3
"""Depth of what is seen of an endless plane beyond the part that is dressed"""
_THIN_M = 0.15
"""Half the height of a box that is no ground but lies on some"""
_UNTINTED = (0.5, 0.5, 0.5, 1.0)
"""MuJoCo's default, in place of which a material's own colour counts"""
_HOLE_M = 3.0
_BEHIND_M = 0.1
"""half of the thickness of what collides of a plane that ends"""
_ENDLESS_M = 1000.0
"""half width of a plane along an axis on which it has no end"""
_MOST_HOLES = 0.2
_BLOTS_M = (11.0, 5.0)

MATERIALS: dict[str, tuple[Ground, ...]] = {
    "lawn": (Ground.LAWN, Ground.MEADOW, Ground.LAWN),
    "field": (Ground.SOIL, Ground.CROPS, Ground.MUD),
    "path": (Ground.DECK, Ground.PAVEMENT, Ground.DECK),
    "road": (Ground.ASPHALT, Ground.NEW_ASPHALT, Ground.CAR_PARK),
}
"""Of a class: what most of it is painted as, and what patches of it are."""


class Chosen(NamedTuple):
    """How a geom is to be dressed."""

    land_class: str
    share: float
    """of the texels that all have together"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Dressed:
    """What was done to a geom."""

    name: str
    land_class: str
    relief: bool


def dress(
    spec: Any, model: Any, data: Any, chosen: dict[int, Chosen], bounds_xy_m: Array
) -> list[Dressed]:
    """Dresses the geoms ``chosen`` of ``spec``, whose geoms all have names, as
    far as they lie in [[x_min, y_min], [x_max, y_max]]. ``model`` and ``data`` are its compiled
    form. The same file gives the same bytes."""
    done = []
    for geom, look in chosen.items():
        if look.land_class not in MATERIALS:
            continue
        name, kind = model.geom(geom).name, int(model.geom_type[geom])
        relief = True
        if kind == int(mujoco.mjtGeom.mjGEOM_HFIELD):
            size = 2.0 * model.hfield_size[model.geom_dataid[geom]][:2]
            own = spec.geom(name)
            own.material, own.rgba = _material(spec, name, look, size), _UNTINTED
            relief = False
        elif flat_top(model, data, geom):
            if kind == int(mujoco.mjtGeom.mjGEOM_BOX) and model.geom_size[geom, 2] < _THIN_M:
                continue
            if not _replace_flat(spec, model, data, geom, look, bounds_xy_m):
                continue
        elif not _replace_mesh(spec, model, data, geom, look, bounds_xy_m):
            continue
        done.append(Dressed(name=name, land_class=look.land_class, relief=relief))
    return done


def touchable(spec: Any, model: Any, data: Any, geom: int, bounds_xy_m: Array) -> bool:
    """Gives a ground mesh the surface that is seen of it to stand on, an unseen height field,
    instead of its convex hull. False where the mesh is full of holes."""
    terrain = _sampled(model, data, geom, bounds_xy_m)
    if terrain is None:
        return False
    heights, low, high = terrain
    name = model.geom(geom).name
    own = spec.geom(name)
    own.contype = own.conaffinity = 0
    _field(spec, f"{name}_touched", heights, low, high, group=3)
    return True


def bounded(spec: Any, model: Any, data: Any, geom: int) -> None:
    """Makes a plane collide only where it is drawn, by an unseen box behind it."""
    name, size = model.geom(geom).name, model.geom_size[geom]
    width, height = np.where(size[:2] > 0.0, size[:2], _ENDLESS_M)
    rotation = data.geom_xmat[geom].reshape(3, 3)
    own = spec.geom(name)
    own.contype = own.conaffinity = 0
    spec.worldbody.add_geom(
        name=f"{name}_touched", type=mujoco.mjtGeom.mjGEOM_BOX, group=3,
        size=[width, height, _BEHIND_M],
        pos=data.geom_xpos[geom] - _BEHIND_M * rotation[:, 2], quat=_quat(rotation),
    )  # fmt: skip


def _replace_flat(
    spec: Any, model: Any, data: Any, geom: int, look: Chosen, bounds_xy_m: Array
) -> bool:
    """Puts a height field in place of a plane or box. False where less than a metre of it lies
    within the bounds."""
    name, size = model.geom(geom).name, model.geom_size[geom].copy()
    rotation, centre = data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom].copy()
    plane = int(model.geom_type[geom]) == int(mujoco.mjtGeom.mjGEOM_PLANE)
    half = np.where(size[:2] > 0.0, size[:2], np.inf)
    corners = np.array([[x, y] for x in bounds_xy_m[:, 0] for y in bounds_xy_m[:, 1]])
    local = (corners - centre[:2]) @ rotation[:2, :2]
    low, high = np.maximum(local.min(axis=0), -half), np.minimum(local.max(axis=0), half)
    if (high - low < 1.0).any():
        return False
    beyond = plane and (half > np.maximum(np.abs(low), np.abs(high)) + 1.0).any()
    middle, extent = 0.5 * (low + high), high - low
    top = 0.0 if plane else float(size[2])
    nodes = np.clip(np.ceil(extent / _NODE_M).astype(int) + 1, 2, _MOST_NODES)
    heights = -RELIEF_M * _relief(name, (int(nodes[1]), int(nodes[0])), extent)
    touches = bool(model.geom_contype[geom] or model.geom_conaffinity[geom])
    spec.delete(spec.geom(name))
    base = 2.0 if plane else max(2.0 * top - RELIEF_M, 0.05)
    offset = np.array([*middle, top - RELIEF_M])
    field = _field_asset(spec, name, heights + RELIEF_M, extent, base)
    spec.worldbody.add_geom(
        name=name, type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname=field,
        pos=centre + rotation @ offset, quat=_quat(rotation),
        material=_material(spec, name, look, extent),
        contype=int(touches), conaffinity=int(touches),
    )  # fmt: skip
    if beyond:
        spec.worldbody.add_geom(
            name=f"{look.land_class}_beyond_{name}", type=mujoco.mjtGeom.mjGEOM_PLANE, size=size,
            pos=centre - _BACKDROP_M * rotation[:, 2], quat=_quat(rotation),
            material=_tiled(spec, name, extent), contype=0, conaffinity=0,
        )  # fmt: skip
    return True


def _replace_mesh(
    spec: Any, model: Any, data: Any, geom: int, look: Chosen, bounds_xy_m: Array
) -> bool:
    """Puts a height field in place of a mesh or another shape. False where it is full of holes."""
    terrain = _sampled(model, data, geom, bounds_xy_m)
    if terrain is None:
        return False
    heights, low, high = terrain
    name = model.geom(geom).name
    spec.delete(spec.geom(name))
    material = _material(spec, name, look, high - low)
    _field(spec, name, heights, low, high, material=material)
    return True


def _sampled(
    model: Any, data: Any, geom: int, bounds_xy_m: Array
) -> tuple[Array, Array, Array] | None:
    """Heights (rows, cols) of one geom at nodes over its part of the bounds, and the corners of
    that part; holes lie below all else. None where a fifth is holes."""
    box = model.geom_aabb[geom]
    rotation = data.geom_xmat[geom].reshape(3, 3)
    middle = rotation @ box[:3] + data.geom_xpos[geom]
    reach = np.abs(rotation) @ box[3:]
    low = np.maximum(middle[:2] - reach[:2], bounds_xy_m[0])
    high = np.minimum(middle[:2] + reach[:2], bounds_xy_m[1])
    if (high - low < 2.0).any():
        return None
    step = max(_MESH_NODE_M, float((high - low).max()) / (_MOST_NODES - 1))
    # Rays go through nodes, a hair inside of the rim.
    inner = np.stack([low - 0.5 * step + 1e-3, high + 0.5 * step - 1e-3])
    count = np.maximum(np.round((high - low) / step).astype(int) + 1, 3)
    step = float(((high - low - 2e-3) / (count - 1)).max())
    inner[1] = inner[0] + step * count
    seen = from_above(model, data, inner, step, only=geom)
    holes = np.isnan(seen.height_m)
    if holes.mean() > _MOST_HOLES:
        return None
    heights = np.where(holes, np.nanmin(seen.height_m) - _HOLE_M * holes.any(), seen.height_m)
    first = seen.centres()[0, 0]
    return heights, first, first + step * (np.array(heights.shape)[::-1] - 1)


def _field(
    spec: Any, name: str, heights: Array, low: Array, high: Array, *, group: int = 0, **more: Any
) -> None:
    """Adds a height field of world heights between two corners."""
    field = _field_asset(spec, name, heights - heights.min(), high - low, 1.0)
    spec.worldbody.add_geom(
        name=name, type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname=field, group=group,
        pos=[*(0.5 * (low + high)), float(heights.min())], **more,
    )  # fmt: skip


def _field_asset(spec: Any, name: str, heights: Array, extent: Array, base_m: float) -> str:
    top = max(float(heights.max()), 1e-3)
    field = spec.add_hfield(name=f"{name}_dressed")
    field.nrow, field.ncol = heights.shape
    field.size = [0.5 * extent[0], 0.5 * extent[1], top, base_m]
    # MuJoCo stretches what it reads to [0, 1]: one node of each end keeps the scale.
    unit = (heights / top).astype(np.float32)
    unit[0, 0], unit[-1, -1] = 0.0, 1.0
    field.userdata = unit.ravel()
    return str(field.name)


def _relief(name: str, shape: tuple[int, int], extent: Array) -> Array:
    """(rows, cols) depths in shares of `RELIEF_M`, 0 to 1."""
    rng = np.random.default_rng([crc32(b"scenes.dress"), crc32(name.encode())])
    waves = max(_WAVES_M * shape[1] / float(extent[0]), 2.0)
    noise = fractal_noise(rng, shape, waves, 4, 0.6)
    return np.clip(0.5 + 0.2 * noise, 0.0, 1.0).astype(np.float64)


def _material(spec: Any, name: str, look: Chosen, extent: Array) -> str:
    """Adds a material that lies once over a level rectangle of ``extent`` (2,) metres."""
    add_texture(spec, f"{name}_dressed", painted(name, look, extent))
    return _textured(spec, f"{name}_dressed", f"{name}_dressed", texuniform=False)


def _tiled(spec: Any, name: str, extent: Array) -> str:
    repeat = [1.0 / float(extent[0]), 1.0 / float(extent[1])]
    return _textured(
        spec, f"{name}_tiled", f"{name}_dressed", texuniform=True, texrepeat=repeat
    )  # fmt: skip


def _textured(spec: Any, name: str, texture: str, **more: Any) -> str:
    material = spec.add_material(name=name, specular=0.0, shininess=0.0, **more)
    textures = list(material.textures)
    textures[RGB_ROLE] = texture
    material.textures = textures
    return name


def painted(name: str, look: Chosen, extent: Array) -> Image:
    """(rows, cols, 3): ground of a class over ``extent`` (2,) metres, top row first, in patches of
    three materials."""
    rng = np.random.default_rng([crc32(b"scenes.dress.colour"), crc32(name.encode())])
    side = float(extent.max())
    most = max(_MOST_TEXELS * float(np.sqrt(look.share)), 256.0)
    texels = int(np.clip(round(side / TEXEL_M), 256, most)) // 4 * 4
    canvas = Canvas.of_size(0.5 * side, texels)
    few = texels // 4
    main, *others = MATERIALS[look.land_class]
    layer = np.full((few, few), int(main), np.uint8)
    for material, blot_m in zip(others, _BLOTS_M, strict=True):
        blots = fractal_noise(rng, (few, few), blot_m * few / side, 4, 0.6)
        layer[blots > 1.0] = int(material)
    canvas.material[:] = cv2.resize(layer, (texels, texels), interpolation=cv2.INTER_NEAREST)
    light: Float32 = np.full((64, 64), 1.0, np.float32)
    image = shade_ground(rng, canvas, light, {})
    cols, rows = np.maximum(np.round(extent / side * texels).astype(int), 1)
    return np.ascontiguousarray(image[texels - rows :, :cols])


def _quat(rotation: Array) -> Array:
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.ascontiguousarray(rotation).ravel())
    return quat
