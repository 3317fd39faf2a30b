"""`open_water`: a level sheet of 256 x 256 m around the only ground to land on: a raft, a pontoon
or an islet, by the seed."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import mujoco
import numpy as np

from touchdown.scenes.api import Array, GroundRaster, Surface
from touchdown.scenes.authoring import water
from touchdown.scenes.authoring.builder import GEOM, SceneBuilder, add_material, fill_texture
from touchdown.scenes.authoring.draft import SceneDraft
from touchdown.scenes.authoring.generation import finish, scene_rng, start_scene
from touchdown.scenes.authoring.ground import TEXELS, Canvas, Ground
from touchdown.scenes.authoring.light import bake_light, ground_texture
from touchdown.scenes.authoring.meshes import box, plaque
from touchdown.scenes.authoring.noise import fractal_noise
from touchdown.scenes.authoring.plane import draw_heading, pick, unit, wavy
from touchdown.scenes.authoring.plots import Plot, SurveyFrame, free_spots
from touchdown.scenes.authoring.relief import HeightField, level_takeoff, smoothstep, write_hfield
from touchdown.scenes.props import waterside
from touchdown.scenes.props.plants import Nursery, add_bush, add_rock, plant_nursery
from touchdown.scenes.props.pontoon import place_pontoon, square_shadow

FREEBOARD_M = 0.45
"""Of both kinds of deck."""


def place_raft(builder: SceneBuilder) -> None:
    """Adds a bathing raft of boards on drums, a flagpole at a corner, a rowing boat alongside."""
    rng = builder.rng
    size = (float(rng.uniform(6.4, 8.0)), float(rng.uniform(6.0, 7.0)))
    plot = Plot(origin_xy_m=np.zeros(2), angle=float(rng.uniform(-0.6, 0.6)))
    deck = waterside.Deck(plot=plot, size_m=size, top_m=0.0)
    tone = rng.uniform(0.85, 1.15)
    waterside.add_deck(
        builder,
        deck,
        waterside.planks(rng, size, 128.0, (168.0 * tone, 140.0 * tone, 108.0 * tone)),
    )
    builder.claim(np.zeros(2), 0.75 * max(size))
    x, y = 0.5 * size[0], 0.5 * size[1]
    for side in (-1.0, 1.0):
        along = side * (y - 0.35)
        ends = plot.at(-x + 0.2, along), plot.at(x - 0.2, along)
        builder.geom("drum", waterside.PILE, capsule=0.33, rgba=[0.16, 0.24, 0.36, 1],
                     fromto=[*ends[0], -0.5, *ends[1], -0.5])  # fmt: skip
    _flagpole(builder, plot.at(x - 0.25, y - 0.25))
    _ladder(builder, plot, -x)
    model = waterside.add_boat_models(builder, 1)[0]
    heading = plot.angle + rng.uniform(-0.06, 0.06)
    waterside.add_boat(builder, model, plot.at(0.8, -y - 1.1), heading)


def _flagpole(builder: SceneBuilder, xy_m: Array) -> None:
    builder.geom("flagpole", waterside.PILE, cylinder=0.03,
                 fromto=[*xy_m, 0.0, *xy_m, 2.8], rgba=[0.92, 0.92, 0.92, 1])  # fmt: skip
    turn = draw_heading(builder.rng)
    flag = xy_m + 0.38 * unit(turn)
    builder.geom("flag", waterside.PILE, box=[0.36, 0.01, 0.22], pos=[*flag, 2.55],
                 heading=turn, rgba=[0.86, 0.16, 0.12, 1])  # fmt: skip
    square_shadow(builder, xy_m, 0.03, 2.8)


def _ladder(builder: SceneBuilder, plot: Plot, x: float) -> None:
    """Two bent tubes over the edge at ``x`` of the deck."""
    for y in (-0.25, 0.25):
        foot = plot.at(x - 0.05, y)
        builder.geom("ladder", waterside.PILE, capsule=0.025,
                     fromto=[*foot, -0.9, *foot, 0.75], rgba=[0.75, 0.77, 0.78, 1])  # fmt: skip


ISLET_HALF_M = 16.0
ISLET_NODES = 97
ISLET_TEXELS = 1280
_SUNK_M = 0.2
"""The height field ends this far below the water, the bed goes on in the texture alone."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Islet:
    """An islet about the origin."""

    terrain: HeightField
    """sunk to `_SUNK_M` below the water at the rim"""
    shore_m: Array
    """(N, N) metres from the waterline at its nodes, negative in the water"""
    level_m: float


def shape_islet(rng: np.random.Generator) -> Islet:
    """Returns sand that rises out of the water to a grassy hump; the height at the origin is 0."""
    flat = HeightField(heights_m=np.zeros((ISLET_NODES, ISLET_NODES)), half_m=ISLET_HALF_M)
    x, y = np.moveaxis(flat.node_grid(), -1, 0)
    amplitude = rng.uniform(0.3, 1.0, 4) * np.array([0.16, 0.08, 0.05, 0.04])
    phase = rng.uniform(0.0, 2.0 * np.pi, 4)
    outline = rng.uniform(7.0, 8.8) * wavy(np.arctan2(y, x), amplitude, phase)
    ragged = 0.3 * fractal_noise(rng, x.shape, 3.0 / flat.cell_m, 3).astype(np.float64)
    shore = outline - np.hypot(x, y) + ragged
    hump = rng.uniform(0.5, 0.75) * smoothstep(0.0, 5.0, shore) + 0.05 * np.maximum(shore, 0.0)
    lumps = 0.05 * fractal_noise(rng, x.shape, 2.0 / flat.cell_m, 2).astype(np.float64)
    land = hump + lumps * smoothstep(1.0, 3.0, shore)
    heights = np.where(shore > 0.0, land, np.maximum(0.16 * shore, -_SUNK_M))
    level = -float(HeightField(heights_m=heights, half_m=ISLET_HALF_M).point(0.0, 0.0))
    terrain = level_takeoff(heights, np.zeros(2), ISLET_HALF_M)
    return Islet(terrain=terrain, shore_m=shore, level_m=level)


def bed_depth(islet: Islet, size: int, half_m: float) -> water.Float32:
    """(size, size) depth of the water over a square of +-half_m about the islet, row 0 at y_min:
    shallows that fall off to 7 m."""
    inner = round(size * ISLET_HALF_M / half_m)
    shore = np.full((size, size), -40.0, np.float32)
    first = (size - inner) // 2
    shore[first : first + inner, first : first + inner] = water.upsample(islet.shore_m, inner)
    axis = (np.arange(size) + 0.5) / size * 2.0 * half_m - half_m
    reach = np.hypot(*np.meshgrid(axis, axis)).astype(np.float32)
    out = np.where(shore > -30.0, -shore, reach - 8.0)
    out = np.where(reach > ISLET_HALF_M - 4.0, np.maximum(out, reach - 8.5), out)
    out = cv2.GaussianBlur(out.astype(np.float32), (0, 0), 1.5)
    far = smoothstep(3.0, 16.0, np.asarray(out, np.float64))
    return np.asarray(0.16 * np.minimum(out, 6.0) + 6.0 * far, np.float32)


def add_islet(builder: SceneBuilder, islet: Islet) -> GroundRaster:
    """Adds the islet with its texture, after all objects that cast a shadow on it."""
    spec, rng = builder.spec, builder.rng
    spec.add_texture(name="islet", type=mujoco.mjtTexture.mjTEXTURE_2D, nchannel=3)
    canvas = Canvas.of_size(ISLET_HALF_M, ISLET_TEXELS)
    shore = water.upsample(islet.shore_m, ISLET_TEXELS)
    fray = fractal_noise(rng, shore.shape, 60.0, 4, 0.6)
    canvas.material[:] = int(Ground.BEACH)
    canvas.material[shore > 2.1 + 0.35 * fray] = int(Ground.MEADOW)
    canvas.material[(shore > 3.0 + 0.5 * fray) & (fray > -0.5)] = int(Ground.LAWN)
    canvas.material[(shore < 0.7) & (fray > 0.7)] = int(Ground.GRAVEL)
    local = replace(builder, terrain=islet.terrain)
    shade = ground_texture(local, canvas, dict.fromkeys(Ground, float(rng.uniform(0, 3))))
    texture = np.empty((*canvas.material.shape, 3), np.uint8)
    shade(texture)
    # The strand is wet up to a hand's breadth above the water.
    wet = np.clip(1.0 - shore / 0.6, 0.0, 1.0)[::-1, :, None]
    texture[:] = (texture * (1.0 - 0.34 * wet)).astype(np.uint8)
    fill_texture(spec.texture("islet"), texture)
    depth = water.upsample(islet.level_m - islet.terrain.heights_m, ISLET_TEXELS)
    return water.flood_raster(canvas.raster("islet"), depth)


def place_islet(builder: SceneBuilder, islet: Islet) -> None:
    """Adds the height field and, around a clear middle, bushes, rocks and a beacon."""
    spec, rng = builder.spec, builder.rng
    add_material(spec, "islet", "islet")
    spec.add_hfield(name="islet", nrow=ISLET_NODES, ncol=ISLET_NODES, size=[1.0, 1.0, 1.0, 1.0])
    surface = Surface(land_class="field", reflectivity=0.42)
    builder.surfaces["islet"] = surface
    spec.worldbody.add_geom(
        name="islet", type=GEOM.mjGEOM_HFIELD, hfieldname="islet", material="islet"
    )
    write_hfield(spec, "islet", "islet", islet.terrain, base_m=0.3)
    builder.claim(np.zeros(2), 3.2)
    nursery: Nursery = plant_nursery(builder)
    shore = HeightField(heights_m=islet.shore_m, half_m=ISLET_HALF_M)
    bushes, rocks = int(rng.integers(2, 5)), int(rng.integers(7, 12))

    def spots(count: int, low_m: float, high_m: float) -> Iterator[Array]:
        """Of the shore."""
        return free_spots(
            builder, count, 60 * count, 11.0, 0.9, lambda xy: low_m < float(shore.at(xy)) < high_m
        )

    for spot in spots(bushes, 1.6, 4.5):
        add_bush(builder, nursery, spot)
    for spot in spots(rocks, -1.2, 1.2):
        add_rock(builder, spot, rng.uniform(0.25, 0.7))
    for spot in spots(1, 1.0, 3.5):
        add_beacon(builder, spot)


def add_beacon(builder: SceneBuilder, xy_m: Array) -> None:
    """Adds a mast of 4.5 m with a striped board."""
    z = builder.terrain.point(*xy_m)
    waterside.add_pile(builder, xy_m, z + 4.5, 0.07)
    for index, rgba in enumerate(([0.85, 0.12, 0.10, 1], [0.95, 0.95, 0.93, 1])):
        builder.geom("beacon_board", Surface(land_class="other", reflectivity=0.5), box=[0.04, 0.4,
                     0.3], pos=[*xy_m, z + 4.2 - 0.6 * index], rgba=rgba)  # fmt: skip
    builder.claim(xy_m, 0.8)


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
    plan = SurveyFrame(takeoff_xy_m=np.zeros(2), takeoff_yaw=float(rng.uniform(-np.pi, np.pi)))
    return finish(plan, builder, ground)


def _surface(level_m: float, islet: Islet | None) -> HeightField:
    """Surface below all objects: the water, and the islet where it is higher."""
    heights = np.full((_NODES, _NODES), level_m)
    terrain = HeightField(heights_m=heights, half_m=HALF_M)
    if islet is not None:
        xy = terrain.node_grid()
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
        waterside.add_sailing_boat(builder, spot, wind + rng.uniform(-0.25, 0.25))
    for index, spot in enumerate(spots[wanted:]):
        colour = [0.82, 0.13, 0.10, 1] if index % 2 else [0.10, 0.48, 0.22, 1]
        waterside.add_buoy(builder, spot, 0.55, colour)


def _spread_water(builder: SceneBuilder, level_m: float, depth: water.Float32) -> None:
    """The sheet and its texture, after all objects that cast a shadow on it."""
    spec, rng = builder.spec, builder.rng
    below = box((HALF_M, HALF_M, 0.25), (0.0, 0.0, -0.252), 1e3)
    mesh = builder.mesh("water", plaque((HALF_M, HALF_M), below))
    sheet = Surface(land_class="water", reflectivity=water.WATER_REFLECTIVITY, water=True)
    builder.geom("water", sheet, mesh=mesh, material="water", pos=[0.0, 0.0, level_m])
    light = bake_light(builder.casters, builder.terrain, builder.sun, TEXELS // 2)
    bed = fractal_noise(rng, (_DEPTH_PX, _DEPTH_PX), 20.0, 4, 0.6)
    coarse = np.clip(_SAND * (1.0 + 0.08 * bed[..., None]), 0.0, 255.0).astype(np.uint8)
    image = np.asarray(cv2.resize(coarse, (TEXELS, TEXELS)), np.uint8)
    water.lay_water(rng, image, depth, HALF_M, water.varied(water.draw_look(rng)), builder.sun)
    # A shadow takes the sun from the water's body but leaves the mirrored sky.
    dim = (0.35 + 0.65 * light) / (0.35 + 0.65 * light.max())
    shade = cv2.resize((255.0 * dim[::-1]).astype(np.uint8), (TEXELS, TEXELS))
    for channel in range(3):
        image[..., channel] = cv2.multiply(image[..., channel], shade, scale=1.0 / 255.0)
    fill_texture(spec.texture("water"), image)
