"""Objects in the snow: conifers and bushes under snow, hut, fences, boulders, poles, and the ice of
the pond."""

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.api import Array, Image, Surface
from touchdown.scenes.authoring.builder import SceneBuilder
from touchdown.scenes.authoring.meshes import blob
from touchdown.scenes.authoring.noise import fractal_noise, tileable_noise
from touchdown.scenes.authoring.plane import draw_heading, pick, rotated, unit, unit_ball
from touchdown.scenes.authoring.relief import HALF_M
from touchdown.scenes.authoring.textures import Colour, hedge_or_soil_tint, to_texture
from touchdown.scenes.places.snow.layout import (
    Plan,
    Relief,
)
from touchdown.scenes.props import woods
from touchdown.scenes.props.houses import House, HouseLooks, add_house
from touchdown.scenes.props.plants import ROCK
from touchdown.scenes.props.stonework import add_log_pile
from touchdown.scenes.props.street import add_bench, add_fence
from touchdown.sim.geometry.tessellation import FIRST_HIDDEN_GROUP

CAP = Surface(land_class="other", reflectivity=0.87)
POLE = Surface(land_class="other", reflectivity=0.35)
SNOW_RGB = np.array([226.0, 231.0, 239.0])
_GREENS: tuple[Colour, ...] = ((50.0, 70.0, 54.0), (44.0, 62.0, 50.0), (66.0, 78.0, 54.0))


def laden(rng: np.random.Generator, image: Image, fraction: float) -> Image:
    """``image`` (H, W, 3), periodic, with clumps of snow on ``fraction`` of it: more towards the
    bottom, where the boughs' outer ends are; each clump casts a shade below it."""
    height, width = image.shape[:2]
    lumps = tileable_noise(rng, max(height, width), 1.5, 9.0)[:height, :width]
    lumps = lumps + 0.35 * tileable_noise(rng, max(height, width), 0.9, 30.0)[:height, :width]
    outward = np.linspace(-0.55, 0.55, height, dtype=np.float32)[:, None]
    level = float(np.quantile(lumps + outward, 1.0 - fraction))
    cover = np.clip((lumps + outward - level) * 3.0, 0.0, 1.0)
    relief = cv2.GaussianBlur(lumps, (0, 0), 2.0)
    shade = 0.90 + 0.10 * np.clip(np.roll(relief, 5, axis=0) * -1.0 + relief + 0.6, 0.0, 1.2)
    below = 1.0 - 0.45 * np.roll(cover, 9, axis=0) * (1.0 - cover)
    white = shade[..., None] * SNOW_RGB
    dark = image.astype(np.float32) * below[..., None]
    return to_texture((dark + cover[..., None] * (white - dark)).astype(np.float32))


def grow_winter_wood(builder: SceneBuilder) -> woods.Wood:
    """Adds snow-laden conifers from young to 12 m, and bushes, for the functions of
    `scenes.props.woods`."""
    rng = builder.rng
    wood = woods.Wood()
    for index, base in enumerate(_GREENS):
        green = woods.needles(rng, hedge_or_soil_tint(rng, base, 0.08))
        image = laden(rng, green, float(rng.uniform(0.60, 0.78)))
        wood.needles.append(builder.material(f"trees_needles_{index}", image))
    twigs = woods.needles(rng, hedge_or_soil_tint(rng, (96.0, 80.0, 66.0), 0.08))
    wood.leaves.append(builder.material("trees_twigs", laden(rng, twigs, 0.55)))
    wood.bark = builder.material("wood_bark", woods.bark(rng, (92.0, 78.0, 66.0)))
    woods.grow_conifers(builder, wood, (5.0, 7.0, 9.0, 11.0, 12.5), (1.3, 2.4), (0.19, 0.23))
    woods.grow_shrubs(builder, wood, (0.5, 0.8), 0.7, 1.4)
    return wood


def add_snowy_rock(builder: SceneBuilder, xy_m: Array, radius_m: float) -> None:
    """Adds a boulder that the snow half buries, with a cap on its top."""
    rng = builder.rng
    half = radius_m * rng.uniform([0.9, 0.75, 0.55], [1.3, 1.0, 0.75])
    z = builder.terrain.point(*xy_m)
    heading = draw_heading(rng)
    mesh = builder.mesh(builder.unique("rock"), blob(rng, half, 2.5, 0.10, 7, 1.0))
    grey = rng.uniform(0.36, 0.50)
    builder.geom("rock", ROCK, mesh=mesh, pos=[*xy_m, z], heading=heading,
                 rgba=[grey, 0.97 * grey, 0.93 * grey, 1])  # fmt: skip
    builder.cast(np.array([*xy_m, z]) + half.mean() * _BALL)
    # The cap lies on the upper half: where it would touch the sides, the boulder sticks out.
    cap = half * [0.80, 0.80, 0.42]
    mesh = builder.mesh(builder.unique("cap"), blob(rng, cap, 2.2, 0.08, 7, 1.0))
    builder.geom("cap", CAP, mesh=mesh, pos=[*xy_m, z + 0.72 * half[2]], heading=heading,
                 rgba=[*(SNOW_RGB / 255.0), 1])  # fmt: skip


def add_snow_pole(builder: SceneBuilder, xy_m: Array) -> None:
    """Adds a marker pole of 1.6 m: dark wood with a red head."""
    z = builder.terrain.point(*xy_m)
    wood, red = [0.30, 0.23, 0.18, 1], [0.78, 0.16, 0.10, 1]
    for low, high, rgba in ((-0.3, 1.25, wood), (1.25, 1.6, red)):
        builder.geom("pole", POLE, cylinder=0.03, rgba=rgba,
                     fromto=[*xy_m, z + low, *xy_m, z + high])  # fmt: skip
    builder.cast_box((0.03, 0.03), (0.0, 1.6), 0.0, np.array([*xy_m, z]))
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
    builder.geom("snowman", POLE, cylinder=(0.15, 0.09),
                 rgba=[0.10, 0.10, 0.12, 1], pos=[*xy_m, z + 1.50])  # fmt: skip
    builder.claim(xy_m, 0.9)


_BALL = unit_ball(5, 8)


SNOW = Surface(land_class="field", reflectivity=0.87)
ICE = Surface(land_class="water", reflectivity=0.06, water=True)
ICE_FRICTION = 0.08
_ICE_RISE_M = 0.004
"""of what is touched over the ice that is seen"""
_GREY_WOOD = [0.40, 0.34, 0.29, 1.0]


def place_objects(builder: SceneBuilder, plan: Plan, relief: Relief) -> None:
    """Adds everything that stands in the snow."""
    rng = builder.rng
    plot = plan.from_middle
    builder.claim(plan.takeoff_xy_m, 7.0)
    builder.claim(plan.pond_xy_m, 1.25 * plan.pond_radius_m)
    builder.claim(plan.hill_xy_m, 9.0)
    _place_hut(builder, plan)
    for start, end in plan.fences_m:
        add_fence(builder, start, end, _GREY_WOOD)
    for spot, radius in plan.rocks:
        if builder.is_free(spot, radius + 0.5):
            add_snowy_rock(builder, spot, radius)
            builder.claim(spot, radius + 0.8)
    for along in np.arange(-55.0, 56.0, 13.0):
        spot = plot.points(
            np.array([along + rng.uniform(-1.0, 1.0), 22.5 + rng.uniform(-1.0, 1.0)])
        )
        if np.abs(spot).max() < HALF_M - 2.0 and builder.is_free(spot, 0.5):
            add_snow_pole(builder, spot)
    turn = rng.uniform(0.0, 2.0 * np.pi)
    spot = plan.hut_xy_m + 7.0 * unit(turn)
    if builder.is_free(spot, 1.0):
        add_snowman(builder, spot)
    bank = plan.pond_xy_m + (plan.pond_radius_m + 3.0) * np.array([-plan.wind[1], plan.wind[0]])
    heading = float(np.arctan2(*(plan.pond_xy_m - bank)[::-1]))
    add_bench(builder, bank, heading)
    _place_trees(builder, plan, grow_winter_wood(builder))


def _place_hut(builder: SceneBuilder, plan: Plan) -> None:
    """A hut of dark logs under a thick roof of snow."""
    rng = builder.rng
    looks = HouseLooks(
        wall=builder.material("building_wall_0", _log_wall(rng)),
        roof=builder.material("building_roof_0", _snow_roof(rng)),
    )
    size = (6.0, 4.4, 2.3)
    hut = House(centre_xy_m=plan.hut_xy_m, angle=plan.hut_angle, size_m=size, ridge_m=1.9)
    add_house(builder, hut, looks)
    aside = rotated(np.array([4.6, 0.8]), plan.hut_angle)
    add_log_pile(builder, plan.hut_xy_m + aside, plan.hut_angle + 0.5 * np.pi)


def _log_wall(rng: np.random.Generator) -> NDArray[np.uint8]:
    """(448, 480, 3): round logs, a window with white frames, snow on the sill."""
    height, width = 448, 480
    rows, _ = np.mgrid[0:height, 0:width].astype(np.float32)
    log = rows / 26.0
    round_ = np.sqrt(np.clip(1.0 - (2.0 * (log - np.floor(log)) - 1.0) ** 2, 0.02, 1.0))
    tone = (0.35 + 0.65 * round_) * (1.0 + 0.10 * fractal_noise(rng, (height, width), 40.0, 3))
    tone *= rng.uniform(0.85, 1.1, 40).astype(np.float32)[np.floor(log).astype(int)]
    image = tone[..., None] * np.array([112.0, 80.0, 56.0], np.float32)
    image[130:300, 150:330] = (214, 208, 196)
    image[140:290, 160:320] = (50, 60, 74)
    image[140:200, 160:320] = (92, 108, 126)
    image[140:290, 236:244] = (214, 208, 196)
    image[296:312, 140:340] = SNOW_RGB
    image[418:448] = SNOW_RGB * 0.93
    return to_texture(image.astype(np.float32))


def _snow_roof(rng: np.random.Generator) -> NDArray[np.uint8]:
    """(512, 512, 3): both slopes under snow, icicles and planks at the eaves."""
    tone = 0.97 + 0.020 * fractal_noise(rng, (512, 512), 60.0, 4)
    image = tone[..., None] * SNOW_RGB
    for first in (0, 256):
        eaves = first + 236 + 5.0 * fractal_noise(rng, (1, 512), 40.0, 2)[0]
        rows = np.arange(512)[:, None]
        shade = (rows > eaves) & (rows < first + 256)
        image[shade] = SNOW_RGB * 0.82
    return to_texture(image.astype(np.float32))


def _place_trees(builder: SceneBuilder, plan: Plan, wood: woods.Wood) -> None:
    """Clumps of conifers, most of them around the survey, a few single ones in it."""
    rng = builder.rng
    plot = plan.from_middle

    def plant(spot: Array) -> None:
        if np.abs(spot).max() > HALF_M - 2.5 or not builder.is_free(spot, 1.6):
            return
        if rng.random() < 0.24:
            woods.add_sapling(builder, wood, spot)
            builder.claim(spot, 1.2)
            return
        crown = pick(rng, wood.conifers)
        woods.add_conifer(builder, wood, spot, crown, pick(rng, wood.needles))
        builder.claim(spot, 0.75 * crown.radius_m)

    for _ in range(15):
        angle = rng.uniform(0.0, 2.0 * np.pi)
        reach = rng.uniform([38.0, 31.0], [52.0, 48.0])
        middle = plot.points(reach * [np.cos(angle), np.sin(angle)])
        for _ in range(int(rng.integers(4, 10))):
            plant(middle + rng.normal(0.0, 4.0, 2))
    for _ in range(int(rng.integers(4, 7))):
        plant(plot.points(rng.uniform([-24.0, -20.0], [26.0, 20.0])))
    for _ in range(14):
        spot = plot.points(rng.uniform([-45.0, -40.0], [45.0, 40.0]))
        if np.abs(spot).max() < HALF_M - 2.0 and builder.is_free(spot, 1.0):
            woods.add_shrub(builder, wood, spot)
            builder.claim(spot, 1.0)


def lay_ice(builder: SceneBuilder, plan: Plan, relief: Relief) -> None:
    """Covers the pond with slabs that are touched and not seen: the terrain shows the ice, and one
    geom has one friction. They are strips, for MuJoCo touches a mesh's convex hull."""
    nodes = relief.pond_m
    axis = np.linspace(-HALF_M, HALF_M, len(nodes))
    cell = axis[1] - axis[0]
    wet = nodes < 0.0
    step = 2
    for row in range(0, len(axis) - step, step):
        cols = np.flatnonzero(wet[row : row + step + 1].any(axis=0))
        if len(cols) == 0:
            continue
        first, last = axis[cols[0]], axis[cols[-1]]
        half = np.array([0.5 * (last - first) + 0.1 * cell, 0.5 * step * cell, 0.1])
        centre = [0.5 * (first + last), axis[row] + half[1], relief.ice_m + _ICE_RISE_M - half[2]]
        builder.geom("water_ice", ICE, box=half, pos=centre,
                     group=FIRST_HIDDEN_GROUP, friction=[ICE_FRICTION, 0.005, 0.0001], priority=2,
                     rgba=[0.6, 0.7, 0.75, 1])  # fmt: skip
