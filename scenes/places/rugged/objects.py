"""What lies and grows on rugged ground: boulders, logs and stumps, scrub, tussocks."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from touchdown.scenes.api import Array, Image, Surface
from touchdown.scenes.authoring import textures
from touchdown.scenes.authoring.builder import SceneBuilder, turned
from touchdown.scenes.authoring.ground import Ground
from touchdown.scenes.authoring.noise import fractal_noise, tileable_noise
from touchdown.scenes.authoring.plane import draw_heading, unit
from touchdown.scenes.authoring.relief import HALF_M
from touchdown.scenes.places.rugged.presets import Dials
from touchdown.scenes.places.rugged.relief import CELL_M, NODES
from touchdown.scenes.places.rugged.rocks import Rocks, boulder_mesh
from touchdown.scenes.places.rugged.safe_ground import SafeGround
from touchdown.scenes.props import woods
from touchdown.scenes.props.scrubland import add_scrub, grow_scrub

BOULDERS, BOULDER_M = 240, 0.7
"""So many rocks, the largest, at least so wide, are bodies of their own."""
_UV_M = 1.8
_LOGS, _STUMPS, _SCRUB = 150, 130, 190
_TUSSOCKS_PER_M2 = 0.55


@dataclass(frozen=True, kw_only=True, slots=True)
class Plants:
    """Spots of what stands on the ground, world metres."""

    logs: Array
    """(N, 4): both ends"""
    stumps: Array
    """(N, 2)"""
    scrub: Array
    """(N, 2)"""
    tussocks: Rocks


def draw_plants(rng: np.random.Generator, dials: Dials) -> Plants:
    """What the cover asks for."""
    density = fractal_noise(rng, (256, 256), 18.0, 3, 0.6)
    weight = np.clip(density + 0.6, 0.05, None).astype(np.float64)

    def spots(count: int) -> Array:
        cells = rng.choice(weight.size, count, p=(weight / weight.sum()).ravel())
        at = np.stack([cells % 256, cells // 256], axis=-1) + rng.uniform(0.0, 1.0, (count, 2))
        return (HALF_M - 2.0) * (at / 128.0 - 1.0)

    felled = dials.cover == "logs"
    middle, fall = spots(_LOGS * felled), draw_heading(rng)
    # Felled the same way, with exceptions.
    ways = unit(fall + rng.normal(0.0, 0.45, len(middle)))
    half = rng.uniform(1.0, 5.0, (len(middle), 1)) * ways
    ends = np.clip(np.hstack([middle - half, middle + half]), -HALF_M + 1.0, HALF_M - 1.0)
    count = int(_TUSSOCKS_PER_M2 * (2.0 * HALF_M) ** 2) * (dials.cover == "tussocks")
    width = rng.uniform(0.25, 0.65, count)
    tussocks = Rocks(
        xy_m=spots(count), diameter_m=width, aspect=rng.uniform(1.0, 1.4, count),
        heading=rng.uniform(0.0, 2.0 * np.pi, count), shape=np.zeros(count, np.int64),
        height_m=width * rng.uniform(0.35, 0.6, count), turn=np.zeros(count),
    )  # fmt: skip
    return Plants(
        logs=ends,
        stumps=spots(_STUMPS * felled),
        scrub=spots(_SCRUB * (dials.cover == "scrub")),
        tussocks=tussocks,
    )


def tall_things(plants: Plants) -> Array:
    """(NODES, NODES) metres that logs, stumps and scrub rise over the ground, about."""
    mask = np.zeros((NODES, NODES), np.uint8)

    def node(xy: Array) -> list[int]:
        return [round(float(v)) for v in (xy + HALF_M) / CELL_M]

    for log in plants.logs:
        cv2.line(mask, node(log[:2]), node(log[2:]), 30, 3)
    for radius, spots in ((0.3, plants.stumps), (0.7, plants.scrub)):
        for xy in spots:
            cv2.circle(mask, node(xy), round(radius / CELL_M), 50, -1)
    return mask / 100.0


def stone(rng: np.random.Generator, rock: Ground) -> Image:
    """(512, 512, 3), periodic: weathered rock of the colour of ``rock`` with joints and lichen."""
    tone = 1.0 + 0.13 * tileable_noise(rng, textures.TILE_PX, 1.3, 3.0)
    tone += 0.09 * tileable_noise(rng, textures.TILE_PX, 0.4, 20.0)
    joints = np.abs(tileable_noise(rng, textures.TILE_PX, 2.0, 3.0))
    tone *= 1.0 - 0.3 * np.exp(-((joints / 0.025) ** 2))
    image = tone[..., None] * np.array(rock.look.rgb, np.float32)
    lichen = tileable_noise(rng, textures.TILE_PX, 1.1, 6.0) > 1.7
    image[lichen] = 0.6 * image[lichen] + 0.4 * np.array([176.0, 178.0, 140.0])
    return textures.to_texture(image.astype(np.float32))


def place_boulders(builder: SceneBuilder, rocks: Rocks, rock: Ground) -> None:
    """Adds rocks as bodies of their own."""
    surface = Surface(land_class="other", reflectivity=rock.look.surface.reflectivity)
    material = builder.material("boulder", stone(builder.rng, rock))
    for index in range(len(rocks.diameter_m)):
        data = boulder_mesh(builder.rng, rocks, index, _UV_M)
        mesh = builder.mesh(builder.unique("boulder"), data)
        at, heading = builder.on_ground(rocks.xy_m[index]), float(rocks.heading[index])
        builder.geom("rock", surface, mesh=mesh, material=material, pos=at, heading=heading)
        builder.cast(turned(data.vertices, heading, at))


def place_plants(builder: SceneBuilder, plants: Plants, safe: SafeGround) -> None:
    """Adds logs, stumps and scrub that lie on no pad."""
    if len(plants.logs):
        wood = woods.Wood(bark=builder.material("wood_bark", woods.bark(builder.rng, (120.0, 98.0,
                          76.0))))  # fmt: skip
        for index, (radius, height) in enumerate(((0.18, 0.26), (0.25, 0.36), (0.33, 0.40))):
            profile = np.array([[-0.35, 1.5 * radius], [0.04, 1.35 * radius],
                                [0.14, 1.05 * radius], [height, radius]])  # fmt: skip
            mesh = builder.mesh(f"stump_{index}", woods.lathe(builder.rng, profile, 11, 0.07))
            wood.stumps.append(woods.Crown(mesh=mesh, radius_m=radius, height_m=height))
        along = np.linspace(0.0, 1.0, 15)[:, None]
        for log in plants.logs:
            points = log[:2] + along * (log[2:] - log[:2])
            if np.ptp(points, axis=0).max() > 1.0 and safe.clear(points, np.full(15, 0.4)).all():
                woods.add_log(builder, wood, log[:2], log[2:], builder.rng.uniform(0.11, 0.26))
        for xy in plants.stumps[safe.clear(plants.stumps, np.full(len(plants.stumps), 0.5))]:
            woods.add_stump(builder, wood, xy)
    free = safe.clear(plants.scrub, np.full(len(plants.scrub), 1.0))
    if free.any():
        land = grow_scrub(builder)
        for xy in plants.scrub[free]:
            add_scrub(builder, land, xy)
