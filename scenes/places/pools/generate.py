"""`pools`: fills pools.xml with a public bath drawn from a seed."""

from __future__ import annotations

from touchdown.scenes.authoring.draft import SceneDraft
from touchdown.scenes.authoring.generation import finish, paint_terrain, scene_rng, start_scene
from touchdown.scenes.authoring.ground import Ground
from touchdown.scenes.places.pools.bath import build_bath
from touchdown.scenes.places.pools.grounds import build_grounds, paint_all
from touchdown.scenes.places.pools.layout import draw_plan, shape_ground
from touchdown.scenes.props.plants import plant_nursery
from touchdown.scenes.props.pools import add_umbrella_models


def generate(seed: int) -> SceneDraft:
    """Returns the scene of ``seed`` without the vehicle. The same seed gives the same bytes."""
    rng = scene_rng("pools", seed)
    plan = draw_plan(rng)
    terrain = shape_ground(rng, plan)
    builder = start_scene("pools", rng, terrain)
    nursery = plant_nursery(builder)
    builder.claim(plan.takeoff_xy_m, 6.5)
    shades = add_umbrella_models(builder, 5)
    build_bath(builder, plan, nursery, shades)
    build_grounds(builder, plan, nursery, shades)
    canvas = paint_all(rng, plan)
    turned = dict.fromkeys(Ground, plan.frame.angle)
    turned[Ground.LAWN] = plan.frame.angle + float(rng.uniform(0.2, 1.3))
    ground = paint_terrain(builder, canvas, turned)
    return finish(plan, builder, ground)
