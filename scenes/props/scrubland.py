"""Scrub, tufts of dry grass and slabs of layered rock, as in dry country."""

from dataclasses import dataclass, field

import numpy as np

from touchdown.scenes.api import Array, Image, Surface
from touchdown.scenes.authoring import textures
from touchdown.scenes.authoring.builder import SceneBuilder
from touchdown.scenes.authoring.meshes import MeshData, blob
from touchdown.scenes.authoring.noise import tileable_noise
from touchdown.scenes.authoring.plane import draw_heading, pick, unit_ball
from touchdown.scenes.props.waterside import reed_texture, tuft_mesh
from touchdown.scenes.props.woods import canopy_mesh

SCRUB = Surface(land_class="trees", reflectivity=0.36, porosity=0.30)
TUFT = Surface(land_class="lawn", reflectivity=0.42, porosity=0.45)
STONE = Surface(land_class="other", reflectivity=0.32)
_GREENS: tuple[textures.Colour, ...] = (
    (176.0, 170.0, 122.0),
    (150.0, 152.0, 112.0),
    (196.0, 176.0, 126.0),
)


@dataclass(kw_only=True, slots=True)
class Scrubland:
    """Materials and meshes that the plants and rocks of a scene share."""

    leaves: list[str] = field(default_factory=list)
    shrubs: list[tuple[str, Array]] = field(default_factory=list)
    """(mesh name, half axes in metres)"""
    straw: str = ""
    tufts: list[tuple[str, float, float]] = field(default_factory=list)
    """(mesh name, radius, height in metres)"""
    stone: str = ""


def grow_scrub(builder: SceneBuilder) -> Scrubland:
    """Adds what the scrub of a scene shares."""
    rng = builder.rng
    land = Scrubland()
    for index, base in enumerate(_GREENS):
        tint = textures.hedge_or_soil_tint(rng, base, 0.08)
        land.leaves.append(
            builder.material(f"trees_scrub_{index}", textures.foliage(rng, tint, (7, 16)))
        )
    for index, radius in enumerate((0.35, 0.5, 0.7, 0.95)):
        half = radius * np.array([1.0, rng.uniform(0.8, 1.1), rng.uniform(0.6, 0.8)])
        mesh = builder.mesh(f"scrub_{index}", canopy_mesh(rng, half, 9, 1.2))
        land.shrubs.append((mesh, half))
    straw = reed_texture(rng, (126.0, 108.0, 66.0), (204.0, 180.0, 122.0))
    land.straw = builder.material("lawn_straw", straw)
    for index, (radius, height) in enumerate(((0.16, 0.30), (0.22, 0.42), (0.30, 0.55))):
        mesh = builder.mesh(f"tuft_{index}", tuft_mesh(rng, radius, height))
        land.tufts.append((mesh, radius, height))
    land.stone = builder.material("stone", weathered(rng, SANDSTONE))
    return land


SANDSTONE = (158.0, 122.0, 92.0)


def weathered(rng: np.random.Generator, rgb: tuple[float, float, float]) -> Image:
    """(512, 512, 3), periodic: weathered rock with dark joints."""
    tone = 1.0 + 0.10 * tileable_noise(rng, textures.TILE_PX, 1.3, 3.0)
    tone += 0.07 * tileable_noise(rng, textures.TILE_PX, 0.4, 20.0)
    joints = np.abs(tileable_noise(rng, textures.TILE_PX, 2.0, 3.0))
    tone *= 1.0 - 0.35 * np.exp(-((joints / 0.03) ** 2))
    hue = tileable_noise(rng, textures.TILE_PX, 1.8, 2.0)[..., None]
    image = tone[..., None] * np.array(rgb) + hue * np.array([8.0, 3.0, -2.0])
    return textures.to_texture(image.astype(np.float32))


def add_scrub(builder: SceneBuilder, land: Scrubland, xy_m: Array) -> None:
    """Adds a low bush of grey-green twigs."""
    rng = builder.rng
    mesh, half = pick(rng, land.shrubs)
    leaf = pick(rng, land.leaves)
    at = builder.on_ground(xy_m, 0.5 * half[2])
    builder.geom("trees_scrub", SCRUB, mesh=mesh, material=leaf, pos=at, heading=draw_heading(rng))
    builder.cast(at + half * _BALL, 1.0 - SCRUB.porosity)
    builder.claim(xy_m, float(half[0]) + 0.3)


def add_tuft(builder: SceneBuilder, land: Scrubland, xy_m: Array) -> None:
    """Adds a tuft of dry grass, 0.3 to 0.55 m high."""
    rng = builder.rng
    mesh, radius, height = pick(rng, land.tufts)
    at = builder.on_ground(xy_m, -0.03)
    builder.geom("lawn_tuft", TUFT, mesh=mesh, material=land.straw, pos=at,
                 heading=draw_heading(rng))  # fmt: skip
    ring = np.array([1.2 * radius, 1.2 * radius, 0.5 * height]) * _BALL
    builder.cast(at + [0.0, 0.0, 0.5 * height] + ring, 0.6)
    builder.claim(xy_m, radius + 0.2)


def add_slab(builder: SceneBuilder, land: Scrubland, xy_m: Array, radius_m: float) -> None:
    """Adds a weathered slab of an outcrop, layers over one another, half in the ground."""
    rng = builder.rng
    turn = draw_heading(rng)
    parts = []
    top = 0.0
    for layer in range(int(rng.integers(2, 4))):
        fraction = 1.0 - 0.22 * layer
        half = radius_m * np.array(
            [fraction, fraction * rng.uniform(0.6, 0.8), rng.uniform(0.16, 0.26)]
        )
        shift = np.array([*(0.12 * radius_m * rng.uniform(-1.0, 1.0, 2)), top])
        parts.append(blob(rng, half, 3.2, 0.09, 9, 1.6).moved(shift))
        top += 1.25 * float(half[2])
    mesh = builder.mesh(builder.unique("slab"), MeshData.join(parts))
    at = builder.on_ground(xy_m)
    builder.geom("rock", STONE, mesh=mesh, material=land.stone, pos=at, heading=turn)
    builder.cast(at + np.array([0.85 * radius_m, 0.85 * radius_m, top]) * _BALL)
    builder.claim(xy_m, radius_m)


_BALL = unit_ball(5, 10)
