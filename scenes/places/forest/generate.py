"""`forest`: fills forest.xml with a wood drawn from a seed."""

from __future__ import annotations

from zlib import crc32

import numpy as np

from touchdown.scenes.api import Surface
from touchdown.scenes.authoring.draft import SceneDraft
from touchdown.scenes.authoring.generation import finish, paint_terrain, start_scene
from touchdown.scenes.authoring.ground import Ground
from touchdown.scenes.places.forest.floor import paint_floor
from touchdown.scenes.places.forest.furniture import furnish
from touchdown.scenes.places.forest.layout import draw_plan
from touchdown.scenes.places.forest.relief import shape_ground
from touchdown.scenes.places.forest.stand import plant
from touchdown.scenes.props.woods import grow_wood

FLOOR = Surface(land_class="trees", reflectivity=0.35)


def generate(seed: int) -> SceneDraft:
    """Returns the scene of ``seed`` without the vehicle. The same seed gives the same bytes."""
    rng = np.random.default_rng([seed, crc32(b"scenes.forest")])
    plan = draw_plan(rng)
    builder = start_scene("forest", rng, shape_ground(rng, plan))
    wood = grow_wood(builder)
    furnish(builder, wood, plan)
    plant(builder, wood, plan)
    canvas = paint_floor(rng, plan)
    turned = dict.fromkeys(Ground, plan.frame.takeoff_yaw + 0.4)
    ground = paint_terrain(builder, canvas, turned, hilly=True)
    return finish(plan.frame, builder, ground, terrain=FLOOR)
