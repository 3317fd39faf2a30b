"""`snow`: fresh snow over gentle relief, with drifts, tracks, a hut and a frozen pond."""

import cv2
import numpy as np

from touchdown.scenes.authoring import micro_relief
from touchdown.scenes.authoring.draft import SceneDraft
from touchdown.scenes.authoring.generation import finish, paint_terrain, scene_rng, start_scene
from touchdown.scenes.authoring.ground import TEXELS, Canvas, Ground
from touchdown.scenes.authoring.noise import fractal_noise
from touchdown.scenes.authoring.plane import unit
from touchdown.scenes.authoring.relief import HALF_M, HeightField, cell_grid
from touchdown.scenes.authoring.water import upsample
from touchdown.scenes.places.snow import layout
from touchdown.scenes.places.snow.objects import SNOW, lay_ice, place_objects

SUN_DEG = (26.0, 40.0)


def generate(seed: int) -> SceneDraft:
    """Returns the scene of ``seed`` without the vehicle. The same seed gives the same bytes."""
    rng = scene_rng("snow", seed)
    plan = layout.draw_plan(rng)
    relief = layout.shape_snow(rng, plan)
    builder = start_scene("snow", rng, relief.terrain, sun_deg=SUN_DEG)
    place_objects(builder, plan, relief)
    lay_ice(builder, plan, relief)
    canvas = Canvas()
    canvas.material[:] = int(Ground.SNOW)
    fine = fine_relief(rng, plan, relief)
    paint_tracks(rng, canvas, fine, plan, relief)
    paint_ice(rng, canvas, fine, plan, relief)
    slopes = fine.shading(rng, builder.sun)
    ground = paint_terrain(builder, canvas, {}, hilly=True, slopes=slopes)
    return finish(plan, builder, ground, terrain=SNOW)


def fine_relief(
    rng: np.random.Generator, plan: layout.Plan, relief: layout.Relief
) -> micro_relief.MicroRelief:
    """Returns the relief that the nodes cannot hold: small ridges along the wind where it has cut,
    faint ripples elsewhere."""
    fine = micro_relief.MicroRelief()
    size = TEXELS // 2
    small = 1024
    xy = cell_grid(small)
    cut = upsample(relief.sastrugi, small)
    dry = np.clip(upsample(relief.pond_m, small), 0.0, 1.0)
    ridges = (0.006 + 0.020 * cut) * layout.sastrugi(rng, plan, xy, 0.85)
    heights = (dry * ridges).astype(np.float32)
    fine.drifts_m[:] = cv2.resize(heights, (size, size), interpolation=cv2.INTER_CUBIC)
    grain = fractal_noise(rng, (size, size), 5.0, 2, 0.6)
    fine.drifts_m += np.float32(0.0016) * grain
    fine.stand_on(relief.terrain)
    return fine


def paint_tracks(
    rng: np.random.Generator,
    canvas: Canvas,
    fine: micro_relief.MicroRelief,
    plan: layout.Plan,
    relief: layout.Relief,
) -> None:
    """Draws a vehicle's track past the hut, skis across the field, sledges down the hill, and the
    walkers between hut, pond, hill and take-off."""
    plot = plan.from_middle
    lane = rng.uniform(26.0, 29.0)
    ends = plot.points(np.array([[-75.0, lane + rng.uniform(-6.0, 6.0)], [75.0, lane + 5.0]]))
    micro_relief.vehicle_track(
        rng, canvas, fine, micro_relief.wander(rng, ends, 2.5), Ground.PACKED_SNOW
    )
    for _ in range(3):
        tilt = rng.uniform(-25.0, 25.0)
        start = rng.uniform(-30.0, 30.0)
        cross = np.array([[start, -75.0], [start + tilt, 75.0]])
        cross = cross if rng.random() < 0.5 else np.array([[-75.0, start], [75.0, start + tilt]])
        line = micro_relief.wander(rng, plot.points(0.75 * cross), 4.0)
        micro_relief.runners(canvas, fine, line, micro_relief.SKIS, Ground.PACKED_SNOW)
        for side in (-0.42, 0.42):  # pole marks
            for spot in micro_relief.parallel(line, side)[:: int(rng.integers(16, 24))]:
                fine.press(spot + 0.05 * micro_relief.OVAL, 0.03)
    for _ in range(int(rng.integers(3, 6))):
        angle = rng.uniform(0.0, 2.0 * np.pi)
        way = unit(angle)
        run = np.array([plan.hill_xy_m + 0.5 * way, plan.hill_xy_m + rng.uniform(15.0, 20.0) * way])
        micro_relief.runners(
            canvas,
            fine,
            micro_relief.wander(rng, run, 0.6),
            micro_relief.SLEDGE,
            Ground.PACKED_SNOW,
        )
        back = np.array([run[1] + rng.uniform(-2.0, 2.0, 2), plan.hill_xy_m])
        micro_relief.footprints(
            rng, canvas, fine, micro_relief.wander(rng, back, 1.0), Ground.PACKED_SNOW
        )
    shore = plan.pond_xy_m + 1.2 * (plan.hut_xy_m - plan.pond_xy_m) * (
        plan.pond_radius_m / np.hypot(*(plan.hut_xy_m - plan.pond_xy_m))
    )
    door = micro_relief.placed(plan.hut_xy_m, plan.hut_angle, np.array([0.0, -3.0]))
    bearing = rng.uniform(-0.2, 0.2) + plan.takeoff_yaw
    beside = plan.takeoff_xy_m + 5.0 * unit(bearing)
    for origin, end, sway in (
        (door, shore, 1.2), (door, shore, 2.0), (door, plan.hill_xy_m, 2.5), (shore, beside, 2.0),
        (door, plot.points(np.array([-5.0, 60.0])), 2.0),
    ):  # fmt: skip
        line = micro_relief.wander(rng, np.array([origin, end]), sway)
        micro_relief.footprints(rng, canvas, fine, line, Ground.PACKED_SNOW)


def paint_ice(
    rng: np.random.Generator,
    canvas: Canvas,
    fine: micro_relief.MicroRelief,
    plan: layout.Plan,
    relief: layout.Relief,
) -> None:
    """Paints the wind-swept ice with its cracks; wisps of snow too narrow to land on cross it."""
    size = TEXELS // 2
    edge = upsample(relief.pond_m, size)
    axis = (np.arange(size, dtype=np.float32) + 0.5) / size * 2.0 * HALF_M - HALF_M
    x, y = np.meshgrid(axis, axis)
    east, north = plan.wind
    streak = fractal_noise(rng, (256, 256), 9.0, 3, 0.55)
    x, y = x - np.float32(plan.pond_xy_m[0]), y - np.float32(plan.pond_xy_m[1])
    # Within the pond nothing of the tile comes twice.
    col = ((east * x + north * y) * 4.5 + 128.0).astype(np.float32)
    row = ((east * y - north * x) * 10.0 + 128.0).astype(np.float32)
    wisps = cv2.remap(streak, col, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    ice = (edge < -0.05) & (wisps < 1.25)
    whole = cv2.resize(ice.astype(np.uint8), (TEXELS, TEXELS), interpolation=cv2.INTER_LINEAR)
    canvas.material[whole > 0] = int(Ground.ICE)
    inside = cv2.resize((edge < 0.0).astype(np.uint8), (TEXELS, TEXELS)) > 0
    fine.prints[inside] = 128
    pond = HeightField(heights_m=relief.pond_m)
    for _ in range(int(rng.integers(9, 14))):
        heading = rng.uniform(0.0, 2.0 * np.pi) + np.cumsum(rng.normal(0.0, 0.16, 60))
        start = plan.pond_xy_m + rng.uniform(-0.8, 0.8, 2) * plan.pond_radius_m
        steps = 0.2 * unit(heading)
        line = start + np.cumsum(steps, axis=0)
        inner = line[pond.at(line) < -0.3]
        if len(inner) > 4:
            width = max(1, round(rng.uniform(0.02, 0.06) / canvas.texel_m))
            points = [canvas.texels(inner)]
            shade = int(rng.integers(60, 150))
            cv2.polylines(canvas.paint, points, False, shade, width, cv2.LINE_AA, 4)
