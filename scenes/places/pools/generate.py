"""`pools`: fills pools.xml with a public bath drawn from a seed."""

from __future__ import annotations

from pathlib import Path
from zlib import crc32

import mujoco
import numpy as np

from touchdown.scenes.api import Surface
from touchdown.scenes.authoring.builder import Builder
from touchdown.scenes.authoring.draft import SceneDraft
from touchdown.scenes.authoring.ground import Ground
from touchdown.scenes.authoring.light import draw_sun, finish_picture
from touchdown.scenes.authoring.terrain import write_hfield
from touchdown.scenes.places.pools.bath import build_bath
from touchdown.scenes.places.pools.grounds import build_grounds, paint_all
from touchdown.scenes.places.pools.layout import HALF_M, draw_plan, shape_ground
from touchdown.scenes.props.plants import plant_nursery
from touchdown.scenes.props.pools import add_umbrella_models

XML = Path(__file__).with_name("pools.xml")


def generate(seed: int) -> SceneDraft:
    """The place of ``seed``, without the vehicle. Same seed, same bytes."""
    rng = np.random.default_rng([seed, crc32(b"scenes.pools")])
    spec = mujoco.MjSpec.from_file(str(XML))
    plan = draw_plan(rng)
    terrain = shape_ground(rng, plan)
    write_hfield(spec, "terrain", "terrain", terrain, base_m=2.0)
    sun = draw_sun(rng, spec)
    builder = Builder(spec=spec, rng=rng, terrain=terrain)
    nursery = plant_nursery(builder)
    builder.claim(plan.takeoff_xy_m, 6.5)
    shades = add_umbrella_models(builder, 5)
    build_bath(builder, plan, nursery, shades)
    build_grounds(builder, plan, nursery, shades)
    canvas = paint_all(rng, plan)
    turned = dict.fromkeys(Ground, plan.frame.angle)
    turned[Ground.LAWN] = plan.frame.angle + float(rng.uniform(0.2, 1.3))
    finish_picture(builder, canvas, sun, turned)
    builder.surfaces["terrain"] = Surface(land_class="lawn", reflectivity=0.45)
    return SceneDraft(
        spec=spec,
        takeoff_xy_m=plan.takeoff_xy_m,
        takeoff_yaw=plan.takeoff_yaw,
        bounds_xy_m=np.array([[-HALF_M, -HALF_M], [HALF_M, HALF_M]]),
        surfaces=builder.surfaces,
        ground=canvas.raster("terrain"),
    )
