"""`footbridge`: a footbridge over a stream, or over a road in a cutting, between lawns."""

from dataclasses import replace

import numpy as np

from touchdown.scenes.api import Array, MovingBody
from touchdown.scenes.authoring import generation, streets
from touchdown.scenes.authoring.builder import SceneBuilder
from touchdown.scenes.authoring.draft import SceneDraft
from touchdown.scenes.authoring.ground import TEXELS, Canvas, Ground
from touchdown.scenes.authoring.plane import SQUARE, left_of, pick, unit_circle
from touchdown.scenes.authoring.plots import free_spots
from touchdown.scenes.authoring.relief import HALF_M, HeightField
from touchdown.scenes.authoring.water import WaterLook, upsample
from touchdown.scenes.places.footbridge import bridge
from touchdown.scenes.props.cars import CAR_SURFACE, add_car_models
from touchdown.scenes.props.plants import Nursery, add_bush, add_rock, add_tree, plant_nursery
from touchdown.scenes.props.street import add_bench, add_bin, add_fence, add_lamp
from touchdown.scenes.props.waterside import add_molehill, add_reeds, grow_reeds

PATH_M = 3.0


def draw_paths(rng: np.random.Generator, plan: bridge.Plan) -> list[Array]:
    """Returns paths, (N, 2) each, from the ramps' feet to the edges of the scene; one branches
    off along the bank."""
    paths = []
    for sign in (-1.0, 1.0):
        plot, reach = plan.bridge.plot, plan.bridge.reach_m
        foot, ahead = plot.at(sign * (reach - 0.5), 0.0), plot.at(sign * (reach + 8.0), 0.0)
        edge = sign * HALF_M
        corners = [foot, ahead]
        corners.append(np.array([0.5 * (ahead[0] + edge), ahead[1] + rng.uniform(-9.0, 9.0)]))
        corners.append(np.array([edge, ahead[1] + rng.uniform(-14.0, 14.0)]))
        paths.append(streets.smooth_line(np.array(corners)))
        along = np.linspace(0.0, 1.0, 5) * rng.choice([-1.0, 1.0])
        stations = plan.course.nearest(foot)[1] + along * 80.0
        aside = -sign * (plan.floor_m + plan.bank_m + 5.0)
        bank = [plan.course.point(float(s), aside) for s in stations[1:]]
        if sign > 0.0 or rng.random() < 0.3:
            paths.append(streets.smooth_line(np.array([ahead, *bank])))
    return paths


def paint_ground(
    canvas: Canvas, plan: bridge.Plan, paths: list[Array], rng: np.random.Generator
) -> None:
    """Paints mown lawns about the bridge and the take-off spot, meadows beyond, rough banks, paths,
    and the road or the stream's bed."""
    canvas.fill(SQUARE * 2.0 * HALF_M, Ground.MEADOW)
    for centre, reach in (
        (plan.takeoff_xy_m, 22.0), (plan.bridge.plot.at(-24.0, 0.0), 24.0),
        (plan.bridge.plot.at(26.0, 0.0), 22.0),
    ):  # fmt: skip
        turn = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
        ragged = 1.0 + 0.12 * np.sin(3.0 * turn + rng.uniform(0.0, 6.0))
        canvas.fill(centre + reach * ragged[:, None] * unit_circle(48), Ground.LAWN)
    bank = 2.0 * (plan.floor_m + plan.bank_m)
    line = plan.course.line_m
    canvas.track(line, bank + 1.0, Ground.MEADOW)
    canvas.track(line, bank - 2.0, Ground.ROUGH)
    material = Ground.GRAVEL if rng.random() < 0.6 else Ground.PAVERS
    for path in paths:
        canvas.track(path, PATH_M, material)
    if plan.over_road:
        streets.paint_street(canvas, plan.course, pavement=Ground.PAVEMENT)
        streets.paint_street(canvas, plan.course)
        streets.paint_wear(canvas, plan.course, rng, 0.0)
        streets.paint_dashes(canvas, plan.course, 0.0, plan.course.length_m)
    else:
        canvas.track(line, 2.0 * plan.floor_m + 2.4, Ground.WORN)
        canvas.track(line, 2.0 * plan.floor_m + 1.0, Ground.MUD)


def furnish(
    builder: SceneBuilder, plan: bridge.Plan, paths: list[Array], nursery: Nursery
) -> tuple[MovingBody, ...]:
    """Lamps, benches, fences, trees, rocks, reeds. Returns the cars that drive below."""
    rng = builder.rng
    builder.claim(plan.takeoff_xy_m, 6.5)
    for path in paths:
        for spot in path[::3]:
            builder.claim(spot, 0.5 * PATH_M + 0.2)
    for path in paths:
        for station in range(int(rng.integers(8, 16)), len(path) - 8, 44):
            _beside(builder, path, station, nursery)
    moving: tuple[MovingBody, ...] = ()
    if plan.over_road:
        moving = _furnish_road(builder, plan)
    else:
        _furnish_stream(builder, plan)
    _plant(builder, plan, nursery)
    return moving


def _beside(builder: SceneBuilder, path: Array, station: int, nursery: Nursery) -> None:
    """A lamp on one side of a path, a bench with a bin on the other."""
    span = path[station + 1] - path[station - 1]
    heading = float(np.arctan2(span[1], span[0]))
    left = left_of(heading)
    spot = path[station] + 2.0 * left
    if np.abs(spot).max() < HALF_M - 2.0 and builder.is_free(spot, 0.1):
        add_lamp(builder, spot, heading - 0.5 * np.pi, 4.4)
    seat = path[min(station + 10, len(path) - 1)] - 2.4 * left
    if np.abs(seat).max() < HALF_M - 2.0 and builder.is_free(seat, 0.5):
        add_bench(builder, seat, heading + 0.5 * np.pi)
        add_bin(builder, seat + 1.6 * span / np.linalg.norm(span), [0.20, 0.30, 0.24, 1])


def _furnish_road(builder: SceneBuilder, plan: bridge.Plan) -> tuple[MovingBody, ...]:
    """Adds kerbs, fences at the tops of the cutting, traffic."""
    rng = builder.rng
    course = plan.course
    for side in (1.0, -1.0):
        streets.place_street_kerb(builder, course, side, [], 0.02)
        middle = float(course.nearest(plan.bridge.plot.origin_xy_m)[1])
        aside = side * (plan.floor_m + plan.bank_m + 0.7)
        for first in (-38.0, -22.0, 6.0, 22.0):
            run = [course.point(middle + first + d, aside) for d in (0.0, 15.5)]
            if np.abs(run).max() < HALF_M - 1.0:
                add_fence(builder, run[0], run[1], [0.46, 0.44, 0.40, 1])
    models = add_car_models(builder, 5)
    path = streets.lane_loop(builder, course, 10.0, course.length_m - 10.0)
    chosen = [pick(rng, models)[:2] for _ in range(int(rng.integers(2, 4)))]
    return streets.send_round(builder, path, chosen, CAR_SURFACE, float(rng.uniform(6.0, 10.0)))


def _furnish_stream(builder: SceneBuilder, plan: bridge.Plan) -> None:
    """Adds reeds and boulders along the water's edge."""
    rng = builder.rng
    bed = grow_reeds(builder)
    course = plan.course
    edge = plan.floor_m + plan.bank_m * plan.water_m / plan.depth_m
    for along in np.arange(2.0, course.length_m - 1.0, 1.3):
        side = float(rng.choice([-1.0, 1.0]))
        spot = course.point(float(along), side * (edge + rng.normal(-0.2, 0.35)))
        u = abs(float(plan.bridge.plot.coordinates(spot)[1]))
        clump = np.sin(0.13 * along + 2.0 * side) > 0.25
        if clump and u > 5.0 and np.abs(spot).max() < HALF_M - 1.5:
            add_reeds(builder, bed, spot)
    for _ in range(16):
        spot = course.point(rng.uniform(3.0, course.length_m - 3.0), rng.normal(0.0, 0.6 * edge))
        if builder.is_free(spot, 0.5):
            add_rock(builder, spot, rng.uniform(0.35, 0.8))


def _plant(builder: SceneBuilder, plan: bridge.Plan, nursery: Nursery) -> None:
    """Trees, bushes, rocks and molehills; fewer trees on the lawns in view of the survey."""
    rng = builder.rng

    def beside(spot: Array) -> bool:
        return float(plan.bank_distance(spot)) > 1.5

    def for_a_tree(spot: Array) -> bool:
        near = np.linalg.norm(spot - plan.takeoff_xy_m) < 20.0
        return beside(spot) and not (near and rng.random() < 0.7)

    def for_a_bush(spot: Array) -> bool:
        return float(plan.bank_distance(spot)) > -plan.bank_m + 1.5

    half = HALF_M - 3.0
    for spot in free_spots(builder, 24, 14 * 24, half, 3.0, for_a_tree):
        add_tree(builder, nursery, spot, rng.uniform(0.8, 1.35))
    for spot in free_spots(builder, 14, 14 * 14, half, 1.0, for_a_bush):
        add_bush(builder, nursery, spot)
    for spot in free_spots(builder, 5, 14 * 5, half, 1.0, beside):
        add_rock(builder, spot, rng.uniform(0.25, 0.6))
    for spot in free_spots(builder, 6, 14 * 6, half, 0.8, beside):
        add_molehill(builder, spot)


def generate(seed: int) -> SceneDraft:
    """Returns the scene of ``seed`` without the vehicle. The same seed gives the same bytes."""
    rng = generation.scene_rng("footbridge", seed)
    plan = bridge.draw_plan(rng)
    bottom = bridge.shape_ground(rng, plan)
    surface = bottom if plan.over_road else np.maximum(bottom, plan.level_m)
    terrain = HeightField(heights_m=surface)
    # Objects stand on the stream's bed, not on the water.
    bed = replace(terrain, heights_m=bottom)
    builder = generation.start_scene("footbridge", rng, terrain, support=bed)
    nursery = plant_nursery(builder)
    paths = draw_paths(rng, plan)
    bridge.add_bridge(builder, plan)
    moving = furnish(builder, plan, paths, nursery)
    canvas = Canvas()
    paint_ground(canvas, plan, paths, rng)
    turned = dict.fromkeys(Ground, plan.bridge.plot.angle)
    turned[Ground.LAWN] = float(rng.uniform(0.0, np.pi))
    stream = None if plan.over_road else _stream(plan, bottom)
    ground = generation.paint_terrain(builder, canvas, turned, hilly=True, flood=stream)
    return generation.finish(plan, builder, ground, moving=moving)


def _stream(plan: bridge.Plan, bottom_m: Array) -> generation.Flood:
    """The water over a bed with heights ``bottom_m`` (N, N)."""
    return generation.Flood(
        depth_m=upsample(plan.level_m - bottom_m, TEXELS // 2),
        draw_look=lambda rng: _look(rng, plan.course.heading(30.0)),
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
