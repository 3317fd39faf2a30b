"""Objects of old villages: dry-stone walls, wells, log piles, sheep, electric fences."""

from itertools import pairwise

import cv2
import numpy as np

from touchdown.scenes.api import Array, Image, Surface
from touchdown.scenes.authoring.builder import SceneBuilder
from touchdown.scenes.authoring.meshes import MeshData, blob, box, boxes, plate, polygon
from touchdown.scenes.authoring.noise import fractal_noise
from touchdown.scenes.authoring.plane import left_of, unit_circle
from touchdown.scenes.authoring.textures import to_texture
from touchdown.scenes.props.garden import drum, plank_material
from touchdown.scenes.props.street import WOOD, add_post, add_wire

STONE = Surface(land_class="building", reflectivity=0.33)
FLEECE = Surface(land_class="other", reflectivity=0.60)
WALL_WIDTH_M = 0.45
UV_M = 2.4
"""Metres that one texture of rubble covers."""


def rubble(rng: np.random.Generator) -> Image:
    """(384, 384, 3): stones of all sizes in dark joints, grown from random seeds."""
    px, count = 384, 170
    seeds = rng.integers(0, px, (count, 2))
    marks = np.full((px, px), 255, np.uint8)
    marks[seeds[:, 0], seeds[:, 1]] = 0
    tiled = np.tile(marks, (3, 3))
    away, labels = cv2.distanceTransformWithLabels(
        tiled, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    middle = slice(px, 2 * px)
    edge = cv2.Laplacian(labels[middle, middle].astype(np.float32), cv2.CV_32F) != 0.0
    joint = cv2.dilate(edge.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    table = rng.normal(1.0, 0.13, (9 * count + 9, 1)) + rng.normal(0.0, 0.04, (9 * count + 9, 3))
    tone = table[labels[middle, middle]].astype(np.float32)
    tone *= (1.08 - 0.006 * away[middle, middle])[..., None]
    tone *= 1.0 + 0.06 * fractal_noise(rng, (px, px), 12.0, 3)[..., None]
    image = tone * np.array([158.0, 150.0, 136.0], np.float32)
    image[joint] *= 0.45
    return to_texture(image)


def thatch(rng: np.random.Generator) -> Image:
    """(512, 512, 3): both slopes of a thatched roof, ridge at the top of each half: reed in
    courses, a cut ridge band, moss."""
    rows, cols = 512, 512
    streak = rng.standard_normal((rows, cols), dtype=np.float32)
    streak = cv2.GaussianBlur(streak, (0, 0), 0.7, None, 8.0) * 5.0
    tone = 1.0 + 0.16 * streak + 0.08 * fractal_noise(rng, (rows, cols), 60.0, 4)
    half = rows // 2
    down = np.mod(np.arange(rows), half)[:, None] / half
    tone *= 1.02 - 0.22 * down
    tone[np.broadcast_to(np.mod(down, 0.25) < 0.012, tone.shape)] *= 0.72
    base = np.array([172.0, 146.0, 98.0]) * rng.uniform([0.75, 0.75, 0.8], [1.0, 1.0, 1.1])
    image = tone[..., None] * base.astype(np.float32)
    moss = np.clip(fractal_noise(rng, (rows, cols), 45.0, 4, 0.6) - 0.9, 0.0, 0.8)[..., None]
    image += moss * (np.array([96.0, 108.0, 62.0], np.float32) - image)
    for first in (0, half):
        band = slice(first, first + half // 9)
        image[band] = 0.82 * image[band] + 12.0
        image[first + half // 9 : first + half // 9 + 4] *= 0.6
    return to_texture(image)


def rubble_material(builder: SceneBuilder) -> str:
    """The stone that all walls of a scene share."""
    name = "building_rubble"
    if builder.spec.material(name) is None:
        builder.material(name, rubble(builder.rng))
    return name


def add_stone_wall(builder: SceneBuilder, line_m: Array, height_m: float) -> None:
    """Adds a dry-stone wall along a polyline, (N, 2), one mesh for each straight piece, with a
    ragged top that follows the ground."""
    rng = builder.rng
    material = rubble_material(builder)
    for start, end in pairwise(line_m):
        span = end - start
        length = float(np.hypot(*span))
        steps = max(2, round(length / 1.2) + 1)
        knots = start + np.linspace(0.0, 1.0, steps)[:, None] * span
        ground = builder.terrain.at(knots)
        base = float(ground.min())
        x = np.linspace(-0.5 * length - 0.12, 0.5 * length + 0.12, steps)
        top = ground - base + height_m + rng.uniform(-0.07, 0.07, steps)
        parts = _wall_parts(x, ground - base - 0.4, top)
        middle = 0.5 * (start + end)
        mesh = builder.mesh(builder.unique("stone_wall"), MeshData.join(parts))
        angle = float(np.arctan2(span[1], span[0]))
        builder.geom("building_stone_wall", STONE, mesh=mesh, material=material,
                     pos=[*middle, base], heading=angle)  # fmt: skip
        aside = 0.5 * WALL_WIDTH_M * left_of(angle)
        foot = np.array([start + aside, start - aside, end + aside, end - aside])
        low = builder.terrain.at(foot)
        builder.cast(np.concatenate([np.column_stack([foot, low + h]) for h in (0.0, height_m)]))
        for knot in knots:
            builder.claim(knot, 0.8)


def _wall_parts(x: Array, low: Array, top: Array) -> list[MeshData]:
    """Returns both faces (leaning in by a tenth), the top and the ends of a wall along x."""
    foot, crown = 0.5 * WALL_WIDTH_M, 0.4 * WALL_WIDTH_M
    parts = []
    for i, j in pairwise(range(len(x))):
        u0, u1 = x[i] / UV_M, x[j] / UV_M
        for side in (1.0, -1.0):
            face = np.array([[x[i], side * foot, low[i]], [x[j], side * foot, low[j]],
                            [x[j], side * crown, top[j]],
                            [x[i], side * crown, top[i]]])  # fmt: skip
            uv = np.array([[u0, -low[i]], [u1, -low[j]], [u1, -top[j]], [u0, -top[i]]])
            uv[:, 1] /= UV_M
            parts.append(polygon(face[::-1] if side > 0 else face, uv[::-1] if side > 0 else uv))
        lid = np.array([[x[i], -crown, top[i]], [x[j], -crown, top[j]],
                        [x[j], crown, top[j]], [x[i], crown, top[i]]])  # fmt: skip
        flat = np.array([[u0, 0.0], [u1, 0.0], [u1, 0.2], [u0, 0.2]])
        parts.append(polygon(lid, flat))
    for index, order in ((0, 1), (-1, -1)):
        end = np.array([[x[index], foot, low[index]], [x[index], -foot, low[index]],
                        [x[index], -crown, top[index]], [x[index], crown, top[index]]])  # fmt: skip
        uv = np.array([[0.0, 0.5], [0.2, 0.5], [0.2, 0.0], [0.0, 0.0]])
        parts.append(polygon(end[::order], uv[::order]))
    return parts


def add_well(builder: SceneBuilder, xy_m: Array, heading: float) -> None:
    """Adds a round well of rubble under a small roof on two posts."""
    mesh = builder.mesh(builder.unique("well"), drum(0.75, -0.3, 0.8, 16))
    builder.geom("building_well", STONE, mesh=mesh, pos=builder.on_ground(xy_m),
                 material=rubble_material(builder))  # fmt: skip
    roof = []
    for y in (-0.8, 0.8):
        roof += plate([[-1.0, y, 1.9], [1.0, y, 1.9], [1.0, 0, 2.5], [-1.0, 0, 2.5]])
    roof += [box((0.06, 0.06, 1.2), (x, 0.0, 1.2)) for x in (-0.8, 0.8)]
    builder.stand("well_roof", WOOD, roof, xy_m, heading, rgba=[0.42, 0.30, 0.22, 1])
    builder.claim(xy_m, 1.5)


def add_log_pile(builder: SceneBuilder, xy_m: Array, heading: float) -> None:
    """Adds split logs stacked 1.1 m high between two stakes."""
    parts = [box((1.3, 0.4, 0.5), (0.0, 0.0, 0.45))]
    parts += [box((0.05, 0.3, 0.65), (x, 0.0, 0.6)) for x in (-1.38, 1.38)]
    builder.stand("logs", WOOD, parts, xy_m, heading, material=plank_material(builder),
               rgba=[0.62, 0.46, 0.32, 1])  # fmt: skip
    builder.claim(xy_m, 1.7)


def add_cart(builder: SceneBuilder, xy_m: Array, heading: float) -> None:
    """Adds a two-wheeled hay cart, tipped on its shafts."""
    parts = boxes([1.2, 0.7, 0.05, 0.0, 0.0, 0.75], [1.2, 0.03, 0.25, 0.0, 0.7, 1.0],
                  [1.2, 0.03, 0.25, 0.0, -0.7, 1.0], [0.9, 0.04, 0.04, 2.0, -0.4, 0.45],
                  [0.9, 0.04, 0.04, 2.0, 0.4, 0.45])  # fmt: skip
    x, z = 0.6 * unit_circle(14).T
    for side in (-0.82, 0.82):
        parts += plate(np.stack([x, np.full(14, side), 0.6 + z], -1))
    builder.stand("cart", WOOD, parts, xy_m, heading, rgba=[0.46, 0.34, 0.24, 1])
    builder.claim(xy_m, 2.2)


def add_sheep_models(builder: SceneBuilder) -> str:
    """Adds the mesh of a sheep."""
    rng = builder.rng
    body = blob(rng, np.array([0.52, 0.27, 0.30]), 2.6, 0.05, 7, 1.0)
    head = blob(rng, np.array([0.20, 0.11, 0.13]), 2.2, 0.02, 4, 1.0)
    parts = [body.moved(np.array([0.0, 0.0, 0.66])), head.moved(np.array([0.62, 0.0, 0.72]))]
    parts += [box((0.04, 0.04, 0.24), (x, y, 0.22)) for x in (-0.3, 0.3) for y in (-0.14, 0.14)]
    return builder.mesh("sheep", MeshData.join(parts))


def add_sheep(builder: SceneBuilder, mesh: str, xy_m: Array, heading: float) -> None:
    """Adds a sheep that grazes on the spot."""
    at = builder.on_ground(xy_m)
    wool = builder.rng.uniform(0.80, 0.93)
    builder.geom("sheep", FLEECE, mesh=mesh, pos=at,
                 heading=heading, rgba=[wool, 0.97 * wool, 0.90 * wool, 1])  # fmt: skip
    oval = [0.5, 0.28] * unit_circle(8)
    builder.cast(np.concatenate([np.column_stack([xy_m + oval, np.full(8, at[2] + h)])
                                 for h in (0.4, 0.9)]))  # fmt: skip
    builder.claim(xy_m, 0.9)


def add_electric_fence(builder: SceneBuilder, line_m: Array, height_m: float) -> None:
    """Adds thin stakes, (N, 2), and one wire from each to the next."""
    tops = []
    for spot in line_m:
        add_post(builder, spot, height_m + 0.08, 0.014, [0.90, 0.90, 0.88, 1])
        tops.append(builder.on_ground(spot, height_m))
        builder.claim(spot, 0.5)
    for first, second in pairwise(tops):
        add_wire(builder, first, second, 0.006, [0.86, 0.84, 0.80, 1])
