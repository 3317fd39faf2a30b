"""`rooftop_parking`: fills rooftop_parking.xml with a scene drawn from a seed."""

from __future__ import annotations

from functools import partial

import numpy as np

from touchdown.scenes.api import Float32, Surface
from touchdown.scenes.authoring.builder import SceneBuilder
from touchdown.scenes.authoring.draft import SceneDraft
from touchdown.scenes.authoring.generation import finish, scene_rng, start_scene
from touchdown.scenes.authoring.ground import TEXELS, Canvas, Ground, shade_ground
from touchdown.scenes.authoring.light import bake_light
from touchdown.scenes.authoring.relief import HeightField
from touchdown.scenes.places.rooftop_parking.deck import (
    deck_heights,
    furnish_deck,
    paint_deck,
    write_deck,
)
from touchdown.scenes.places.rooftop_parking.layout import HALF_M, Plan, draw_plan
from touchdown.scenes.places.rooftop_parking.town import (
    build_walls,
    draw_houses,
    furnish_town,
    paint_town,
    shape_town,
)
from touchdown.scenes.props.cars import add_car_models
from touchdown.scenes.props.plants import plant_nursery


def generate(seed: int) -> SceneDraft:
    """Returns the scene of ``seed`` without the vehicle. The same seed gives the same bytes."""
    rng = scene_rng("rooftop_parking", seed)
    plan = draw_plan(rng)
    houses = draw_houses(rng, plan)
    ground = shape_town(rng, plan, houses)
    # Objects stand on the deck where there is one: one height field holds both.
    both = HeightField(heights_m=deck_heights(rng, plan, ground), half_m=HALF_M)
    builder = start_scene("rooftop_parking", rng, ground, support=both)
    nursery = plant_nursery(builder)
    models = add_car_models(builder, 8)
    build_walls(builder, plan)
    moving = furnish_town(builder, plan, houses, nursery, models)
    below = len(builder.casters)
    furnish_deck(builder, plan, models)
    canvas = Canvas(half_m=HALF_M)
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


def _light(builder: SceneBuilder, below: int, plan: Plan, ground: HeightField) -> Float32:
    """Light on the ground and, over the building, on the deck, (n, n), row 0 at y_min: the first
    ``below`` casters stand on the ground, the others on the deck."""
    pixels = TEXELS // 2
    casters, sun = builder.casters, builder.sun
    light = bake_light(casters[:below], ground, sun, pixels, 0.50)
    on_deck = bake_light(casters[below:], builder.terrain, sun, pixels, 0.50)
    per_m = pixels / (2.0 * HALF_M)
    (c0, r0), (c1, r1) = (
        np.round((corner + HALF_M) * per_m).astype(int)
        for corner in (plan.low_xy_m, plan.high_xy_m)
    )
    light[r0:r1, c0:c1] = on_deck[r0:r1, c0:c1]
    return light
