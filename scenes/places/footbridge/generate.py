"""`footbridge`: fills footbridge.xml with a place drawn from a seed."""

from __future__ import annotations

from dataclasses import replace
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
from touchdown.scenes.authoring.terrain import Terrain, write_hfield
from touchdown.scenes.authoring.water import WaterLook, flood_raster, lay_water, upsample
from touchdown.scenes.places.footbridge.banks import draw_paths, furnish, paint_ground
from touchdown.scenes.places.footbridge.bridge import add_bridge
from touchdown.scenes.places.footbridge.layout import HALF_M, draw_plan, shape_ground
from touchdown.scenes.props.plants import plant_nursery

Array = NDArray[np.float64]

XML = Path(__file__).with_name("footbridge.xml")


def generate(seed: int) -> SceneDraft:
    """The place of ``seed``, without the vehicle. Same seed, same bytes."""
    rng = np.random.default_rng([seed, crc32(b"scenes.footbridge")])
    spec = mujoco.MjSpec.from_file(str(XML))
    plan = draw_plan(rng)
    bottom = shape_ground(rng, plan)
    surface = bottom if plan.over_road else np.maximum(bottom, plan.level_m)
    terrain = Terrain(heights_m=surface, half_m=HALF_M)
    write_hfield(spec, "terrain", "terrain", terrain, base_m=2.0)
    sun = draw_sun(rng, spec)
    # Things stand on the stream's bed, not on the water.
    builder = Builder(spec=spec, rng=rng, terrain=replace(terrain, heights_m=bottom))
    nursery = plant_nursery(builder)
    paths = draw_paths(rng, plan)
    add_bridge(builder, plan)
    moving = furnish(builder, plan, paths, nursery)
    canvas = Canvas(half_m=HALF_M)
    paint_ground(canvas, plan, paths, rng)
    turned = dict.fromkeys(Ground, plan.bridge.lot.angle)
    turned[Ground.LAWN] = float(rng.uniform(0.0, np.pi))
    picture = ground_picture(builder, canvas, sun, turned, hilly=True)
    raster = canvas.raster("terrain")
    if not plan.over_road:
        depth = upsample(plan.level_m - bottom, TEXELS // 2)
        lay_water(rng, picture, depth, HALF_M, _look(rng, plan.course.heading(30.0)), sun)
        raster = flood_raster(raster, depth)
    fill_texture(spec.texture("ground"), picture)
    builder.surfaces["terrain"] = Surface(land_class="lawn", reflectivity=0.45)
    return SceneDraft(
        spec=spec,
        takeoff_xy_m=plan.takeoff_xy_m,
        takeoff_yaw=plan.takeoff_yaw,
        bounds_xy_m=np.array([[-HALF_M, -HALF_M], [HALF_M, HALF_M]]),
        surfaces=builder.surfaces,
        ground=raster,
        moving=moving,
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
