"""Roadway, pavements, markings, kerbs and traffic."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from touchdown.scenes.api import Array, MovingBody
from touchdown.scenes.authoring.builder import SceneBuilder
from touchdown.scenes.authoring.ground import Canvas, Ground
from touchdown.scenes.authoring.plane import pick
from touchdown.scenes.authoring.streets import add_car, band, paint_wear, path_length
from touchdown.scenes.places.crossroad.layout import HALF_M, QUADRANTS, ROAD_DEPTH_M, Plan, Road
from touchdown.scenes.props.cars import CAR_SURFACE, CarShape
from touchdown.scenes.props.street import add_kerb

LINE_M = 0.14
ZEBRA_FROM_M, ZEBRA_DEPTH_M = 1.2, 3.0
STOP_LINE_GAP_M, STOP_LINE_M = 1.0, 0.45


def paint_surfaces(canvas: Canvas, plan: Plan) -> None:
    """Paints pavements first, then the roadway over them."""
    far = 2.0 * HALF_M
    pairs = ((plan.side, Ground.SIDE_PAVEMENT), (plan.main, Ground.PAVEMENT))
    for road, material in pairs:
        edge = 0.5 * road.width_m + plan.pavement_m
        canvas.fill(band(road, (-far, far), (-edge, edge)), material)
    for signs in QUADRANTS.values():
        canvas.fill(plan.corner_outline(signs, plan.pavement_m), Ground.PAVEMENT)
    for road in (plan.side, plan.main):
        half = 0.5 * road.width_m
        canvas.fill(band(road, (-far, far), (-half, half)), Ground.ASPHALT)
    for signs in QUADRANTS.values():
        canvas.fill(plan.corner_outline(signs, 0.0), Ground.ASPHALT)


def _junction_reach(plan: Plan, road: Road) -> float:
    """From the junction's middle to where the kerb of ``road`` is straight again."""
    other = plan.side if road is plan.main else plan.main
    return 0.5 * other.width_m + plan.corner_radius_m


def paint_markings(canvas: Canvas, plan: Plan) -> None:
    """Paints zebra crossings, stop lines, a solid centre line near the junction and dashes beyond
    it, edge lines."""
    far = 1.6 * HALF_M
    for road in (plan.main, plan.side):
        reach = _junction_reach(plan, road)
        half = 0.5 * road.width_m
        for sign in (1.0, -1.0):
            start = reach + ZEBRA_FROM_M
            end = start + ZEBRA_DEPTH_M
            for across in np.arange(-half + 0.55, half - 0.5, 1.0):
                canvas.mark(band(road, (sign * start, sign * end), (across, across + 0.5)))
            line = end + STOP_LINE_GAP_M
            # Traffic keeps right: approaching from +along it drives on the left of ``along``.
            near, outer = sign * 0.12, sign * (half - 0.35)
            canvas.mark(band(road, (sign * line, sign * (line + STOP_LINE_M)), (near, outer)))
            solid = line + 12.0
            centre = (-0.5 * LINE_M, 0.5 * LINE_M)
            canvas.mark(band(road, (sign * line, sign * solid), centre))
            for dash in np.arange(solid + 3.0, far, 6.0):
                canvas.mark(band(road, (sign * dash, sign * (dash + 3.0)), centre))
            for edge in (half - 0.42, -half + 0.30):
                canvas.mark(band(road, (sign * end, sign * far), (edge, edge + 0.12)))
            if road is plan.main:
                _arrow(canvas, road, sign * (line + 4.5), sign * 0.25 * road.width_m, -sign)


def _arrow(canvas: Canvas, road: Road, along: float, across: float, way: float) -> None:
    """A straight-on arrow that points to ``way`` (+1: along the road)."""
    canvas.mark(band(road, (along - way * 1.6, along + way * 0.4), (across - 0.08, across + 0.08)))
    tip = [
        (along + way * 0.3, across - 0.32),
        (along + way * 1.5, across),
        (along + way * 0.3, across + 0.32),
    ]
    canvas.mark(np.array([road.point(*corner) for corner in tip]))


def wear_down(canvas: Canvas, plan: Plan, rng: np.random.Generator) -> None:
    """Paints patches, cracks and stains on both roads."""
    for road in (plan.main, plan.side):
        paint_wear(canvas, road, rng, _junction_reach(plan, road))


def place_kerbs(builder: SceneBuilder, plan: Plan, openings: list[tuple[Array, float]]) -> None:
    """Adds kerb stones along every straight and corner, lowered away at zebra crossings and at
    ``openings`` (centre, radius: driveways)."""
    top = builder.terrain.point(*plan.main.point(0.0, 0.0)) + ROAD_DEPTH_M + 0.015
    for signs in QUADRANTS.values():
        arc = plan.corner_arc(signs, 0.08, 6)
        for first, second in pairwise(arc):
            add_kerb(builder, first, second, top)
    for road in (plan.main, plan.side):
        low, high = road.ends_m()
        reach = _junction_reach(plan, road)
        gap = reach + ZEBRA_FROM_M + ZEBRA_DEPTH_M
        edge = 0.5 * road.width_m + 0.08
        for across in (edge, -edge):
            for first, last in ((low, -gap), (-reach - ZEBRA_FROM_M, -reach),
                                (reach, reach + ZEBRA_FROM_M), (gap, high)):  # fmt: skip
                for start, end in _cut(road, across, first, last, openings):
                    add_kerb(builder, road.point(start, across), road.point(end, across), top)


def _cut(
    road: Road, across: float, first: float, last: float, openings: list[tuple[Array, float]]
) -> list[tuple[float, float]]:
    """The stretch without the openings that touch it."""
    stretches = [(first, last)]
    for centre, radius in openings:
        rel = centre - road.junction_xy_m
        along = float(rel @ road.along)
        if abs(float(rel @ road.across) - across) > 2.5:
            continue
        kept = []
        for start, end in stretches:
            kept += [(start, min(end, along - radius)), (max(start, along + radius), end)]
        stretches = [(start, end) for start, end in kept if end - start > 0.3]
    return stretches


def add_traffic(
    builder: SceneBuilder,
    plan: Plan,
    models: list[tuple[str, str, CarShape]],
    rng: np.random.Generator,
) -> tuple[MovingBody, ...]:
    """Adds two or three cars that drive to the end of a road and come back on the other lane."""
    moving = []
    for index in range(int(rng.integers(2, 4))):
        path = lane_loop(builder, plan.main if index != 1 else plan.side)
        look = pick(rng, models)[:2]
        start = (0.17 + 0.5 * (index // 2) + rng.uniform(0.0, 0.15)) * path_length(path)
        speed = float(rng.uniform(5.0, 9.0))
        moving.append(add_car(builder, path, look, CAR_SURFACE, speed, start))
    return tuple(moving)


def lane_loop(builder: SceneBuilder, road: Road) -> Array:
    """(K, 3) closed path on both lanes, right-hand traffic, turning at the ends of the road."""
    low, high = road.ends_m()
    lane = 0.25 * road.width_m
    turn = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 9)
    ahead = [(high - 6.0 + lane * np.cos(a), lane * np.sin(a)) for a in turn]
    back = [(low + 6.0 - lane * np.cos(a), -lane * np.sin(a)) for a in turn]
    xy = np.array([road.point(along, across) for along, across in ahead + back])
    z = builder.terrain.at(xy)
    return np.column_stack([xy, np.full(len(xy), float(z.mean()))])
