"""`houses`: a settlement of streets, houses with gardens, and a green with a playground."""

from dataclasses import dataclass

import numpy as np

from touchdown.scenes.api import Array, MovingBody
from touchdown.scenes.authoring import relief, streets
from touchdown.scenes.authoring.builder import SceneBuilder
from touchdown.scenes.authoring.draft import SceneDraft
from touchdown.scenes.authoring.generation import finish, paint_terrain, scene_rng, start_scene
from touchdown.scenes.authoring.ground import Canvas, Ground, mown_askew
from touchdown.scenes.authoring.plane import pick, unit, unit_circle
from touchdown.scenes.authoring.plots import Plot, SurveyFrame, claim_area, scatter
from touchdown.scenes.places.houses.homes import (
    GARDENS,
    Home,
    build_home,
    draw_home,
    fence_home,
    paint_home,
)
from touchdown.scenes.props import playground
from touchdown.scenes.props.cars import CAR_SURFACE, Models, add_car_models, park_car
from touchdown.scenes.props.garden import add_toys
from touchdown.scenes.props.houses import paint_house_looks, tiled_roof
from touchdown.scenes.props.plants import Nursery, add_bush, add_small_tree, add_tree, plant_nursery
from touchdown.scenes.props.street import add_bench, add_kerb, add_lamp, add_line, add_sagging_wire

TURNING_M = 7.2
"""Radius of the turning circle at the end of the close."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Plan(SurveyFrame):
    """``frame``: coordinates of the whole scene, its main street about along u. The green, with
    the take-off spot, lies in the quarter of negative u and v."""

    frame: Plot
    main: streets.Street
    south: streets.Street
    close: streets.Street

    @property
    def streets(self) -> tuple[streets.Street, streets.Street, streets.Street]:
        return self.main, self.south, self.close

    @property
    def turning_xy_m(self) -> Array:
        """Middle of the turning circle."""
        return self.close.line_m[-1]

    def pavement_distance(self, xy_m: Array) -> Array:
        """(..., 2) -> (...) metres to the outer edge of the nearest pavement, negative inside."""
        street = [s.nearest(xy_m)[0] - s.edge_m for s in self.streets]
        circle = np.linalg.norm(np.asarray(xy_m) - self.turning_xy_m, axis=-1)
        return np.minimum.reduce([*street, circle - TURNING_M - self.close.pavement_m])

    def kerb_distance(self, xy_m: Array) -> Array:
        """(..., 2) -> (...) metres to the nearest roadway, negative on it."""
        street = [s.kerb_distance(xy_m) for s in self.streets]
        circle = np.linalg.norm(np.asarray(xy_m) - self.turning_xy_m, axis=-1)
        return np.minimum.reduce([*street, circle - TURNING_M])


def draw_plan(rng: np.random.Generator) -> Plan:
    """Returns a main street that swings, a street to the south and a close to the north."""
    angle = 0.5 * np.pi * int(rng.integers(4)) + rng.uniform(-0.06, 0.06)
    frame = Plot(origin_xy_m=rng.uniform(-1.0, 1.0, 2), angle=angle)

    def street(corners: list[tuple[float, float]], width: float, pavement: float) -> streets.Street:
        line = streets.smooth_line(frame.points(np.array(corners)))
        return streets.Street(line_m=line, width_m=width, pavement_m=pavement)

    level = rng.uniform(1.0, 5.0)
    swing = rng.uniform(2.0, 6.0) * (1.0 if rng.random() < 0.5 else -1.0)
    shape = ((-84.0, -1.0), (-45.0, -1.0), (-14.0, 0.5), (26.0, -0.3), (50.0, 1.0), (84.0, 1.0))
    corners = [(u, level + fraction * swing) for u, fraction in shape]
    main = street(corners, rng.uniform(6.0, 6.8), rng.uniform(1.7, 2.1))
    stations = np.array([main.point(s, 0.0) for s in np.arange(0.0, main.length_m, 1.0)])
    local = frame.coordinates(stations)

    def on_main(u: float) -> tuple[float, float]:
        return u, float(np.interp(u, local[:, 0], local[:, 1]))

    first, second = rng.uniform(4.0, 9.0), rng.uniform(-9.0, -3.0)
    bends = rng.uniform(-2.5, 2.5, 4)
    south = street([on_main(first), (first, -10.0), (first + bends[0], -34.0),
                   (first + bends[1], -84.0)], rng.uniform(5.2, 5.8), 1.6)  # fmt: skip
    close = street([on_main(second), (second, 16.0), (second + bends[2], 30.0),
                   (second + bends[3], 47.0)], rng.uniform(4.8, 5.4), 1.5)  # fmt: skip
    return Plan(
        frame=frame,
        main=main,
        south=south,
        close=close,
        takeoff_xy_m=frame.at(-25.0 + rng.uniform(-1.5, 1.5), -20.0 + rng.uniform(-1.5, 1.5)),
        takeoff_yaw=float(angle + rng.uniform(-0.05, 0.05)),
    )


def shape_ground(
    rng: np.random.Generator,
    plan: Plan,
    pads: list[relief.Pad],
    ditches: list[relief.Ditch],
    mounds: list[relief.Mound],
) -> relief.HeightField:
    """Returns natural ground with mounds, ditches, pads and streets; the take-off spot is at height
    0."""
    heights, xy = relief.natural_ground(rng)
    heights = heights + (0.30 - heights.mean())
    heights = relief.level_pads(heights, xy, pads)
    heights = relief.raise_mounds(relief.dig_ditches(heights, xy, ditches), xy, mounds)
    heights = heights * relief.smoothstep(0.5, 5.5, plan.pavement_distance(xy))
    heights = heights - streets.roadway_depth(plan.kerb_distance(xy))
    return relief.level_takeoff(heights, plan.takeoff_xy_m)


@dataclass(frozen=True, kw_only=True, slots=True)
class Green:
    """In frame coordinates: u from ``west`` to ``east``, v from ``low`` to ``high``."""

    plan: Plan
    west: float
    east: float
    low: float
    high: float
    play_uv: Array
    """middle of the playground"""
    path_m: Array
    """(N, 2) world"""
    mound: relief.Mound
    ditch: relief.Ditch


def draw_green(rng: np.random.Generator, plan: Plan) -> Green:
    """Returns the green: a playground in the south-west corner, a slope with the look of lawn,
    a grassed ditch."""
    frame = plan.frame
    local = [frame.coordinates(plan.south.point(s, -plan.south.edge_m)) for s in (20.0, 45.0)]
    east = float(min(point[0] for point in local)) - 0.8
    high = float(frame.coordinates(plan.takeoff_xy_m)[1]) + 17.0
    u = np.arange(-66.0, east + 1.0, 1.0)
    swing = rng.uniform(1.0, 2.2) * np.sin(u / rng.uniform(7.0, 11.0) + rng.uniform(0.0, 6.0))
    path = frame.points(np.column_stack([u, -32.5 + rng.uniform(-1.0, 1.0) + swing]))
    spot = frame.at(east - rng.uniform(7.0, 9.0), -15.0 + rng.uniform(-4.0, 3.0))
    return Green(plan=plan, west=-44.0, east=east, low=-50.0, high=high,
                 play_uv=np.array([-30.0 + rng.uniform(-5.0, 6.0), -41.5]), path_m=path,
                 mound=relief.Mound(centre_xy_m=spot, height_m=rng.uniform(0.8, 1.3),
                                    radius_m=rng.uniform(3.4, 4.2)),
                 ditch=relief.Ditch(start_xy_m=frame.at(-62.0, -51.0),
                                    end_xy_m=frame.at(east - 4.0, -50.0),
                                    depth_m=rng.uniform(0.5, 0.8), half_width_m=1.6))  # fmt: skip


def paint_green(canvas: Canvas, green: Green, rng: np.random.Generator) -> None:
    """Paints footpath, safety surface, meadow beyond the ditch, bare patches before the goal."""
    frame = green.plan.frame
    meadow = [frame.at(u, -50.5 + 0.6 * np.sin(0.3 * u)) for u in np.arange(-70.0, green.east, 2.0)]
    canvas.fill(
        np.array([*meadow, frame.at(green.east, -90.0), frame.at(-70.0, -90.0)]), Ground.MEADOW
    )
    canvas.track(np.array([green.ditch.start_xy_m, green.ditch.end_xy_m]), 1.0, Ground.WORN)
    canvas.track(green.path_m, 1.8, Ground.GRAVEL)
    u, v = green.play_uv
    canvas.fill(frame.rectangle((u - 8.5, u + 4.5), (v - 4.6, v + 4.6)), Ground.RUBBER)
    canvas.fill(frame.ring(u + 8.0, v, 3.4), Ground.SAND)
    # A kick-about field worn by feet.
    for _ in range(3):
        spot = green.plan.takeoff_xy_m + rng.normal(0.0, 3.0, 2)
        blot = rng.uniform(0.5, 1.1, 14)[:, None] * frame.ring(0.0, 0.0, 1.0, 14)
        canvas.fill(spot + blot, Ground.WORN)


def build_green(builder: SceneBuilder, green: Green, nursery: Nursery) -> None:
    """Adds trees along the edges, play equipment, benches, and lines over the lawn."""
    rng, frame = builder.rng, green.plan.frame
    start = frame.coordinates(green.plan.takeoff_xy_m)
    for spot in green.path_m[::2]:
        builder.claim(spot, 1.0)
    u, v = green.play_uv
    playground.add_swing(builder, frame.at(u - 5.5, v + 1.5), frame.angle)
    playground.add_play_slide(builder, frame.at(u - 1.0, v - 1.8), frame.angle)
    playground.add_climbing_dome(builder, frame.at(u + 2.0, v + 2.0))
    builder.claim(frame.at(u + 8.0, v), 3.4)
    claim_area(builder, frame, (u - 8.5, u + 4.5), (v - 4.6, v + 4.6))
    for reach in (-5.0, 4.0):
        add_bench(builder, frame.at(u + reach, v + 6.0), frame.away + np.pi)
    add_toys(builder, frame.at(start[0] + rng.uniform(7.0, 11.0), start[1] + rng.uniform(4.0, 9.0)))
    near = frame.at(start[0] - 9.0, start[1] + rng.uniform(4.0, 8.0))
    playground.add_goal(builder, near, frame.angle, 2.4, 1.6)
    line_v = start[1] + rng.uniform(-7.0, -5.0)
    first, last = start[0] + rng.uniform(5.0, 8.0), start[0] + rng.uniform(17.0, 20.0)
    far = frame.at(last, line_v + rng.uniform(-2, 2))
    playground.add_slackline(builder, frame.at(first, line_v), far, rng.uniform(0.45, 0.9))
    builder.claim(frame.at(0.5 * (first + last), line_v), 5.0)
    for along in np.arange(green.west + 2.0, green.east - 3.0, rng.uniform(8.5, 10.5)):
        spot = frame.at(along, green.high - 1.0)
        distance = float(green.plan.pavement_distance(spot))
        if distance > 2.0 and builder.is_free(spot, 2.0):
            add_tree(builder, nursery, spot, rng.uniform(0.8, 1.0))
    lawn = (green.west + 2.0, green.east - 3.0)
    for spot in scatter(builder, frame, 2, lawn, (green.low + 3.0, -24.0), 3.0):
        add_tree(builder, nursery, spot, rng.uniform(0.9, 1.2))
    for spot in scatter(builder, frame, 3, (-57.0, green.east - 4.0), (-57.0, -53.0), 2.4):
        add_small_tree(builder, nursery, spot, rng.uniform(0.9, 1.1))
    for spot in scatter(builder, frame, 3, (-57.0, green.east - 2.0), (-57.0, -36.0), 1.0):
        add_bush(builder, nursery, spot)
    for index in (int(0.35 * len(green.path_m)), int(0.75 * len(green.path_m))):
        spot = green.path_m[index] + 1.6 * unit(frame.away)
        if builder.is_free(spot, 0.0) or index:
            add_lamp(builder, spot, frame.away + np.pi, 4.0)


def generate(seed: int) -> SceneDraft:
    """Returns the scene of ``seed`` without the vehicle. The same seed gives the same bytes."""
    rng = scene_rng("houses", seed)
    plan = draw_plan(rng)
    rows = draw_rows(rng, plan)
    homes = [home for row in rows for home in row]
    green = draw_green(rng, plan)
    pads = [pad for home in homes for pad in home.pads()]
    terrain = shape_ground(rng, plan, pads, [green.ditch], [green.mound])
    builder = start_scene("houses", rng, terrain)
    moving = place_objects(builder, plan, rows, green)
    canvas = paint_ground(rng, plan, homes, green)
    ground = paint_terrain(builder, canvas, mown_askew(rng, plan.frame.angle))
    return finish(plan, builder, ground, moving=moving)


def draw_rows(rng: np.random.Generator, plan: Plan) -> list[list[Home]]:
    """Returns rows of neighbouring homes along the streets, gardens of all kinds."""
    main, south, close, frame = plan.main, plan.south, plan.close, plan.frame

    def station(street: streets.Street, u: float | None = None, v: float | None = None) -> float:
        local = frame.coordinates(street.line_m)
        axis, value = (0, u) if u is not None else (1, v)
        return 0.5 * float(np.argmin(np.abs(local[:, axis] - (value or 0.0))))

    close_u = float(frame.coordinates(close.point(12.0, 0.0))[0])
    south_u = float(frame.coordinates(south.point(12.0, 0.0))[0])
    stretches = [
        (main, 1.0, station(main, u=-59.5), station(main, u=close_u - close.edge_m - 1.5), 3, 25.0),
        (main, 1.0, station(main, u=close_u + close.edge_m + 1.5), station(main, u=59.5), 3, 25.0),
        (main, -1.0, station(main, u=south_u + 36.5), station(main, u=60.0), 1, 27.0),
        (south, 1.0, station(south, v=-13.0), station(south, v=-59.5), 3, 27.5),
        (main, -1.0, station(main, u=-60.5), station(main, u=-44.5), 1, 26.0),
    ]
    kinds = list(rng.permutation(np.resize(np.array(GARDENS), 13)))
    rows = []
    for street, side, first, last, count, depth in stretches:
        width = abs(last - first) / count
        row = []
        for index in range(count):
            middle = first + (index + 0.5) * (last - first) / count
            heading = street.heading(middle)
            edge = street.point(middle, side * (street.edge_m + 0.3))
            along = unit(heading)
            plot = Plot(origin_xy_m=edge - 0.5 * width * along, angle=heading, mirrored=side < 0.0)
            row.append(draw_home(rng, plot, width - 0.5, depth, str(kinds.pop())))
        rows.append(row)
    for side in (1.0, -1.0):
        heading = close.heading(38.0)
        edge = close.point(close.length_m - 1.0, side * (TURNING_M + close.pavement_m + 0.2))
        along = unit(heading)
        plot = Plot(origin_xy_m=edge - 7.0 * along, angle=heading, mirrored=side < 0.0)
        rows.append([draw_home(rng, plot, 16.5, 26.0, str(kinds.pop()))])
    return rows


def place_objects(
    builder: SceneBuilder, plan: Plan, rows: list[list[Home]], green: Green
) -> tuple[MovingBody, ...]:
    """Adds all objects and cars. Returns the moving cars."""
    rng = builder.rng
    nursery = plant_nursery(builder)
    models = add_car_models(builder, 7)
    looks = paint_house_looks(builder, [tiled_roof(rng, 11.0, 5.4) for _ in range(6)])
    builder.claim(plan.takeoff_xy_m, 6.0)
    homes = [home for row in rows for home in row]
    place_kerbs(builder, plan, homes)
    build_green(builder, green, nursery)
    order = rng.permutation(len(homes))
    for index, home in enumerate(homes):
        build_home(builder, home, looks[int(order[index]) % 6], nursery, models)
    for row in rows:
        for index, home in enumerate(row):
            fence_home(builder, home, nursery, index == 0)
    string_wires(builder, plan, homes)
    light_and_park(builder, plan, models)
    scatter_edge_trees(builder, plan, nursery)
    return add_traffic(builder, plan, models)


def place_kerbs(builder: SceneBuilder, plan: Plan, homes: list[Home]) -> None:
    """Adds kerbs of the three streets with gaps at drives and junctions, and round the turning
    circle."""
    for street in plan.streets:
        for side in (1.0, -1.0):
            gaps = []
            for home in homes:
                gate = home.plot.at(home.drive_u, -street.pavement_m)
                distance, along = street.nearest(gate)
                across = street.point(float(along), side) - street.point(float(along), 0.0)
                aside = (gate - street.point(float(along), 0.0)) @ across
                if distance < street.edge_m + 1.0 and aside > 0.0:
                    gaps.append((float(along) - 1.9, float(along) + 1.9))
            gaps += _junction_gaps(plan, street, side)
            streets.place_street_kerb(builder, street, side, gaps, 0.015)
    ring = plan.turning_xy_m + (TURNING_M + 0.08) * unit_circle(20)
    top = builder.terrain.point(*plan.turning_xy_m) + streets.ROAD_DEPTH_M + 0.015
    for index in range(20):
        first, second = ring[index], ring[(index + 1) % 20]
        if float(plan.close.kerb_distance(0.5 * (first + second))) > 0.3:
            add_kerb(builder, first, second, top)


def _junction_gaps(plan: Plan, street: streets.Street, side: float) -> list[tuple[float, float]]:
    """Stretches of a kerb that lie on another roadway or outside of the scene."""
    stations = np.arange(0.0, street.length_m, 0.5)
    kerb = np.array([street.point(s, side * (0.5 * street.width_m + 0.08)) for s in stations])
    other = [s.kerb_distance(kerb) for s in plan.streets if s is not street]
    if street is plan.close:
        other.append(np.linalg.norm(kerb - plan.turning_xy_m, axis=1) - TURNING_M)
    inside = (np.minimum.reduce(other) < 0.1) | (np.abs(kerb).max(axis=1) > relief.HALF_M)
    return [(float(s) - 0.3, float(s) + 0.3) for s in stations[inside]]


def string_wires(builder: SceneBuilder, plan: Plan, homes: list[Home]) -> None:
    """Adds a line of poles along the main street, and cables from its poles down to the houses."""
    main, rng = plan.main, builder.rng
    side = -(main.edge_m + 0.35) if rng.random() < 0.5 else main.edge_m + 0.35
    first = rng.uniform(24.0, 30.0)
    stations = np.arange(first, main.length_m - 22.0, rng.uniform(27.0, 31.0))
    spots = []
    for along in stations:
        tries = [main.point(along + shift, side) for shift in (0.0, 2.5, -2.5, 5.0, -5.0)]
        off_road = [spot for spot in tries if float(plan.kerb_distance(spot)) > 0.6]
        free = [spot for spot in off_road if builder.is_free(spot, 0.2)]
        spots.append((free or tries)[0])
    tops = np.array(add_line(builder, spots, rng.uniform(6.6, 7.4), rng.uniform(0.4, 0.7)))
    for home in homes:
        eaves = home.plot.at(home.house_u, home.front_v + 0.2)
        reach = np.linalg.norm(tops[:, :2] - eaves, axis=1)
        nearest = int(np.argmin(reach))
        if reach[nearest] < 15.0:
            z = builder.terrain.point(*home.house.centre_xy_m) + home.house.size_m[2] - 0.2
            add_sagging_wire(builder, tops[nearest], np.array([*eaves, z]), 0.0, 1)


def light_and_park(builder: SceneBuilder, plan: Plan, models: Models) -> None:
    """Adds lamps along the side streets and cars at their kerbs."""
    rng = builder.rng
    for street in (plan.south, plan.close):
        for index, along in enumerate(np.arange(17.0, min(street.length_m, 66.0), 19.0)):
            side = 1.0 if index % 2 else -1.0
            spot = street.point(along, side * (street.edge_m - 0.3))
            if builder.is_free(spot, 0.2):
                add_lamp(builder, spot, street.heading(along) - side * 0.5 * np.pi, 5.5)
        for along in np.arange(13.0, min(street.length_m, 64.0) - 6.0, 8.5):
            side = 1.0 if rng.random() < 0.5 else -1.0
            spot = street.point(along, side * (0.5 * street.width_m - 1.0))
            if rng.random() < 0.4 and builder.is_free(spot, 0.4):
                way = street.heading(along) + (0.0 if side < 0 else np.pi)
                park_car(builder, pick(rng, models), spot, way)


def scatter_edge_trees(builder: SceneBuilder, plan: Plan, nursery: Nursery) -> None:
    """Adds trees behind the gardens."""
    frame, rng = plan.frame, builder.rng
    north = 40.0, 60.0
    for u, v in (((-60.0, -18.0), north), ((34.0, 60.0), north), ((42.0, 60.0), (-60.0, -34.0))):
        for spot in scatter(builder, frame, 1, u, v, 2.8):
            add_tree(builder, nursery, spot, rng.uniform(0.9, 1.25))
        for spot in scatter(builder, frame, 1, u, v, 2.0):
            add_small_tree(builder, nursery, spot, rng.uniform(0.8, 1.1))


def add_traffic(builder: SceneBuilder, plan: Plan, models: Models) -> tuple[MovingBody, ...]:
    """Adds one or two cars on the main street."""
    rng, main = builder.rng, plan.main
    inside = [s for s in np.arange(0.0, main.length_m, 1.0)
              if np.abs(main.point(s, 0.0)).max() < relief.HALF_M - 5.0]  # fmt: skip
    path = streets.lane_loop(builder, main, float(inside[0]), float(inside[-1]))
    moving = []
    for index in range(int(rng.integers(1, 3))):
        look = pick(rng, models)[:2]
        start = (0.1 + 0.5 * index + rng.uniform(0.0, 0.3)) * streets.path_length(path)
        moving.append(streets.add_car(builder, path, look, CAR_SURFACE, 6.5, start))
    return tuple(moving)


def paint_ground(rng: np.random.Generator, plan: Plan, homes: list[Home], green: Green) -> Canvas:
    """Paints gardens and green first, pavements and roadways over them."""
    canvas = Canvas()
    paint_green(canvas, green, rng)
    for home in homes:
        paint_home(canvas, home, rng)
    circle = unit_circle(48)
    for street in plan.streets:
        streets.paint_street(canvas, street, pavement=Ground.PAVEMENT)
    canvas.fill(plan.turning_xy_m + (TURNING_M + plan.close.pavement_m) * circle, Ground.PAVEMENT)
    for home in homes:
        drive = (home.drive_u - 1.6, home.drive_u + 1.6)
        canvas.fill(home.plot.rectangle(drive, (-plan.main.pavement_m - 0.4, 0.0)), Ground.PAVERS)
    for street in plan.streets:
        streets.paint_street(canvas, street)
    canvas.fill(plan.turning_xy_m + TURNING_M * circle, Ground.ASPHALT)
    for street in plan.streets:
        streets.paint_wear(canvas, street, rng, 0.0)
    streets.paint_dashes(canvas, plan.main, 3.0, plan.main.length_m - 3.0)
    return canvas
