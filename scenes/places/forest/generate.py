"""`forest`: fills forest.xml with a wood drawn from a seed."""

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
from touchdown.scenes.places.forest.floor import paint_floor
from touchdown.scenes.places.forest.furniture import furnish
from touchdown.scenes.places.forest.layout import HALF_M, draw_plan
from touchdown.scenes.places.forest.relief import shape_ground
from touchdown.scenes.places.forest.stand import plant
from touchdown.scenes.props.woods import grow_wood

XML = Path(__file__).with_name("forest.xml")


def generate(seed: int) -> SceneDraft:
    """The wood of ``seed``, without the vehicle. Same seed, same bytes."""
    rng = np.random.default_rng([seed, crc32(b"scenes.forest")])
    spec = mujoco.MjSpec.from_file(str(XML))
    plan = draw_plan(rng)
    terrain = shape_ground(rng, plan)
    write_hfield(spec, "terrain", "terrain", terrain, base_m=2.0)
    sun = draw_sun(rng, spec)
    builder = Builder(spec=spec, rng=rng, terrain=terrain)
    wood = grow_wood(builder)
    furnish(builder, wood, plan)
    plant(builder, wood, plan)
    canvas = paint_floor(rng, plan)
    turned = dict.fromkeys(Ground, plan.frame.yaw + 0.4)
    finish_picture(builder, canvas, sun, turned, hilly=True)
    builder.surfaces["terrain"] = Surface(land_class="trees", reflectivity=0.35)
    return SceneDraft(
        spec=spec,
        takeoff_xy_m=plan.frame.takeoff_xy_m,
        takeoff_yaw=plan.frame.yaw,
        bounds_xy_m=np.array([[-HALF_M, -HALF_M], [HALF_M, HALF_M]]),
        surfaces=builder.surfaces,
        ground=canvas.raster("terrain"),
    )
