"""`pools`: a swimming bath: basins, deck, sunshades, and a sports field beside them."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from touchdown.scenes.api import Array
from touchdown.scenes.authoring import relief
from touchdown.scenes.authoring.builder import SceneBuilder
from touchdown.scenes.authoring.draft import SceneDraft
from touchdown.scenes.authoring.generation import finish, paint_terrain, scene_rng, start_scene
from touchdown.scenes.authoring.ground import Canvas, Ground, mown_askew
from touchdown.scenes.authoring.plane import pick, unit, unit_circle
from touchdown.scenes.authoring.plots import Plot, SurveyFrame, claim_area, scatter
from touchdown.scenes.authoring.streets import trace_crack
from touchdown.scenes.props import street
from touchdown.scenes.props.cars import add_car_models, park_car
from touchdown.scenes.props.garden import SHED, add_table
from touchdown.scenes.props.houses import House, add_house
from touchdown.scenes.props.plants import Nursery, add_bush, add_hedge, add_tree, plant_nursery
from touchdown.scenes.props.playground import add_flag, add_goal, add_net, add_towel
from touchdown.scenes.props.pools import (
    Pool,
    add_guard_chair,
    add_lounger,
    add_lounger_models,
    add_pool,
    add_umbrella,
    add_umbrella_models,
    add_water_slide,
    add_whirlpool,
    kidney_outline,
    rectangle_outline,
)

Span = tuple[float, float]


@dataclass(frozen=True, kw_only=True, slots=True)
class Plan(SurveyFrame):
    """All spans in ``frame`` coordinates, (first, last) metres; the car park lies towards +v."""

    frame: Plot
    pools: dict[str, Pool]
    """`lanes`, `leisure`, `covered` and `paddling`, in no fixed order along u"""
    deck: tuple[Span, Span]
    pitch: tuple[Span, Span]
    pitch_ground: Ground
    court_uv: Array
    """middle of the beach court"""
    house_u: float
    """middle of the service building"""
    mounds: tuple[relief.Mound, ...]

    def pads(self) -> list[relief.Pad]:
        (u0, u1), (v0, v1) = self.deck
        (p0, p1), (q0, q1) = self.pitch
        pad = self.frame.pad
        return [
            # The paddling pool lies 5 m before the deck.
            pad(
                0.5 * (u0 + u1),
                0.5 * (v0 + v1) - 2.5,
                (0.5 * (u1 - u0) + 0.8, 0.5 * (v1 - v0) + 3.3),
            ),
            pad(0.5 * (p0 + p1), 0.5 * (q0 + q1), (0.5 * (p1 - p0) + 1.0, 0.5 * (q1 - q0) + 1.0)),
            pad(self.house_u, 36.0, (17.0, 7.5)),
            pad(0.0, 54.5, (40.0, 8.0)),
            pad(float(self.court_uv[0]), float(self.court_uv[1]), (9.5, 5.5), 2.0),
        ]


def draw_plan(rng: np.random.Generator) -> Plan:
    """Returns three large basins side by side in any order, the paddling pool before them."""
    angle = 0.5 * np.pi * int(rng.integers(4)) + rng.uniform(-0.06, 0.06)
    frame = Plot(origin_xy_m=rng.uniform(-1.0, 1.0, 2), angle=angle)
    shift = rng.uniform(-1.5, 1.5)
    widths = {"lanes": 25.0, "leisure": 18.0, "covered": 9.0}
    order = [list(widths)[int(k)] for k in rng.permutation(3)]
    gap = rng.uniform(4.5, 6.0)
    start = -0.5 * (sum(widths.values()) + 2.0 * gap) + rng.uniform(-3.0, 3.0)
    middle: dict[str, float] = {}
    for kind in order:
        middle[kind] = start + 0.5 * widths[kind]
        start += widths[kind] + gap
    v = 15.5 + shift
    lanes = int(rng.integers(4, 7))
    long = rectangle_outline(middle["lanes"], v, 25.0, 2.1 * lanes, 0.15)
    kidney = kidney_outline(rng, middle["leisure"], v - 0.5, rng.uniform(5.4, 6.2))
    covered = rectangle_outline(middle["covered"], v, 8.0, 5.5, 0.3)
    small_u = middle["leisure"] + (13.5 if order.index("leisure") < 1 else -13.5)
    small_u = float(np.clip(small_u, -34.0, 34.0))
    round_ = 2.4 * unit_circle(28) + [small_u, v - 10.6]
    basins = {
        "lanes": Pool(plot=frame, outline_m=long, lanes=lanes),
        "leisure": Pool(plot=frame, outline_m=kidney),
        "covered": Pool(plot=frame, outline_m=covered, covered=True),
        "paddling": Pool(plot=frame, outline_m=round_),
    }
    first = rng.uniform(-6.0, 1.0)
    takeoff = np.array([-25.0, -20.0]) + rng.uniform(-1.5, 1.5, 2)
    low = -28.0 + rng.uniform(-2.0, 2.0)
    slope = relief.Mound(centre_xy_m=frame.at(rng.uniform(-42.0, -36.0), rng.uniform(-8.0, -3.0)),
                  height_m=rng.uniform(1.0, 1.5), radius_m=rng.uniform(4.0, 5.0))  # fmt: skip
    return Plan(
        frame=frame,
        pools=basins,
        deck=((-38.0, 38.0), (v - 9.0, v + 9.5)),
        pitch=((first, first + rng.uniform(34.0, 38.0)), (low, low + rng.uniform(20.0, 23.0))),
        pitch_ground=Ground.PITCH if rng.random() < 0.7 else Ground.CLAY,
        court_uv=np.array([-40.0 + rng.uniform(-3.0, 3.0), -39.0 + rng.uniform(-3.0, 1.0)]),
        house_u=rng.uniform(-14.0, 14.0),
        mounds=(slope,),
        takeoff_xy_m=frame.points(takeoff),
        takeoff_yaw=float(angle + rng.uniform(-0.05, 0.05)),
    )


def shape_ground(rng: np.random.Generator, plan: Plan) -> relief.HeightField:
    """Returns uneven lawns with level pads below all buildings; the take-off spot is at height
    0."""
    heights, xy = relief.natural_ground(rng)
    heights = heights + (0.35 - heights.mean())
    heights = relief.level_pads(relief.raise_mounds(heights, xy, plan.mounds), xy, plan.pads())
    return relief.level_takeoff(heights, plan.takeoff_xy_m)


Shades = list[tuple[str, str]]
"""(mesh, material) of sunshades"""


def build_bath(builder: SceneBuilder, plan: Plan, nursery: Nursery, shades: Shades) -> None:
    """Adds all objects on the deck and behind it."""
    for pool in plan.pools.values():
        add_pool(builder, pool)
    _add_slide(builder, plan)
    _add_guards(builder, plan)
    _add_buildings(builder, plan)
    _add_loungers(builder, plan, shades)
    (u0, u1), (v0, v1) = plan.deck
    rng, frame = builder.rng, plan.frame
    for u in (u0 - 0.8, u1 + 0.8):
        for low, high in ((v0 + 2.0, v0 + 8.0), (v0 + 10.0, v1 - 1.0)):
            add_hedge(builder, nursery, frame.at(u, low), frame.at(u, high), 1.1)
    for u in np.arange(u0 + 6.0, u1, 21.0):
        spot = frame.at(u + rng.uniform(-1.0, 1.0), v1 - 0.7)
        if builder.is_free(spot, 0.3):
            street.add_lamp(builder, spot, frame.away + np.pi, 4.6)
    for u in (u0 + 3.0, u1 - 3.0):
        street.add_bin(builder, frame.at(u, v0 + 0.9), [0.20, 0.42, 0.62, 1])


def _add_slide(builder: SceneBuilder, plan: Plan) -> None:
    """Adds a chute that ends in the leisure pool, coming from behind it."""
    pool = plan.pools["leisure"]
    low, high = pool.box_m
    u = 0.5 * (low[0] + high[0]) + builder.rng.uniform(-1.5, 1.5)
    inside = pool.outline_m[np.abs(pool.outline_m[:, 0] - u) < 1.2]
    add_water_slide(
        builder, plan.frame.at(u, float(inside[:, 1].max()) - 0.6), plan.frame.away + np.pi
    )


def _add_guards(builder: SceneBuilder, plan: Plan) -> None:
    pool = plan.pools["lanes"]
    low, high = pool.box_m
    frame = plan.frame
    add_guard_chair(builder, frame.at(0.5 * (low[0] + high[0]), low[1] - 1.3), frame.away)
    # Starting blocks, one for each lane.
    for lane in range(pool.lanes):
        v = low[1] + (lane + 0.5) * (high[1] - low[1]) / pool.lanes
        spot = frame.at(float(high[0]) + 0.75, float(v))
        builder.geom("block", SHED, box=[0.28, 0.26, 0.32], pos=builder.on_ground(spot, 0.3),
                     heading=frame.angle, rgba=[0.92, 0.92, 0.9, 1])  # fmt: skip
        builder.claim(spot, 0.6)
    (u0, u1), (v0, _) = plan.deck
    spot = frame.at(u0 + 5.0 if builder.rng.random() < 0.5 else u1 - 5.0, v0 + 3.5)
    if builder.is_free(spot, 2.0):
        add_whirlpool(builder, spot)


def _add_buildings(builder: SceneBuilder, plan: Plan) -> None:
    """Adds the flat-roofed service building, a row of coloured cabins and a kiosk."""
    rng, frame, u = builder.rng, plan.frame, plan.house_u
    add_house(builder, House(centre_xy_m=frame.at(u, 36.5), angle=frame.angle,
              size_m=(rng.uniform(21.0, 25.0), rng.uniform(8.5, 10.0), 3.5),
              ridge_m=0.0))  # fmt: skip
    side = -1.0 if u > 0.0 else 1.0
    first = u + side * 17.0
    tints = ([0.80, 0.26, 0.20, 1], [0.93, 0.80, 0.28, 1], [0.22, 0.48, 0.70, 1],
             [0.93, 0.92, 0.88, 1])  # fmt: skip
    for index in range(9):
        spot = frame.at(first + side * 1.55 * index, 34.5)
        z = builder.terrain.point(*spot)
        builder.geom("building_cabin", SHED, box=[0.74, 0.8, 1.25], pos=[*spot, z + 1.0],
                     heading=frame.angle, rgba=tints[index % 4])  # fmt: skip
        builder.cast_box((0.74, 0.8), (0.0, 2.25), frame.angle, np.array([*spot, z]))
        builder.claim(spot, 1.1)
    kiosk = House(centre_xy_m=frame.at(first + side * 8.0, 41.0), angle=frame.angle,
                  size_m=(5.0, 4.0, 2.8), ridge_m=1.3, hipped=True)  # fmt: skip
    add_house(builder, kiosk)
    for index in range(3):
        add_table(builder, frame.at(first + side * (3.0 + 3.4 * index), 38.0), frame.angle)
    for index, rgba in enumerate(([0.2, 0.4, 0.7, 1], [0.92, 0.9, 0.88, 1], [0.8, 0.2, 0.2, 1])):
        add_flag(builder, frame.at(u - side * (14.0 + 1.8 * index), 43.0), 6.5, rgba)
    street.add_bench(builder, frame.at(u, 30.4), frame.away + np.pi)


def _add_loungers(builder: SceneBuilder, plan: Plan, shades: Shades) -> None:
    """Adds rows of loungers beside the basins, a sunshade between every other pair."""
    rng, frame = builder.rng, plan.frame
    loungers = add_lounger_models(builder, 5)
    (u0, u1), (v0, v1) = plan.deck
    for row in (v1 - 2.2, v0 + 2.4):
        heading = frame.away if row > 0.5 * (v0 + v1) else frame.away + np.pi
        for index, u in enumerate(np.arange(u0 + 2.0, u1 - 1.5, 1.75)):
            spot = frame.at(u, row + rng.normal(0.0, 0.12))
            if index % 3 == 2:
                shade = frame.at(u, row + 0.3 * np.sin(heading - frame.angle))
                if rng.random() < 0.7 and builder.is_free(shade, -0.2):
                    add_umbrella(builder, pick(rng, shades), shade)
            elif rng.random() < 0.8 and builder.is_free(spot, 0.0):
                model = pick(rng, loungers)
                add_lounger(builder, model, spot, heading + rng.normal(0.0, 0.06))


def outline(pool: Pool) -> Array:
    """(N, 2) world outline of a basin, widened by 2 m."""
    middle = pool.outline_m.mean(axis=0)
    offset = pool.outline_m - middle
    reach = np.linalg.norm(offset, axis=1, keepdims=True)
    return pool.plot.points(middle + offset * (1.0 + 2.0 / reach))


LINE_M = 0.12


def build_grounds(builder: SceneBuilder, plan: Plan, nursery: Nursery, shades: Shades) -> None:
    """Adds all objects off the deck."""
    _furnish_pitch(builder, plan)
    u, v = plan.court_uv
    (u0, u1), (v0, _) = plan.deck
    claim_area(builder, plan.frame, (u - 9.5, u + 9.5), (v - 5.5, v + 5.5))
    claim_area(builder, plan.frame, (u0, u1), (v0, 46.0))
    add_net(builder, plan.frame.at(u, v - 4.9), plan.frame.at(u, v + 4.9), (1.4, 2.4))
    _park_cars(builder, plan)
    _fence_in(builder, plan, nursery)
    _dress_lawn(builder, plan, nursery, shades)


def _furnish_pitch(builder: SceneBuilder, plan: Plan) -> None:
    """Adds goals, a training net across one half, corner posts, and a rope round two sides."""
    rng, frame = builder.rng, plan.frame
    (u0, u1), (v0, v1) = plan.pitch
    middle = 0.5 * (v0 + v1)
    add_goal(builder, frame.at(u0 + 0.4, middle), frame.angle, 5.0, 2.0)
    add_goal(builder, frame.at(u1 - 0.4, middle), frame.angle + np.pi, 5.0, 2.0)
    fraction = rng.uniform(0.66, 0.8)
    across = u0 + fraction * (u1 - u0)
    add_net(builder, frame.at(across, v0 + 1.5), frame.at(across, v1 - 1.5), (0.3, 1.1))
    for u in (u0, u1):
        for v in (v0, v1):
            street.add_post(builder, frame.at(u, v), 1.5, 0.02, [0.95, 0.85, 0.2, 1])
    stakes = [frame.at(u, v1 + 1.2) for u in np.linspace(u0, u1, 6)]
    tops = [builder.on_ground(spot, 0.95) for spot in stakes]
    for spot in stakes:
        street.add_post(builder, spot, 1.0, 0.03, [0.92, 0.92, 0.92, 1])
        builder.claim(spot, 0.6)
    for first, second in pairwise(tops):
        street.add_wire(builder, first, second, 0.015, [0.90, 0.88, 0.82, 1])
    claim_area(builder, frame, (u0, u1), (v0, v1))


def _park_cars(builder: SceneBuilder, plan: Plan) -> None:
    rng, frame = builder.rng, plan.frame
    models = add_car_models(builder, 6)
    for u in np.arange(-34.0, 34.0, 2.7):
        for v, way in ((50.6, np.pi), (60.4, 0.0)):
            if rng.random() < 0.24:
                heading = frame.away + way + (np.pi if rng.random() < 0.3 else 0.0)
                park_car(builder, pick(rng, models), frame.at(u + 1.35, v), heading)


def _fence_in(builder: SceneBuilder, plan: Plan, nursery: Nursery) -> None:
    """Adds a fence towards the car park, hedges on the other sides."""
    frame, rng = plan.frame, builder.rng
    green = [0.24, 0.40, 0.30, 1]
    for first in (-56.0, -36.0, 12.0, 34.0):
        street.add_fence(builder, frame.at(first, 46.0), frame.at(first + 20.0, 46.0), green)
    height = rng.uniform(1.5, 1.9)
    for u in (-56.5, 56.5):
        for v in (-56.0, -30.5, -5.0, 20.5):
            add_hedge(builder, nursery, frame.at(u, v), frame.at(u, v + 25.0), height)
    for u in (-56.0, -28.0, 0.0, 28.0):
        add_hedge(builder, nursery, frame.at(u, -56.5), frame.at(u + 27.5, -56.5), height)


def _dress_lawn(builder: SceneBuilder, plan: Plan, nursery: Nursery, shades: Shades) -> None:
    """Shade trees, towels, a few sunshades, benches."""
    rng, frame = builder.rng, plan.frame
    start = frame.coordinates(plan.takeoff_xy_m)
    for spot in scatter(builder, frame, 4, (-54.0, -12.0), (-54.0, -3.0), 3.2):
        add_tree(builder, nursery, spot, rng.uniform(0.9, 1.25))
    for spot in scatter(builder, frame, 5, (-8.0, 54.0), (-54.0, -34.0), 3.2):
        add_tree(builder, nursery, spot, rng.uniform(0.9, 1.25))
    for low, high in ((-54.0, -42.0), (42.0, 54.0)):
        for spot in scatter(builder, frame, 2, (low, high), (-4.0, 44.0), 3.0):
            add_tree(builder, nursery, spot, rng.uniform(0.9, 1.2))
    for index, spot in enumerate(
        scatter(builder, frame, 16, (start[0] - 22.0, start[0] + 18.0), (-34.0, 3.0), 1.4)
    ):
        heading = float(rng.uniform(0.0, 3.14))
        tint = [*rng.permutation([rng.uniform(0.6, 0.8), rng.uniform(0.35, 0.7), 0.35]), 1.0]
        add_towel(builder, spot, (1.9, 0.9), heading, tint)
        if index % 5 == 0:
            aside = spot + 1.1 * unit(heading + 1.5)
            add_umbrella(builder, shades[index % 2], aside)
    for spot in scatter(builder, frame, 7, (-54.0, 54.0), (-54.0, 44.0), 1.2):
        add_bush(builder, nursery, spot)
    (u0, u1), (v0, _) = plan.pitch
    for u in (u0 + 8.0, u1 - 8.0):
        street.add_bench(builder, frame.at(u, v0 - 2.0), frame.away)


def paint_all(rng: np.random.Generator, plan: Plan) -> Canvas:
    """Paints lawns, deck, buildings' paving, sports grounds with their lines, car park."""
    canvas = Canvas()
    frame = plan.frame
    (u0, u1), (v0, v1) = plan.deck
    canvas.fill(frame.rectangle((-90.0, 90.0), (46.5, 90.0)), Ground.LAWN)
    canvas.fill(frame.rectangle((u0, u1), (v0, v1)), Ground.DECK)
    canvas.fill(
        frame.rectangle((plan.house_u - 15.0, plan.house_u + 15.0), (v1, 46.0)), Ground.PAVEMENT
    )
    side = -1.0 if plan.house_u > 0.0 else 1.0
    far = plan.house_u + side * 33.0
    span = (min(plan.house_u, far), max(plan.house_u, far))
    canvas.fill(frame.rectangle(span, (v1, 44.5)), Ground.PAVERS)
    for kind in ("leisure", "paddling"):
        canvas.fill(outline(plan.pools[kind]), Ground.PLANKS)
    walk = frame.points(np.array([[u0 + 4.0, v0], [-27.0, -4.0], [-30.0, -14.0], plan.court_uv]))
    canvas.track(walk, 1.6, Ground.GRAVEL)
    u, v = plan.court_uv
    canvas.fill(frame.rectangle((u - 9.5, u + 9.5), (v - 5.5, v + 5.5)), Ground.SAND)
    _paint_pitch(canvas, plan)
    _paint_car_park(canvas, plan, rng)
    for _ in range(40):
        spot = frame.at(rng.uniform(u0, u1), rng.uniform(v0, v1))
        blot = rng.uniform(0.2, 0.8) * rng.uniform(0.6, 1.2, (12, 1)) * unit_circle(12)
        canvas.soil(spot + blot, int(rng.integers(18, 60)))
    return canvas


def _paint_pitch(canvas: Canvas, plan: Plan) -> None:
    """Paints a playing field with touch lines, halfway line, circle and penalty areas."""
    frame = plan.frame
    (u0, u1), (v0, v1) = plan.pitch
    canvas.fill(frame.rectangle((u0 - 1.0, u1 + 1.0), (v0 - 1.0, v1 + 1.0)), plan.pitch_ground)
    middle_u, middle_v = 0.5 * (u0 + u1), 0.5 * (v0 + v1)

    def line(first: tuple[float, float], last: tuple[float, float]) -> None:
        low, high = np.minimum(first, last), np.maximum(first, last)
        half = 0.5 * LINE_M
        canvas.mark(
            frame.rectangle((low[0] - half, high[0] + half), (low[1] - half, high[1] + half)), 235
        )

    for v in (v0, v1):
        line((u0, v), (u1, v))
    for u in (u0, u1, middle_u):
        line((u, v0), (u, v1))
    for end, reach in ((u0, 5.5), (u1, -5.5)):
        line((end + reach, middle_v - 6.0), (end + reach, middle_v + 6.0))
        for v in (middle_v - 6.0, middle_v + 6.0):
            line((end, v), (end + reach, v))
    outer, inner = (frame.ring(middle_u, middle_v, radius, 60) for radius in (3.06, 2.94))
    for i in range(60):
        j = (i + 1) % 60
        canvas.mark(np.array([outer[i], outer[j], inner[j], inner[i]]), 235)


def _paint_car_park(canvas: Canvas, plan: Plan, rng: np.random.Generator) -> None:
    frame = plan.frame
    canvas.fill(frame.rectangle((-38.0, 38.0), (47.6, 63.4)), Ground.CAR_PARK)
    canvas.fill(frame.rectangle((30.0, 36.0), (60.0, 90.0)), Ground.CAR_PARK)
    for u in np.arange(-34.0, 34.1, 2.7):
        for low, high in ((48.0, 53.0), (58.0, 63.0)):
            canvas.mark(frame.rectangle((u - 0.05, u + 0.05), (low, high)))
    for _ in range(14):
        start = frame.at(rng.uniform(-36, 36), rng.uniform(49, 62))
        trace_crack(canvas, rng, start)


def generate(seed: int) -> SceneDraft:
    """Returns the scene of ``seed`` without the vehicle. The same seed gives the same bytes."""
    rng = scene_rng("pools", seed)
    plan = draw_plan(rng)
    terrain = shape_ground(rng, plan)
    builder = start_scene("pools", rng, terrain)
    nursery = plant_nursery(builder)
    builder.claim(plan.takeoff_xy_m, 6.5)
    shades = add_umbrella_models(builder, 5)
    build_bath(builder, plan, nursery, shades)
    build_grounds(builder, plan, nursery, shades)
    canvas = paint_all(rng, plan)
    ground = paint_terrain(builder, canvas, mown_askew(rng, plan.frame.angle))
    return finish(plan, builder, ground)
