"""Plan of the building and the streets; its roof with falls, markings and objects."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.api import Array, Surface
from touchdown.scenes.authoring.builder import SceneBuilder
from touchdown.scenes.authoring.ground import Canvas, Ground
from touchdown.scenes.authoring.meshes import MeshData, box
from touchdown.scenes.authoring.noise import fractal_noise
from touchdown.scenes.authoring.plane import pick, unit_circle
from touchdown.scenes.authoring.plots import Plot, SurveyFrame
from touchdown.scenes.authoring.relief import HALF_M, HeightField
from touchdown.scenes.authoring.streets import Street, smooth_line
from touchdown.scenes.props.cars import Models, park_car
from touchdown.scenes.props.street import STEEL, add_lamp

NODE_M = 2.0 / 3.0
"""Node spacing of ground and deck; three of it are 80 texels."""
STOREY_M = 2.9
BAY_DEPTH_M, BAY_WIDTH_M, AISLE_M = 5.0, 2.5, 6.5
RAMP_DEPTH_M = 3.1
STREET_M, PAVEMENT_M = 7.0, 2.4
EDGE_M = 1.0
"""From the parapet to the first marking."""
WORLD = Plot(origin_xy_m=np.zeros(2), angle=0.0)


@dataclass(frozen=True, kw_only=True, slots=True)
class Ramp:
    """The way down through the deck, along x: from ``top_x_m`` (deck level) to ``foot_x_m``."""

    top_x_m: float
    foot_x_m: float
    low_y_m: float
    high_y_m: float

    def depth(self, xy_m: Array) -> Array:
        """(..., 2) -> (...) metres below the deck, 0 outside."""
        x, y = np.asarray(xy_m)[..., 0], np.asarray(xy_m)[..., 1]
        fraction = (x - self.top_x_m) / (self.foot_x_m - self.top_x_m)
        inside = (
            (y > self.low_y_m + 1e-6)
            & (y < self.high_y_m - 1e-6)
            & (fraction > 0)
            & (fraction <= 1)
        )
        return np.where(inside, RAMP_DEPTH_M * fraction, 0.0)


@dataclass(frozen=True, kw_only=True, slots=True)
class Plan(SurveyFrame):
    """The deck's rectangle lies on nodes of the terrain. Rows of bays along x; y from the south:
    bays, aisle, two rows of bays, aisle, bays, and a strip with the ramp and the stair house."""

    low_xy_m: Array
    high_xy_m: Array
    height_m: float
    """of the deck over the ground"""
    ramp: Ramp
    stairs_x_m: float
    streets: tuple[Street, Street]
    """along x, along y"""

    @property
    def centre(self) -> Array:
        return np.asarray(0.5 * (self.low_xy_m + self.high_xy_m), np.float64)

    @property
    def size_m(self) -> Array:
        return np.asarray(self.high_xy_m - self.low_xy_m, np.float64)

    def inside(self, xy_m: Array, margin_m: float = 0.0) -> NDArray[np.bool_]:
        """(..., 2) -> (...): on the deck, ``margin_m`` from its edge."""
        xy = np.asarray(xy_m)
        low, high = self.low_xy_m + margin_m, self.high_xy_m - margin_m
        return np.asarray(((xy >= low - 1e-9) & (xy <= high + 1e-9)).all(axis=-1))

    def rows(self) -> list[tuple[float, float, float]]:
        """For every row of bays: y of its edge at the aisle, y of its head, heading of a parked
        car."""
        first = float(self.low_xy_m[1]) + EDGE_M
        north = 0.5 * np.pi
        aisle = first + BAY_DEPTH_M
        second = aisle + AISLE_M
        middle = second + BAY_DEPTH_M
        third = middle + BAY_DEPTH_M
        fourth = third + AISLE_M
        return [(aisle, first, -north), (second, middle, north), (third, middle, -north),
                (fourth, fourth + BAY_DEPTH_M, north)]  # fmt: skip

    def aisles(self) -> list[float]:
        """y of the aisles' middle lines."""
        rows = self.rows()
        return [0.5 * (rows[0][0] + rows[1][0]), 0.5 * (rows[2][0] + rows[3][0])]

    def bays_x(self) -> Array:
        """x of the lines between bays; lanes at both ends join the aisles."""
        room = float(self.size_m[0]) - 2.0 * (EDGE_M + AISLE_M)
        count = int(room / BAY_WIDTH_M)
        start = float(self.centre[0]) - 0.5 * count * BAY_WIDTH_M
        return np.asarray(start + BAY_WIDTH_M * np.arange(count + 1), np.float64)


def draw_plan(rng: np.random.Generator) -> Plan:
    """Returns a roof of 54..60 x 42 m whose south-west corner is below the survey's start."""
    width = 2.0 * int(rng.integers(27, 31))
    low = np.array([-34.0 + 2.0 * int(rng.integers(0, 2)), -26.0])
    high = low + [width, 42.0]
    strip = (float(high[1]) - 5.0 * NODE_M - 4.0, float(high[1]) - NODE_M)
    length = float(27 * NODE_M)
    east = rng.random() < 0.5
    # Its top is at the lane across the ends of the aisles.
    top = float(high[0]) - 8.0 if east else float(low[0]) + 8.0
    foot = top - length if east else top + length
    ramp = Ramp(top_x_m=_on_node(top), foot_x_m=_on_node(foot), low_y_m=_on_node(strip[0]),
                high_y_m=_on_node(strip[1]))  # fmt: skip
    stairs = float(low[0]) + 7.0 if east else float(high[0]) - 7.0
    beside = 0.5 * STREET_M + PAVEMENT_M + rng.uniform(2.5, 4.5)
    street_y = float(low[1]) - beside if rng.random() < 0.6 else float(high[1]) + beside
    street_x = float(high[0]) + beside if rng.random() < 0.7 else float(low[0]) - beside
    lean = rng.uniform(-0.02, 0.02, 2)
    far = HALF_M
    along_x = np.array([[-far, street_y - far * lean[0]], [far, street_y + far * lean[0]]])
    along_y = np.array([[street_x + far * lean[1], -far], [street_x - far * lean[1], far]])
    streets = tuple(
        Street(line_m=smooth_line(ends), width_m=STREET_M, pavement_m=PAVEMENT_M)
        for ends in (along_x, along_y)
    )
    plan = Plan(low_xy_m=low, high_xy_m=high, height_m=STOREY_M * int(rng.integers(2, 4)),
                ramp=ramp, stairs_x_m=stairs, streets=(streets[0], streets[1]),
                takeoff_xy_m=np.zeros(2), takeoff_yaw=float(rng.uniform(-0.10, 0.10)))  # fmt: skip
    spot = np.array([-24.0 + rng.uniform(-2.0, 2.0), plan.aisles()[0]])
    return replace(plan, takeoff_xy_m=spot)


def _on_node(value: float) -> float:
    return round((value + HALF_M) / NODE_M) * NODE_M - HALF_M


CONCRETE = Surface(land_class="building", reflectivity=0.36)
UNIT = Surface(land_class="building", reflectivity=0.45)
GLASS = Surface(land_class="building", reflectivity=0.10)
STOP = Surface(land_class="other", reflectivity=0.30)
FALL = 0.015
"""Slope of the deck towards the gullies in the aisles' middle lines."""
PARAPET_M = 1.1
_CONCRETE_RGBA = [0.70, 0.69, 0.66, 1.0]
_STOP_RGBA = [0.60, 0.58, 0.50, 1.0]
_UNIT_RGBA = [0.74, 0.76, 0.77, 1.0]
LINE_M = 0.10


def deck_heights(rng: np.random.Generator, plan: Plan, terrain: HeightField) -> Array:
    """(N, N) heights over the whole grid of ``terrain``: the ground's, and on the deck's nodes the
    deck's, whose take-off spot is at height 0."""
    xy = terrain.node_grid()
    nearest = np.min([np.abs(xy[..., 1] - aisle) for aisle in plan.aisles()], axis=0)
    uneven = 0.004 * fractal_noise(rng, xy.shape[:2], 3.0 / NODE_M, 3)
    deck = FALL * np.minimum(nearest, 9.0) + uneven - plan.ramp.depth(xy)
    level = HeightField(heights_m=deck).at(plan.takeoff_xy_m)
    return np.where(plan.inside(xy), deck - level, terrain.heights_m)


def write_deck(spec: Any, plan: Plan, both: HeightField, image: NDArray[np.uint8]) -> NDArray[Any]:
    """Fills the height field `deck` with the deck's part of ``both`` and returns its part of the
    ground texture."""
    first = np.round((plan.low_xy_m + HALF_M) / NODE_M).astype(int)
    last = np.round((plan.high_xy_m + HALF_M) / NODE_M).astype(int)
    heights = both.heights_m[first[1] : last[1] + 1, first[0] : last[0] + 1]
    lowest, span = float(heights.min()), float(np.ptp(heights))
    hfield = spec.hfield("deck")
    hfield.nrow, hfield.ncol = heights.shape
    hfield.size = [*(0.5 * plan.size_m), span, plan.height_m - RAMP_DEPTH_M]
    hfield.userdata = ((heights - lowest) / span).astype(np.float32).ravel()
    spec.geom("path_deck").pos = [*plan.centre, lowest]
    texels = len(image) / (2.0 * HALF_M)
    left, right = np.round((np.array([plan.low_xy_m[0], plan.high_xy_m[0]]) + HALF_M) * texels)
    top, bottom = np.round((HALF_M - np.array([plan.high_xy_m[1], plan.low_xy_m[1]])) * texels)
    return image[int(top) : int(bottom), int(left) : int(right)]


def paint_deck(canvas: Canvas, plan: Plan, rng: np.random.Generator) -> None:
    """Paints bays, arrows, hatched areas, joints, gullies and stains."""
    low, high = plan.low_xy_m, plan.high_xy_m
    canvas.fill(WORLD.rectangle((low[0], high[0]), (low[1], high[1])), Ground.ROOF_DECK)
    ramp = plan.ramp
    ends = sorted((ramp.top_x_m, ramp.foot_x_m))
    canvas.fill(WORLD.rectangle((ends[0], ends[1]), (ramp.low_y_m, ramp.high_y_m)), Ground.ASPHALT)
    _paint_wear(canvas, plan, rng)
    lines = plan.bays_x()
    for mouth, head, _ in plan.rows():
        for x in lines:
            canvas.mark(WORLD.rectangle((x - 0.5 * LINE_M, x + 0.5 * LINE_M), (mouth, head)))
        if head != low[1] + EDGE_M:
            canvas.mark(WORLD.rectangle((lines[0], lines[-1]), (head - 0.05, head + 0.05)))
    for index, aisle in enumerate(plan.aisles()):
        way = 1.0 if index == 0 else -1.0
        for x in np.arange(lines[0] + 4.0, lines[-1] - 3.0, 11.0):
            _arrow(canvas, float(x), aisle, way)
    for x0, x1 in ((low[0] + EDGE_M, lines[0]), (lines[-1], high[0] - EDGE_M)):
        # Where rows end at the cross lanes: hatched noses.
        side = x0 if x0 == lines[-1] else x1
        nose = 1.2 * (1.0 if x0 == lines[-1] else -1.0)
        rows = plan.rows()
        _hatch(canvas, (side, side + nose), (rows[1][0], rows[2][0]))
    strip = float(plan.rows()[3][1])
    span = (plan.stairs_x_m - 4.5, plan.stairs_x_m + 4.5)
    _hatch(canvas, span, (strip + 0.4, strip + 1.4))
    beyond = (ends[0] - 0.2, ends[1] + 0.2)
    y = ramp.low_y_m - 0.95
    canvas.mark(WORLD.rectangle(beyond, (y - 0.08, y + 0.08)))
    for x in lines[3:-3:9]:
        _wheelchair(canvas, float(x) + 0.5 * BAY_WIDTH_M, plan.rows()[3][0] + 2.6)


def _hatch(canvas: Canvas, x: tuple[float, float], y: tuple[float, float]) -> None:
    """Oblique stripes in a frame."""
    x0, x1, y0, y1 = *sorted(x), *sorted(y)
    high = y1 - y0
    for start in np.arange(x0 - high, x1, 0.9):
        first, last = max(0.0, x0 - start), min(high, x1 - 0.2 - start)
        if last > first:
            foot, head = start + first, start + last
            canvas.mark(np.array([[foot, y0 + first], [foot + 0.2, y0 + first],
                                  [head + 0.2, y0 + last], [head, y0 + last]]))  # fmt: skip
    for edge in (y0, y1):
        canvas.mark(WORLD.rectangle((x0, x1), (edge - 0.05, edge + 0.05)))


def _arrow(canvas: Canvas, x: float, y: float, way: float) -> None:
    canvas.mark(WORLD.rectangle((x - way * 1.1, x + way * 0.6), (y - 0.08, y + 0.08)))
    tip = np.array([[x + way * 0.5, y - 0.36], [x + way * 1.5, y], [x + way * 0.5, y + 0.36]])
    canvas.mark(tip)


def _wheelchair(canvas: Canvas, x: float, y: float) -> None:
    """A ring with a back and a head, as on bays for the disabled."""
    circle = np.concatenate([unit_circle(24), unit_circle(24)[:1]])
    canvas.mark(np.array([x, y]) + np.concatenate([0.62 * circle, 0.48 * circle[::-1]]))
    canvas.mark(WORLD.rectangle((x - 0.14, x + 0.02), (y, y + 0.9)))
    canvas.mark(np.array([x - 0.05, y + 1.15]) + 0.17 * unit_circle(14))
    canvas.mark(WORLD.rectangle((x, x + 0.6), (y + 0.02, y + 0.15)))


def _paint_wear(canvas: Canvas, plan: Plan, rng: np.random.Generator) -> None:
    """Paints joints between slabs, sealed cracks, tyre tracks, gullies, oil under the bays."""
    low, high = plan.low_xy_m, plan.high_xy_m
    for x in np.arange(low[0] + 7.5, high[0] - 1.0, 7.5):
        canvas.trace(np.array([[x, low[1]], [x, high[1]]]), 0.05, 150)
    for y in (plan.rows()[1][1], plan.rows()[3][1] + 0.2):
        canvas.trace(np.array([[low[0], y], [high[0], y]]), 0.05, 150)
    for aisle in plan.aisles():
        for offset in (-1.9, -0.6, 0.6, 1.9):
            wander = 0.15 * np.sin(np.linspace(0.0, 9.0, 40) + rng.uniform(0.0, 6.0))
            x = np.linspace(low[0] + 2.0, high[0] - 2.0, 40)
            canvas.trace(np.column_stack([x, aisle + offset + wander]), 0.22, 26)
        for x in np.arange(low[0] + 6.0, high[0] - 3.0, 9.0):
            canvas.soil(WORLD.rectangle((x - 0.25, x + 0.25), (aisle - 0.2, aisle + 0.2)), 215)
    for mouth, head, _ in plan.rows():
        middle = 0.5 * (mouth + head)
        for x in plan.bays_x()[:-1] + 0.5 * BAY_WIDTH_M:
            if rng.random() < 0.7:
                spot = np.array([x, middle]) + rng.normal(0.0, [0.3, 0.8])
                blot = rng.uniform(0.10, 0.38) * unit_circle(12) * rng.uniform(0.7, 1.3, (12, 1))
                canvas.soil(spot + blot, int(rng.integers(30, 110)))
    for _ in range(26):
        spot = rng.uniform(low + 1.0, high - 1.0)
        steps = rng.normal(0.0, 0.22, (int(rng.integers(8, 30)), 2)) + rng.normal(0.0, 0.15, 2)
        line = np.clip(spot + np.cumsum(steps, axis=0), low + 0.3, high - 0.3)
        canvas.trace(line, 0.035, int(rng.integers(90, 200)))
    for _ in range(9):
        spot, reach = rng.uniform(low + 2.0, high - 2.0), rng.uniform(0.6, 2.2)
        damp = spot + reach * unit_circle(16) * rng.uniform(0.6, 1.2, (16, 1))
        canvas.soil(np.clip(damp, low, high), int(rng.integers(25, 60)))


def furnish_deck(builder: SceneBuilder, plan: Plan, models: Models) -> None:
    """Adds parapets, ramp walls, houses of stairs and lift, ventilation, lamps, wheel stops,
    cars."""
    rng = builder.rng
    builder.claim(plan.takeoff_xy_m, 6.5)
    _add_parapets(builder, plan)
    _add_ramp_house(builder, plan)
    _add_stair_house(builder, plan)
    rows = plan.rows()
    lines = plan.bays_x()
    for x in lines[4:-2:8]:
        spot = np.array([x, rows[1][1]])
        if builder.is_free(spot, 0.0):
            add_lamp(builder, spot, 0.5 * np.pi if rng.random() < 0.5 else -0.5 * np.pi, 5.0)
    _add_units(builder, plan)
    for mouth, head, heading in rows:
        stops = []
        inward = np.sign(mouth - head)
        for x in lines[:-1] + 0.5 * BAY_WIDTH_M:
            at = np.array([x, head + inward * 0.75])
            z = builder.terrain.point(*at)
            stops.append(box((0.85, 0.075, 0.06), (*at, z + 0.06)))
            middle = np.array([x, 0.5 * (mouth + head) + inward * 0.25]) + rng.normal(0.0, 0.12, 2)
            fraction = 0.62 if heading < 0.0 else 0.42
            if rng.random() < fraction and builder.is_free(middle, 0.6):
                turn = heading + (np.pi if rng.random() < 0.3 else 0.0) + rng.normal(0.0, 0.02)
                free = builder.occupied[:]
                park_car(builder, pick(rng, models), middle, turn)
                # Neighbours in the next bay are no obstacle.
                builder.occupied[:] = [*free, (middle, 0.9)]
        # A row each, since contacts use a mesh's convex hull.
        mesh = builder.mesh(builder.unique("wheel_stops"), MeshData.join(stops))
        builder.geom("wheel_stops", STOP, mesh=mesh, rgba=_STOP_RGBA)


def block(
    builder: SceneBuilder,
    stem: str,
    surface: Surface,
    first: Sequence[float],
    last: Sequence[float],
    rgba: list[float],
) -> None:
    """A box between two corners, (3,) world, with its shadow."""
    low, high = np.array(first, np.float64), np.array(last, np.float64)
    builder.geom(stem, surface, pos=0.5 * (low + high), box=0.5 * (high - low), rgba=rgba)
    half = 0.5 * (high - low)
    builder.cast_box((half[0], half[1]), (-half[2], half[2]), 0.0, 0.5 * (low + high))


def _add_parapets(builder: SceneBuilder, plan: Plan) -> None:
    """Adds a wall with a rail on it along every edge."""
    (x0, y0), (x1, y1) = plan.low_xy_m, plan.high_xy_m
    top, foot, wide = PARAPET_M, -0.5, 0.22
    runs = (((x0 - wide, y0 - wide), (x1 + wide, y0)), ((x0 - wide, y1), (x1 + wide, y1 + wide)),
            ((x0 - wide, y0), (x0, y1)), ((x1, y0), (x1 + wide, y1)))  # fmt: skip
    for low, high in runs:
        block(builder, "building_parapet", CONCRETE, [*low, foot], [*high, top - 0.15],
              _CONCRETE_RGBA)  # fmt: skip
        middle = 0.5 * (np.array(low) + np.array(high))
        half = np.maximum(0.5 * (np.array(high) - np.array(low)) - 0.07, 0.03)
        builder.geom("parapet_rail", STEEL, pos=[*middle, top + 0.05],
                     box=[*half, 0.04], rgba=[0.40, 0.43, 0.46, 1])  # fmt: skip


def _add_ramp_house(builder: SceneBuilder, plan: Plan) -> None:
    """Adds walls along the ramp, as thick as the node spacing in which the deck drops, and a flat
    roof over its foot."""
    ramp = plan.ramp
    away = np.sign(ramp.foot_x_m - ramp.top_x_m)
    x0, x1 = sorted((ramp.top_x_m, ramp.foot_x_m + away * 1.5 * NODE_M))
    low, top = -RAMP_DEPTH_M - 0.3, 1.0
    for y in (ramp.low_y_m, ramp.high_y_m - NODE_M):
        block(builder, "building_ramp_wall", CONCRETE, [x0, y, low], [x1, y + NODE_M, top],
              _CONCRETE_RGBA)  # fmt: skip
    foot = ramp.foot_x_m - away * 5.0
    lid = sorted((foot, ramp.foot_x_m + away * 1.5 * NODE_M))
    block(builder, "building_ramp_roof", CONCRETE, [lid[0], ramp.low_y_m - 0.3, top],
          [lid[1], ramp.high_y_m + 0.1, top + 0.3], [0.62, 0.61, 0.58, 1])  # fmt: skip
    end = sorted((ramp.foot_x_m, ramp.foot_x_m + away * 1.5 * NODE_M))
    block(builder, "building_ramp_gate", CONCRETE, [end[0], ramp.low_y_m, low],
          [end[1], ramp.high_y_m, top], [0.16, 0.16, 0.17, 1])  # fmt: skip
    builder.claim(np.array([0.5 * (x0 + x1), 0.5 * (ramp.low_y_m + ramp.high_y_m)]), 3.0)


def _add_stair_house(builder: SceneBuilder, plan: Plan) -> None:
    """Adds stairs and lift: a block with a door, a lower lift shaft beside it and a flat roof."""
    rng = builder.rng
    y1 = float(plan.high_xy_m[1])
    x, deep = plan.stairs_x_m, 4.6
    tint = _CONCRETE_RGBA if rng.random() < 0.5 else [0.62, 0.36, 0.28, 1.0]
    block(
        builder, "building_stairs", CONCRETE, [x - 3.4, y1 - deep, -0.3], [x + 1.2, y1, 2.9], tint
    )
    block(builder, "building_stairs_roof", CONCRETE, [x - 3.8, y1 - deep - 0.9, 2.9],
          [x + 1.6, y1, 3.15], [0.45, 0.46, 0.47, 1])  # fmt: skip
    block(builder, "building_lift", CONCRETE, [x + 1.2, y1 - 3.0, -0.3], [x + 3.9, y1, 4.1], tint)
    for left, rgba in ((x - 2.6, [0.15, 0.28, 0.45, 1]), (x - 0.9, [0.25, 0.32, 0.36, 1])):
        block(builder, "building_door", GLASS, [left, y1 - deep - 0.04, 0.05],
              [left + 1.2, y1 - deep, 2.2], rgba)  # fmt: skip
    builder.claim(np.array([x, y1 - 2.0]), 4.0)


def _add_units(builder: SceneBuilder, plan: Plan) -> None:
    """Adds ventilation units with fans and roof lights along the northern strip, between the stair
    house and the ramp."""
    rng = builder.rng
    strip = float(plan.rows()[3][1]) + 1.2, float(plan.high_xy_m[1]) - 1.0
    ramp = sorted((plan.ramp.top_x_m, plan.ramp.foot_x_m))
    found = 0
    for _ in range(60):
        x = rng.uniform(plan.low_xy_m[0] + 2.0, plan.high_xy_m[0] - 2.0)
        y = rng.uniform(strip[0] + 0.9, strip[1] - 0.9)
        spot = np.array([x, y])
        clear = x < ramp[0] - 3.5 or x > ramp[1] + 3.5
        if found >= 7 or not clear or not builder.is_free(spot, 1.5):
            continue
        found += 1
        builder.claim(spot, 1.5)
        z = builder.terrain.point(x, y)
        half = rng.uniform([0.6, 0.5], [1.3, 0.9])
        if rng.random() < 0.35:
            block(builder, "building_roof_light", GLASS, [*(spot - half), z],
                  [*(spot + half), z + 0.22], [0.42, 0.54, 0.62, 1])  # fmt: skip
            continue
        high = rng.uniform(0.8, 1.5)
        top = z + high
        block(
            builder, "building_unit", UNIT, [*(spot - half), z], [*(spot + half), top], _UNIT_RGBA
        )
        for dx in (-0.5, 0.5):
            builder.geom("building_fan", UNIT, cylinder=(0.36 * half[0], 0.05),
                         pos=[x + dx * half[0], y, top], rgba=[0.25, 0.26, 0.28, 1])  # fmt: skip
