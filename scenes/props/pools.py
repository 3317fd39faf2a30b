"""Swimming pools and their furniture."""

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from touchdown.scenes.api import Array, Image, Surface
from touchdown.scenes.authoring.builder import SceneBuilder, turned
from touchdown.scenes.authoring.meshes import MeshData, box, plate, polygon
from touchdown.scenes.authoring.noise import fractal_noise, tileable_noise
from touchdown.scenes.authoring.plane import pick, unit
from touchdown.scenes.authoring.plots import Plot
from touchdown.scenes.authoring.streets import KERB
from touchdown.scenes.authoring.textures import to_texture
from touchdown.scenes.props.garden import CLOTH, drum
from touchdown.scenes.props.street import WOOD, add_post

WATER = Surface(land_class="water", reflectivity=0.03, water=True)
COVER = Surface(land_class="water", reflectivity=0.32)
"""A tarpaulin over a pool: it echoes like solid ground and carries nothing."""
BASIN_PX_PER_M = 40.0
LEVEL_M, COPING_M = 0.03, 0.07
COPING_WIDTH_M = 0.4
CANOPIES = ((206, 58, 48), (238, 196, 72), (44, 104, 168), (236, 232, 220), (62, 138, 98),
            (222, 122, 52))  # fmt: skip


@dataclass(frozen=True, kw_only=True, slots=True)
class Pool:
    """A basin in plot coordinates. outline_m: (N, 2) counter-clockwise, seen whole from its middle;
    lanes: swimming lanes along u, 0 for none; covered: under a tarpaulin."""

    plot: Plot
    outline_m: Array
    lanes: int = 0
    covered: bool = False

    @property
    def box_m(self) -> tuple[Array, Array]:
        """Least and maximum (u, v)."""
        return self.outline_m.min(axis=0), self.outline_m.max(axis=0)


def rectangle_outline(u: float, v: float, length: float, width: float, round_m: float) -> Array:
    """(N, 2) counter-clockwise rectangle about (u, v) with rounded corners."""
    x, y = 0.5 * length - round_m, 0.5 * width - round_m
    points = []
    for corner, (sx, sy) in enumerate(((1, 1), (-1, 1), (-1, -1), (1, -1))):
        for turn in np.linspace(0.0, 0.5 * np.pi, 5) + 0.5 * np.pi * corner:
            points.append([sx * x + round_m * np.cos(turn), sy * y + round_m * np.sin(turn)])
    return np.array(points) + [u, v]


def kidney_outline(rng: np.random.Generator, u: float, v: float, radius: float) -> Array:
    """(40, 2) counter-clockwise bean-like outline about (u, v), up to 1.6 radii long."""
    turn = np.linspace(0.0, 2.0 * np.pi, 40, endpoint=False)
    phase = rng.uniform(0.0, 2.0 * np.pi)
    reach = radius * (1.0 + 0.16 * np.cos(2.0 * turn) - 0.14 * np.cos(turn - phase))
    reach += 0.07 * radius * np.cos(3.0 * turn + phase)
    return np.stack([1.25 * reach * np.cos(turn), 0.85 * reach * np.sin(turn)], -1) + [u, v]


def add_pool(builder: SceneBuilder, pool: Pool) -> None:
    """Adds water nearly flush with a stone coping. The ground below is taken as level."""
    middle = pool.outline_m.mean(axis=0)
    where = pool.plot.points(middle)
    z = float(builder.terrain.at(pool.plot.points(pool.outline_m)).max())
    name = builder.unique("cover" if pool.covered else "pool")
    low, high = pool.box_m
    painter = _cover_texture if pool.covered else _basin_texture
    material = builder.material(f"water_{name}", painter(builder.rng, pool), 0.0)
    outline = pool.plot.points(pool.outline_m)
    uv = (pool.outline_m - low) / (high - low)
    uv[:, 1] = 1.0 - uv[:, 1]
    if pool.plot.mirrored:
        outline, uv = outline[::-1], uv[::-1]
    level = COPING_M if pool.covered else LEVEL_M
    hub = (middle - low) / (high - low)
    water = _prism(outline - where, uv, np.array([hub[0], 1.0 - hub[1]]), level)
    builder.geom("water_pool", COVER if pool.covered else WATER, mesh=builder.mesh(name, water),
                 material=material, pos=[*where, z])  # fmt: skip
    ring = _ring(outline - where, COPING_WIDTH_M, COPING_M)
    # A coping as one mesh would carry legs on its convex hull: it stays out of contacts.
    builder.geom("path_coping", KERB, mesh=builder.mesh(f"{name}_coping", ring), pos=[*where, z],
                 rgba=[0.83, 0.80, 0.74, 1], contype=0, conaffinity=0)  # fmt: skip
    for point in pool.plot.points(_inside(pool.outline_m)):
        builder.claim(point, 1.6)


def _inside(outline_m: Array) -> Array:
    """(K, 2) points 1.5 m apart that lie inside, for claims."""
    low, high = outline_m.min(axis=0), outline_m.max(axis=0)
    u, v = np.meshgrid(np.arange(low[0], high[0] + 1.5, 1.5), np.arange(low[1], high[1] + 1.5, 1.5))
    shape = outline_m.astype(np.float32)
    points = np.stack([u.ravel(), v.ravel()], -1)
    keep = [cv2.pointPolygonTest(shape, (float(a), float(b)), True) > -0.5 for a, b in points]
    return points[np.array(keep)]


def _prism(outline: Array, uv: Array, hub_uv: Array, high: float) -> MeshData:
    """Walls from -0.3 m and a fan-shaped lid about the origin, (N, 2) counter-clockwise outline."""
    count = len(outline)
    rim = np.column_stack([outline, np.full(count, high)])
    lid = MeshData(
        vertices=np.concatenate([rim, [[0.0, 0.0, high]]]),
        faces=np.array([[i, (i + 1) % count, count] for i in range(count)], np.int32),
        uv=np.concatenate([uv, hub_uv[None]]),
    )
    foot = np.column_stack([outline, np.full(count, -0.3)])
    parts = [lid]
    for i in range(count):
        j = (i + 1) % count
        parts.append(polygon(np.array([foot[i], foot[j], rim[j], rim[i]]), uv[i]))
    return MeshData.join(parts)


def _ring(outline: Array, width: float, high: float) -> MeshData:
    """A flat rim outside of an outline, (N, 2) counter-clockwise."""
    ahead = np.roll(outline, -1, axis=0) - np.roll(outline, 1, axis=0)
    normal = np.stack([ahead[:, 1], -ahead[:, 0]], -1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    outer = outline + width * normal
    parts = []
    for i in range(len(outline)):
        j = (i + 1) % len(outline)
        a, b = np.append(outline[i], high), np.append(outline[j], high)
        c, d = np.append(outer[j], high), np.append(outer[i], high)
        down = np.array([0.0, 0.0, high + 0.2])
        parts.append(polygon(np.array([b, a, d, c])))
        parts.append(polygon(np.array([a, b, b - down, a - down])))
        parts.append(polygon(np.array([c, d, d - down, c - down])))
    return MeshData.join(parts)


def _basin_texture(rng: np.random.Generator, pool: Pool) -> Image:
    """Returns tiles seen through clear water: deeper along u, bright caustics, lane lines."""
    low, high = pool.box_m
    width, height = (max(32, round(float(s) * BASIN_PX_PER_M)) for s in high - low)
    rows, cols = np.mgrid[0:height, 0:width].astype(np.float32)
    u, v = cols / BASIN_PX_PER_M, rows / BASIN_PX_PER_M
    length, across = float(high[0] - low[0]), float(high[1] - low[1])
    # Refraction bends straight joints by a few centimetres.
    bend_u = 0.05 * fractal_noise(rng, (height, width), 1.1 * BASIN_PX_PER_M, 2)
    bend_v = 0.05 * fractal_noise(rng, (height, width), 1.1 * BASIN_PX_PER_M, 2)
    depth = (u / length)[..., None]
    shallow = np.array([126.0, 214.0, 222.0]) * rng.uniform(0.94, 1.04)
    deep = np.array([46.0, 142.0, 186.0]) * rng.uniform(0.92, 1.05)
    image = (shallow + (deep - shallow) * depth).astype(np.float32)
    joint = (np.mod(u + bend_u, 0.5) < 0.045) | (np.mod(v + bend_v, 0.5) < 0.045)
    image *= np.where(joint, 0.90, 1.0)[..., None]
    tone = rng.normal(0.0, 0.025, (64, 64)).astype(np.float32)
    tile = (
        np.floor((u + bend_u) / 0.5).astype(int) % 64,
        np.floor((v + bend_v) / 0.5).astype(int) % 64,
    )
    image *= 1.0 + tone[tile][..., None]
    for lane in range(pool.lanes):
        middle = (lane + 0.5) * across / pool.lanes
        line = (np.abs(v + bend_v - middle) < 0.13) & (u > 1.6) & (u < length - 1.6)
        for end in (1.6, length - 1.6):
            line |= (np.abs(u - end) < 0.13) & (np.abs(v + bend_v - middle) < 0.5)
        image[line] = np.array([22.0, 58.0, 104.0], np.float32)
    ripple = tileable_noise(rng, 512, 1.6, 9.0)
    web = 1.0 - np.minimum(np.abs(np.roll(ripple, 40, 0) + 0.6 * ripple.T), 0.55) / 0.55
    stretch = np.tile(web, (height // 512 + 1, width // 512 + 1))[:height, :width]
    image *= (0.93 + 0.30 * stretch**2.2)[..., None]
    for lane in range(1, pool.lanes):
        row = int(lane * across / pool.lanes * BASIN_PX_PER_M)
        beads = np.where(
            (cols[0] // 18).astype(int)[:, None] % 2 == 0, [214.0, 60, 52], [240, 240, 236]
        )
        image[row - 2 : row + 2] = beads
    edge = np.minimum(np.minimum(u, length - u), np.minimum(v, across - v))
    image *= (1.0 - 0.22 * np.exp(-edge / 0.25))[..., None]
    return to_texture(image)


def _cover_texture(rng: np.random.Generator, pool: Pool) -> Image:
    """Returns a grey-green tarpaulin with eyelets, seams and puddles."""
    low, high = pool.box_m
    width, height = (max(32, round(float(s) * BASIN_PX_PER_M)) for s in high - low)
    tone = 1.0 + 0.10 * fractal_noise(rng, (height, width), 1.5 * BASIN_PX_PER_M, 4)
    tone += 0.03 * rng.standard_normal((height, width), dtype=np.float32)
    tone[:, :: int(2.0 * BASIN_PX_PER_M)] *= 0.7
    base = np.array([[96.0, 108.0, 104.0], [70.0, 96.0, 128.0]])[int(rng.integers(2))]
    image = tone[..., None] * base.astype(np.float32)
    pool_of_rain = np.clip(fractal_noise(rng, (height, width), 70.0, 2) - 1.2, 0.0, 0.5)[..., None]
    return to_texture(image * (1.0 - 0.7 * pool_of_rain))


def lounger_mesh() -> MeshData:
    """Returns a sun lounger along x with its back up; its upper faces are mapped to a towel's
    texture."""
    parts = []
    steps = ((-0.95, 0.30), (0.35, 0.30), (0.95, 0.62))
    for first, second in pairwise(steps):
        (x0, z0), (x1, z1) = first, second
        top = np.array([[x0, -0.32, z0], [x1, -0.32, z1], [x1, 0.32, z1], [x0, 0.32, z0]])
        uv = np.array([[(x + 0.95) / 1.9, 0.0 if y < 0 else 1.0] for x, y, _ in top])
        parts.append(polygon(top, uv))
        parts.append(polygon(top[::-1] - [0.0, 0.0, 0.05], 0.01))
    for x in (-0.8, 0.5):
        parts.append(box((0.03, 0.30, 0.14), (x, 0.0, 0.13), 1e3))
    return MeshData.join(parts)


def add_lounger_models(builder: SceneBuilder, count: int) -> list[tuple[str, str]]:
    """(mesh, material) of loungers in several colours."""
    rng = builder.rng
    mesh = builder.mesh("lounger", lounger_mesh())
    models = []
    for index in range(count):
        colour = np.array(pick(rng, CANOPIES), np.float32)
        image = np.empty((32, 64, 3), np.float32)
        image[:] = 232.0
        image[:, 4:60] = colour
        if rng.random() < 0.5:
            image[:, 4:60:8] = image[:, 5:60:8] = 236.0
        models.append((mesh, builder.material(f"lounger_{index}", to_texture(image))))
    return models


def add_lounger(builder: SceneBuilder, model: tuple[str, str], xy_m: Array, heading: float) -> None:
    """Adds one sun lounger; its head end points along ``heading``."""
    origin = builder.on_ground(xy_m)
    builder.geom("lounger", WOOD, mesh=model[0], material=model[1], pos=origin, heading=heading)
    corners = [
        [x, y, z] for x, z in ((-0.95, 0.2), (0.35, 0.2), (0.95, 0.6)) for y in (-0.32, 0.32)
    ]
    builder.cast(turned(np.array(corners), heading, origin))
    builder.claim(xy_m, 0.9)


def add_umbrella_models(builder: SceneBuilder, count: int) -> list[tuple[str, str]]:
    """(mesh, material) of canopies 2.8 m across with eight panels in one or two colours."""
    rng = builder.rng
    turn = np.linspace(0.0, 2.0 * np.pi, 9)
    parts = []
    for i in range(8):
        rim = [[1.4 * np.cos(t), 1.4 * np.sin(t), 0.0] for t in (turn[i], turn[i + 1])]
        uv = np.array([[0.02 + 0.5 * (i % 2), 0.9], [0.48 + 0.5 * (i % 2), 0.9], [0.25, 0.1]])
        parts.append(polygon(np.array([*rim, [0.0, 0.0, 0.55]]), uv))
        parts.append(polygon(np.array([[0.0, 0.0, 0.53], rim[1], rim[0]]), uv))
    mesh = builder.mesh("umbrella", MeshData.join(parts))
    models = []
    for index in range(count):
        first, second = (CANOPIES[int(k)] for k in rng.choice(len(CANOPIES), 2, replace=False))
        image = np.empty((32, 64, 3), np.uint8)
        image[:, :32] = first
        image[:, 32:] = second if rng.random() < 0.6 else first
        image[28:] = 240
        models.append((mesh, builder.material(f"umbrella_{index}", image)))
    return models


def add_umbrella(builder: SceneBuilder, model: tuple[str, str], xy_m: Array) -> None:
    """Adds a sunshade on a thin pole."""
    add_post(builder, xy_m, 2.3, 0.025, [0.86, 0.86, 0.84, 1])
    heading = float(builder.rng.uniform(0.0, 0.8))
    at = builder.on_ground(xy_m, 1.95)
    builder.geom("umbrella", CLOTH, mesh=model[0], material=model[1], pos=at, heading=heading)
    turn = np.arange(0.0, 2.0 * np.pi, 0.25 * np.pi) + heading
    rim = np.column_stack([at[:2] + 1.4 * unit(turn), np.full(8, at[2])])
    builder.cast(np.concatenate([rim, [at + [0.0, 0.0, 0.5]]]))
    builder.claim(xy_m, 0.6)


def add_guard_chair(builder: SceneBuilder, xy_m: Array, heading: float) -> None:
    """Adds a life guard's high chair."""
    parts = [
        box((0.35, 0.35, 0.04), (0.0, 0.0, 1.6)),
        box((0.04, 0.35, 0.35), (-0.32, 0.0, 1.95)),
        box((0.15, 0.3, 0.03), (0.45, 0.0, 0.8)),
    ]
    for sx in (-0.4, 0.4):
        for sy in (-0.38, 0.38):
            parts.append(box((0.05, 0.05, 0.8), (sx, sy, 0.8)))
    builder.stand("guard_chair", WOOD, parts, xy_m, heading, rgba=[0.88, 0.86, 0.80, 1])
    builder.claim(xy_m, 1.0)


def add_water_slide(builder: SceneBuilder, foot_xy_m: Array, heading: float) -> None:
    """Adds a tower with a straight chute that ends at ``foot_xy_m``, coming from ``-heading``."""
    back = -unit(heading)
    z = builder.terrain.point(*foot_xy_m)
    tint = [0.20, 0.46, 0.74, 1] if builder.rng.random() < 0.5 else [0.90, 0.70, 0.16, 1]
    run = 9.0
    parts = []
    steps = np.linspace(0.0, 1.0, 7)
    heights = 0.35 + 3.6 * steps**1.35
    for i in range(6):
        x0, x1, z0, z1 = -run * steps[i], -run * steps[i + 1], heights[i], heights[i + 1]
        floor = np.array([[x1, -0.45, z1], [x0, -0.45, z0], [x0, 0.45, z0], [x1, 0.45, z1]])
        parts.append(polygon(floor))
        parts.append(polygon(floor[::-1] - [0, 0, 0.08]))
        for side in (-0.45, 0.45):
            wall = np.array(
                [[x1, side, z1], [x0, side, z0], [x0, side, z0 + 0.4], [x1, side, z1 + 0.4]]
            )
            parts += plate(wall)
    builder.stand("slide", CLOTH, parts, foot_xy_m, heading, rgba=tint, contype=0, conaffinity=0)
    top = foot_xy_m + (run + 1.0) * back
    deck = np.array([*top, z + 3.9])
    builder.geom("slide_tower", WOOD, box=[1.1, 1.1, 0.06], pos=deck,
                 heading=heading, rgba=[0.80, 0.80, 0.78, 1])  # fmt: skip
    builder.cast_box((1.1, 1.1), (0.0,), 0.0, deck)
    left = np.array([-back[1], back[0]])
    for sx in (-0.9, 0.9):
        for sy in (-0.9, 0.9):
            add_post(builder, top + sx * back + sy * left, 4.9, 0.06, [0.70, 0.72, 0.74, 1])
    for fraction in (0.35, 0.7):
        spot = foot_xy_m + fraction * run * back
        add_post(builder, spot, 0.3 + 3.6 * fraction**1.35, 0.06, [0.70, 0.72, 0.74, 1])
    for fraction in np.linspace(0.0, 1.15, 8):
        builder.claim(foot_xy_m + fraction * run * back, 1.3)


def add_whirlpool(builder: SceneBuilder, xy_m: Array) -> None:
    """Adds a round raised tub, 0.5 m high, full to the brim."""
    for stem, radius, low, high, tint, surface in (
        ("tub", 1.6, -0.2, 0.50, [0.74, 0.71, 0.66, 1], KERB),
        ("water_tub", 1.3, 0.3, 0.52, [0.42, 0.76, 0.82, 1], WATER),
    ):
        mesh = builder.mesh(builder.unique(stem), drum(radius, low, high, 24))
        builder.geom(stem, surface, mesh=mesh, pos=builder.on_ground(xy_m), rgba=tint)
    builder.claim(xy_m, 2.2)
