"""Plan of the roads in signed distances; their surfaces, markings, kerbs and traffic."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from touchdown.scenes.api import Array, MovingBody
from touchdown.scenes.authoring import relief, streets
from touchdown.scenes.authoring.builder import SceneBuilder
from touchdown.scenes.authoring.ground import Canvas, Ground
from touchdown.scenes.authoring.plane import left_of, pick, unit
from touchdown.scenes.authoring.plots import SurveyFrame
from touchdown.scenes.props.cars import CAR_SURFACE, Models
from touchdown.scenes.props.street import add_kerb


@dataclass(frozen=True, kw_only=True, slots=True)
class Road:
    """A straight road through the junction."""

    angle: float
    """heading in radians"""
    width_m: float
    junction_xy_m: Array

    @property
    def along(self) -> Array:
        return unit(self.angle)

    @property
    def across(self) -> Array:
        """Unit vector to the left of ``along``."""
        return left_of(self.angle)

    def point(self, along_m: float, across_m: float) -> Array:
        """(2,) world point at road coordinates, origin at the junction."""
        return self.junction_xy_m + along_m * self.along + across_m * self.across

    def ends_m(self) -> tuple[float, float]:
        """Along-road coordinates at which the centre line leaves the square of the scene."""
        with np.errstate(divide="ignore"):
            low = (-relief.HALF_M - self.junction_xy_m) / self.along
            high = (relief.HALF_M - self.junction_xy_m) / self.along
        return float(np.minimum(low, high).max()), float(np.maximum(low, high).min())


@dataclass(frozen=True, kw_only=True, slots=True)
class Plan(SurveyFrame):
    """The junction of a main road (about east-west) and a side road (about north-south)."""

    main: Road
    side: Road
    corner_radius_m: float
    pavement_m: float

    def kerb_distance(self, xy_m: Array) -> Array:
        """(..., 2) world points -> (...) metres to the kerb line, negative on the roadway."""
        rel = np.asarray(xy_m) - self.main.junction_xy_m
        main = np.abs(rel @ self.main.across) - 0.5 * self.main.width_m
        side = np.abs(rel @ self.side.across) - 0.5 * self.side.width_m
        radius = self.corner_radius_m
        rounded = radius - np.hypot(radius - main, radius - side)
        corner = (main < radius) & (side < radius) & (main > -radius) & (side > -radius)
        plain = np.minimum(main, side)
        inside = (main > 0.0) & (side > 0.0)
        return np.where(corner & inside, rounded, plain)

    @property
    def corridor_m(self) -> float:
        """From the kerb to the outer edge of the pavement, with a hand's width of level ground."""
        return self.pavement_m + 0.5

    def offset_point(self, main_m: Array, side_m: Array) -> Array:
        """(..., 2) world points at signed distances (metres, left positive) from both centre
        lines."""
        rel = np.stack(np.broadcast_arrays(main_m, side_m), axis=-1)
        inverse = np.linalg.inv(np.stack([self.main.across, self.side.across]))
        return self.main.junction_xy_m + rel @ inverse.T

    def corner_arc(self, signs: tuple[int, int], distance_m: float, steps: int = 9) -> Array:
        """(steps, 2) points of the rounded corner at ``distance_m`` outside the kerb line, from
        the main road's straight to the side road's. signs: as in `QUADRANTS`."""
        angle = np.linspace(0.0, 0.5 * np.pi, steps)
        radius = self.corner_radius_m - distance_m
        main = self.corner_radius_m - radius * np.cos(angle)
        side = self.corner_radius_m - radius * np.sin(angle)
        return self.offset_point(
            signs[0] * (0.5 * self.main.width_m + main), signs[1] * (0.5 * self.side.width_m + side)
        )

    def corner_outline(self, signs: tuple[int, int], distance_m: float) -> Array:
        """Returns the corner's filling between the straight roads and `corner_arc`, (N, 2)."""
        main, side = 0.4 * self.main.width_m, 0.4 * self.side.width_m
        far_main = 0.5 * self.main.width_m + self.corner_radius_m
        far_side = 0.5 * self.side.width_m + self.corner_radius_m
        corners = self.offset_point(
            signs[0] * np.array([far_main, main, main]), signs[1] * np.array([side, side, far_side])
        )
        return np.concatenate([corners, self.corner_arc(signs, distance_m)])


QUADRANTS: dict[str, tuple[int, int]] = {"NE": (1, -1), "NW": (1, 1), "SW": (-1, 1), "SE": (-1, -1)}
"""Sides of (main, side) road on which a quarter lies: left of the way they run is positive."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Quarter:
    """One quarter of the scene with its own coordinates: ``s`` metres along the main road from the
    side road's pavement, ``t`` metres away from the main road's pavement."""

    plan: Plan
    signs: tuple[int, int]

    def points(self, st_m: Array) -> Array:
        """(..., 2) quarter coordinates -> (..., 2) world."""
        st = np.asarray(st_m, np.float64)
        plan = self.plan
        main = self.signs[0] * (0.5 * plan.main.width_m + plan.pavement_m + st[..., 1])
        side = self.signs[1] * (0.5 * plan.side.width_m + plan.pavement_m + st[..., 0])
        return plan.offset_point(main, side)

    def coordinates(self, xy_m: Array) -> Array:
        """(..., 2) world -> (..., 2) quarter coordinates."""
        plan = self.plan
        rel = np.asarray(xy_m) - plan.main.junction_xy_m
        t = self.signs[0] * (rel @ plan.main.across) - 0.5 * plan.main.width_m - plan.pavement_m
        s = self.signs[1] * (rel @ plan.side.across) - 0.5 * plan.side.width_m - plan.pavement_m
        return np.stack([s, t], axis=-1)

    def rectangle(self, s: tuple[float, float], t: tuple[float, float]) -> Array:
        """(4, 2) world corners of a rectangle of quarter coordinates."""
        return self.points(np.array([[s[0], t[0]], [s[1], t[0]], [s[1], t[1]], [s[0], t[1]]]))

    @property
    def away(self) -> float:
        """Heading (radians) straight away from the main road."""
        return self.plan.main.angle + self.signs[0] * 0.5 * np.pi


def draw_plan(rng: np.random.Generator) -> Plan:
    """Returns a plan whose roads leave a meadow south-west of the junction for the take-off."""
    junction = rng.uniform([-5.0, -5.0], [7.0, 7.0])
    angle = rng.uniform(-0.09, 0.09)
    skew = rng.uniform(-0.05, 0.05)
    main = Road(angle=angle, width_m=rng.uniform(7.6, 9.0), junction_xy_m=junction)
    side = Road(
        angle=0.5 * np.pi + angle + skew, width_m=rng.uniform(6.2, 7.4), junction_xy_m=junction
    )
    return Plan(
        main=main,
        side=side,
        corner_radius_m=rng.uniform(4.5, 6.5),
        pavement_m=rng.uniform(2.0, 2.8),
        takeoff_xy_m=np.array([-25.0, -20.0]) + rng.uniform(-2.5, 2.5, 2),
        takeoff_yaw=float(rng.uniform(-0.10, 0.10)),
    )


def shape_ground(
    rng: np.random.Generator, plan: Plan, pads: list[relief.Pad], ditches: list[relief.Ditch]
) -> relief.HeightField:
    """Returns natural ground with the roads, pads, ditches and the take-off spot cut in. The height
    at the take-off spot is 0."""
    heights, xy = relief.natural_ground(rng)
    heights = heights + (0.35 - heights.mean())
    heights = relief.level_pads(relief.dig_ditches(heights, xy, ditches), xy, pads)
    kerb = plan.kerb_distance(xy)
    # Beyond the pavement the ground may rise or fall over a few metres; it never dips below it
    # near the edge, as a gardener would have it.
    blend = relief.smoothstep(plan.corridor_m, plan.corridor_m + 5.0, kerb)
    heights = blend * heights
    heights = heights - streets.roadway_depth(kerb)
    return relief.level_takeoff(heights, plan.takeoff_xy_m)


LINE_M = 0.14
ZEBRA_FROM_M, ZEBRA_DEPTH_M = 1.2, 3.0
STOP_LINE_GAP_M, STOP_LINE_M = 1.0, 0.45


def paint_surfaces(canvas: Canvas, plan: Plan) -> None:
    """Paints pavements first, then the roadway over them."""
    far = 2.0 * relief.HALF_M
    pairs = ((plan.side, Ground.SIDE_PAVEMENT), (plan.main, Ground.PAVEMENT))
    for road, material in pairs:
        edge = 0.5 * road.width_m + plan.pavement_m
        canvas.fill(streets.band(road, (-far, far), (-edge, edge)), material)
    for signs in QUADRANTS.values():
        canvas.fill(plan.corner_outline(signs, plan.pavement_m), Ground.PAVEMENT)
    for road in (plan.side, plan.main):
        half = 0.5 * road.width_m
        canvas.fill(streets.band(road, (-far, far), (-half, half)), Ground.ASPHALT)
    for signs in QUADRANTS.values():
        canvas.fill(plan.corner_outline(signs, 0.0), Ground.ASPHALT)


def _junction_reach(plan: Plan, road: Road) -> float:
    """From the junction's middle to where the kerb of ``road`` is straight again."""
    other = plan.side if road is plan.main else plan.main
    return 0.5 * other.width_m + plan.corner_radius_m


def paint_markings(canvas: Canvas, plan: Plan) -> None:
    """Paints zebra crossings, stop lines, a solid centre line near the junction and dashes beyond
    it, edge lines."""
    far = 1.6 * relief.HALF_M
    for road in (plan.main, plan.side):
        reach = _junction_reach(plan, road)
        half = 0.5 * road.width_m
        for sign in (1.0, -1.0):
            start = reach + ZEBRA_FROM_M
            end = start + ZEBRA_DEPTH_M
            for across in np.arange(-half + 0.55, half - 0.5, 1.0):
                canvas.mark(streets.band(road, (sign * start, sign * end), (across, across + 0.5)))
            line = end + STOP_LINE_GAP_M
            # Traffic keeps right: approaching from +along it drives on the left of ``along``.
            near, outer = sign * 0.12, sign * (half - 0.35)
            canvas.mark(
                streets.band(road, (sign * line, sign * (line + STOP_LINE_M)), (near, outer))
            )
            solid = line + 12.0
            centre = (-0.5 * LINE_M, 0.5 * LINE_M)
            canvas.mark(streets.band(road, (sign * line, sign * solid), centre))
            for dash in np.arange(solid + 3.0, far, 6.0):
                canvas.mark(streets.band(road, (sign * dash, sign * (dash + 3.0)), centre))
            for edge in (half - 0.42, -half + 0.30):
                canvas.mark(streets.band(road, (sign * end, sign * far), (edge, edge + 0.12)))
            if road is plan.main:
                _arrow(canvas, road, sign * (line + 4.5), sign * 0.25 * road.width_m, -sign)


def _arrow(canvas: Canvas, road: Road, along: float, across: float, way: float) -> None:
    """A straight-on arrow that points to ``way`` (+1: along the road)."""
    canvas.mark(
        streets.band(road, (along - way * 1.6, along + way * 0.4), (across - 0.08, across + 0.08))
    )
    tip = [
        (along + way * 0.3, across - 0.32),
        (along + way * 1.5, across),
        (along + way * 0.3, across + 0.32),
    ]
    canvas.mark(np.array([road.point(*corner) for corner in tip]))


def wear_down(canvas: Canvas, plan: Plan, rng: np.random.Generator) -> None:
    """Paints patches, cracks and stains on both roads."""
    for road in (plan.main, plan.side):
        streets.paint_wear(canvas, road, rng, _junction_reach(plan, road))


def place_kerbs(builder: SceneBuilder, plan: Plan, openings: list[tuple[Array, float]]) -> None:
    """Adds kerb stones along every straight and corner, lowered away at zebra crossings and at
    ``openings`` (centre, radius: driveways)."""
    top = builder.terrain.point(*plan.main.point(0.0, 0.0)) + streets.ROAD_DEPTH_M + 0.015
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
    models: Models,
    rng: np.random.Generator,
) -> tuple[MovingBody, ...]:
    """Adds two or three cars that drive to the end of a road and come back on the other lane."""
    moving = []
    for index in range(int(rng.integers(2, 4))):
        path = lane_loop(builder, plan.main if index != 1 else plan.side)
        look = pick(rng, models)[:2]
        start = (0.17 + 0.5 * (index // 2) + rng.uniform(0.0, 0.15)) * streets.path_length(path)
        speed = float(rng.uniform(5.0, 9.0))
        moving.append(streets.add_car(builder, path, look, CAR_SURFACE, speed, start))
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
