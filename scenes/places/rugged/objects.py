"""What lies and grows on rugged ground: boulders, logs and stumps, scrub, tussocks."""

from dataclasses import dataclass

import cv2
import numpy as np

from touchdown.scenes.api import Array, Surface
from touchdown.scenes.authoring.builder import SceneBuilder, turned
from touchdown.scenes.authoring.ground import Ground
from touchdown.scenes.authoring.noise import fractal_noise
from touchdown.scenes.authoring.plane import draw_heading, unit
from touchdown.scenes.authoring.relief import HALF_M
from touchdown.scenes.places.rugged.presets import Dials
from touchdown.scenes.places.rugged.relief import CELL_M, NODES
from touchdown.scenes.places.rugged.rocks import Rocks, boulder_mesh
from touchdown.scenes.places.rugged.safe_ground import SafeGround
from touchdown.scenes.props import woods
from touchdown.scenes.props.scrubland import add_scrub, grow_scrub, weathered

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


def place_boulders(builder: SceneBuilder, rocks: Rocks, rock: Ground) -> None:
    """Adds rocks as bodies of their own."""
    surface = Surface(land_class="other", reflectivity=rock.look.surface.reflectivity)
    material = builder.material("boulder", weathered(builder.rng, rock.look.rgb))
    for index in range(len(rocks.diameter_m)):
        data = boulder_mesh(builder.rng, rocks, index, _UV_M)
        mesh = builder.mesh(builder.unique("boulder"), data)
        at, heading = builder.on_ground(rocks.xy_m[index]), float(rocks.heading[index])
        builder.geom("rock", surface, mesh=mesh, material=material, pos=at, heading=heading)
        builder.cast(turned(data.vertices, heading, at))


def place_plants(builder: SceneBuilder, plants: Plants, safe: SafeGround) -> None:
    """Adds logs, stumps and scrub that lie on no pad."""
    if len(plants.logs):
        bark = woods.bark(builder.rng, (120.0, 98.0, 76.0))
        wood = woods.Wood(bark=builder.material("wood_bark", bark))
        woods.grow_stumps(builder, wood)
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
