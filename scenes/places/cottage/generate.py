"""`cottage`: fills cottage.xml with a hamlet drawn from a seed."""

from __future__ import annotations

import numpy as np

from touchdown.scenes.authoring.builder import SceneBuilder
from touchdown.scenes.authoring.draft import SceneDraft
from touchdown.scenes.authoring.generation import finish, paint_terrain, scene_rng, start_scene
from touchdown.scenes.authoring.ground import Canvas, Ground
from touchdown.scenes.authoring.plane import left_of, pick, unit_circle
from touchdown.scenes.authoring.plots import Plot, scatter
from touchdown.scenes.authoring.relief import Ditch
from touchdown.scenes.authoring.streets import STEP_M, paint_street
from touchdown.scenes.places.cottage.farmsteads import (
    WIDTH_M,
    Farmstead,
    build_farmstead,
    draw_farmstead,
    paint_farmstead,
)
from touchdown.scenes.places.cottage.layout import HALF_M, Plan, draw_plan, shape_ground
from touchdown.scenes.props.cars import CarShape, add_car_models, park_car
from touchdown.scenes.props.garden import add_washing_line
from touchdown.scenes.props.houses import paint_house_looks, tiled_roof
from touchdown.scenes.props.plants import (
    Nursery,
    add_bush,
    add_rock,
    add_small_tree,
    add_tree,
    plant_nursery,
)
from touchdown.scenes.props.stonework import (
    add_electric_fence,
    add_sheep,
    add_sheep_models,
    add_stone_wall,
    thatch,
)
from touchdown.scenes.props.street import add_bench, add_sign
from touchdown.scenes.props.wires import add_line


def generate(seed: int) -> SceneDraft:
    """Returns the scene of ``seed`` without the vehicle. The same seed gives the same bytes."""
    rng = scene_rng("cottage", seed)
    plan = draw_plan(rng)
    farmsteads = draw_farmsteads(rng, plan)
    pads = [pad for farmstead in farmsteads for pad in farmstead.pads()]
    pads.append(plan.frame.pad(float(plan.lawn_uv[0]), float(plan.lawn_uv[1]), (5.2, 3.6), 2.5))
    ditch = Ditch(start_xy_m=plan.frame.at(-60.0, rng.uniform(-9.5, -8.0)),
                  end_xy_m=plan.frame.at(-36.0, rng.uniform(-12.0, -9.0)),
                  depth_m=rng.uniform(0.5, 0.8), half_width_m=1.6)  # fmt: skip
    terrain = shape_ground(rng, plan, pads, [ditch])
    builder = start_scene("cottage", rng, terrain)
    place_objects(builder, plan, farmsteads)
    canvas = paint_ground(rng, plan, farmsteads, ditch)
    turned = dict.fromkeys(Ground, plan.frame.angle)
    turned[Ground.LAWN] = plan.frame.angle + float(rng.uniform(0.2, 1.3))
    ground = paint_terrain(builder, canvas, turned)
    return finish(plan, builder, ground)


def draw_farmsteads(rng: np.random.Generator, plan: Plan) -> list[Farmstead]:
    """Returns three farmsteads above the lane, two below it on the side away from the
    take-off spot."""
    local = plan.frame.coordinates(plan.lane.line_m)
    spots = [(u + rng.uniform(-2.5, 2.5), 1.0) for u in (-36.0, -8.0, 20.0)]
    spots += [(u + rng.uniform(-1.5, 1.5), -1.0) for u in (20.0, 46.0)]
    if rng.random() < 0.5:
        spots.append((47.0 + rng.uniform(-1.0, 1.0), 1.0))
    kinds = rng.permutation(np.resize(np.array(["well", "cart", "washing"]), len(spots)))
    farmsteads = []
    for (u, side), kind in zip(spots, kinds, strict=True):
        along = STEP_M * float(np.argmin(np.abs(local[:, 0] - u)))
        heading = plan.lane.heading(along)
        ends = [plan.lane.point(along + s, 0.0) for s in (-0.5 * WIDTH_M, 0.5 * WIDTH_M)]
        middle = plan.lane.point(along, 0.0)
        left = left_of(heading)
        # In a bend the lane bulges towards the plot.
        bulge = max(side * float((end - middle) @ left) for end in ends)
        reach = 0.5 * plan.lane.width_m + 1.3 + max(bulge, 0.0) + rng.uniform(0.0, 1.2)
        origin = middle + side * reach * left - 0.5 * WIDTH_M * np.array([left[1], -left[0]])
        plot = Plot(origin_xy_m=origin, angle=heading, mirrored=side < 0.0)
        farmsteads.append(draw_farmstead(rng, plot, str(kind)))
    return farmsteads


def place_objects(builder: SceneBuilder, plan: Plan, farmsteads: list[Farmstead]) -> None:
    """Adds all objects."""
    rng, frame = builder.rng, plan.frame
    nursery = plant_nursery(builder)
    models = add_car_models(builder, 4)
    roofs = [thatch(rng), thatch(rng), tiled_roof(rng, 11.0, 4.6), tiled_roof(rng, 11.0, 4.6)]
    looks = paint_house_looks(builder, roofs)
    builder.claim(plan.takeoff_xy_m, 6.5)
    builder.claim(frame.points(plan.lawn_uv), 4.5)
    for along in np.arange(0.0, plan.lane.length_m, 2.0):
        builder.claim(plan.lane.point(along, 0.0), 0.5 * plan.lane.width_m)
    for index, farmstead in enumerate(farmsteads):
        build_farmstead(builder, farmstead, looks[index % len(looks)], nursery, models)
    wall_the_lane(builder, plan, farmsteads)
    hang_laundry(builder, plan)
    graze_meadow(builder, plan)
    plant_trees(builder, plan, nursery)
    wire_and_park(builder, plan, models)


def wall_the_lane(builder: SceneBuilder, plan: Plan, farmsteads: list[Farmstead]) -> None:
    """Adds dry-stone walls beside the lane between the farmsteads, with field gates."""
    rng, lane = builder.rng, plan.lane
    for side in (1.0, -1.0):
        across = side * (0.5 * lane.width_m + 1.1)
        for start in np.arange(22.0, lane.length_m - 26.0, 9.0):
            line = lane.offset_line(across, start, start + 9.0)[::3]
            line = np.concatenate([line, [lane.point(start + 9.0, across)]])
            line = line[[0, len(line) // 2, -1]]
            on_farmstead = any(
                (np.abs(farmstead.plot.coordinates(line) - [0.5 * WIDTH_M, 8.0])
                 < [0.5 * WIDTH_M + 0.4, 10.0]).all(axis=1).any()
                for farmstead in farmsteads
            )  # fmt: skip
            inside = np.abs(line).max() < HALF_M - 0.5
            if inside and not on_farmstead and rng.random() < 0.75:
                add_stone_wall(builder, line, rng.uniform(0.7, 0.95))


def hang_laundry(builder: SceneBuilder, plan: Plan) -> None:
    """Adds a line across half of the drying green, without laundry: hard to see from above."""
    rng = builder.rng
    u, v = plan.lawn_uv
    side = 2.1 if rng.random() < 0.5 else -2.1
    ends = [plan.frame.at(u + x, v + side) for x in (-5.0, 5.2)]
    add_washing_line(builder, ends[0], ends[1], laundry=False)


def graze_meadow(builder: SceneBuilder, plan: Plan) -> None:
    """Adds sheep behind an electric fence below the take-off spot, rocks on the hill."""
    rng, frame = builder.rng, plan.frame
    u = np.arange(-58.0, 12.0, 6.0)
    fence_v = -33.0 + rng.uniform(-1.0, 1.0) + 0.8 * np.sin(0.1 * u)
    add_electric_fence(builder, frame.points(np.column_stack([u, fence_v])), 0.9)
    mesh = add_sheep_models(builder)
    for spot in scatter(builder, frame, int(rng.integers(6, 10)), (-50, 10), (-56, -36), 1.5):
        add_sheep(builder, mesh, spot, float(rng.uniform(0.0, 6.28)))
    for spot in scatter(builder, frame, 6, (-50.0, 56.0), (38.0, 58.0), 1.0):
        add_rock(builder, spot, rng.uniform(0.25, 0.65))
    for spot in scatter(builder, frame, 4, (-16.0, 8.0), (-31.0, -8.0), 1.0):
        add_rock(builder, spot, rng.uniform(0.22, 0.4))


def plant_trees(builder: SceneBuilder, plan: Plan, nursery: Nursery) -> None:
    """Adds an orchard in rows, oaks on the hill, bushes."""
    rng, frame = builder.rng, plan.frame
    first = rng.uniform(-58.0, -54.0)
    for u in np.arange(first, -38.0, 6.0):
        for v in (-28.0, -22.0, -16.0):
            spot = frame.at(u + rng.normal(0.0, 0.3), v + rng.normal(0.0, 0.3))
            if builder.is_free(spot, 2.0):
                add_small_tree(builder, nursery, spot, rng.uniform(0.9, 1.15))
    for low, high, count in ((38.0, 59.0, 5), (-60.0, -36.0, 3)):
        for spot in scatter(builder, frame, count, (-58.0, 58.0), (low, high), 3.0):
            add_tree(builder, nursery, spot, rng.uniform(1.0, 1.35))
    for spot in scatter(builder, frame, 2, (-18.0, 4.0), (-14.0, -4.0), 2.8):
        add_tree(builder, nursery, spot, rng.uniform(0.8, 1.0))
    for spot in scatter(builder, frame, 9, (-58.0, 58.0), (-58.0, 58.0), 1.2):
        add_bush(builder, nursery, spot)


def wire_and_park(
    builder: SceneBuilder, plan: Plan, models: list[tuple[str, str, CarShape]]
) -> None:
    """Adds a line of poles beside the lane, a bench, a sign, and a car that blocks half the
    lane."""
    rng, lane = builder.rng, plan.lane
    side = 0.5 * lane.width_m + 0.55
    spots = [lane.point(along, side) for along in np.arange(24.0, lane.length_m - 22.0, 29.0)]
    spots = [spot for spot in spots if np.abs(spot).max() < HALF_M - 1.0]
    add_line(builder, spots, 6.2, 0.6)
    along = rng.uniform(92.0, 108.0)
    heading = lane.heading(along)
    model = pick(rng, models)
    park_car(builder, model, lane.point(along, -0.5 * lane.width_m + 0.9), heading)
    spot = lane.point(along - 34.0, -(0.5 * lane.width_m + 2.4))
    add_bench(builder, spot, heading - 0.5 * np.pi)
    add_sign(builder, lane.point(28.0, -side), heading + np.pi, [0.95, 0.85, 0.2, 1])


def paint_ground(
    rng: np.random.Generator, plan: Plan, farmsteads: list[Farmstead], ditch: Ditch
) -> Canvas:
    """Paints meadow, orchard, farmsteads, and the lane with its wheel tracks and grassy edges."""
    canvas = Canvas(half_m=HALF_M)
    frame, lane = plan.frame, plan.lane
    u = np.arange(-100.0, 101.0, 2.0)
    for far, edge in ((-100.0, -31.0), (100.0, 34.5)):
        wavy = edge + 1.6 * np.sin(0.11 * u + rng.uniform(0.0, 6.0)) + 0.5 * np.sin(0.5 * u)
        near = frame.points(np.column_stack([u, wavy]))
        canvas.fill(
            np.concatenate([near, [frame.at(100.0, far), frame.at(-100.0, far)]]), Ground.MEADOW
        )
    canvas.track(np.array([ditch.start_xy_m, ditch.end_xy_m]), 0.9, Ground.WORN)
    sheep_track = np.array([frame.at(u, -45.0 + 2.5 * np.sin(0.15 * u)) for u in range(-62, 30, 2)])
    canvas.track(sheep_track, 0.5, Ground.WORN)
    for farmstead in farmsteads:
        paint_farmstead(canvas, farmstead)
    canvas.track(lane.line_m, lane.width_m + 0.7, Ground.WORN)
    paint_street(canvas, lane, Ground.LANE)
    for side in (-0.75, 0.75):
        canvas.trace(lane.offset_line(side), 0.35, 34)
    for _ in range(26):
        spot = lane.point(rng.uniform(0.0, lane.length_m), rng.normal(0.0, 0.9))
        blot = rng.uniform(0.15, 0.5) * rng.uniform(0.6, 1.2, (12, 1)) * frame.axes[0]
        round_ = unit_circle(12)
        canvas.soil(
            spot + np.linalg.norm(blot, axis=1)[:, None] * round_, int(rng.integers(40, 120))
        )
    return canvas
