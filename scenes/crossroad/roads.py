"""Roadway, pavements, markings, kerbs and traffic."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from scenes.api import MovingBody
from scenes.builder import GEOM, Builder
from scenes.crossroad.layout import HALF_M, QUADRANTS, ROAD_DEPTH_M, Plan, Road
from scenes.ground import Canvas, Ground
from scenes.props.cars import CAR_SURFACE, CarShape
from scenes.props.street import add_kerb

Array = NDArray[np.float64]

LINE_M = 0.14
ZEBRA_FROM_M, ZEBRA_DEPTH_M = 1.2, 3.0
STOP_LINE_GAP_M, STOP_LINE_M = 1.0, 0.45


def band(road: Road, along: tuple[float, float], across: tuple[float, float]) -> Array:
    """(4, 2) world corners of a rectangle in road coordinates."""
    return np.array([
        road.point(along[0], across[0]), road.point(along[1], across[0]),
        road.point(along[1], across[1]), road.point(along[0], across[1]),
    ])  # fmt: skip


def paint_surfaces(canvas: Canvas, plan: Plan) -> None:
    """Pavements first, then the roadway over them."""
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
    """Zebra crossings, stop lines, a solid centre line near the junction and dashes beyond it,
    edge lines."""
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


def paint_wear(canvas: Canvas, plan: Plan, rng: np.random.Generator) -> None:
    """Repair patches, tar seams, cracks, manholes, gullies and oil stains on the roadway."""
    for road in (plan.main, plan.side):
        low, high = road.ends_m()
        half = 0.5 * road.width_m
        for _ in range(int(rng.integers(5, 9))):
            along, across = rng.uniform(low, high), rng.uniform(-half + 1.0, half - 1.0)
            size = rng.uniform([0.8, 0.4], [4.0, 1.1])
            lines = (max(across - size[1], -half + 0.1), min(across + size[1], half - 0.1))
            outline = band(road, (along, along + size[0]), lines)
            canvas.fill(outline, Ground.NEW_ASPHALT)
            canvas.trace(np.concatenate([outline, outline[:1]]), 0.05, 190)
        for _ in range(int(rng.integers(22, 32))):
            _crack(canvas, road, rng, rng.uniform(low, high), rng.uniform(-half + 0.4, half - 0.4))
        for _ in range(7):
            along = rng.uniform(low, high)
            centre = road.point(along, rng.choice([-0.25, 0.25]) * road.width_m)
            turn = np.linspace(0.0, 2.0 * np.pi, 20, endpoint=False)
            ring = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
            canvas.soil(centre + 0.36 * ring, 200)
            canvas.soil(centre + 0.30 * ring, 120)
            for bar in (-0.15, 0.0, 0.15):
                canvas.trace(centre + np.array([[bar, -0.2], [bar, 0.2]]), 0.04, 220)
        for along in np.arange(low + 6.0, high, 17.0):
            for side in (1.0, -1.0):
                if abs(along) > _junction_reach(plan, road):
                    edge = side * (half - 0.28)
                    canvas.soil(band(road, (along, along + 0.5), (edge - 0.2, edge + 0.2)), 215)
        for _ in range(26):
            centre = road.point(rng.uniform(low, high), rng.normal(0.0, 0.3 * half))
            turn = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
            radius = rng.uniform(0.08, 0.35) * rng.uniform(0.7, 1.2, 12)
            blot = np.stack([radius * np.cos(turn), radius * np.sin(turn)], axis=-1)
            canvas.soil(centre + blot, int(rng.integers(40, 110)))


def _crack(
    canvas: Canvas, road: Road, rng: np.random.Generator, along: float, across: float
) -> None:
    steps = int(rng.integers(10, 36))
    heading = rng.uniform(0.0, 2.0 * np.pi) + np.cumsum(rng.normal(0.0, 0.35, steps))
    path = np.cumsum(0.22 * np.stack([np.cos(heading), np.sin(heading)], axis=-1), axis=0)
    limit = 0.5 * road.width_m - 0.1
    lateral = np.clip(across + path[:, 1], -limit, limit)
    line = np.array([road.point(along + a, c) for a, c in zip(path[:, 0], lateral, strict=True)])
    canvas.trace(line, 0.03 if rng.random() < 0.7 else 0.07, int(rng.integers(130, 230)))


def place_kerbs(builder: Builder, plan: Plan, openings: list[tuple[Array, float]]) -> None:
    """Kerb stones along every straight and corner, lowered away at zebra crossings and at
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
    builder: Builder, plan: Plan, models: list[tuple[str, str, CarShape]], rng: np.random.Generator
) -> tuple[MovingBody, ...]:
    """Two or three cars that drive to the end of a road and come back on the other lane."""
    moving = []
    count = int(rng.integers(2, 4))
    for index in range(count):
        road = plan.main if index != 1 else plan.side
        path = lane_loop(builder, road)
        mesh, material, _ = models[int(rng.integers(len(models)))]
        name = f"moving_car_{index}"
        lengths = np.linalg.norm(np.roll(path, -1, axis=0) - path, axis=1)
        start = (0.17 + 0.5 * (index // 2) + rng.uniform(0.0, 0.15)) * float(lengths.sum())
        where, heading = along_path(path, start)
        half = 0.5 * heading
        body = builder.spec.worldbody.add_body(
            name=name, mocap=True, pos=where, quat=[np.cos(half), 0.0, 0.0, np.sin(half)]
        )
        builder.geom(
            "car_moving",
            CAR_SURFACE,
            body=body,
            type=GEOM.mjGEOM_MESH,
            meshname=mesh,
            material=material,
        )
        speed = float(rng.uniform(5.0, 9.0))
        moving.append(MovingBody(body_name=name, path_world=path, speed_mps=speed, start_m=start))
    return tuple(moving)


def lane_loop(builder: Builder, road: Road) -> Array:
    """(K, 3) closed path on both lanes, right-hand traffic, turning at the ends of the road."""
    low, high = road.ends_m()
    lane = 0.25 * road.width_m
    turn = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 9)
    ahead = [(high - 6.0 + lane * np.cos(a), lane * np.sin(a)) for a in turn]
    back = [(low + 6.0 - lane * np.cos(a), -lane * np.sin(a)) for a in turn]
    xy = np.array([road.point(along, across) for along, across in ahead + back])
    z = builder.terrain.at(xy)
    return np.column_stack([xy, np.full(len(xy), float(z.mean()))])


def along_path(path: Array, distance_m: float) -> tuple[Array, float]:
    """Point (3,) and heading (radians) on a closed polyline."""
    steps = np.roll(path, -1, axis=0) - path
    lengths = np.linalg.norm(steps, axis=1)
    rest = distance_m % float(lengths.sum())
    index = int(np.searchsorted(np.cumsum(lengths), rest, side="right"))
    into = rest - float(lengths[:index].sum())
    unit = steps[index] / lengths[index]
    return path[index] + into * unit, float(np.arctan2(unit[1], unit[0]))
