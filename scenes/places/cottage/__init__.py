"""`cottage`: cottages with courtyards along a village lane on a sloped meadow."""

from dataclasses import dataclass

import numpy as np

from touchdown.scenes.api import Array
from touchdown.scenes.authoring import relief
from touchdown.scenes.authoring.builder import SceneBuilder
from touchdown.scenes.authoring.draft import SceneDraft
from touchdown.scenes.authoring.generation import finish, paint_terrain, scene_rng, start_scene
from touchdown.scenes.authoring.ground import Canvas, Ground, mown_askew
from touchdown.scenes.authoring.plane import left_of, pick, unit, unit_circle
from touchdown.scenes.authoring.plots import Plot, SurveyFrame, scatter
from touchdown.scenes.authoring.streets import STEP_M, Street, paint_street, smooth_line
from touchdown.scenes.props import garden, houses, plants, stonework
from touchdown.scenes.props.cars import Models, add_car_models, park_car
from touchdown.scenes.props.street import add_bench, add_line, add_sign, add_wire

VERGE_M = 0.8
"""Level ground beside the lane."""
_LIFT_M = 40.0
"""`level_pads` keeps pads above 0: the hillside is shaped well above it and lowered at the end."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Plan(SurveyFrame):
    """``frame``: v points uphill, the lane runs about along u."""

    frame: Plot
    lane: Street
    below_deg: float
    """slope of the meadow below the lane"""
    above_deg: float
    """slope of the hill above it"""
    lawn_uv: Array
    """middle of a level drying green near the take-off spot"""


def draw_plan(rng: np.random.Generator) -> Plan:
    """Returns a lane with bends along the contour."""
    angle = 0.5 * np.pi * int(rng.integers(4)) + rng.uniform(-0.06, 0.06)
    frame = Plot(origin_xy_m=rng.uniform(-1.0, 1.0, 2), angle=angle)
    level, bend = rng.uniform(1.0, 4.0), rng.uniform(-4.5, 4.5, 5)
    corners = [(u, level + b) for u, b in zip((-84.0, -44.0, -8.0, 30.0, 84.0), bend, strict=True)]
    corners.insert(1, (-64.0, level + bend[0]))
    lane = Street(
        line_m=smooth_line(frame.points(np.array(corners))), width_m=rng.uniform(3.9, 4.7)
    )
    takeoff = np.array([-25.0, -20.0]) + rng.uniform(-1.5, 1.5, 2)
    return Plan(
        frame=frame,
        lane=lane,
        below_deg=rng.uniform(5.8, 8.0),
        above_deg=rng.uniform(7.5, 10.0),
        lawn_uv=takeoff + np.array([rng.uniform(10.0, 13.0), rng.uniform(2.0, 5.0)]),
        takeoff_xy_m=frame.points(takeoff),
        takeoff_yaw=float(angle + rng.uniform(-0.05, 0.05)),
    )


def hillside(plan: Plan, xy_m: Array) -> Array:
    """(..., 2) -> (...) metres: gentle near the lane, steeper above and below."""
    v = plan.frame.coordinates(xy_m)[..., 1]
    below = np.tan(np.deg2rad(plan.below_deg)) * np.minimum(v + 6.0, 0.0)
    above = np.tan(np.deg2rad(plan.above_deg)) * np.maximum(v - 14.0, 0.0)
    # Towards the border the slopes ease, as hills do.
    return 0.02 * v + below + above - 0.0022 * np.maximum(v - 40.0, 0.0) ** 2


def shape_ground(
    rng: np.random.Generator, plan: Plan, pads: list[relief.Pad], ditches: list[relief.Ditch]
) -> relief.HeightField:
    """Returns hillside, terraces, and the lane as a bench along it; the take-off spot is at height
    0."""
    heights, xy = relief.natural_ground(rng)
    heights = heights + hillside(plan, xy) + _LIFT_M
    heights = relief.level_pads(relief.dig_ditches(heights, xy, ditches), xy, pads)
    rough = relief.HeightField(heights_m=heights)
    along_line = rough.at(plan.lane.line_m)
    window = np.hanning(61)
    padded = np.pad(along_line, 30, mode="edge")
    profile = np.convolve(padded, window / window.sum(), mode="valid")
    distance, along = plan.lane.nearest(xy)
    level = np.interp(along, 0.5 * np.arange(len(profile)), profile)
    half = 0.5 * plan.lane.width_m + VERGE_M
    heights = level + (heights - level) * relief.smoothstep(half, half + 4.0, distance)
    return relief.level_takeoff(heights, plan.takeoff_xy_m)


WIDTH_M, YARD_V, DEPTH_M = 21.0, 15.5, 29.0
"""Frontage, depth of the courtyard, and depth of the whole farmstead."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Farmstead:
    """plot: u along the lane, v away from it. The cottage stands at the back of the yard, the wing
    on the side of ``wing_u``."""

    plot: Plot
    house: houses.House
    wing: houses.House
    wing_u: float
    gate_u: float
    yard: Ground
    clutter: str
    """`well`, `cart` or `washing`"""

    def pads(self) -> list[relief.Pad]:
        """The yard with the buildings, and a terrace behind."""
        return [
            self.plot.pad(0.5 * WIDTH_M, 7.4, (0.5 * WIDTH_M - 0.3, 8.0), 2.4),
            self.plot.pad(0.5 * WIDTH_M, 23.2, (0.5 * WIDTH_M - 0.5, 4.6), 2.4),
        ]


def draw_farmstead(rng: np.random.Generator, plot: Plot, clutter: str) -> Farmstead:
    """Returns a long low cottage and a shorter wing at a right angle."""
    left = bool(rng.random() < 0.5)
    length, width = rng.uniform(10.0, 12.5), rng.uniform(5.8, 6.6)
    wing_u = 3.4 if left else WIDTH_M - 3.4
    u = WIDTH_M - 1.2 - 0.5 * length if left else 1.2 + 0.5 * length
    house = houses.House(centre_xy_m=plot.at(u, YARD_V - 1.2 - 0.5 * width), angle=plot.angle,
                  size_m=(length, width, rng.uniform(2.5, 2.8)),
                  ridge_m=rng.uniform(2.9, 3.5))  # fmt: skip
    wing = houses.House(centre_xy_m=plot.at(wing_u, rng.uniform(6.0, 7.0)), angle=plot.away,
                 size_m=(rng.uniform(6.0, 7.5), 4.4, 2.4), ridge_m=2.1)  # fmt: skip
    return Farmstead(plot=plot, house=house, wing=wing, wing_u=wing_u, clutter=clutter,
                     gate_u=rng.uniform(9.0, 11.0),
                     yard=Ground.COBBLES if rng.random() < 0.6 else Ground.GRAVEL)  # fmt: skip


def paint_farmstead(canvas: Canvas, farmstead: Farmstead) -> None:
    """Paints cobbled yard, kitchen garden, lawn."""
    plot = farmstead.plot
    canvas.fill(plot.rectangle((0.4, WIDTH_M - 0.4), (0.4, YARD_V)), Ground.LAWN)
    inner = (4.6, WIDTH_M - 1.6) if farmstead.wing_u < 8.0 else (1.6, WIDTH_M - 4.6)
    canvas.fill(plot.rectangle(inner, (2.6, 8.4)), farmstead.yard)
    gate = (farmstead.gate_u - 1.5, farmstead.gate_u + 1.5)
    canvas.fill(plot.rectangle(gate, (-2.0, 3.0)), farmstead.yard)
    canvas.fill(plot.rectangle((0.4, WIDTH_M - 0.4), (YARD_V, DEPTH_M - 0.6)), Ground.LAWN)
    canvas.fill(plot.rectangle((1.2, 9.6), (19.4, 27.2)), Ground.SOIL)
    for first in (19.8, 23.6):
        canvas.fill(plot.rectangle((1.5, 9.3), (first, first + 3.0)), Ground.CROPS)
    canvas.fill(plot.rectangle((0.9, WIDTH_M - 0.9), (0.7, 1.9)), Ground.MULCH)


def build_farmstead(
    builder: SceneBuilder,
    farmstead: Farmstead,
    looks: houses.HouseLooks,
    nursery: plants.Nursery,
    models: Models,
) -> None:
    """Adds all objects of the farmstead."""
    rng, plot = builder.rng, farmstead.plot
    for house in (farmstead.house, farmstead.wing):
        houses.add_house(builder, house, looks)
    u, v = plot.coordinates(farmstead.house.centre_xy_m)
    z = builder.terrain.point(*farmstead.house.centre_xy_m)
    builder.geom("building_door", houses.WALL, box=[0.5, 0.04, 1.0], heading=plot.angle,
                 pos=[*plot.at(u + 0.4, v - 0.5 * farmstead.house.size_m[1] - 0.03), z + 1.0],
                 rgba=[*rng.uniform([0.15, 0.2, 0.15], [0.5, 0.4, 0.5]), 1.0])  # fmt: skip
    wall_m = rng.uniform(0.9, 1.15)
    gap = farmstead.gate_u - 1.6, farmstead.gate_u + 1.6
    stonework.add_stone_wall(
        builder, plot.points(np.array([[0.0, 10.0], [0.0, 0.3], [gap[0], 0.3]])), wall_m
    )
    edge = np.array([[gap[1], 0.3], [WIDTH_M, 0.3], [WIDTH_M, 10.0]])
    stonework.add_stone_wall(builder, plot.points(edge), wall_m)
    back = [[0.0, YARD_V + 1.2], [0.0, DEPTH_M], [WIDTH_M, DEPTH_M], [WIDTH_M, YARD_V + 1.2]]
    stonework.add_stone_wall(builder, plot.points(np.array(back)), 0.85)
    _clutter(builder, farmstead, models)
    for bed_v in (21.3, 25.1):
        spot, height = plot.at(5.4, bed_v), rng.uniform(0.25, 0.5)
        garden.add_crop_rows(builder, spot, plot.angle, (7.4, 2.6), height)
    _bean_poles(builder, plot.at(5.4, 18.6), plot.angle)
    if rng.random() < 0.5:
        garden.add_greenhouse(builder, plot.at(WIDTH_M - 3.0, 26.6), plot.angle)
    else:
        garden.add_shed(builder, plot.at(WIDTH_M - 2.8, 26.4), plot.angle, (3.2, 2.4, 2.0))
    for spot in scatter(builder, plot, 2, (11.0, WIDTH_M - 1.5), (18.0, 27.5), 1.8):
        plants.add_small_tree(builder, nursery, spot, rng.uniform(0.75, 1.05))
    for spot in scatter(builder, plot, 2, (1.2, WIDTH_M - 1.2), (1.2, 1.6), 0.7):
        plants.add_bush(builder, nursery, spot)


def _clutter(builder: SceneBuilder, farmstead: Farmstead, models: Models) -> None:
    """Adds objects that make the level courtyard unfit for landing."""
    rng, plot = builder.rng, farmstead.plot
    inner = (6.6, 18.4) if farmstead.wing_u < 8.0 else (2.6, 14.4)
    stonework.add_log_pile(builder, plot.at(inner[1] - 1.0, 7.3), plot.angle)
    if farmstead.clutter == "well":
        stonework.add_well(builder, plot.at(0.5 * sum(inner) + rng.uniform(-1, 1), 4.9), plot.angle)
        garden.add_table(builder, plot.at(inner[0] + 1.2, 6.6), plot.angle)
    elif farmstead.clutter == "cart":
        stonework.add_cart(
            builder, plot.at(inner[0] + 2.0, 5.6), plot.angle + rng.uniform(-0.5, 0.5)
        )
        model = pick(rng, models)
        park_car(builder, model, plot.at(farmstead.gate_u + 2.4, 5.0), plot.angle + 0.1)
    else:
        ends = plot.at(inner[0] + 0.3, 5.2), plot.at(inner[1] - 0.3, 4.4)
        garden.add_washing_line(builder, *ends)
        garden.add_toys(builder, plot.at(0.5 * sum(inner), 6.8))


def _bean_poles(builder: SceneBuilder, xy_m: Array, heading: float) -> None:
    """Three wigwams of thin canes, 2.1 m high."""
    along = unit(heading)
    for reach in (-2.2, 0.0, 2.2):
        middle = xy_m + reach * along
        tip = builder.on_ground(middle, 2.1)
        for angle in (0.4, 2.5, 4.6):
            foot = middle + 0.45 * unit(angle)
            add_wire(builder, builder.on_ground(foot), tip, 0.015, [0.62, 0.50, 0.32, 1])
        builder.claim(middle, 0.9)


def generate(seed: int) -> SceneDraft:
    """Returns the scene of ``seed`` without the vehicle. The same seed gives the same bytes."""
    rng = scene_rng("cottage", seed)
    plan = draw_plan(rng)
    farmsteads = draw_farmsteads(rng, plan)
    pads = [pad for farmstead in farmsteads for pad in farmstead.pads()]
    pads.append(plan.frame.pad(float(plan.lawn_uv[0]), float(plan.lawn_uv[1]), (5.2, 3.6), 2.5))
    ditch = relief.Ditch(start_xy_m=plan.frame.at(-60.0, rng.uniform(-9.5, -8.0)),
                  end_xy_m=plan.frame.at(-36.0, rng.uniform(-12.0, -9.0)),
                  depth_m=rng.uniform(0.5, 0.8), half_width_m=1.6)  # fmt: skip
    terrain = shape_ground(rng, plan, pads, [ditch])
    builder = start_scene("cottage", rng, terrain)
    place_objects(builder, plan, farmsteads)
    canvas = paint_ground(rng, plan, farmsteads, ditch)
    ground = paint_terrain(builder, canvas, mown_askew(rng, plan.frame.angle))
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
    nursery = plants.plant_nursery(builder)
    models = add_car_models(builder, 4)
    roofs = [stonework.thatch(rng) for _ in range(2)]
    roofs += [houses.tiled_roof(rng, 11.0, 4.6) for _ in range(2)]
    looks = houses.paint_house_looks(builder, roofs)
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
            inside = np.abs(line).max() < relief.HALF_M - 0.5
            if inside and not on_farmstead and rng.random() < 0.75:
                stonework.add_stone_wall(builder, line, rng.uniform(0.7, 0.95))


def hang_laundry(builder: SceneBuilder, plan: Plan) -> None:
    """Adds a line across half of the drying green, without laundry: hard to see from above."""
    rng = builder.rng
    u, v = plan.lawn_uv
    side = 2.1 if rng.random() < 0.5 else -2.1
    ends = [plan.frame.at(u + x, v + side) for x in (-5.0, 5.2)]
    garden.add_washing_line(builder, ends[0], ends[1], laundry=False)


def graze_meadow(builder: SceneBuilder, plan: Plan) -> None:
    """Adds sheep behind an electric fence below the take-off spot, rocks on the hill."""
    rng, frame = builder.rng, plan.frame
    u = np.arange(-58.0, 12.0, 6.0)
    fence_v = -33.0 + rng.uniform(-1.0, 1.0) + 0.8 * np.sin(0.1 * u)
    stonework.add_electric_fence(builder, frame.points(np.column_stack([u, fence_v])), 0.9)
    mesh = stonework.add_sheep_models(builder)
    for spot in scatter(builder, frame, int(rng.integers(6, 10)), (-50, 10), (-56, -36), 1.5):
        stonework.add_sheep(builder, mesh, spot, float(rng.uniform(0.0, 6.28)))
    for spot in scatter(builder, frame, 6, (-50.0, 56.0), (38.0, 58.0), 1.0):
        plants.add_rock(builder, spot, rng.uniform(0.25, 0.65))
    for spot in scatter(builder, frame, 4, (-16.0, 8.0), (-31.0, -8.0), 1.0):
        plants.add_rock(builder, spot, rng.uniform(0.22, 0.4))


def plant_trees(builder: SceneBuilder, plan: Plan, nursery: plants.Nursery) -> None:
    """Adds an orchard in rows, oaks on the hill, bushes."""
    rng, frame = builder.rng, plan.frame
    first = rng.uniform(-58.0, -54.0)
    for u in np.arange(first, -38.0, 6.0):
        for v in (-28.0, -22.0, -16.0):
            spot = frame.at(u + rng.normal(0.0, 0.3), v + rng.normal(0.0, 0.3))
            if builder.is_free(spot, 2.0):
                plants.add_small_tree(builder, nursery, spot, rng.uniform(0.9, 1.15))
    for low, high, count in ((38.0, 59.0, 5), (-60.0, -36.0, 3)):
        for spot in scatter(builder, frame, count, (-58.0, 58.0), (low, high), 3.0):
            plants.add_tree(builder, nursery, spot, rng.uniform(1.0, 1.35))
    for spot in scatter(builder, frame, 2, (-18.0, 4.0), (-14.0, -4.0), 2.8):
        plants.add_tree(builder, nursery, spot, rng.uniform(0.8, 1.0))
    for spot in scatter(builder, frame, 9, (-58.0, 58.0), (-58.0, 58.0), 1.2):
        plants.add_bush(builder, nursery, spot)


def wire_and_park(builder: SceneBuilder, plan: Plan, models: Models) -> None:
    """Adds a line of poles beside the lane, a bench, a sign, and a car that blocks half the
    lane."""
    rng, lane = builder.rng, plan.lane
    side = 0.5 * lane.width_m + 0.55
    spots = [lane.point(along, side) for along in np.arange(24.0, lane.length_m - 22.0, 29.0)]
    spots = [spot for spot in spots if np.abs(spot).max() < relief.HALF_M - 1.0]
    add_line(builder, spots, 6.2, 0.6)
    along = rng.uniform(92.0, 108.0)
    heading = lane.heading(along)
    model = pick(rng, models)
    park_car(builder, model, lane.point(along, -0.5 * lane.width_m + 0.9), heading)
    spot = lane.point(along - 34.0, -(0.5 * lane.width_m + 2.4))
    add_bench(builder, spot, heading - 0.5 * np.pi)
    add_sign(builder, lane.point(28.0, -side), heading + np.pi, [0.95, 0.85, 0.2, 1])


def paint_ground(
    rng: np.random.Generator, plan: Plan, farmsteads: list[Farmstead], ditch: relief.Ditch
) -> Canvas:
    """Paints meadow, orchard, farmsteads, and the lane with its wheel tracks and grassy edges."""
    canvas = Canvas()
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
        blot = rng.uniform(0.15, 0.5) * rng.uniform(0.6, 1.2, (12, 1)) * unit_circle(12)
        canvas.soil(spot + blot, int(rng.integers(40, 120)))
    return canvas
