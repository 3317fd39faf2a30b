"""What the vehicle touches and what its sensors see of the ground of a file.

Meshes are touched where they are seen, not at their convex hull, and planes only where they are
drawn. Featureless ground, a level plane, box or mesh of one colour or a regular pattern, becomes a
height field of the same outline with a texture of its own. Its surface lies up to `RELIEF_M` below
the one in the file, so that thin things on it stay seen. A height field keeps its heights and gets
the texture alone.
"""

from collections.abc import Container
from typing import Any, NamedTuple
from zlib import crc32

import cv2
import mujoco
import numpy as np

from touchdown.scenes.api import Array, Float32, Image, Surface
from touchdown.scenes.authoring.builder import add_material, add_texture
from touchdown.scenes.authoring.ground import Canvas, Ground, shade_ground
from touchdown.scenes.authoring.noise import fractal_noise
from touchdown.scenes.importers.classes import look_of
from touchdown.scenes.importers.top_view import Place, grounds, largest, top_view
from touchdown.sim.geometry.tessellation import FIRST_HIDDEN_GROUP

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
            add_field(spec, f"{own.name}_touched", terrain, group=FIRST_HIDDEN_GROUP)


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
                name=f"{name}_touched", type=mujoco.mjtGeom.mjGEOM_BOX, group=FIRST_HIDDEN_GROUP,
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


RELIEF_M = 0.06
"""Greatest depth of the relief; its standard deviation is a fifth of that."""
TEXEL_M = 0.03
_MAX_GEOMS = 12
"""the largest first"""
_WAVES_M = 9.0
_RELIEF_NODE_M = 0.4
_MAX_TEXELS = 5120
"""along a side; the texels of all textures together are no more than a square of these"""
_BACKDROP_M = 0.3
"""Depth of what is seen of an endless plane beyond the part that is textured"""
_THIN_M = 0.15
"""Half the height of a box that is no ground but lies on some"""
_UNTINTED = (0.5, 0.5, 0.5, 1.0)
"""MuJoCo's default, in place of which a material's own colour counts"""
_BLOTS_M = (11.0, 5.0)
_UPRIGHT = np.cos(np.deg2rad(1.0))

MATERIALS: dict[str, tuple[Ground, ...]] = {
    "lawn": (Ground.LAWN, Ground.MEADOW, Ground.LAWN),
    "field": (Ground.SOIL, Ground.CROPS, Ground.MUD),
    "path": (Ground.DECK, Ground.PAVEMENT, Ground.DECK),
    "road": (Ground.ASPHALT, Ground.NEW_ASPHALT, Ground.CAR_PARK),
}
"""Of a class: what most of it is painted as, and what patches of it are."""


class Look(NamedTuple):
    """How a geom is to be textured."""

    land_class: str
    fraction: float
    """of the texels that all have together"""


def featureless_ground(place: Place, surfaces: dict[str, Surface]) -> dict[int, Look]:
    """Ground without features, the widest first."""
    area = place.seen_m2()
    found: dict[int, str] = {}
    for geom in np.argsort(-area, kind="stable").tolist():
        if area[geom] < MIN_AREA_M2 or len(found) == _MAX_GEOMS:
            break
        land_class = surfaces[place.name(geom)].land_class
        if land_class in MATERIALS and look_of(place.model, geom).plain:
            found[geom] = land_class
    whole = sum(area[geom] for geom in found)
    return {geom: Look(kind, float(area[geom] / whole)) for geom, kind in found.items()}


def texture_ground(spec: Any, place: Place, looks: dict[int, Look]) -> dict[str, str]:
    """Textures geoms of ``spec``, whose geoms all have names, within the bounds of ``place``, its
    compiled form. Returns the class of each that was textured, by name. The same file gives the
    same bytes."""
    done = {}
    for geom, look in looks.items():
        name = place.name(geom)
        if place.is_kind(geom, "HFIELD"):
            size = 2.0 * place.model.hfield_size[place.model.geom_dataid[geom]][:2]
            own = spec.geom(name)
            own.material, own.rgba = _material(spec, name, look, size), _UNTINTED
        elif not _replace(spec, place, geom, look):
            continue
        done[name] = look.land_class
    return done


def _replace(spec: Any, place: Place, geom: int, look: Look) -> bool:
    """Puts a height field in place of a geom. False where the geom stays."""
    if place.rotation(geom)[2, 2] > _UPRIGHT and place.is_kind(geom, "PLANE", "BOX"):
        thin = place.is_kind(geom, "BOX") and place.model.geom_size[geom, 2] < _THIN_M
        return not thin and _replace_flat(spec, place, geom, look)
    return _replace_shape(spec, place, geom, look)


def _replace_flat(spec: Any, place: Place, geom: int, look: Look) -> bool:
    """Puts a height field in place of a plane or box. False where less than a metre of it lies
    within the bounds."""
    name, size = place.name(geom), place.model.geom_size[geom].copy()
    rotation, centre = place.rotation(geom), place.data.geom_xpos[geom].copy()
    plane = place.is_kind(geom, "PLANE")
    half = np.where(size[:2] > 0.0, size[:2], np.inf)
    x, y = place.bounds_xy_m.T
    corners = np.array([[a, b] for a in x for b in y])
    local = (corners - centre[:2]) @ rotation[:2, :2]
    low, high = np.maximum(local.min(axis=0), -half), np.minimum(local.max(axis=0), half)
    if (high - low < 1.0).any():
        return False
    beyond = plane and (half > np.maximum(np.abs(low), np.abs(high)) + 1.0).any()
    middle, extent = 0.5 * (low + high), high - low
    top = 0.0 if plane else float(size[2])
    nodes = np.clip(np.ceil(extent / _RELIEF_NODE_M).astype(int) + 1, 2, MAX_NODES)
    heights = -RELIEF_M * _relief(name, (int(nodes[1]), int(nodes[0])), extent)
    touches = int(place.collides(geom))
    spec.delete(spec.geom(name))
    base = 2.0 if plane else max(2.0 * top - RELIEF_M, 0.05)
    offset = np.array([*middle, top - RELIEF_M])
    field = field_asset(spec, name, heights + RELIEF_M, extent, base)
    spec.worldbody.add_geom(
        name=name, type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname=field,
        pos=centre + rotation @ offset, quat=quat_of(rotation),
        material=_material(spec, name, look, extent), contype=touches, conaffinity=touches,
    )  # fmt: skip
    if beyond:
        tiled = add_material(
            spec, f"{name}_tiled", f"{name}_dressed", texuniform=True, texrepeat=1.0 / extent
        )
        spec.worldbody.add_geom(
            name=f"{look.land_class}_beyond_{name}", type=mujoco.mjtGeom.mjGEOM_PLANE, size=size,
            pos=centre - _BACKDROP_M * rotation[:, 2], quat=quat_of(rotation), material=tiled,
            contype=0, conaffinity=0,
        )  # fmt: skip
    return True


def _replace_shape(spec: Any, place: Place, geom: int, look: Look) -> bool:
    """Puts a height field in place of a mesh or another shape. False where it is full of holes."""
    terrain = sampled(place, geom)
    if terrain is None:
        return False
    name = place.name(geom)
    spec.delete(spec.geom(name))
    material = _material(spec, name, look, terrain.high_xy_m - terrain.low_xy_m)
    add_field(spec, name, terrain, material=material)
    return True


def _relief(name: str, shape: tuple[int, int], extent: Array) -> Array:
    """(rows, cols) depths in fractions of `RELIEF_M`, 0 to 1."""
    rng = np.random.default_rng([crc32(b"scenes.dress"), crc32(name.encode())])
    waves = max(_WAVES_M * shape[1] / float(extent[0]), 2.0)
    noise = fractal_noise(rng, shape, waves, 4, 0.6)
    return np.clip(0.5 + 0.2 * noise, 0.0, 1.0).astype(np.float64)


def _material(spec: Any, name: str, look: Look, extent: Array) -> str:
    """Adds a material that lies once over a level rectangle of ``extent`` (2,) metres."""
    add_texture(spec, f"{name}_dressed", painted(name, look, extent))
    return add_material(spec, f"{name}_dressed", f"{name}_dressed")


def painted(name: str, look: Look, extent: Array) -> Image:
    """(rows, cols, 3): ground of a class over ``extent`` (2,) metres, top row first, in patches of
    three materials."""
    rng = np.random.default_rng([crc32(b"scenes.dress.colour"), crc32(name.encode())])
    side = float(extent.max())
    maximum = max(_MAX_TEXELS * float(np.sqrt(look.fraction)), 256.0)
    texels = int(np.clip(round(side / TEXEL_M), 256, maximum)) // 4 * 4
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
