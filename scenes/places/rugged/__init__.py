"""`rugged`: ground by dials, in six kinds. Relief of a real spectrum, rocks by the size-frequency
law, plants or snow, grooves, and a given fraction of safe ground."""

import numpy as np

from touchdown.scenes.api import Array, RuggedParams, Surface
from touchdown.scenes.authoring.draft import SceneDraft
from touchdown.scenes.authoring.generation import finish, paint_terrain, scene_rng, start_scene
from touchdown.scenes.authoring.ground import Canvas
from touchdown.scenes.authoring.noise import fractal_noise
from touchdown.scenes.authoring.plots import draw_frame
from touchdown.scenes.authoring.relief import HALF_M, HeightField
from touchdown.scenes.places.rugged import objects
from touchdown.scenes.places.rugged.paint import light_slopes, paint_ground
from touchdown.scenes.places.rugged.presets import Dials
from touchdown.scenes.places.rugged.relief import (
    CELL_M,
    NODES,
    grooves,
    mean_slope_deg,
    relief_m,
    roughness,
    shape_ground,
    snow_depth,
)
from touchdown.scenes.places.rugged.rocks import Rocks, draw_rocks, heap
from touchdown.scenes.places.rugged.safe_ground import SafeGround

SUN_DEG = (32.0, 52.0)


def generate(seed: int, params: RuggedParams) -> SceneDraft:
    """Returns the scene of ``seed`` and the dials ``params`` without the vehicle. The same seed and
    dials give the same bytes."""
    rng = scene_rng("rugged", seed)
    dials, frame = Dials.of(params), draw_frame(rng)
    ground = shape_ground(rng, dials)
    facts = {"slope_deg": mean_slope_deg(ground, CELL_M), "relief_m": relief_m(ground)}
    snow = snow_depth(rng, ground) if dials.cover == "snow" else np.zeros((NODES, NODES))
    cut = grooves(rng, dials) * (snow < 0.1)
    ground += np.where(snow > 0.0, snow, 0.0) + roughness(rng, dials) * (snow < 0.05) - cut
    patchy = np.exp(0.7 * fractal_noise(rng, (200, 200), 16.0, 3, 0.5)).astype(np.float64)
    rocks = draw_rocks(rng, dials.rock_abundance, (2.0 * HALF_M) ** 2, patchy)
    rocks = snowed_in(rocks, snow)
    plants = objects.draw_plants(rng, dials)
    things = [heap(rocks, NODES), heap(plants.tussocks, NODES), objects.tall_things(plants)]
    safe = SafeGround(rng=rng, heights=ground, things=np.maximum.reduce(things))
    reached = safe.reach(dials.safe_fraction, frame.takeoff_xy_m)
    facts |= {"safe_fraction": reached, "safe_fraction_wanted": dials.safe_fraction}
    rocks = rocks.only(safe.clear(rocks.xy_m, 0.5 * rocks.diameter_m))
    tussocks = plants.tussocks
    tussocks = tussocks.only(safe.clear(tussocks.xy_m, 0.5 * tussocks.diameter_m))
    boulders, small = split(rocks)
    terrain = standing(safe.heights, (small, tussocks), frame.takeoff_xy_m)
    builder = start_scene("rugged", rng, terrain, sun_deg=SUN_DEG)
    objects.place_boulders(builder, boulders, dials.preset.rock)
    objects.place_plants(builder, plants, safe)
    canvas = Canvas()
    paint_ground(rng, canvas, dials, safe.heights, snow, cut, small, tussocks)
    slopes = light_slopes(rng, safe.heights, terrain, builder.sun, (small, tussocks))
    raster = paint_terrain(builder, canvas, {}, hilly=True, slopes=slopes)
    own = dials.preset.ground.look.surface
    surface = Surface(land_class=own.land_class, reflectivity=own.reflectivity)
    draft = finish(frame, builder, raster, terrain=surface)
    draft.facts.update(facts, rocks=float(len(rocks.diameter_m)))
    return draft


def snowed_in(rocks: Rocks, snow: Array) -> Rocks:
    """The rocks that look out of ``snow``, (NODES, NODES) metres, as far as they do."""
    above = rocks.height_m - HeightField(heights_m=snow).at(rocks.xy_m)
    return rocks._replace(height_m=above).only(above > 0.3 * rocks.height_m)


def split(rocks: Rocks) -> tuple[Rocks, Rocks]:
    """The largest, which are bodies of their own, and those that are part of the ground."""
    order = np.argsort(-rocks.diameter_m, kind="stable")[: objects.BOULDERS]
    large = np.zeros(len(rocks.diameter_m), bool)
    large[order] = rocks.diameter_m[order] >= objects.BOULDER_M
    return rocks.only(large), rocks.only(~large)


def standing(heights: Array, things: tuple[Rocks, ...], takeoff_xy_m: Array) -> HeightField:
    """The terrain with ``things`` on it, at height 0 at the take-off spot."""
    raised = np.maximum.reduce([heap(one, NODES) for one in things])
    terrain = HeightField(heights_m=heights + raised)
    return HeightField(heights_m=terrain.heights_m - float(terrain.at(takeoff_xy_m)))
