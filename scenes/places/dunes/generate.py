"""`dunes`: fills dunes.xml with a scene drawn from a seed."""

from __future__ import annotations

from zlib import crc32

import numpy as np

from touchdown.scenes.authoring.draft import SceneDraft
from touchdown.scenes.authoring.generation import finish, paint_terrain, start_scene
from touchdown.scenes.authoring.ground import Canvas
from touchdown.scenes.places.dunes.layout import HALF_M, draw_plan, shape_dunes
from touchdown.scenes.places.dunes.objects import SAND, place_objects
from touchdown.scenes.places.dunes.painting import (
    draw_ripples,
    fine_relief,
    paint_sand,
    paint_traces,
)

SUN_DEG = (26.0, 44.0)


def generate(seed: int) -> SceneDraft:
    """Returns the scene of ``seed`` without the vehicle. The same seed gives the same bytes."""
    rng = np.random.default_rng([seed, crc32(b"scenes.dunes")])
    plan = draw_plan(rng)
    relief = shape_dunes(rng, plan)
    builder = start_scene("dunes", rng, relief.terrain, sun_deg=SUN_DEG)
    place_objects(builder, plan, relief)
    canvas = Canvas(half_m=HALF_M)
    paint_sand(rng, canvas, relief)
    fine = fine_relief(rng, relief)
    paint_traces(rng, canvas, fine, plan)
    slopes = fine.shading(rng, builder.sun, draw_ripples(rng, plan, relief))
    ground = paint_terrain(builder, canvas, {}, hilly=True, slopes=slopes)
    return finish(plan, builder, ground, terrain=SAND)
