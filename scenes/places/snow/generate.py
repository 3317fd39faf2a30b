"""`snow`: fills snow.xml with a scene drawn from a seed."""

from __future__ import annotations

from zlib import crc32

import numpy as np

from touchdown.scenes.authoring.draft import SceneDraft
from touchdown.scenes.authoring.generation import finish, paint_terrain, start_scene
from touchdown.scenes.authoring.ground import Canvas, Ground
from touchdown.scenes.places.snow.layout import HALF_M, draw_plan, shape_snow
from touchdown.scenes.places.snow.objects import SNOW, lay_ice, place_objects
from touchdown.scenes.places.snow.painting import fine_relief, paint_ice, paint_tracks

SUN_DEG = (26.0, 40.0)


def generate(seed: int) -> SceneDraft:
    """Returns the scene of ``seed`` without the vehicle. The same seed gives the same bytes."""
    rng = np.random.default_rng([seed, crc32(b"scenes.snow")])
    plan = draw_plan(rng)
    relief = shape_snow(rng, plan)
    builder = start_scene("snow", rng, relief.terrain, sun_deg=SUN_DEG)
    place_objects(builder, plan, relief)
    lay_ice(builder, plan, relief)
    canvas = Canvas(half_m=HALF_M)
    canvas.material[:] = int(Ground.SNOW)
    fine = fine_relief(rng, plan, relief)
    paint_tracks(rng, canvas, fine, plan, relief)
    paint_ice(rng, canvas, fine, plan, relief)
    slopes = fine.shading(rng, builder.sun)
    ground = paint_terrain(builder, canvas, {}, hilly=True, slopes=slopes)
    return finish(plan, builder, ground, terrain=SNOW)
