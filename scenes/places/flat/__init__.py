"""`flat`: a patchwork of lawns and fields.

The ground is exactly level and without objects, so that ranges hold no information about motion
along it; only the texture does.
"""

from itertools import pairwise

import cv2
import numpy as np

from touchdown.scenes.api import Array
from touchdown.scenes.authoring import generation
from touchdown.scenes.authoring.draft import SceneDraft
from touchdown.scenes.authoring.ground import Canvas, Ground, mown_askew
from touchdown.scenes.authoring.noise import fractal_noise
from touchdown.scenes.authoring.plane import SQUARE, pick, rotated, unit
from touchdown.scenes.authoring.plots import SurveyFrame
from touchdown.scenes.authoring.relief import HALF_M, HeightField, cell_grid

NODES = 9


def generate(seed: int) -> SceneDraft:
    """Returns the scene of ``seed`` without the vehicle. The same seed gives the same bytes."""
    rng = generation.scene_rng("flat", seed)
    # The ground goes on beyond the bounds, so that it is safe up to the very edge.
    terrain = HeightField(heights_m=np.zeros((NODES, NODES)), half_m=HALF_M + MARGIN_M)
    builder = generation.start_scene("flat", rng, terrain, base_m=1.0)
    canvas = Canvas(half_m=terrain.half_m)
    takeoff = np.array([-25.0, -20.0]) + rng.uniform(-2.5, 2.5, 2)
    angle = float(rng.uniform(0.0, np.pi))
    paint_parcels(rng, canvas, angle)
    paint_pitch(rng, canvas, takeoff + rng.uniform([18.0, 12.0], [30.0, 26.0]))
    ground = generation.paint_terrain(builder, canvas, mown_askew(rng, angle))
    plan = SurveyFrame(takeoff_xy_m=takeoff, takeoff_yaw=float(rng.uniform(-0.10, 0.10)))
    return generation.finish(plan, builder, ground, half_m=HALF_M)


MARGIN_M = 4.0
_GRASS = (Ground.LAWN, Ground.MEADOW, Ground.LAWN, Ground.MEADOW)
_TILLED = (Ground.SOIL, Ground.CROPS, Ground.PITCH)
_LINE_M = 0.12


def paint_parcels(rng: np.random.Generator, canvas: Canvas, angle: float) -> None:
    """Paints grass with strips of fields between headlands, edges frayed, and worn tracks along
    them."""
    size = len(canvas.material) // 4
    x, y = np.moveaxis(cell_grid(size, canvas.half_m), -1, 0)
    fray = fractal_noise(rng, (size, size), 26.0, 4, 0.6)
    along = np.cos(angle) * x + np.sin(angle) * y
    bend = rng.uniform(2.0, 6.0) * np.sin(along / rng.uniform(18.0, 34.0) + rng.uniform(0.0, 6.0))
    across = -np.sin(angle) * x + np.cos(angle) * y + bend
    layer = np.full((size, size), int(Ground.MEADOW), np.uint8)
    start = -96.0 + rng.uniform(0.0, 8.0)
    tilled = bool(rng.random() < 0.5)
    while start < 96.0:
        width = rng.uniform(12.0, 26.0)
        for first, last in _stretches(rng):
            kinds = _TILLED if tilled and rng.random() < 0.75 else _GRASS
            kind = pick(rng, kinds)
            edge = 0.12 * fray
            inside = (across > start + 0.8 + edge) & (across < start + width - 0.8 + edge)
            layer[inside & (along > first + edge) & (along < last + edge)] = int(kind)
        wheel = np.abs(np.abs(across - start) - 0.75) < 0.28 + 0.06 * fray
        layer[wheel] = int(Ground.WORN)
        start += width
        tilled = not tilled
    blots = fractal_noise(rng, (size, size), 90.0, 3, 0.6)
    grass = (layer == int(Ground.MEADOW)) | (layer == int(Ground.LAWN))
    layer[grass & (blots > 2.0 + 0.2 * fray)] = int(Ground.WORN)
    layer[grass & (blots < -1.7 + 0.2 * fray)] = int(Ground.ROUGH)
    canvas.material[:] = cv2.resize(layer, canvas.material.shape, interpolation=cv2.INTER_NEAREST)


def _stretches(rng: np.random.Generator) -> list[tuple[float, float]]:
    """A strip's parcels one behind the other, headlands of 2.4 m between them."""
    found = []
    start = -98.0
    while start < 98.0:
        end = start + rng.uniform(28.0, 70.0)
        found.append((start, end))
        start = end + 2.4
    return found


def paint_pitch(rng: np.random.Generator, canvas: Canvas, centre_xy_m: Array) -> None:
    """Paints white lines of a playing field on mown grass."""
    turn = float(rng.uniform(0.0, np.pi))
    half = rng.uniform([15.0, 9.5], [19.0, 12.5])

    def world(local: Array) -> Array:
        return centre_xy_m + rotated(np.asarray(local, np.float64), turn)

    canvas.fill(world(SQUARE * (half + 2.0)), Ground.LAWN)
    circle = np.linspace(0.0, 2.0 * np.pi, 60)
    ring = 3.2 * unit(circle)
    box = np.array([[0.0, -0.45], [0.24, -0.45], [0.24, 0.45], [0.0, 0.45]])
    lines = [np.concatenate([SQUARE, SQUARE[:1]]) * half, ring]
    lines.append(np.array([[0.0, -half[1]], [0.0, half[1]]]))
    for side in (-1.0, 1.0):
        lines.append((np.array([1.0, 0.0]) - box) * half * [side, 1.0])
    for line in lines:
        _stripe(canvas, world(line))
    for spot in (np.zeros(2), np.array([0.72, 0.0]) * half, np.array([-0.72, 0.0]) * half):
        dot = 0.16 * unit(circle)
        canvas.mark(world(spot + dot), 215)


def _stripe(canvas: Canvas, line_m: Array) -> None:
    """A painted line along a polyline, a little worn."""
    for start, end in pairwise(line_m):
        way = (end - start) / max(float(np.hypot(*(end - start))), 1e-9)
        side = 0.5 * _LINE_M * np.array([-way[1], way[0]])
        canvas.mark(np.array([start - side, end - side, end + side, start + side]), 215)
