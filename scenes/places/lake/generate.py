"""`lake`: fills lake.xml with a place drawn from a seed."""

from __future__ import annotations

from pathlib import Path
from zlib import crc32

import mujoco
import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.api import Surface
from touchdown.scenes.authoring.builder import Builder, fill_texture
from touchdown.scenes.authoring.draft import SceneDraft
from touchdown.scenes.authoring.ground import TEXELS, Canvas, Ground
from touchdown.scenes.authoring.light import draw_sun, ground_picture
from touchdown.scenes.authoring.terrain import write_hfield
from touchdown.scenes.authoring.water import WaterLook, flood_raster, lay_water, upsample
from touchdown.scenes.places.lake.layout import HALF_M, draw_plan, shape_basin
from touchdown.scenes.places.lake.picture import paint_fields, paint_shore, paint_strand
from touchdown.scenes.places.lake.things import footpath, place_all
from touchdown.scenes.props.plants import plant_nursery

Array = NDArray[np.float64]

XML = Path(__file__).with_name("lake.xml")


def generate(seed: int) -> SceneDraft:
    """The place of ``seed``, without the vehicle. Same seed, same bytes."""
    rng = np.random.default_rng([seed, crc32(b"scenes.lake")])
    spec = mujoco.MjSpec.from_file(str(XML))
    plan = draw_plan(rng)
    basin = shape_basin(rng, plan)
    write_hfield(spec, "terrain", "terrain", basin.terrain, base_m=2.0)
    sun = draw_sun(rng, spec)
    builder = Builder(spec=spec, rng=rng, terrain=basin.terrain)
    nursery = plant_nursery(builder)
    path = footpath(plan, rng)
    place_all(builder, plan, basin, nursery, path)
    canvas = Canvas(half_m=HALF_M)
    paint_shore(rng, canvas, plan, basin)
    paint_fields(rng, canvas)
    paint_strand(rng, canvas, plan)
    canvas.track(path, 1.9, Ground.GRAVEL)
    rows = dict.fromkeys(Ground, float(rng.uniform(0.0, np.pi)))
    picture = ground_picture(builder, canvas, sun, rows)
    depth = upsample(basin.level_m - basin.bottom_m, TEXELS // 2)
    lay_water(rng, picture, depth, HALF_M, draw_look(rng), sun)
    fill_texture(spec.texture("ground"), picture)
    builder.surfaces["terrain"] = Surface(land_class="lawn", reflectivity=0.45)
    return SceneDraft(
        spec=spec,
        takeoff_xy_m=plan.takeoff_xy_m,
        takeoff_yaw=plan.takeoff_yaw,
        bounds_xy_m=np.array([[-HALF_M, -HALF_M], [HALF_M, HALF_M]]),
        surfaces=builder.surfaces,
        ground=flood_raster(canvas.raster("terrain"), depth),
    )


def draw_look(rng: np.random.Generator) -> WaterLook:
    """Clear and blue-green, or brown as of a moor."""
    peat = float(rng.uniform(0.0, 1.0)) ** 2
    clear, brown = np.array([26.0, 74.0, 84.0]), np.array([44.0, 56.0, 44.0])
    red, green, blue = (1.0 - peat) * clear + peat * brown
    return WaterLook(
        body=(red, green, blue),
        clarity_m=(0.55 - 0.1 * peat, 1.0 - 0.35 * peat, 0.9 - 0.5 * peat),
        wave_m=float(rng.uniform(0.8, 1.4)),
        ripple=float(rng.uniform(0.3, 0.55)),
        wind_angle=float(rng.uniform(0.0, 2.0 * np.pi)),
    )
