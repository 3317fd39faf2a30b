"""`turf`: wide mown grass: a sports ground, a golf course or an airfield."""

import numpy as np
from scipy import ndimage

from touchdown.scenes.api import Array, Float32
from touchdown.scenes.authoring import generation
from touchdown.scenes.authoring.draft import SceneDraft
from touchdown.scenes.authoring.ground import TEXELS, Canvas, Ground
from touchdown.scenes.authoring.plots import SurveyFrame, draw_frame
from touchdown.scenes.authoring.relief import HALF_M, HeightField, level_takeoff, smoothstep
from touchdown.scenes.authoring.water import WaterLook, upsample
from touchdown.scenes.places.turf.airfield import Airfield
from touchdown.scenes.places.turf.golf import Golf
from touchdown.scenes.places.turf.layout import Turf, plant_edge, undulation
from touchdown.scenes.places.turf.pitch import Pitch
from touchdown.scenes.props.woods import grow_wood

POND = WaterLook(body=(40.0, 60.0, 52.0), clarity_m=(0.4, 0.6, 0.45), wave_m=0.7, ripple=0.25)
EDGE_TREES = 42


def generate(seed: int) -> SceneDraft:
    """Returns the scene of ``seed`` without the vehicle. The same seed gives the same bytes."""
    rng = generation.scene_rng("turf", seed)
    frame = draw_frame(rng)
    turf = draw_turf(seed, rng, frame)
    terrain, depth = shape_ground(rng, frame, turf)
    builder = generation.start_scene("turf", rng, terrain)
    wood = grow_wood(builder)
    builder.claim(frame.takeoff_xy_m, 5.0)
    turf.build(builder, wood)
    plant_edge(builder, wood, turf, EDGE_TREES)
    canvas = Canvas()
    turf.paint(canvas, rng)
    wet = upsample(depth, TEXELS // 2)
    soak(canvas, wet)
    flood = generation.Flood(depth_m=wet, draw_look=lambda _: POND)
    ground = generation.paint_terrain(builder, canvas, stripe_angles(rng, frame), flood=flood)
    return generation.finish(frame, builder, ground)


def draw_turf(seed: int, rng: np.random.Generator, frame: SurveyFrame) -> Turf:
    """Returns one of the three kinds, in turn by seed."""
    kinds = (Pitch, Golf, Airfield)
    return kinds[seed % len(kinds)](rng, frame)


def shape_ground(
    rng: np.random.Generator, frame: SurveyFrame, turf: Turf
) -> tuple[HeightField, Array]:
    """Returns the terrain, level water included, and the water's depth at its nodes (N, N),
    negative on land. The height at the take-off spot is 0."""
    heights = undulation(rng, float(rng.uniform(0.40, 0.60)))
    xy = HeightField(heights_m=heights).node_grid()
    heights = turf.shape(heights, xy)
    depth = turf.pools(xy)
    heights = level_pools(heights, depth)
    return level_takeoff(heights, frame.takeoff_xy_m), depth


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


def stripe_angles(rng: np.random.Generator, frame: SurveyFrame) -> dict[Ground, float]:
    """Mowing stripes along or across the survey, slabs and gravel along it."""
    turned = dict.fromkeys(Ground, frame.takeoff_yaw)
    turned[Ground.FAIRWAY] = frame.takeoff_yaw + 0.5 * np.pi
    turned[Ground.GREEN] = frame.takeoff_yaw + float(rng.uniform(0.0, np.pi))
    turned[Ground.LAWN] = frame.takeoff_yaw + float(rng.uniform(0.0, np.pi))
    return turned
