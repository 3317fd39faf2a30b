"""Sports field, beach court, sunbathing lawn, fence and car park; and the ground texture."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from touchdown.scenes.authoring.builder import SceneBuilder
from touchdown.scenes.authoring.ground import Canvas, Ground
from touchdown.scenes.authoring.plane import pick, unit
from touchdown.scenes.authoring.plots import claim_area, scatter
from touchdown.scenes.places.pools.bath import Shades, outline
from touchdown.scenes.places.pools.layout import HALF_M, Plan
from touchdown.scenes.props.cars import add_car_models, park_car
from touchdown.scenes.props.plants import Nursery, add_bush, add_hedge, add_tree
from touchdown.scenes.props.playground import add_goal, add_net, add_towel
from touchdown.scenes.props.pools import add_umbrella
from touchdown.scenes.props.street import add_bench, add_fence
from touchdown.scenes.props.wires import add_post, add_wire

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
    share = rng.uniform(0.66, 0.8)
    across = u0 + share * (u1 - u0)
    add_net(builder, frame.at(across, v0 + 1.5), frame.at(across, v1 - 1.5), (0.3, 1.1))
    for u in (u0, u1):
        for v in (v0, v1):
            add_post(builder, frame.at(u, v), 1.5, 0.02, [0.95, 0.85, 0.2, 1])
    stakes = [frame.at(u, v1 + 1.2) for u in np.linspace(u0, u1, 6)]
    tops = [builder.on_ground(spot, 0.95) for spot in stakes]
    for spot in stakes:
        add_post(builder, spot, 1.0, 0.03, [0.92, 0.92, 0.92, 1])
        builder.claim(spot, 0.6)
    for first, second in pairwise(tops):
        add_wire(builder, first, second, 0.015, [0.90, 0.88, 0.82, 1])
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
        add_fence(builder, frame.at(first, 46.0), frame.at(first + 20.0, 46.0), green)
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
        add_bench(builder, frame.at(u, v0 - 2.0), frame.away)


def paint_all(rng: np.random.Generator, plan: Plan) -> Canvas:
    """Paints lawns, deck, buildings' paving, sports grounds with their lines, car park."""
    canvas = Canvas(half_m=HALF_M)
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
        canvas.fill(outline(plan.pool(kind), 2.0), Ground.PLANKS)
    walk = frame.points(np.array([[u0 + 4.0, v0], [-27.0, -4.0], [-30.0, -14.0], plan.court_uv]))
    canvas.track(walk, 1.6, Ground.GRAVEL)
    u, v = plan.court_uv
    canvas.fill(frame.rectangle((u - 9.5, u + 9.5), (v - 5.5, v + 5.5)), Ground.SAND)
    _paint_pitch(canvas, plan)
    _paint_car_park(canvas, plan, rng)
    for _ in range(40):
        spot = frame.at(rng.uniform(u0, u1), rng.uniform(v0, v1))
        turn = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
        blot = rng.uniform(0.2, 0.8) * rng.uniform(0.6, 1.2, 12)
        ring = blot[:, None] * unit(turn)
        canvas.soil(spot + ring, int(rng.integers(18, 60)))
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
    outer, inner = (
        frame.ring(middle_u, middle_v, 3.06, 60),
        frame.ring(middle_u, middle_v, 2.94, 60),
    )
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
        steps = rng.normal(0.0, 0.25, (24, 2)) + rng.normal(0.0, 0.15, 2)
        canvas.trace(start + np.cumsum(steps, axis=0), 0.03, 170)
