"""`forest`: fills forest.xml with a wood drawn from a seed."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.api import Array, Surface
from touchdown.scenes.authoring.draft import SceneDraft
from touchdown.scenes.authoring.generation import finish, paint_terrain, scene_rng, start_scene
from touchdown.scenes.authoring.ground import TEXELS, Canvas, Ground
from touchdown.scenes.authoring.noise import fractal_noise
from touchdown.scenes.places.forest.furniture import furnish
from touchdown.scenes.places.forest.layout import HALF_M, Clearing, Plan, draw_plan, shape_ground
from touchdown.scenes.places.forest.stand import plant
from touchdown.scenes.props.woods import grow_wood

FLOOR = Surface(land_class="trees", reflectivity=0.35)


def generate(seed: int) -> SceneDraft:
    """Returns the scene of ``seed`` without the vehicle. The same seed gives the same bytes."""
    rng = scene_rng("forest", seed)
    plan = draw_plan(rng)
    builder = start_scene("forest", rng, shape_ground(rng, plan))
    wood = grow_wood(builder)
    furnish(builder, wood, plan)
    plant(builder, wood, plan)
    canvas = paint_floor(rng, plan)
    turned = dict.fromkeys(Ground, plan.frame.takeoff_yaw + 0.4)
    ground = paint_terrain(builder, canvas, turned, hilly=True)
    return finish(plan.frame, builder, ground, terrain=FLOOR)


_COARSE = 1280
_GRASS = {"start": Ground.MEADOW, "meadow": Ground.MEADOW, "plot": Ground.MEADOW,
          "slope": Ground.ROUGH, "stumps": Ground.MEADOW, "boulders": Ground.ROUGH}  # fmt: skip


def paint_floor(rng: np.random.Generator, plan: Plan) -> Canvas:
    """Paints litter and ferns, grass in the clearings, the track and its ruts, the brook's muddy
    banks."""
    canvas = Canvas(half_m=HALF_M)
    cell = 2.0 * HALF_M / _COARSE
    axis = -HALF_M + (np.arange(_COARSE) + 0.5) * cell
    xy = np.stack(np.meshgrid(axis, axis), axis=-1)
    ferns = fractal_noise(rng, (_COARSE, _COARSE), 9.0 / cell, 4, 0.6)
    fray = fractal_noise(rng, (_COARSE, _COARSE), 2.2 / cell, 3, 0.6)
    material = np.full((_COARSE, _COARSE), int(Ground.LITTER), np.uint8)
    material[ferns > 0.45] = int(Ground.FERN)
    to_brook = _distance_to(plan.brook.line_m)
    to_track = _distance_to(plan.track.line_m)
    material[to_brook + 0.6 * fray < 5.0] = int(Ground.FERN)
    material[to_track + 0.45 * fray < 3.0] = int(Ground.ROUGH)
    for clearing in plan.clearings:
        distance = clearing.distance(xy) + 0.7 * fray
        material[distance < 0.9] = int(Ground.WORN)
        material[distance < 0.2] = int(_GRASS[clearing.kind])
    material[to_track + 0.12 * fray < 1.65] = int(Ground.GRAVEL)
    material[to_track + 0.30 * fray < 0.34] = int(Ground.ROUGH)
    material[to_brook + 0.25 * fray < 1.8] = int(Ground.MULCH)
    size = (TEXELS, TEXELS)
    canvas.material[:] = cv2.resize(material, size, interpolation=cv2.INTER_NEAREST)
    for clearing in plan.clearings:
        if clearing.kind == "plot":
            _plough(canvas, plan, clearing)
    _rut(canvas, plan, rng)
    return canvas


def _distance_to(line_m: Array) -> NDArray[np.float32]:
    """(_COARSE, _COARSE) metres to a polyline, row 0 at y_min."""
    mask = np.full((_COARSE, _COARSE), 255, np.uint8)
    cell = 2.0 * HALF_M / _COARSE
    points = np.round(((line_m + HALF_M) / cell - 0.5) * 16).astype(np.int32)
    cv2.polylines(mask, [points], False, 0, 1, cv2.LINE_8, 4)
    distance = cv2.distanceTransform(mask, cv2.DIST_L2, 5)
    return np.asarray(distance * cell, np.float32)


def _plough(canvas: Canvas, plan: Plan, clearing: Clearing) -> None:
    """A game plot: a tilled rectangle in the middle of the clearing."""
    c, s = np.cos(plan.frame.takeoff_yaw + 0.4), np.sin(plan.frame.takeoff_yaw + 0.4)
    half = clearing.radius_m * np.array([0.62, 0.50])
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
    canvas.fill(clearing.centre_xy_m + corners @ np.array([[c, s], [-s, c]]), Ground.SOIL)


def _rut(canvas: Canvas, plan: Plan, rng: np.random.Generator) -> None:
    """Wheel ruts, a puddle's length dark here and there."""
    line = plan.track.line_m
    step = np.gradient(line, axis=0)
    left = np.stack([-step[:, 1], step[:, 0]], -1) / np.linalg.norm(step, axis=1, keepdims=True)
    for side in (-0.8, 0.8):
        canvas.trace(line + side * left, 0.42, 46)
        for start in rng.integers(0, len(line) - 6, 9):
            part = slice(int(start), int(start) + int(rng.integers(3, 6)))
            canvas.trace(line[part] + side * left[part], 0.36, 120)
