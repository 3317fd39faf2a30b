"""`turf`: fills turf.xml with a sports ground, a golf hole or an airfield drawn from a seed."""

from __future__ import annotations

from pathlib import Path
from zlib import crc32

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from touchdown.scenes.api import Surface
from touchdown.scenes.authoring.builder import Builder, fill_texture
from touchdown.scenes.authoring.draft import SceneDraft
from touchdown.scenes.authoring.ground import TEXELS, Canvas, Ground
from touchdown.scenes.authoring.light import draw_sun, ground_picture
from touchdown.scenes.authoring.relief import level_takeoff, smoothstep
from touchdown.scenes.authoring.survey_frame import Frame, draw_frame
from touchdown.scenes.authoring.terrain import Terrain, write_hfield
from touchdown.scenes.authoring.water import WaterLook, flood_raster, lay_water, upsample
from touchdown.scenes.places.turf.airfield import Airfield
from touchdown.scenes.places.turf.golf import Golf
from touchdown.scenes.places.turf.layout import HALF_M, Turf, plant_edge, undulation
from touchdown.scenes.places.turf.pitch import Pitch
from touchdown.scenes.props.woods import grow_wood

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]

XML = Path(__file__).with_name("turf.xml")
POND = WaterLook(body=(40.0, 60.0, 52.0), clarity_m=(0.4, 0.6, 0.45), wave_m=0.7, ripple=0.25)
EDGE_TREES = 42


def generate(seed: int) -> SceneDraft:
    """The turf of ``seed``, without the vehicle. Same seed, same bytes."""
    rng = np.random.default_rng([seed, crc32(b"scenes.turf")])
    spec = mujoco.MjSpec.from_file(str(XML))
    frame = draw_frame(rng)
    turf = draw_turf(seed, rng, frame)
    terrain, depth = shape_ground(rng, frame, turf)
    write_hfield(spec, "terrain", "terrain", terrain, base_m=2.0)
    sun = draw_sun(rng, spec)
    builder = Builder(spec=spec, rng=rng, terrain=terrain)
    wood = grow_wood(builder)
    builder.claim(frame.takeoff_xy_m, 5.0)
    turf.build(builder, wood)
    plant_edge(builder, wood, turf, EDGE_TREES)
    canvas = Canvas(half_m=HALF_M)
    turf.paint(canvas, rng)
    wet = upsample(depth, TEXELS // 2)
    soak(canvas, wet)
    picture = ground_picture(builder, canvas, sun, stripe_angles(rng, frame))
    lay_water(rng, picture, wet, HALF_M, POND, sun)
    fill_texture(spec.texture("ground"), picture)
    builder.surfaces["terrain"] = Surface(land_class="lawn", reflectivity=0.45)
    return SceneDraft(
        spec=spec,
        takeoff_xy_m=frame.takeoff_xy_m,
        takeoff_yaw=frame.yaw,
        bounds_xy_m=np.array([[-HALF_M, -HALF_M], [HALF_M, HALF_M]]),
        surfaces=builder.surfaces,
        ground=flood_raster(canvas.raster("terrain"), wet),
    )


def draw_turf(seed: int, rng: np.random.Generator, frame: Frame) -> Turf:
    """The three kinds take turns, so that few seeds show all of them."""
    kinds = (Pitch, Golf, Airfield)
    return kinds[seed % len(kinds)](rng, frame)


def shape_ground(rng: np.random.Generator, frame: Frame, turf: Turf) -> tuple[Terrain, Array]:
    """The terrain, level water included, and the water's depth at its nodes (N, N), negative on
    land. The height at the take-off spot is 0."""
    heights = undulation(rng, float(rng.uniform(0.40, 0.60)))
    xy = np.stack(Terrain(heights_m=heights, half_m=HALF_M).node_grid(), axis=-1)
    heights = turf.shape(heights, xy)
    depth = turf.pools(xy)
    heights = level_pools(heights, depth)
    return level_takeoff(heights, HALF_M, frame.takeoff_xy_m), depth


def level_pools(heights: Array, depth: Array) -> Array:
    """Heights (N, N) with each pool, (N, N) depth above 0, level at its lowest shore."""
    cell = 2.0 * HALF_M / (len(heights) - 1)
    labels, count = ndimage.label(depth > 0.0)
    for number in range(1, count + 1):
        pool = labels == number
        away = ndimage.distance_transform_edt(~pool) * cell
        level = float(heights[pool].min())
        heights = level + (heights - level) * smoothstep(cell, 3.0, away)
    return heights


def soak(canvas: Canvas, depth: Float32) -> None:
    """Mud on the bottom of the pools and along their shores. depth: (n, n), n half the canvas."""
    wet = np.repeat(np.repeat(depth > -0.03, 2, axis=0), 2, axis=1)
    canvas.material[wet] = int(Ground.MUD)


def stripe_angles(rng: np.random.Generator, frame: Frame) -> dict[Ground, float]:
    """Mowing stripes along or across the survey, slabs and gravel along it."""
    turned = dict.fromkeys(Ground, frame.yaw)
    turned[Ground.FAIRWAY] = frame.yaw + 0.5 * np.pi
    turned[Ground.GREEN] = frame.yaw + float(rng.uniform(0.0, np.pi))
    turned[Ground.LAWN] = frame.yaw + float(rng.uniform(0.0, np.pi))
    return turned
