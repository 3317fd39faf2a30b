"""`lake`: fills lake.xml with a scene drawn from a seed."""

from __future__ import annotations

from zlib import crc32

import numpy as np

from touchdown.scenes.authoring.draft import SceneDraft
from touchdown.scenes.authoring.generation import Flood, finish, paint_terrain, start_scene
from touchdown.scenes.authoring.ground import TEXELS, Canvas, Ground
from touchdown.scenes.authoring.plane import draw_heading
from touchdown.scenes.authoring.water import WaterLook, upsample
from touchdown.scenes.places.lake.layout import HALF_M, draw_plan, shape_basin
from touchdown.scenes.places.lake.objects import footpath, place_objects
from touchdown.scenes.places.lake.painting import paint_fields, paint_shore, paint_strand
from touchdown.scenes.props.plants import plant_nursery


def generate(seed: int) -> SceneDraft:
    """Returns the scene of ``seed`` without the vehicle. The same seed gives the same bytes."""
    rng = np.random.default_rng([seed, crc32(b"scenes.lake")])
    plan = draw_plan(rng)
    basin = shape_basin(rng, plan)
    builder = start_scene("lake", rng, basin.terrain)
    nursery = plant_nursery(builder)
    path = footpath(plan, rng)
    place_objects(builder, plan, basin, nursery, path)
    canvas = Canvas(half_m=HALF_M)
    paint_shore(rng, canvas, plan, basin)
    paint_fields(rng, canvas)
    paint_strand(rng, canvas, plan)
    canvas.track(path, 1.9, Ground.GRAVEL)
    rows = dict.fromkeys(Ground, float(rng.uniform(0.0, np.pi)))
    depth = upsample(basin.level_m - basin.bottom_m, TEXELS // 2)
    flood = Flood(depth_m=depth, draw_look=draw_look)
    ground = paint_terrain(builder, canvas, rows, flood=flood)
    return finish(plan, builder, ground)


def draw_look(rng: np.random.Generator) -> WaterLook:
    """Returns the look of water from clear blue-green to brown."""
    peat = float(rng.uniform(0.0, 1.0)) ** 2
    clear, brown = np.array([26.0, 74.0, 84.0]), np.array([44.0, 56.0, 44.0])
    red, green, blue = (1.0 - peat) * clear + peat * brown
    return WaterLook(
        body=(red, green, blue),
        clarity_m=(0.55 - 0.1 * peat, 1.0 - 0.35 * peat, 0.9 - 0.5 * peat),
        wave_m=float(rng.uniform(0.8, 1.4)),
        ripple=float(rng.uniform(0.3, 0.55)),
        wind_angle=draw_heading(rng),
    )
