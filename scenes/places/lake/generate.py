"""`lake`: fills lake.xml with a scene drawn from a seed."""

from __future__ import annotations

import cv2
import numpy as np

from touchdown.scenes.authoring.draft import SceneDraft
from touchdown.scenes.authoring.generation import (
    Flood,
    finish,
    paint_terrain,
    scene_rng,
    start_scene,
)
from touchdown.scenes.authoring.ground import TEXELS, Canvas, Ground
from touchdown.scenes.authoring.noise import fractal_noise
from touchdown.scenes.authoring.plane import draw_heading
from touchdown.scenes.authoring.water import WaterLook, upsample
from touchdown.scenes.places.lake.layout import HALF_M, Basin, Plan, Shore, draw_plan, shape_basin
from touchdown.scenes.places.lake.objects import footpath, place_objects
from touchdown.scenes.props.plants import plant_nursery


def generate(seed: int) -> SceneDraft:
    """Returns the scene of ``seed`` without the vehicle. The same seed gives the same bytes."""
    rng = scene_rng("lake", seed)
    plan = draw_plan(rng)
    basin = shape_basin(rng, plan)
    builder = start_scene("lake", rng, basin.terrain)
    nursery = plant_nursery(builder)
    path = footpath(plan, rng)
    place_objects(builder, plan, basin, nursery, path)
    canvas = Canvas(half_m=HALF_M)
    paint_shore(rng, canvas, plan, basin)
    paint_fields(rng, canvas)
    paint_strand(rng, canvas, plan)
    canvas.track(path, 1.9, Ground.GRAVEL)
    rows = dict.fromkeys(Ground, float(rng.uniform(0.0, np.pi)))
    depth = upsample(basin.level_m - basin.bottom_m, TEXELS // 2)
    flood = Flood(depth_m=depth, draw_look=draw_look)
    ground = paint_terrain(builder, canvas, rows, flood=flood)
    return finish(plan, builder, ground)


def draw_look(rng: np.random.Generator) -> WaterLook:
    """Returns the look of water from clear blue-green to brown."""
    peat = float(rng.uniform(0.0, 1.0)) ** 2
    clear, brown = np.array([26.0, 74.0, 84.0]), np.array([44.0, 56.0, 44.0])
    red, green, blue = (1.0 - peat) * clear + peat * brown
    return WaterLook(
        body=(red, green, blue),
        clarity_m=(0.55 - 0.1 * peat, 1.0 - 0.35 * peat, 0.9 - 0.5 * peat),
        wave_m=float(rng.uniform(0.8, 1.4)),
        ripple=float(rng.uniform(0.3, 0.55)),
        wind_angle=draw_heading(rng),
    )


_SIZE = TEXELS // 4
_CORNERS = (
    ((-54.0, 30.0), (-37.0, 32.0), (-27.0, 70.0), (-55.0, 70.0)),
    ((18.0, -46.0), (18.0, -70.0), (70.0, -70.0), (70.0, -38.0)),
)
"""Outlines of the fields (x, y), metres; they end at the edge of the scene."""


def paint_shore(rng: np.random.Generator, canvas: Canvas, plan: Plan, basin: Basin) -> None:
    """Paints meadow, mown grass about the take-off spot, and the shore by its kind, edges
    frayed."""
    axis = (np.arange(_SIZE) + 0.5) / _SIZE * 2.0 * HALF_M - HALF_M
    xy = np.stack(np.meshgrid(axis, axis), axis=-1)
    shore = upsample(basin.shore_m, _SIZE)
    cells = _SIZE / (2.0 * HALF_M)
    fray = np.clip(fractal_noise(rng, (_SIZE, _SIZE), 4.0 * cells, 4, 0.6), -1.3, 1.3)
    wander = fractal_noise(rng, (_SIZE, _SIZE), 7.0 * cells, 2, 0.5)
    kind = plan.kind(plan.bearing(xy) + 0.05 * wander + 0.025 * fray)
    layer = np.full((_SIZE, _SIZE), int(Ground.MEADOW), np.uint8)
    home = np.linalg.norm(xy - plan.takeoff_xy_m, axis=-1)
    mown = (home < 12.0 + 0.6 * fray) | (np.abs(shore - 11.5) < 4.5 + 0.8 * fray)
    layer[mown] = int(Ground.LAWN)
    limits = {
        Shore.BEACH: ((9.5, 1.3, Ground.BEACH),),
        Shore.REEDS: ((3.6, 1.0, Ground.MUD),),
        Shore.SHINGLE: ((6.0, 1.2, Ground.GRAVEL), (2.6, 0.5, Ground.BEACH)),
        Shore.BANK: ((1.5, 0.7, Ground.WORN), (-0.4, 0.4, Ground.MUD)),
    }
    for which, bands in limits.items():
        for edge, spread, material in bands:
            layer[(kind == which) & (shore < edge + spread * fray)] = int(material)
    layer[(plan.outer(xy) < 0.55 + 0.3 * fray) & (shore < -1.0)] = int(Ground.MUD)
    islet = np.linalg.norm(xy - plan.islet_xy_m, axis=-1) < plan.islet_radius_m + 3.0 + 1.2 * fray
    layer[islet & (shore > 1.4 + 0.4 * fray)] = int(Ground.MEADOW)
    layer[islet & (shore <= 1.4 + 0.4 * fray)] = int(Ground.GRAVEL)
    canvas.material[:] = cv2.resize(layer, canvas.material.shape, interpolation=cv2.INTER_NEAREST)


def paint_fields(rng: np.random.Generator, canvas: Canvas) -> None:
    """Paints fields in two corners of the scene, away from the lake."""
    kinds = rng.permutation([int(Ground.SOIL), int(Ground.CROPS), int(Ground.LAWN)])
    for corner, kind in zip(_CORNERS, kinds[:2], strict=True):
        outline = np.array(corner) + rng.uniform(-2.0, 2.0, (4, 2))
        canvas.fill(outline, Ground(int(kind)))


def paint_strand(rng: np.random.Generator, canvas: Canvas, plan: Plan) -> None:
    """Paints drift lines on the beach."""
    for index in range(2):
        out = 0.7 + 1.5 * index + rng.uniform(-0.2, 0.2)
        beach = plan.middle_of(Shore.BEACH)
        for start in np.arange(beach - 0.6, beach + 0.6, 0.05):
            if rng.random() < 0.6:
                turn = start + np.linspace(0.0, 0.05, 8)
                line = plan.shore_points(turn, np.array([out]))
                canvas.trace(line + rng.normal(0.0, 0.05, line.shape), 0.08, 60)
