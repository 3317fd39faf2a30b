"""`footbridge`: fills footbridge.xml with a scene drawn from a seed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from touchdown.scenes.api import Array
from touchdown.scenes.authoring.draft import SceneDraft
from touchdown.scenes.authoring.generation import (
    Flood,
    finish,
    paint_terrain,
    scene_rng,
    start_scene,
)
from touchdown.scenes.authoring.ground import TEXELS, Canvas, Ground
from touchdown.scenes.authoring.relief import HeightField
from touchdown.scenes.authoring.water import WaterLook, upsample
from touchdown.scenes.places.footbridge.banks import draw_paths, furnish, paint_ground
from touchdown.scenes.places.footbridge.bridge import add_bridge
from touchdown.scenes.places.footbridge.layout import HALF_M, Plan, draw_plan, shape_ground
from touchdown.scenes.props.plants import plant_nursery


def generate(seed: int) -> SceneDraft:
    """Returns the scene of ``seed`` without the vehicle. The same seed gives the same bytes."""
    rng = scene_rng("footbridge", seed)
    plan = draw_plan(rng)
    bottom = shape_ground(rng, plan)
    surface = bottom if plan.over_road else np.maximum(bottom, plan.level_m)
    terrain = HeightField(heights_m=surface, half_m=HALF_M)
    # Objects stand on the stream's bed, not on the water.
    bed = replace(terrain, heights_m=bottom)
    builder = start_scene("footbridge", rng, terrain, support=bed)
    nursery = plant_nursery(builder)
    paths = draw_paths(rng, plan)
    add_bridge(builder, plan)
    moving = furnish(builder, plan, paths, nursery)
    canvas = Canvas(half_m=HALF_M)
    paint_ground(canvas, plan, paths, rng)
    turned = dict.fromkeys(Ground, plan.bridge.plot.angle)
    turned[Ground.LAWN] = float(rng.uniform(0.0, np.pi))
    stream = None if plan.over_road else _stream(plan, bottom)
    ground = paint_terrain(builder, canvas, turned, hilly=True, flood=stream)
    return finish(plan, builder, ground, moving=moving)


def _stream(plan: Plan, bottom_m: Array) -> Flood:
    """The water over a bed with heights ``bottom_m`` (N, N)."""
    return Flood(
        depth_m=upsample(plan.level_m - bottom_m, TEXELS // 2),
        draw_look=lambda rng: _look(rng, plan.course.heading(30.0)),
    )


def _look(rng: np.random.Generator, angle: float) -> WaterLook:
    """Running water: short ripples across the course over a brown bed."""
    return WaterLook(
        body=(52.0, 66.0, 56.0),
        clarity_m=(0.55, 0.85, 0.6),
        wave_m=float(rng.uniform(0.35, 0.6)),
        ripple=float(rng.uniform(0.4, 0.6)),
        wind_angle=angle,
    )
