"""Winter: conifers and bushes under snow, boulders with a cap of snow, poles, a snowman."""

from __future__ import annotations

import cv2
import numpy as np

from touchdown.scenes.api import Array, Image, Surface
from touchdown.scenes.authoring.builder import GEOM, SceneBuilder, quat_z
from touchdown.scenes.authoring.meshes import blob
from touchdown.scenes.authoring.noise import tileable_noise
from touchdown.scenes.authoring.plane import draw_heading
from touchdown.scenes.authoring.textures import Colour, hedge_or_soil_tint, to_texture
from touchdown.scenes.props.plants import ROCK
from touchdown.scenes.props.tree_shapes import bark, canopy_mesh, conifer_mesh, lathe, needles
from touchdown.scenes.props.woods import Crown, Wood

CAP = Surface(land_class="other", reflectivity=0.87)
POLE = Surface(land_class="other", reflectivity=0.35)
SNOW_RGB = np.array([226.0, 231.0, 239.0])
_GREENS: tuple[Colour, ...] = ((50.0, 70.0, 54.0), (44.0, 62.0, 50.0), (66.0, 78.0, 54.0))


def laden(rng: np.random.Generator, image: Image, share: float) -> Image:
    """``image`` (H, W, 3), periodic, with clumps of snow on ``share`` of it: more towards the
    bottom, where the boughs' outer ends are; each clump casts a shade below it."""
    height, width = image.shape[:2]
    lumps = tileable_noise(rng, max(height, width), 1.5, 9.0)[:height, :width]
    lumps = lumps + 0.35 * tileable_noise(rng, max(height, width), 0.9, 30.0)[:height, :width]
    outward = np.linspace(-0.55, 0.55, height, dtype=np.float32)[:, None]
    level = float(np.quantile(lumps + outward, 1.0 - share))
    cover = np.clip((lumps + outward - level) * 3.0, 0.0, 1.0)
    relief = cv2.GaussianBlur(lumps, (0, 0), 2.0)
    shade = 0.90 + 0.10 * np.clip(np.roll(relief, 5, axis=0) * -1.0 + relief + 0.6, 0.0, 1.2)
    below = 1.0 - 0.45 * np.roll(cover, 9, axis=0) * (1.0 - cover)
    white = shade[..., None] * SNOW_RGB
    dark = image.astype(np.float32) * below[..., None]
    return to_texture((dark + cover[..., None] * (white - dark)).astype(np.float32))


def grow_winter_wood(builder: SceneBuilder) -> Wood:
    """Adds snow-laden conifers from young to 12 m, and bushes, for the functions of
    `scenes.props.woods`."""
    rng = builder.rng
    wood = Wood()
    for index, base in enumerate(_GREENS):
        green = needles(rng, hedge_or_soil_tint(rng, base, 0.08))
        image = laden(rng, green, float(rng.uniform(0.60, 0.78)))
        wood.needles.append(builder.material(f"trees_needles_{index}", image))
    twigs = needles(rng, hedge_or_soil_tint(rng, (96.0, 80.0, 66.0), 0.08))
    wood.leaves.append(builder.material("trees_twigs", laden(rng, twigs, 0.55)))
    wood.bark = builder.material("wood_bark", bark(rng, (92.0, 78.0, 66.0)))
    for prefix, heights, kept in (
        ("conifer", (5.0, 7.0, 9.0, 11.0, 12.5), wood.conifers),
        ("sapling", (1.3, 2.4), wood.saplings),
    ):
        for index, height in enumerate(heights):
            radius = height * rng.uniform(0.19, 0.23) + 0.45
            mesh = builder.mesh(f"{prefix}_{index}", conifer_mesh(rng, height, radius))
            kept.append(Crown(mesh=mesh, radius_m=radius, height_m=height))
    for index, crown in enumerate(wood.conifers):
        radius = 0.06 + 0.013 * crown.height_m
        profile = np.array([[-0.7, 1.3 * radius], [0.25, radius],
                            [0.6 * crown.height_m, 0.03 + 0.008 * crown.height_m]])  # fmt: skip
        name = f"conifer_trunk_{index}"
        wood.trunks[crown.mesh] = builder.mesh(name, lathe(rng, profile, 7, 0.06))
    for index, radius in enumerate((0.5, 0.8)):
        half = radius * np.array([1.0, rng.uniform(0.8, 1.1), 0.7])
        mesh = builder.mesh(f"shrub_{index}", canopy_mesh(rng, half, 8, 1.4))
        wood.shrubs.append(Crown(mesh=mesh, radius_m=radius, height_m=float(half[2])))
    return wood


def add_snowy_rock(builder: SceneBuilder, xy_m: Array, radius_m: float) -> None:
    """Adds a boulder that the snow half buries, with a cap on its top."""
    rng = builder.rng
    half = radius_m * rng.uniform([0.9, 0.75, 0.55], [1.3, 1.0, 0.75])
    z = builder.terrain.point(*xy_m)
    quat = quat_z(draw_heading(rng))
    mesh = builder.mesh(builder.unique("rock"), blob(rng, half, 2.5, 0.10, 7, 1.0))
    grey = rng.uniform(0.36, 0.50)
    builder.geom("rock", ROCK, mesh=mesh, pos=[*xy_m, z], quat=quat,
                 rgba=[grey, 0.97 * grey, 0.93 * grey, 1])  # fmt: skip
    builder.cast(np.array([*xy_m, z]) + half.mean() * _BALL)
    # The cap lies on the upper half: where it would touch the sides, the boulder sticks out.
    cap = half * [0.80, 0.80, 0.42]
    mesh = builder.mesh(builder.unique("cap"), blob(rng, cap, 2.2, 0.08, 7, 1.0))
    builder.geom("cap", CAP, mesh=mesh, pos=[*xy_m, z + 0.72 * half[2]], quat=quat,
                 rgba=[*(SNOW_RGB / 255.0), 1])  # fmt: skip


def add_snow_pole(builder: SceneBuilder, xy_m: Array) -> None:
    """Adds a marker pole of 1.6 m: dark wood with a red head."""
    z = builder.terrain.point(*xy_m)
    wood, red = [0.30, 0.23, 0.18, 1], [0.78, 0.16, 0.10, 1]
    for low, high, rgba in ((-0.3, 1.25, wood), (1.25, 1.6, red)):
        builder.geom("pole", POLE, cylinder=0.03, rgba=rgba,
                     fromto=[*xy_m, z + low, *xy_m, z + high])  # fmt: skip
    square = 0.03 * np.array([[1, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0]], np.float64)
    foot = np.array([*xy_m, z])
    builder.cast(np.concatenate([foot + square, foot + square + [0.0, 0.0, 1.6]]))
    builder.claim(xy_m, 0.6)


def add_snowman(builder: SceneBuilder, xy_m: Array) -> None:
    """Adds a snowman of 1.5 m with a hat."""
    z = builder.terrain.point(*xy_m)
    white = [*(SNOW_RGB / 255.0), 1.0]
    for radius, at in ((0.42, 0.30), (0.30, 0.86), (0.20, 1.26)):
        centre = np.array([*xy_m, z + at])
        builder.geom("snowman", CAP, ball=radius, rgba=white, pos=centre)
        ring = radius * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1.0]])
        builder.cast(centre + ring)
    builder.geom("snowman", POLE, type=GEOM.mjGEOM_CYLINDER, size=[0.15, 0.09, 0],
                 rgba=[0.10, 0.10, 0.12, 1], pos=[*xy_m, z + 1.50])  # fmt: skip
    builder.claim(xy_m, 0.9)


_BALL = np.array([
    [np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)]
    for t in np.linspace(0.0, np.pi, 5) for p in np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False)
])  # fmt: skip
