"""`rooftop_parking`: a flat roof used as a car park, above the streets of a town."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from touchdown.scenes.api import Array, Float32, Image, MovingBody, Surface
from touchdown.scenes.authoring import relief, streets
from touchdown.scenes.authoring.builder import SceneBuilder
from touchdown.scenes.authoring.draft import SceneDraft
from touchdown.scenes.authoring.generation import finish, scene_rng, start_scene
from touchdown.scenes.authoring.ground import TEXELS, Canvas, Ground, shade_ground
from touchdown.scenes.authoring.light import bake_light
from touchdown.scenes.authoring.noise import fractal_noise
from touchdown.scenes.authoring.plane import SQUARE, pick, rotated, unit_circle
from touchdown.scenes.authoring.plots import free_spots
from touchdown.scenes.authoring.textures import to_texture
from touchdown.scenes.places.rooftop_parking.deck import (
    STREET_M,
    WORLD,
    Plan,
    deck_heights,
    draw_plan,
    furnish_deck,
    paint_deck,
    write_deck,
)
from touchdown.scenes.props.cars import CAR_SURFACE, Models, add_car_models, park_car
from touchdown.scenes.props.houses import House, add_house, wall_mesh
from touchdown.scenes.props.plants import Nursery, add_bush, add_hedge, add_tree, plant_nursery
from touchdown.scenes.props.street import add_bench, add_lamp

WALL = Surface(land_class="building", reflectivity=0.36)
APRON_M = 2.0
"""Paved strip around the building."""


def draw_houses(rng: np.random.Generator, plan: Plan) -> list[House]:
    """Returns neighbouring houses on the free ground, aligned with the streets."""
    houses: list[House] = []
    for _ in range(400):
        if len(houses) == 6:
            break
        flat = rng.random() < 0.4
        storeys = int(rng.integers(1, 5 if flat else 3))
        size = (
            (rng.uniform(14.0, 19.0), rng.uniform(9.0, 11.0), 2.8 * storeys + 0.6)
            if flat
            else (rng.uniform(9.0, 12.0), rng.uniform(7.6, 9.0), 2.8 * storeys)
        )
        angle = float(rng.choice([0.0, 0.5 * np.pi])) + rng.uniform(-0.03, 0.03)
        spot = rng.uniform(-relief.HALF_M + 8.0, relief.HALF_M - 8.0, 2)
        reach = 0.5 * float(np.hypot(size[0], size[1])) + 1.0
        near = min(float(s.kerb_distance(spot)) - s.pavement_m for s in plan.streets)
        outside = np.maximum(np.maximum(plan.low_xy_m - spot, spot - plan.high_xy_m), 0.0)
        apart = all(
            np.hypot(*(spot - h.centre_xy_m)) > reach + 0.5 * h.size_m[0] + 4.0 for h in houses
        )
        if np.hypot(*outside) > reach + APRON_M + 2.5 and near > reach and apart:
            ridge = 0.0 if flat else float(rng.uniform(2.6, 3.6))
            houses.append(House(centre_xy_m=spot, angle=angle, size_m=size, ridge_m=ridge))
    return houses


def shape_town(rng: np.random.Generator, plan: Plan, houses: list[House]) -> relief.HeightField:
    """Returns the ground around the building: level under it, streets a kerb's height below
    pavements."""
    heights, xy = relief.natural_ground(rng)
    heights *= 0.6
    heights += 0.25 - heights.mean()
    pads = [
        relief.Pad(
            centre_xy_m=h.centre_xy_m, half_size_m=0.5 * np.array(h.size_m[:2]) + 1.5, angle=h.angle
        )
        for h in houses
    ]
    heights = relief.level_pads(heights, xy, pads)
    outside = np.maximum(np.maximum(plan.low_xy_m - xy, xy - plan.high_xy_m), 0.0)
    apron = np.hypot(outside[..., 0], outside[..., 1])
    heights = heights * relief.smoothstep(APRON_M + 0.5, APRON_M + 4.0, apron)
    kerb = np.min([street.kerb_distance(xy) for street in plan.streets], axis=0)
    corridor = plan.streets[0].pavement_m + 0.5
    heights = heights * relief.smoothstep(corridor, corridor + 4.0, kerb)
    heights = heights - streets.roadway_depth(kerb)
    return relief.HeightField(heights_m=heights - plan.height_m)


def paint_town(canvas: Canvas, plan: Plan, houses: list[House], rng: np.random.Generator) -> None:
    """Paints lawns, terraces, apron, pavements, streets with their markings."""
    for _ in range(7):
        middle, reach = rng.uniform(-relief.HALF_M, relief.HALF_M, 2), rng.uniform(4.0, 13.0)
        edge = unit_circle(28) * (1.0 + 0.25 * np.sin(3.0 * np.linspace(0.0, 6.28, 28)))[:, None]
        canvas.fill(middle + reach * edge, Ground.MEADOW if rng.random() < 0.7 else Ground.WORN)
    for house in houses:
        street = min(plan.streets, key=lambda s: float(s.kerb_distance(house.centre_xy_m)))
        foot = street.point(float(street.nearest(house.centre_xy_m)[1]), 0.0)
        canvas.track(np.array([house.centre_xy_m, foot]), 1.8, Ground.GRAVEL)
    for house in houses:
        corners = SQUARE * (0.5 * np.array(house.size_m[:2]) + 1.3)
        around = Ground.PAVERS if house.ridge_m > 0.0 else Ground.PAVEMENT
        canvas.fill(house.centre_xy_m + rotated(corners, house.angle), around)
    apron = plan.low_xy_m - APRON_M, plan.high_xy_m + APRON_M
    canvas.fill(
        WORLD.rectangle((apron[0][0], apron[1][0]), (apron[0][1], apron[1][1])), Ground.PAVEMENT
    )
    along_x, along_y = plan.streets
    gate = _gate_x(plan)
    y0, y1 = sorted((float(plan.centre[1]), float(along_x.point(0.5 * along_x.length_m, 0.0)[1])))
    canvas.fill(WORLD.rectangle((gate - 3.2, gate + 3.2), (y0, y1)), Ground.PAVERS)
    for street in plan.streets:
        streets.paint_street(canvas, street, pavement=Ground.PAVEMENT)
    for street in plan.streets:
        streets.paint_street(canvas, street)
    for street in plan.streets:
        streets.paint_wear(canvas, street, rng, 0.0)
    for street, other in ((along_x, along_y), (along_y, along_x)):
        cross = crossing_m(street, other)
        streets.paint_dashes(canvas, street, 0.0, cross - 9.0)
        streets.paint_dashes(canvas, street, cross + 9.0, street.length_m)
        for sign in (-1.0, 1.0):
            start = cross + sign * (0.5 * STREET_M + 2.6)
            for across in np.arange(-0.5 * STREET_M + 0.5, 0.5 * STREET_M - 0.6, 1.0):
                canvas.mark(
                    streets.band(street, (start, start + sign * 3.0), (across, across + 0.5))
                )


def crossing_m(street: streets.Street, other: streets.Street) -> float:
    """Metres along ``street`` to the point nearest to ``other``."""
    stations = np.arange(0.0, street.length_m, 0.5)
    points = np.array([street.point(float(s), 0.0) for s in stations])
    return float(stations[np.argmin(other.nearest(points)[0])])


def _gate_x(plan: Plan) -> float:
    return float(plan.low_xy_m[0]) + 0.3 * float(plan.size_m[0])


def car_park_bay(rng: np.random.Generator) -> Image:
    """(448, 224, 3): a bay of an open car park as `scenes.props.houses.wall_mesh` lays it on: a
    concrete balustrade, a dark opening and a column; the lower half is plain concrete."""
    px = 224
    tone = 1.0 + 0.04 * fractal_noise(rng, (2 * px, px), 50.0, 4)
    tone += 0.02 * rng.standard_normal((2 * px, px), dtype=np.float32)
    image = tone[..., None] * np.array([178.0, 175.0, 168.0], np.float32)
    top, low = int(0.16 * px), int(0.60 * px)
    depth = np.linspace(0.55, 1.25, low - top)[:, None, None]
    image[top:low] = depth * np.array([40.0, 42.0, 46.0])
    for row in (0.66, 0.98):
        image[int(row * px) - 2 : int(row * px) + 1] *= 0.72
    column = int(0.12 * px)
    image[top:low, :column] = 0.86 * np.array([178.0, 175.0, 168.0])
    image[top:low, column : column + 4] *= 0.5
    for bar in np.linspace(0.40, 0.56, 3):
        image[int(bar * px) : int(bar * px) + 2, column:] = (120.0, 124.0, 128.0)
    return to_texture(image.astype(np.float32))


def build_walls(builder: SceneBuilder, plan: Plan) -> None:
    """Adds the building below the deck, with its shadow on the ground."""
    size = (float(plan.size_m[0]) + 0.4, float(plan.size_m[1]) + 0.4, plan.height_m - 0.5)
    material = builder.material("building_car_park", car_park_bay(builder.rng))
    walls = wall_mesh(size, 0.0)
    # Without their lid, through which the ramp goes; the deck's height field is solid down to the
    # ground, so that nothing has to collide with them.
    mesh = builder.mesh("car_park_walls", replace(walls, faces=walls.faces[:-2]))
    builder.geom("building_car_park", WALL, mesh=mesh, material=material,
                 pos=[*plan.centre, -plan.height_m], contype=0, conaffinity=0)  # fmt: skip
    ground = -plan.height_m
    builder.cast_box(
        (0.5 * size[0], 0.5 * size[1]), (ground, 1.0), 0.0, np.array([*plan.centre, 0.0])
    )


def furnish_town(
    builder: SceneBuilder, plan: Plan, houses: list[House], nursery: Nursery, models: Models
) -> tuple[MovingBody, ...]:
    """Adds houses, kerbs, lamps, parked cars, trees. Returns the cars that drive."""
    for house in houses:
        add_house(builder, house)
    along_x, along_y = plan.streets
    for street, other in ((along_x, along_y), (along_y, along_x)):
        cross = crossing_m(street, other)
        gap = (cross - 0.5 * STREET_M - 6.0, cross + 0.5 * STREET_M + 6.0)
        for side in (1.0, -1.0):
            openings = [gap]
            if street is along_x:
                gate = _gate_x(plan) - float(street.line_m[0][0])
                openings.append((gate - 3.4, gate + 3.4))
            streets.place_street_kerb(builder, street, side, openings, 0.02)
            # Cars are parked where none drive.
            _line_street(builder, street, side, gap, models if street is along_x else [])
    _plant(builder, plan, nursery)
    return _drive(builder, along_y, models)


def _line_street(
    builder: SceneBuilder,
    street: streets.Street,
    side: float,
    gap: tuple[float, float],
    models: Models,
) -> None:
    """Adds lamps on one side, cars at the other kerb, where there are ``models``."""
    rng = builder.rng
    for along in np.arange(rng.uniform(4.0, 12.0), street.length_m, 22.0 if side > 0 else 13.0):
        heading = street.heading(float(along))
        if gap[0] - 4.0 < along < gap[1] + 4.0:
            continue
        if side > 0:
            spot = street.point(float(along), 0.5 * street.width_m + 0.6)
            if np.abs(spot).max() < relief.HALF_M - 1.0 and builder.is_free(spot, 0.3):
                add_lamp(builder, spot, heading - 0.5 * np.pi)
        elif models and rng.random() < 0.55:
            spot = street.point(float(along), -0.5 * street.width_m + 1.05)
            if np.abs(spot).max() < relief.HALF_M - 4.0 and builder.is_free(spot, 1.0):
                park_car(builder, pick(rng, models), spot, heading)


def _plant(builder: SceneBuilder, plan: Plan, nursery: Nursery) -> None:
    """A hedge along the building's blind side, trees and bushes wherever there is room."""
    rng = builder.rng
    (x0, y0), (x1, y1) = plan.low_xy_m - APRON_M - 0.9, plan.high_xy_m + APRON_M + 0.9
    for start, end in (((x0, y0 + 2.0), (x0, y0 + 16.0)), ((x1, y1 - 16.0), (x1, y1 - 2.0))):
        if all(float(s.kerb_distance(np.array(start))) > s.pavement_m + 1.0 for s in plan.streets):
            add_hedge(builder, nursery, np.array(start), np.array(end), 1.1)

    def spots(count: int, gap_m: float) -> Iterator[Array]:
        """Beside streets and building."""

        def clear(spot: Array) -> bool:
            away = min(float(s.kerb_distance(spot)) - s.pavement_m for s in plan.streets)
            outside = np.maximum(np.maximum(plan.low_xy_m - spot, spot - plan.high_xy_m), 0.0)
            return float(np.hypot(*outside)) > APRON_M + gap_m and away > gap_m

        return free_spots(builder, count, 20 * count, relief.HALF_M - 3.0, gap_m, clear)

    for spot in spots(21, 2.4):
        add_tree(builder, nursery, spot, rng.uniform(0.8, 1.3))
    for spot in spots(14, 1.0):
        add_bush(builder, nursery, spot)
    for spot in spots(3, 1.4):
        add_bench(builder, spot, rng.uniform(0.0, 2.0 * np.pi))


def _drive(builder: SceneBuilder, street: streets.Street, models: Models) -> tuple[MovingBody, ...]:
    """Two or three cars that go to the end of a street and come back."""
    rng = builder.rng
    path = streets.lane_loop(builder, street, 14.0, street.length_m - 14.0)
    chosen = [pick(rng, models)[:2] for _ in range(int(rng.integers(2, 4)))]
    return streets.send_round(builder, path, chosen, CAR_SURFACE, float(rng.uniform(5.0, 9.0)))


def generate(seed: int) -> SceneDraft:
    """Returns the scene of ``seed`` without the vehicle. The same seed gives the same bytes."""
    rng = scene_rng("rooftop_parking", seed)
    plan = draw_plan(rng)
    houses = draw_houses(rng, plan)
    ground = shape_town(rng, plan, houses)
    # Objects stand on the deck where there is one: one height field holds both.
    both = relief.HeightField(heights_m=deck_heights(rng, plan, ground))
    builder = start_scene("rooftop_parking", rng, ground, support=both)
    nursery = plant_nursery(builder)
    models = add_car_models(builder, 8)
    build_walls(builder, plan)
    moving = furnish_town(builder, plan, houses, nursery, models)
    below = len(builder.casters)
    furnish_deck(builder, plan, models)
    canvas = Canvas()
    paint_town(canvas, plan, houses, rng)
    paint_deck(canvas, plan, rng)
    light = _light(builder, below, plan, ground)
    turned = dict.fromkeys(Ground, plan.streets[0].heading(1.0))
    turned[Ground.LAWN] = float(rng.uniform(0.0, np.pi))
    texture = shade_ground(rng, canvas, light, turned)
    deck = write_deck(builder.spec, plan, both, texture)
    for name, image in (("ground", texture), ("deck", deck)):
        builder.picture(name, image.shape, partial(np.copyto, src=image))
    builder.surfaces["path_deck"] = Surface(land_class="path", reflectivity=0.22)
    return finish(plan, builder, canvas.raster("terrain"), moving=moving)


def _light(builder: SceneBuilder, below: int, plan: Plan, ground: relief.HeightField) -> Float32:
    """Light on the ground and, over the building, on the deck, (n, n), row 0 at y_min: the first
    ``below`` casters stand on the ground, the others on the deck."""
    pixels = TEXELS // 2
    casters, sun = builder.casters, builder.sun
    light = bake_light(casters[:below], ground, sun, pixels)
    on_deck = bake_light(casters[below:], builder.terrain, sun, pixels)
    per_m = pixels / (2.0 * relief.HALF_M)
    (c0, r0), (c1, r1) = (
        np.round((corner + relief.HALF_M) * per_m).astype(int)
        for corner in (plan.low_xy_m, plan.high_xy_m)
    )
    light[r0:r1, c0:c1] = on_deck[r0:r1, c0:c1]
    return light
