"""`dunes`: crests of sand across the wind with slip faces, and the flats between them, with scrub,
tufts of dry grass and outcrops of layered rock."""

from dataclasses import dataclass

import cv2
import numpy as np

from touchdown.scenes.api import Array, Surface
from touchdown.scenes.authoring import micro_relief
from touchdown.scenes.authoring.builder import SceneBuilder
from touchdown.scenes.authoring.draft import SceneDraft
from touchdown.scenes.authoring.generation import finish, paint_terrain, scene_rng, start_scene
from touchdown.scenes.authoring.ground import TEXELS, Canvas, Ground
from touchdown.scenes.authoring.noise import fractal_noise
from touchdown.scenes.authoring.plane import unit
from touchdown.scenes.authoring.plots import SurveyFrame, draw_frame
from touchdown.scenes.authoring.relief import HALF_M, HeightField, level_takeoff, smoothstep
from touchdown.scenes.authoring.water import upsample
from touchdown.scenes.props.scrubland import add_scrub, add_slab, add_tuft, grow_scrub
from touchdown.scenes.props.street import add_post

NODES = 321
REPOSE = float(np.tan(np.deg2rad(32.0)))
"""Slope at which dry sand slides."""
_FLAT_FRACTION = 0.30
"""of a wave length, the flat before the next dune"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Plan(SurveyFrame):
    """Spots in world metres."""

    wind_angle: float
    """radians, the way the wind blows"""
    wave_m: float
    """from dune to dune"""
    height_m: float
    """of the highest crest"""
    outcrops: tuple[tuple[Array, float], ...]
    """middle and radius of bare rock"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Relief:
    """The ground."""

    terrain: HeightField
    dune: Array
    """(N, N) metres of dune over the flat at the nodes"""
    slip: Array
    """(N, N) 0..1: on a slip face"""
    rock: Array
    """(N, N) 0..1: bare rock"""


def draw_plan(rng: np.random.Generator) -> Plan:
    """Returns a plan whose wind blows anywhere, with outcrops on the flats."""
    frame = draw_frame(rng)
    middle = frame.from_middle
    outcrops: list[tuple[Array, float]] = []
    for _ in range(60):
        spot = rng.uniform([-40.0, -36.0], [40.0, 36.0])
        radius = float(rng.uniform(2.2, 4.2))
        world = middle.points(spot)
        clear = np.hypot(*(spot - [-25.0, -20.0])) > 12.0
        apart = all(np.hypot(*(world - other)) > 14.0 for other, _ in outcrops)
        if clear and apart and len(outcrops) < 6:
            outcrops.append((world, radius))
    return Plan(
        takeoff_xy_m=frame.takeoff_xy_m,
        takeoff_yaw=frame.takeoff_yaw,
        wind_angle=float(rng.uniform(-np.pi, np.pi)),
        wave_m=float(rng.uniform(27.0, 36.0)),
        height_m=float(rng.uniform(2.3, 3.4)),
        outcrops=tuple(outcrops),
    )


def dune_profile(phase: Array, height_m: Array, wave_m: float) -> tuple[Array, Array]:
    """Heights (...) of dunes at phases 0..1 along the wind, and 1 on slip faces: a flat, a gentle
    rise to the crest, and the fall at the angle of repose. height_m: (...) of the crest there."""
    fall = np.maximum(height_m, 1e-3) / (REPOSE * wave_m)
    crest = 1.0 - fall
    rise = np.clip((phase - _FLAT_FRACTION) / np.maximum(crest - _FLAT_FRACTION, 0.05), 0.0, 1.0)
    stoss = rise**1.5 * (1.0 - 0.35 * rise) / 0.65
    lee = np.clip((1.0 - phase) / fall, 0.0, 1.0)
    on_lee = phase > crest
    return height_m * np.where(on_lee, lee, stoss), (on_lee & (height_m > 0.25)).astype(np.float64)


def shape_dunes(rng: np.random.Generator, plan: Plan) -> Relief:
    """Returns the ground; the height at the take-off spot is 0."""
    axis = np.linspace(-HALF_M, HALF_M, NODES)
    xy = np.stack(np.meshgrid(axis, axis), axis=-1)
    cell, shape = float(axis[1] - axis[0]), (NODES, NODES)
    east, north = np.cos(plan.wind_angle), np.sin(plan.wind_angle)
    sway = fractal_noise(rng, shape, 34.0 / cell, 2, 0.35).astype(np.float64)
    start = plan.takeoff_xy_m @ np.array([east, north])
    # The take-off lies on a flat, a few metres behind a slip face.
    spot_sway = float(HeightField(heights_m=sway).at(plan.takeoff_xy_m))
    along = xy @ np.array([east, north]) - start + 6.5 * (sway - spot_sway)
    phase = np.mod(along / plan.wave_m + 0.5 * _FLAT_FRACTION, 1.0)
    # Crests break where the sand is scarce.
    scarce = fractal_noise(rng, shape, 30.0 / cell, 2, 0.4).astype(np.float64)
    high = plan.height_m * smoothstep(-1.3, 0.7, scarce)
    dune, slip = dune_profile(phase, high, plan.wave_m)
    ground = 0.35 * fractal_noise(rng, shape, 42.0 / cell, 2, 0.3).astype(np.float64)
    rough = smoothstep(0.5, 1.3, fractal_noise(rng, shape, 15.0 / cell, 2).astype(np.float64))
    rough *= smoothstep(0.6, 0.1, dune)
    mega = 2.0 * np.pi * (along + 0.5 * sway) / rng.uniform(2.0, 2.6)
    ground += 0.028 * rough * np.sin(mega + 0.4 * np.sin(mega))
    ground += 0.012 * fractal_noise(rng, shape, 3.0 / cell, 2)
    rock = np.zeros(shape)
    ragged = 0.8 * fractal_noise(rng, shape, 3.5 / cell, 3, 0.6).astype(np.float64)
    for centre, radius in plan.outcrops:
        off = np.linalg.norm(xy - centre, axis=-1) + ragged
        rock = np.maximum(rock, smoothstep(radius + 0.4, radius - 0.8, off) * (dune < 0.5))
    steps = 0.14 * np.round(2.0 * fractal_noise(rng, shape, 2.2 / cell, 2).astype(np.float64))
    heights = ground + _settled(dune, cell) + rock * (0.25 + 0.5 * steps)
    terrain = level_takeoff(heights, plan.takeoff_xy_m)
    return Relief(terrain=terrain, dune=dune, slip=slip, rock=rock)


def _settled(dune: Array, cell_m: float) -> Array:
    """Sand that lies steeper than its angle of repose, where crests turn, slides: (N, N) heights
    relaxed until no edge between nodes is steeper."""
    heights = dune.copy()
    maximum = 1.04 * REPOSE * cell_m
    for _ in range(40):
        moved = 0.0
        for axis in (0, 1):
            step = np.diff(heights, axis=axis)
            excess = 0.5 * (step - np.clip(step, -maximum, maximum))
            moved = max(moved, float(np.abs(excess).max()))
            pad = [(0, 0), (0, 0)]
            pad[axis] = (0, 1)
            heights += 0.7 * np.pad(excess, pad)
            pad[axis] = (1, 0)
            heights -= 0.7 * np.pad(excess, pad)
        if moved < 1e-3:
            break
    return heights


SUN_DEG = (26.0, 44.0)


def generate(seed: int) -> SceneDraft:
    """Returns the scene of ``seed`` without the vehicle. The same seed gives the same bytes."""
    rng = scene_rng("dunes", seed)
    plan = draw_plan(rng)
    relief = shape_dunes(rng, plan)
    builder = start_scene("dunes", rng, relief.terrain, sun_deg=SUN_DEG)
    place_objects(builder, plan, relief)
    canvas = Canvas()
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
    dune = HeightField(heights_m=relief.dune)
    builder.claim(plan.takeoff_xy_m, 6.0)
    for centre, radius in plan.outcrops:
        if float(dune.at(centre)) > 0.4:
            continue
        for _ in range(int(rng.integers(4, 8))):
            spot = centre + rng.normal(0.0, 0.45 * radius, 2)
            add_slab(builder, land, spot, float(rng.uniform(0.5, 1.3)))
    for _ in range(70):
        middle = plan.from_middle.points(rng.uniform([-56.0, -52.0], [56.0, 52.0]))
        for _ in range(int(rng.integers(2, 8))):
            spot = middle + rng.normal(0.0, 2.6, 2)
            outside = np.abs(spot).max() > HALF_M - 2.0
            if outside or float(dune.at(spot)) > 0.5 or not builder.is_free(spot, 0.5):
                continue
            (add_tuft if rng.random() < 0.62 else add_scrub)(builder, land, spot)
    for side in (-1.0, 1.0):
        spot = plan.from_middle.points(
            np.array([side * rng.uniform(14.0, 28.0), rng.uniform(-16, 16)])
        )
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


def fine_relief(rng: np.random.Generator, relief: Relief) -> micro_relief.MicroRelief:
    """Returns lumps of the coarse flats, joints of the rock and runnels of slip faces."""
    fine = micro_relief.MicroRelief()
    size = TEXELS // 2
    rock = upsample(relief.rock, size)
    joints = np.abs(fractal_noise(rng, (size, size), 16.0, 3, 0.55))
    fine.drifts_m += np.float32(0.0012) * fractal_noise(rng, (size, size), 4.0, 2, 0.6)
    fine.drifts_m += np.float32(0.06) * np.minimum(joints, np.float32(0.5)) * rock
    fine.stand_on(relief.terrain)
    return fine


def draw_ripples(rng: np.random.Generator, plan: Plan, relief: Relief) -> micro_relief.Ripples:
    """Ripples over the dunes' windward sides and part of the flats, none on slip faces, rock or
    where the sand is too coarse."""
    size = 640
    slip, rock = upsample(relief.slip, size), upsample(relief.rock, size)
    dune = upsample(relief.dune, size)
    patches = fractal_noise(rng, (size, size), 40.0, 3, 0.6)
    cover = np.clip(0.55 + 0.5 * patches, 0.12, 1.0) * np.where(dune > 0.1, 1.0, 0.6)
    cover *= np.clip(1.0 - 1.6 * cv2.GaussianBlur(slip, (0, 0), 1.0), 0.0, 1.0) * (1.0 - rock)
    wave = float(rng.uniform(0.10, 0.15))
    return micro_relief.Ripples(
        wave_m=wave,
        height_m=wave / 15.0,
        wind_angle=plan.wind_angle,
        cover=cover.astype(np.float32),
    )


def paint_traces(
    rng: np.random.Generator, canvas: Canvas, fine: micro_relief.MicroRelief, plan: Plan
) -> None:
    """A track of vehicles across the field, driven a few times, and walkers from it."""
    plot = plan.from_middle
    turn = rng.uniform(-0.35, 0.35)
    middle = rng.uniform(-8.0, 14.0)
    slant = 85.0 * np.tan(turn)
    line = micro_relief.wander(
        rng, plot.points(np.array([[-85.0, middle - slant], [85.0, middle + slant]])), 5.0
    )
    for _ in range(3):
        shift = rng.normal(0.0, 0.35, 2)
        micro_relief.vehicle_track(
            rng, canvas, fine, micro_relief.sidled(rng, line + shift, 0.5), Ground.RUTTED_SAND
        )
    for _ in range(2):
        start = line[int(rng.uniform(0.3, 0.7) * len(line))]
        end = start + rng.uniform(18.0, 30.0) * unit(rng.uniform(0.0, 2.0 * np.pi))
        micro_relief.footprints(
            rng, canvas, fine, micro_relief.wander(rng, np.array([start, end]), 1.5), None
        )
