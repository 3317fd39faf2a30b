"""`open_water`: fills open_water.xml with a scene drawn from a seed.

The water is one level sheet of 256 x 256 m. The only ground to land on is the take-off
ground: a raft, a pontoon or an islet, by the seed.
"""

from __future__ import annotations

import cv2
import numpy as np

from touchdown.scenes.api import Array, Surface
from touchdown.scenes.authoring.builder import SceneBuilder, fill_texture
from touchdown.scenes.authoring.draft import SceneDraft
from touchdown.scenes.authoring.generation import Takeoff, finish, scene_rng, start_scene
from touchdown.scenes.authoring.ground import TEXELS
from touchdown.scenes.authoring.light import bake_light
from touchdown.scenes.authoring.meshes import MeshData, box, polygon
from touchdown.scenes.authoring.noise import fractal_noise
from touchdown.scenes.authoring.plane import draw_heading, pick
from touchdown.scenes.authoring.relief import HeightField
from touchdown.scenes.authoring.water import (
    WATER_REFLECTIVITY,
    Float32,
    WaterLook,
    lay_water,
    varied,
)
from touchdown.scenes.places.open_water.islet import (
    Islet,
    add_islet,
    bed_depth,
    place_islet,
    shape_islet,
)
from touchdown.scenes.places.open_water.rafts import FREEBOARD_M, place_pontoon, place_raft
from touchdown.scenes.props.boats import add_buoy, add_sailing_boat

HALF_M = 128.0
KINDS = ("islet", "raft", "pontoon")
_NODES = 257
_DEPTH_PX = TEXELS // 4
_SAND = np.array([198.0, 182.0, 146.0], np.float32)


def generate(seed: int) -> SceneDraft:
    """Returns the scene of ``seed`` without the vehicle. The same seed gives the same bytes."""
    rng = scene_rng("open_water", seed)
    kind = pick(rng, KINDS)
    islet = shape_islet(rng) if kind == "islet" else None
    level = islet.level_m if islet else -FREEBOARD_M
    builder = start_scene("open_water", rng, _surface(level, islet))
    if islet:
        place_islet(builder, islet)
    elif kind == "raft":
        place_raft(builder)
    else:
        place_pontoon(builder)
    _place_boats(builder)
    ground = add_islet(builder, islet) if islet else None
    if islet:
        depth = bed_depth(islet, _DEPTH_PX, HALF_M)
    else:
        depth = np.full((_DEPTH_PX, _DEPTH_PX), 7.0, np.float32)
    _spread_water(builder, level, depth)
    plan = Takeoff(takeoff_xy_m=np.zeros(2), takeoff_yaw=float(rng.uniform(-np.pi, np.pi)))
    return finish(plan, builder, ground)


def _surface(level_m: float, islet: Islet | None) -> HeightField:
    """Surface below all objects: the water, and the islet where it is higher."""
    heights = np.full((_NODES, _NODES), level_m)
    terrain = HeightField(heights_m=heights, half_m=HALF_M)
    if islet is not None:
        xy = np.stack(terrain.node_grid(), axis=-1)
        near = (np.abs(xy) < islet.terrain.half_m).all(axis=-1)
        heights[near] = np.maximum(islet.terrain.at(xy[near]), level_m)
    return terrain


def _place_boats(builder: SceneBuilder) -> None:
    """Adds yachts at anchor and fairway buoys, none within 70 m: the survey sees nothing but water
    once the take-off spot is out of view."""
    rng = builder.rng
    wanted = int(rng.integers(3, 6))
    spots: list[Array] = []
    while len(spots) < wanted + 4:
        spot = rng.uniform(-HALF_M + 8.0, HALF_M - 8.0, 2)
        if np.hypot(*spot) > 85.0 and builder.is_free(spot, 9.0):
            builder.claim(spot, 5.0)
            spots.append(spot)
    wind = rng.uniform(0.0, 2.0 * np.pi)
    for spot in spots[:wanted]:
        add_sailing_boat(builder, spot, wind + rng.uniform(-0.25, 0.25))
    for index, spot in enumerate(spots[wanted:]):
        colour = [0.82, 0.13, 0.10, 1] if index % 2 else [0.10, 0.48, 0.22, 1]
        add_buoy(builder, spot, 0.55, colour)


def _spread_water(builder: SceneBuilder, level_m: float, depth: Float32) -> None:
    """The sheet and its texture, after all objects that cast a shadow on it."""
    spec, rng = builder.spec, builder.rng
    top = HALF_M * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float64)
    uv = np.array([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]])
    below = box((HALF_M, HALF_M, 0.25), (0.0, 0.0, -0.252), 1e3)
    mesh = builder.mesh("water", MeshData.join([polygon(top, uv), below]))
    water = Surface(land_class="water", reflectivity=WATER_REFLECTIVITY, water=True)
    builder.geom("water", water, mesh=mesh, material="water", pos=[0.0, 0.0, level_m])
    light = bake_light(builder.casters, builder.terrain, builder.sun, TEXELS // 2, ambient=0.50)
    bed = fractal_noise(rng, (_DEPTH_PX, _DEPTH_PX), 20.0, 4, 0.6)
    coarse = np.clip(_SAND * (1.0 + 0.08 * bed[..., None]), 0.0, 255.0).astype(np.uint8)
    image = np.asarray(cv2.resize(coarse, (TEXELS, TEXELS)), np.uint8)
    lay_water(rng, image, depth, HALF_M, varied(draw_look(rng)), builder.sun)
    # A shadow takes the sun from the water's body but leaves the mirrored sky.
    dim = (0.35 + 0.65 * light) / (0.35 + 0.65 * light.max())
    shade = cv2.resize((255.0 * dim[::-1]).astype(np.uint8), (TEXELS, TEXELS))
    for channel in range(3):
        image[..., channel] = cv2.multiply(image[..., channel], shade, scale=1.0 / 255.0)
    fill_texture(spec.texture("water"), image)


def draw_look(rng: np.random.Generator) -> WaterLook:
    """Returns the look of blue, green or grey water with waves of some metres."""
    colours = np.array([[18.0, 66.0, 96.0], [22.0, 80.0, 84.0], [46.0, 76.0, 88.0]])
    red, green, blue = rng.dirichlet(np.ones(3)) @ colours
    return WaterLook(
        body=(red, green, blue),
        clarity_m=(0.7, 1.5, 1.4),
        wave_m=float(rng.uniform(2.5, 5.0)),
        ripple=float(rng.uniform(0.45, 0.75)),
        wind_angle=draw_heading(rng),
    )
