"""Woodland: conifers and broad-leaved trees of two geoms each, logs, stumps and undergrowth; their
meshes and textures."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from touchdown.scenes.api import Array, Image, Surface
from touchdown.scenes.authoring.builder import SceneBuilder
from touchdown.scenes.authoring.meshes import MeshData, sphere_grid, wrapped
from touchdown.scenes.authoring.noise import fractal_noise
from touchdown.scenes.authoring.plane import draw_heading, pick, unit_ball, unit_circle
from touchdown.scenes.authoring.textures import (
    TILE_PX,
    Colour,
    foliage,
    hedge_or_soil_tint,
    to_texture,
)
from touchdown.scenes.props.plants import HEDGE, TRUNK


def conifer_mesh(rng: np.random.Generator, height_m: float, radius_m: float) -> MeshData:
    """Returns whorls of drooping branches, each a ragged cone over the next; the foot is at z = 0.
    Texture: around the trunk and from it outwards."""
    whorls = 4 if height_m < 4.0 else 6
    spikes = 7 if height_m < 4.0 else 9
    parts = []
    low = 0.13 * height_m
    for index in range(whorls):
        fraction = index / whorls
        base = low + (height_m - low) * fraction**0.92
        top = min(base + (height_m - low) * (0.42 - 0.10 * fraction), height_m)
        if index == whorls - 1:
            top = height_m
        radius = radius_m * (1.0 - fraction) ** 0.85
        parts.append(_whorl(rng, base, top, radius, spikes))
    return MeshData.join(parts)


def _whorl(
    rng: np.random.Generator, base_m: float, top_m: float, radius_m: float, spikes: int
) -> MeshData:
    """One ragged cone: branch tips and the notches between them alternate around the rim."""
    count = 2 * spikes
    angle = rng.uniform(0.0, 2.0 * np.pi) + np.linspace(0.0, 2.0 * np.pi, count + 1)
    out = np.where(np.arange(count + 1) % 2 == 0, 1.0, 0.60)
    reach = radius_m * out * rng.uniform(0.86, 1.12, count + 1)
    reach[-1] = reach[0]
    droop = np.where(np.arange(count + 1) % 2 == 0, 0.0, 0.16) * (top_m - base_m)
    rim = np.stack([reach * np.cos(angle), reach * np.sin(angle), base_m + droop], axis=-1)
    middle = 0.5 * (angle[:-1] + angle[1:])
    apex = np.tile([0.0, 0.0, top_m], (count, 1))
    under = np.tile([0.0, 0.0, base_m + 0.25 * (top_m - base_m)], (count, 1))
    lean = (top_m - base_m) / radius_m
    outward = np.stack([np.cos(angle), np.sin(angle), np.full(count + 1, 1.0 / max(lean, 0.3))], -1)
    peak = np.stack([np.cos(middle), np.sin(middle), np.full(count, 1.6)], -1)
    down = np.tile([0.0, 0.0, -1.0], (count, 1))
    turns = 3.0 / (2.0 * np.pi)
    edge = np.where(np.arange(count + 1) % 2 == 0, 0.98, 0.62)
    uv = np.concatenate([np.stack([turns * angle, edge], -1),
                        np.stack([turns * middle, np.full(count, 0.06)], -1),
                        np.stack([turns * middle, np.full(count, 0.02)], -1)])  # fmt: skip
    i = np.arange(count)
    upper = np.stack([count + 1 + i, i, i + 1], -1)
    lower = np.stack([2 * count + 1 + i, i + 1, i], -1)
    return MeshData(
        vertices=np.concatenate([rim, apex, under]),
        faces=np.concatenate([upper, lower]).astype(np.int32),
        uv=uv,
        normals=np.concatenate([outward, peak, down]),
    )


def canopy_mesh(
    rng: np.random.Generator, half: Array, rings: int, metres_per_uv: float
) -> MeshData:
    """Returns a crown like a cauliflower: seen from its middle, the farthest wall of a dozen balls
    that lie around it. half: (3,) half axes in metres."""
    unit = sphere_grid(rings)
    reach = np.full(unit.shape[:2], 0.62)
    count = 13
    height = np.linspace(0.95, -0.55, count) + rng.uniform(-0.08, 0.08, count)
    azimuth = 2.4 * np.arange(count) + rng.uniform(-0.4, 0.4, count)
    flat = np.sqrt(np.maximum(1.0 - height**2, 0.0))
    ways = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), height], axis=-1)
    for way in ways:
        centre = rng.uniform(0.50, 0.66) * way
        radius = rng.uniform(0.34, 0.50)
        along = unit @ centre
        inside = along**2 - centre @ centre + radius**2
        reach = np.maximum(reach, np.where(inside > 0.0, along + np.sqrt(np.abs(inside)), 0.0))
    reach *= 1.0 + 0.05 * rng.standard_normal(reach.shape)
    reach[:, -1], reach[0], reach[-1] = reach[:, 0], reach[0, 0], reach[-1, 0]
    return wrapped(rng, unit * reach[..., None] * half, metres_per_uv)


def lathe(rng: np.random.Generator, profile: Array, sides: int, wobble: float) -> MeshData:
    """Bark turned about +z through ``profile``, (K, 2) heights and radii, with sawn ends; each side
    is off by up to ``wobble`` (fraction of the radius)."""
    angle = np.linspace(0.0, 2.0 * np.pi, sides + 1)
    rough = 1.0 + rng.uniform(-wobble, wobble, sides + 1)
    rough[-1] = rough[0]
    ring = np.stack([np.cos(angle) * rough, np.sin(angle) * rough], axis=-1)
    levels = len(profile)
    wall = np.concatenate([np.column_stack([r * ring, np.full(sides + 1, z)]) for z, r in profile])
    out = np.tile(np.column_stack([ring, np.zeros(sides + 1)]), (levels, 1))
    around = np.tile(np.linspace(0.0, 1.0, sides + 1), levels)
    along = np.repeat(0.7 * (profile[:, 0] - profile[0, 0]) / np.ptp(profile[:, 0]), sides + 1)
    index = np.arange(levels * (sides + 1)).reshape(levels, sides + 1)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = [np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)]
    parts = [MeshData(vertices=wall, faces=np.concatenate(faces).astype(np.int32),
                      uv=np.column_stack([around, along]), normals=out)]  # fmt: skip
    for (z, r), way in ((profile[0], -1.0), (profile[-1], 1.0)):
        loop = ring[:-1][:: int(way)]
        points = np.column_stack([r * loop, np.full(sides, z)])
        uv = np.column_stack([0.5 + 0.45 * loop[:, 0], 0.87 + 0.11 * loop[:, 1]])
        fan = [[0, i, i + 1] for i in range(1, sides - 1)]
        parts.append(MeshData(vertices=points, faces=np.array(fan, np.int32), uv=uv,
                              normals=np.tile([0.0, 0.0, way], (sides, 1))))  # fmt: skip
    return MeshData.join(parts)


def needles(rng: np.random.Generator, base: Colour) -> Image:
    """(512, 512, 3), periodic to the right: sprays that hang outwards from the dark inside (top) to
    the young tips (bottom). base: RGB 0..255."""
    size = TILE_PX
    depth = np.linspace(0.0, 1.0, size, dtype=np.float32)[:, None, None]
    image = np.array(base, np.float32) * (0.34 + 0.30 * depth) * np.ones((1, size, 1), np.float32)
    count = 1500
    tops = np.sort(rng.uniform(-30.0, size, count))
    lefts = rng.uniform(0.0, size, count)
    lengths, leans = rng.uniform(24.0, 70.0, count), rng.normal(0.0, 0.35, count)
    tones, hues = rng.normal(0.0, 0.13, count), rng.normal(0.0, 0.06, (count, 3))
    widths = rng.integers(2, 6, count)
    for i in range(count):
        fraction = (tops[i] + lengths[i]) / size
        tone = (0.48 + 0.75 * np.clip(fraction, 0.0, 1.0)) * (1.0 + tones[i])
        colour = (np.array(base) * tone * (1.0 + hues[i]) + [4.0, 6.0, 0.0]).tolist()
        for shift in (-size, 0, size):
            x = lefts[i] + shift
            first = (round(x), round(tops[i]))
            last = (round(x + leans[i] * lengths[i]), round(tops[i] + lengths[i]))
            cv2.line(image, first, last, colour, int(widths[i]), cv2.LINE_AA)
    return to_texture(image)


def bark(rng: np.random.Generator, base: Colour) -> Image:
    """(256, 256, 3): furrowed bark above, and in the lowest quarter a sawn face with its rings.
    base: RGB 0..255."""
    size = 256
    furrows = cv2.blur(fractal_noise(rng, (size, size), 9.0, 3, 0.7), (1, 13))
    tone = 1.0 + 0.32 * furrows + 0.06 * rng.standard_normal((size, size), dtype=np.float32)
    image = tone[..., None] * np.array(base, np.float32)
    rows, cols = np.mgrid[0:size, 0:size].astype(np.float32) / size
    radius = np.hypot((cols - 0.5) / 0.45, (rows - 0.87) / 0.11)
    rings = 1.0 + 0.10 * np.sin(34.0 * radius) - 0.18 * np.exp(-((radius / 0.12) ** 2))
    face = rings[..., None] * np.array([206.0, 172.0, 122.0], np.float32)
    return to_texture(np.where((rows > 0.74)[..., None], face, image).astype(np.float32))


CONIFER = Surface(land_class="trees", reflectivity=0.38, porosity=0.28, spread=0.25)
BROADLEAF = Surface(land_class="trees", reflectivity=0.47, porosity=0.38, spread=0.25)
LOG = Surface(land_class="other", reflectivity=0.34)
NEEDLES: tuple[Colour, ...] = ((58.0, 86.0, 52.0), (44.0, 72.0, 48.0), (84.0, 100.0, 54.0))
SUMMER: tuple[Colour, ...] = ((96.0, 130.0, 56.0), (74.0, 110.0, 52.0), (118.0, 136.0, 58.0),
              (86.0, 118.0, 70.0))  # fmt: skip
AUTUMN: tuple[Colour, ...] = ((176.0, 136.0, 48.0), (108.0, 124.0, 52.0), (168.0, 98.0, 46.0),
              (140.0, 132.0, 56.0))  # fmt: skip
TRUNKS_M = (2.6, 3.4, 4.2)
CROWN_RADII_M = (2.3, 3.0, 3.8, 4.6)


@dataclass(frozen=True, kw_only=True, slots=True)
class Crown:
    """A shared crown mesh whose origin is the foot of its tree (conifers) or the
    crown's middle (broad-leaved)."""

    mesh: str
    radius_m: float
    height_m: float


@dataclass(kw_only=True, slots=True)
class Wood:
    """Materials and meshes that all woodland plants of a scene share."""

    needles: list[str] = field(default_factory=list)
    leaves: list[str] = field(default_factory=list)
    conifers: list[Crown] = field(default_factory=list)
    saplings: list[Crown] = field(default_factory=list)
    crowns: list[Crown] = field(default_factory=list)
    shrubs: list[Crown] = field(default_factory=list)
    bark: str = ""
    birch: str = ""
    trunks: dict[str, str] = field(default_factory=dict)
    """trunk mesh by the crown mesh of a conifer"""
    stumps: list[Crown] = field(default_factory=list)


def grow_wood(builder: SceneBuilder) -> Wood:
    """Adds the shared materials and meshes; the seed decides on the season."""
    rng = builder.rng
    wood = Wood()
    for index, base in enumerate(NEEDLES):
        tint = hedge_or_soil_tint(rng, base, 0.08)
        wood.needles.append(builder.material(f"trees_needles_{index}", needles(rng, tint)))
    palette = AUTUMN if rng.random() < 0.35 else SUMMER
    for index, base in enumerate(palette):
        tint = hedge_or_soil_tint(rng, base, 0.10)
        wood.leaves.append(builder.material(f"trees_leaf_{index}", foliage(rng, tint, (8, 19))))
    wood.bark = builder.material("wood_bark", bark(rng, (104.0, 84.0, 66.0)))
    wood.birch = builder.material("wood_birch", bark(rng, (206.0, 202.0, 192.0)))
    grow_conifers(builder, wood, (6.5, 8.5, 10.0, 11.5, 13.0), (1.6, 2.6), (0.21, 0.25))
    for length in TRUNKS_M:
        top = (length + 1.8, 0.12)
        _trunk(builder, trunk_name(length), 0.24, top)
    for index, radius in enumerate(CROWN_RADII_M):
        half = radius * np.array([1.0, 1.0, rng.uniform(0.68, 0.85)])
        mesh = builder.mesh(f"canopy_{index}", canopy_mesh(rng, half, 10, 2.6))
        wood.crowns.append(Crown(mesh=mesh, radius_m=radius, height_m=float(half[2])))
    grow_shrubs(builder, wood, (0.55, 0.8, 1.1), 0.8, 1.8)
    grow_stumps(builder, wood)
    return wood


def grow_stumps(builder: SceneBuilder, wood: Wood) -> None:
    """Adds stumps of three sizes."""
    for index, (radius, height) in enumerate(((0.16, 0.24), (0.22, 0.34), (0.30, 0.42))):
        profile = np.array([[-0.35, 1.5 * radius], [0.04, 1.35 * radius], [0.14, 1.05 * radius],
                           [height, radius]])  # fmt: skip
        mesh = builder.mesh(f"stump_{index}", lathe(builder.rng, profile, 11, 0.07))
        wood.stumps.append(Crown(mesh=mesh, radius_m=radius, height_m=height))


def grow_conifers(
    builder: SceneBuilder,
    wood: Wood,
    heights_m: Sequence[float],
    young_m: Sequence[float],
    slender: tuple[float, float],
) -> None:
    """Adds conifers and saplings of these heights, and trunks for the conifers. slender: bounds of
    a crown's radius over its height."""
    rng = builder.rng
    for prefix, heights, kept in (
        ("conifer", heights_m, wood.conifers), ("sapling", young_m, wood.saplings)
    ):  # fmt: skip
        for index, height in enumerate(heights):
            radius = height * rng.uniform(*slender) + 0.45
            mesh = builder.mesh(f"{prefix}_{index}", conifer_mesh(rng, height, radius))
            kept.append(Crown(mesh=mesh, radius_m=radius, height_m=height))
    for index, crown in enumerate(wood.conifers):
        top = (0.6 * crown.height_m, 0.03 + 0.008 * crown.height_m)
        radius = 0.06 + 0.013 * crown.height_m
        wood.trunks[crown.mesh] = _trunk(builder, f"conifer_trunk_{index}", radius, top)


def grow_shrubs(
    builder: SceneBuilder, wood: Wood, radii_m: Sequence[float], flat: float, metres_per_uv: float
) -> None:
    """Adds shrubs; flat: height over width."""
    for index, radius in enumerate(radii_m):
        half = radius * np.array([1.0, builder.rng.uniform(0.8, 1.1), flat])
        mesh = builder.mesh(f"shrub_{index}", canopy_mesh(builder.rng, half, 8, metres_per_uv))
        wood.shrubs.append(Crown(mesh=mesh, radius_m=radius, height_m=float(half[2])))


def trunk_name(bare_m: float) -> str:
    """Mesh name of the trunk of a broad-leaved tree that is bare up to ``bare_m``."""
    return f"trunk_{round(10.0 * bare_m)}"


def _trunk(builder: SceneBuilder, name: str, radius_m: float, top: tuple[float, float]) -> str:
    """A trunk mesh from below the ground to ``top`` (height, radius)."""
    profile = np.array([[-0.7, 1.3 * radius_m], [0.25, radius_m], [*top]])
    return builder.mesh(name, lathe(builder.rng, profile, 7, 0.06))


def _add_trunk(builder: SceneBuilder, mesh: str, material: str, foot: Array) -> None:
    builder.geom("trees_trunk", TRUNK, mesh=mesh, material=material, pos=foot,
                 heading=draw_heading(builder.rng))  # fmt: skip


def add_conifer(builder: SceneBuilder, wood: Wood, xy_m: Array, crown: Crown, needles: str) -> None:
    """Adds a spruce or pine: trunk and crown."""
    rng = builder.rng
    foot = builder.on_ground(xy_m)
    _add_trunk(builder, wood.trunks[crown.mesh], wood.bark, foot)
    _add_cone(builder, "trees_conifer", crown, needles, foot, draw_heading(rng))


def add_sapling(builder: SceneBuilder, wood: Wood, xy_m: Array) -> None:
    """Adds a young conifer, branched down to the ground."""
    rng = builder.rng
    crown = pick(rng, wood.saplings)
    needles = pick(rng, wood.needles)
    foot = builder.on_ground(xy_m)
    _add_cone(builder, "trees_sapling", crown, needles, foot, draw_heading(rng))


def _add_cone(
    builder: SceneBuilder, stem: str, crown: Crown, needles: str, foot: Array, turn: float
) -> None:
    builder.geom(stem, CONIFER, mesh=crown.mesh, material=needles, pos=foot, heading=turn)
    low = 0.14 * crown.height_m
    rim = np.column_stack([0.85 * crown.radius_m * _RING, np.full(len(_RING), low)])
    builder.cast(
        np.concatenate([foot + rim, foot[None] + [0.0, 0.0, crown.height_m]]),
        1.0 - CONIFER.porosity,
    )


def add_broadleaf(
    builder: SceneBuilder, wood: Wood, xy_m: Array, crown: Crown, leaf: str, trunk_m: float
) -> None:
    """Adds an oak, beech or birch; ``trunk_m``: bare trunk below the crown, one of `TRUNKS_M`."""
    rng = builder.rng
    z = builder.terrain.point(*xy_m)
    material = wood.birch if rng.random() < 0.25 else wood.bark
    _add_trunk(builder, trunk_name(trunk_m), material, np.array([*xy_m, z]))
    at = np.array([*xy_m, z + trunk_m + 0.9 * crown.height_m])
    turn = draw_heading(rng)
    builder.geom("trees_crown", BROADLEAF, mesh=crown.mesh, material=leaf, pos=at, heading=turn)
    half = np.array([crown.radius_m, crown.radius_m, crown.height_m])
    builder.cast(at + half * _BALL, 1.0 - BROADLEAF.porosity)


def add_shrub(builder: SceneBuilder, wood: Wood, xy_m: Array) -> None:
    """Adds undergrowth: hazel, bramble, juniper."""
    rng = builder.rng
    crown = pick(rng, wood.shrubs)
    leaf = pick(rng, wood.leaves)
    at = builder.on_ground(xy_m, 0.55 * crown.height_m)
    builder.geom("trees_shrub", HEDGE, mesh=crown.mesh, material=leaf, pos=at,
                 heading=draw_heading(rng))  # fmt: skip
    builder.cast(at + np.array([crown.radius_m, crown.radius_m, crown.height_m]) * _BALL, 0.9)


def add_stump(builder: SceneBuilder, wood: Wood, xy_m: Array) -> None:
    """Adds a stump, 0.24 to 0.42 m high, with roots."""
    rng = builder.rng
    stump = pick(rng, wood.stumps)
    at = builder.on_ground(xy_m)
    builder.geom("stump", LOG, mesh=stump.mesh, material=wood.bark, pos=at,
                 heading=draw_heading(rng))  # fmt: skip
    rim = np.column_stack([stump.radius_m * _RING, np.zeros(len(_RING))])
    builder.cast(np.concatenate([at + rim, at + rim + [0.0, 0.0, stump.height_m]]))
    builder.claim(xy_m, 0.5)


def add_log(
    builder: SceneBuilder, wood: Wood, start_xy_m: Array, end_xy_m: Array, radius_m: float
) -> None:
    """Adds a trunk on the ground; it rests on its ends and on high ground between them."""
    rng = builder.rng
    span = end_xy_m - start_xy_m
    length = float(np.hypot(*span))
    fraction = np.linspace(0.0, 1.0, 9)
    ground = builder.terrain.at(start_xy_m + fraction[:, None] * span)
    first, last = float(ground[0]), float(ground[-1])
    lift = max(0.0, 0.6 * float((ground - (first + fraction * (last - first))).max()))
    start = np.array([*start_xy_m, first + lift + 0.75 * radius_m])
    end = np.array([*end_xy_m, last + lift + 0.55 * radius_m])
    profile = np.array([[0.0, 1.25 * radius_m], [0.06 * length, radius_m],
                        [0.5 * length, 0.85 * radius_m], [length, 0.6 * radius_m]])  # fmt: skip
    mesh = builder.mesh(builder.unique("log"), lathe(rng, profile, 10, 0.05))
    builder.geom("log", LOG, mesh=mesh, material=wood.bark, pos=start,
                 quat=quat_of_axis(end - start))  # fmt: skip
    across = np.array([-span[1], span[0], 0.0]) / length
    square = [x * across + [0.0, 0.0, z] for x in (-1.0, 1.0) for z in (-1.0, 1.0)]
    builder.cast(np.array([e + radius_m * s for e in (start, end) for s in square]))
    for at in np.linspace(0.0, 1.0, max(2, int(length / 1.2))):
        builder.claim(start_xy_m + at * span, 0.7)


def quat_of_axis(axis: Array) -> list[float]:
    """Quaternion wxyz of the shortest turn from +z to ``axis`` (3,), which does not point down."""
    unit = axis / np.linalg.norm(axis)
    quat = np.array([1.0 + unit[2], -unit[1], unit[0], 0.0])
    return [float(v) for v in quat / np.linalg.norm(quat)]


_RING = unit_circle(12)
_BALL = unit_ball(6, 8)
