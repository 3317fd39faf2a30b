"""`dunes`: fills dunes.xml with a scene drawn from a seed."""

from __future__ import annotations

import cv2
import numpy as np

from touchdown.scenes.api import Surface
from touchdown.scenes.authoring.builder import SceneBuilder
from touchdown.scenes.authoring.draft import SceneDraft
from touchdown.scenes.authoring.generation import finish, paint_terrain, scene_rng, start_scene
from touchdown.scenes.authoring.ground import TEXELS, Canvas, Ground
from touchdown.scenes.authoring.micro_relief import MicroRelief, Ripples
from touchdown.scenes.authoring.noise import fractal_noise
from touchdown.scenes.authoring.plane import unit
from touchdown.scenes.authoring.relief import HeightField
from touchdown.scenes.authoring.tracks import footprints, sidled, vehicle_track, wander
from touchdown.scenes.authoring.water import upsample
from touchdown.scenes.places.dunes.layout import HALF_M, Plan, Relief, draw_plan, shape_dunes
from touchdown.scenes.props.arid import add_scrub, add_slab, add_tuft, grow_scrub
from touchdown.scenes.props.wires import add_post

SUN_DEG = (26.0, 44.0)


def generate(seed: int) -> SceneDraft:
    """Returns the scene of ``seed`` without the vehicle. The same seed gives the same bytes."""
    rng = scene_rng("dunes", seed)
    plan = draw_plan(rng)
    relief = shape_dunes(rng, plan)
    builder = start_scene("dunes", rng, relief.terrain, sun_deg=SUN_DEG)
    place_objects(builder, plan, relief)
    canvas = Canvas(half_m=HALF_M)
    paint_sand(rng, canvas, relief)
    fine = fine_relief(rng, relief)
    paint_traces(rng, canvas, fine, plan)
    slopes = fine.shading(rng, builder.sun, draw_ripples(rng, plan, relief))
    ground = paint_terrain(builder, canvas, {}, hilly=True, slopes=slopes)
    return finish(plan, builder, ground, terrain=SAND)


SAND = Surface(land_class="field", reflectivity=0.44)


def place_objects(builder: SceneBuilder, plan: Plan, relief: Relief) -> None:
    """Adds everything that stands in the sand: scrub and grass on the flats, in clumps."""
    rng = builder.rng
    land = grow_scrub(builder)
    dune = HeightField(heights_m=relief.dune, half_m=HALF_M)
    builder.claim(plan.takeoff_xy_m, 6.0)
    for centre, radius in plan.outcrops:
        if float(dune.at(centre)) > 0.4:
            continue
        for _ in range(int(rng.integers(4, 8))):
            spot = centre + rng.normal(0.0, 0.45 * radius, 2)
            add_slab(builder, land, spot, float(rng.uniform(0.5, 1.3)))
    for _ in range(70):
        middle = plan.middle.points(rng.uniform([-56.0, -52.0], [56.0, 52.0]))
        for _ in range(int(rng.integers(2, 8))):
            spot = middle + rng.normal(0.0, 2.6, 2)
            outside = np.abs(spot).max() > HALF_M - 2.0
            if outside or float(dune.at(spot)) > 0.5 or not builder.is_free(spot, 0.5):
                continue
            (add_tuft if rng.random() < 0.62 else add_scrub)(builder, land, spot)
    for side in (-1.0, 1.0):
        spot = plan.middle.points(np.array([side * rng.uniform(14.0, 28.0), rng.uniform(-16, 16)]))
        if builder.is_free(spot, 1.0):
            add_post(builder, spot, 1.5, 0.05, [0.45, 0.37, 0.28, 1.0])


_SMALL = 1280


def paint_sand(rng: np.random.Generator, canvas: Canvas, relief: Relief) -> None:
    """Dunes over flats of coarser sand; dry grass in bunches on the flats, bare rock."""
    size = _SMALL
    dune, rock = upsample(relief.dune, size), upsample(relief.rock, size)
    cell = 2.0 * HALF_M / size
    ragged = fractal_noise(rng, (size, size), 1.6 / cell, 3, 0.6)
    patches = fractal_noise(rng, (size, size), 11.0 / cell, 3, 0.6)
    bunches = fractal_noise(rng, (size, size), 0.5 / cell, 2, 0.7)
    layer = np.full((size, size), int(Ground.SAND_FLAT), np.uint8)
    grown = np.clip(patches - 0.6, 0.0, 0.8) - 0.5 * np.clip(dune, 0.0, 1.0)
    layer[0.9 * bunches + 1.6 * grown > 1.75] = int(Ground.DRY_GRASS)
    layer[(dune + 0.05 * ragged > 0.14) & (layer != int(Ground.DRY_GRASS))] = int(Ground.DUNE)
    layer[(rock + 0.15 * ragged > 0.5) & (rock > 0.15)] = int(Ground.BEDROCK)
    canvas.material[:] = cv2.resize(layer, (TEXELS, TEXELS), interpolation=cv2.INTER_NEAREST)


def fine_relief(rng: np.random.Generator, relief: Relief) -> MicroRelief:
    """Returns lumps of the coarse flats, joints of the rock and runnels of slip faces."""
    fine = MicroRelief(half_m=HALF_M)
    size = TEXELS // 2
    rock = upsample(relief.rock, size)
    joints = np.abs(fractal_noise(rng, (size, size), 16.0, 3, 0.55))
    fine.drifts_m += np.float32(0.0012) * fractal_noise(rng, (size, size), 4.0, 2, 0.6)
    fine.drifts_m += np.float32(0.06) * np.minimum(joints, np.float32(0.5)) * rock
    fine.stand_on(relief.terrain)
    return fine


def draw_ripples(rng: np.random.Generator, plan: Plan, relief: Relief) -> Ripples:
    """Ripples over the dunes' windward sides and part of the flats, none on slip faces, rock or
    where the sand is too coarse."""
    size = 640
    slip, rock = upsample(relief.slip, size), upsample(relief.rock, size)
    dune = upsample(relief.dune, size)
    patches = fractal_noise(rng, (size, size), 40.0, 3, 0.6)
    cover = np.clip(0.55 + 0.5 * patches, 0.12, 1.0) * np.where(dune > 0.1, 1.0, 0.6)
    cover *= np.clip(1.0 - 1.6 * cv2.GaussianBlur(slip, (0, 0), 1.0), 0.0, 1.0) * (1.0 - rock)
    wave = float(rng.uniform(0.10, 0.15))
    return Ripples(
        wave_m=wave,
        height_m=wave / 15.0,
        wind_angle=plan.wind_angle,
        cover=cover.astype(np.float32),
    )


def paint_traces(rng: np.random.Generator, canvas: Canvas, fine: MicroRelief, plan: Plan) -> None:
    """A track of vehicles across the field, driven a few times, and walkers from it."""
    plot = plan.middle
    turn = rng.uniform(-0.35, 0.35)
    middle = rng.uniform(-8.0, 14.0)
    slant = 85.0 * np.tan(turn)
    line = wander(
        rng, plot.points(np.array([[-85.0, middle - slant], [85.0, middle + slant]])), 5.0
    )
    for _ in range(3):
        shift = rng.normal(0.0, 0.35, 2)
        vehicle_track(rng, canvas, fine, sidled(rng, line + shift, 0.5), Ground.RUTTED_SAND)
    for _ in range(2):
        start = line[int(rng.uniform(0.3, 0.7) * len(line))]
        end = start + rng.uniform(18.0, 30.0) * unit(rng.uniform(0.0, 2.0 * np.pi))
        footprints(rng, canvas, fine, wander(rng, np.array([start, end]), 1.5), None)
