"""Trees, bushes, hedges and rocks."""

from dataclasses import dataclass, field

import numpy as np

from touchdown.scenes.api import Array, Surface
from touchdown.scenes.authoring.builder import SceneBuilder
from touchdown.scenes.authoring.meshes import blob
from touchdown.scenes.authoring.plane import draw_heading, pick
from touchdown.scenes.authoring.textures import Colour, foliage, hedge_or_soil_tint

CROWN = Surface(land_class="trees", reflectivity=0.45, porosity=0.35, spread=0.25)
HEDGE = Surface(land_class="trees", reflectivity=0.42, porosity=0.10, spread=0.25)
TRUNK = Surface(land_class="trees", reflectivity=0.30)
ROCK = Surface(land_class="other", reflectivity=0.30)
SPECIES: tuple[Colour, ...] = ((96.0, 132.0, 58.0), (72.0, 112.0, 56.0), (122.0, 138.0, 54.0),
               (84.0, 120.0, 84.0))  # fmt: skip
LUMP_RADII_M = (1.0, 1.45, 1.95)


@dataclass(kw_only=True, slots=True)
class Nursery:
    """Shared crown meshes and leaf textures."""

    leaves: list[str] = field(default_factory=list)
    lumps: list[tuple[str, float]] = field(default_factory=list)
    """(mesh name, radius in metres)"""
    hedge_leaf: str = ""
    rock: str = ""


def plant_nursery(builder: SceneBuilder) -> Nursery:
    """Adds the materials and meshes that all plants of a scene share."""
    rng = builder.rng
    nursery = Nursery()
    for index, base in enumerate(SPECIES):
        tint = hedge_or_soil_tint(rng, base, 0.10)
        nursery.leaves.append(builder.material(f"trees_leaf_{index}", foliage(rng, tint, (7, 17))))
    tint = hedge_or_soil_tint(rng, (62.0, 100.0, 48.0), 0.10)
    nursery.hedge_leaf = builder.material("trees_hedge", foliage(rng, tint, (4, 9)))
    for radius in LUMP_RADII_M:
        for variant in range(2):
            half = radius * np.array([1.0, 1.0, rng.uniform(0.72, 0.9)])
            data = blob(rng, half, 2.0, 0.13, 9, 1.5)
            name = builder.mesh(f"crown_{int(10 * radius)}_{variant}", data)
            nursery.lumps.append((name, radius))
    return nursery


def add_tree(builder: SceneBuilder, nursery: Nursery, xy_m: Array, size: float) -> None:
    """Adds a broad-leaved tree; ``size`` 1 is about 6 m high with a crown of 4 m."""
    rng = builder.rng
    z = builder.terrain.point(*xy_m)
    trunk_m = 1.9 * size
    builder.geom("trees_trunk", TRUNK, rgba=[0.33, 0.26, 0.20, 1], fromto=[*xy_m, z - 0.3, *xy_m,
                 z + trunk_m + 0.6 * size], capsule=0.13 * size)  # fmt: skip
    leaf = pick(rng, nursery.leaves)
    big = [lump for lump in nursery.lumps if lump[1] >= (1.5 if size > 1.0 else 1.2)]
    middle = [lump for lump in nursery.lumps if lump[1] <= (1.5 if size > 1.0 else 1.0)]
    top = np.array([*xy_m, z + trunk_m + 1.5 * size])
    _add_lump(builder, pick(rng, big), leaf, top)
    count = int(rng.integers(3, 6))
    turn = rng.uniform(0.0, 2.0 * np.pi)
    for index in range(count):
        angle = turn + 2.0 * np.pi * index / count + rng.uniform(-0.3, 0.3)
        reach = rng.uniform(0.85, 1.35) * size
        offset = [reach * np.cos(angle), reach * np.sin(angle), rng.uniform(-0.9, 0.1) * size]
        _add_lump(builder, pick(rng, middle), leaf, top + offset)
    builder.claim(xy_m, 2.2 * size)


def add_small_tree(builder: SceneBuilder, nursery: Nursery, xy_m: Array, size: float) -> None:
    """Adds a fruit tree of two lumps; ``size`` 1 is about 3.5 m high."""
    rng = builder.rng
    z = builder.terrain.point(*xy_m)
    builder.geom("trees_trunk", TRUNK, rgba=[0.36, 0.29, 0.23, 1],
                 fromto=[*xy_m, z - 0.3, *xy_m, z + 1.9 * size], capsule=0.09 * size)  # fmt: skip
    leaf = pick(rng, nursery.leaves)
    small = [lump for lump in nursery.lumps if lump[1] <= (1.5 if size > 0.9 else 1.0)]
    top = np.array([*xy_m, z + 2.2 * size])
    turn = rng.uniform(0.0, 2.0 * np.pi)
    aside = 0.45 * size * np.array([np.cos(turn), np.sin(turn), 0.5])
    for offset in (aside, -aside):
        _add_lump(builder, pick(rng, small), leaf, top + offset)
    builder.claim(xy_m, 1.6 * size)


def add_bush(builder: SceneBuilder, nursery: Nursery, xy_m: Array) -> None:
    """Adds a round bush of 0.7 to 1.3 m."""
    rng = builder.rng
    half = rng.uniform(0.45, 0.8) * np.array([1.0, rng.uniform(0.8, 1.2), 0.85])
    mesh = builder.mesh(builder.unique("bush"), blob(rng, half, 2.3, 0.10, 8, 1.2))
    leaf = pick(rng, nursery.leaves)
    at = builder.on_ground(xy_m, 0.6 * half[2])
    builder.geom("trees_bush", HEDGE, mesh=mesh, material=leaf, pos=at)
    builder.cast(at + half * _SPHERE, 0.9)
    builder.claim(xy_m, 0.8)


def add_hedge(
    builder: SceneBuilder, nursery: Nursery, start_xy_m: Array, end_xy_m: Array, height_m: float
) -> None:
    """Adds a clipped hedge along a segment."""
    rng = builder.rng
    span = end_xy_m - start_xy_m
    half = np.array([0.5 * np.hypot(*span), 0.38, 0.5 * height_m + 0.25])
    rings = 14
    mesh = builder.mesh(builder.unique("hedge"), blob(rng, half, 8.0, 0.012, rings, 1.1))
    middle = 0.5 * (start_xy_m + end_xy_m)
    steps = np.linspace(0.0, 1.0, 9)[:, None]
    ground = float(builder.terrain.at(start_xy_m + steps * span).mean())
    at = np.array([*middle, ground + 0.5 * height_m - 0.25])
    angle = float(np.arctan2(span[1], span[0]))
    builder.geom("trees_hedge", HEDGE, mesh=mesh, material=nursery.hedge_leaf, pos=at,
                 heading=angle)  # fmt: skip
    builder.cast_box((half[0], half[1]), (-half[2], half[2]), angle, at, 0.95)
    builder.claim_line(start_xy_m, end_xy_m, max(2, int(half[0])))


def add_rock(builder: SceneBuilder, xy_m: Array, radius_m: float) -> None:
    """Adds a boulder, a third of it in the ground."""
    rng = builder.rng
    half = radius_m * rng.uniform([0.9, 0.7, 0.55], [1.3, 1.0, 0.85])
    mesh = builder.mesh(builder.unique("rock"), blob(rng, half, 2.6, 0.12, 6, 1.0))
    at = builder.on_ground(xy_m, 0.3 * half[2])
    grey = rng.uniform(0.46, 0.60)
    builder.geom("rock", ROCK, mesh=mesh, pos=at, rgba=[grey, 0.98 * grey, 0.93 * grey, 1])
    builder.cast(at + half * _SPHERE)
    builder.claim(xy_m, 1.2 * radius_m)


def _add_lump(builder: SceneBuilder, lump: tuple[str, float], leaf: str, at: Array) -> None:
    mesh, radius = lump
    builder.geom("trees_crown", CROWN, mesh=mesh, material=leaf, pos=at,
                 heading=draw_heading(builder.rng))  # fmt: skip
    builder.cast(at + radius * np.array([1.0, 1.0, 0.8]) * _SPHERE, 1.0 - CROWN.porosity)


def _sphere_points() -> Array:
    """(K, 3) points spread over the unit sphere (a Fibonacci spiral)."""
    count = 60
    index = np.arange(count) + 0.5
    polar = np.arccos(1.0 - 2.0 * index / count)
    azimuth = np.pi * (1.0 + np.sqrt(5.0)) * index
    return np.stack(
        [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1
    )


_SPHERE = _sphere_points()
