"""`crossroad`: two crossing roads between houses, gardens and rugged lawns."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from touchdown.scenes.api import Array, Surface
from touchdown.scenes.authoring.builder import SceneBuilder
from touchdown.scenes.authoring.draft import SceneDraft
from touchdown.scenes.authoring.generation import finish, paint_terrain, scene_rng, start_scene
from touchdown.scenes.authoring.ground import Canvas, Ground
from touchdown.scenes.authoring.plane import pick, unit, unit_circle
from touchdown.scenes.authoring.plots import scatter
from touchdown.scenes.authoring.relief import HALF_M, Ditch, Pad
from touchdown.scenes.authoring.streets import trace_crack
from touchdown.scenes.places.crossroad import layout
from touchdown.scenes.props import plants
from touchdown.scenes.props.cars import Models, add_car_models, park_car
from touchdown.scenes.props.houses import House, add_house
from touchdown.scenes.props.street import add_bench, add_bin, add_fence, add_lamp, add_sign

STRAW = Surface(land_class="other", reflectivity=0.5)
DEPTH_M = 44.0
"""How far a quarter surely reaches from the roads."""


@dataclass(kw_only=True, slots=True)
class Theme(ABC):
    """Use of a quarter: its relief first, then its texture, then its objects."""

    quarter: layout.Quarter
    rng: np.random.Generator
    pads: list[Pad] = field(default_factory=list)
    ditches: list[Ditch] = field(default_factory=list)
    openings: list[tuple[Array, float]] = field(default_factory=list)

    def at(self, s: float, t: float) -> Array:
        return self.quarter.points(np.array([s, t]))

    def pad(self, s: float, t: float, half: tuple[float, float], blend_m: float = 3.0) -> None:
        pad = Pad(centre_xy_m=self.at(s, t), half_size_m=np.array(half), blend_m=blend_m,
                  angle=self.quarter.plan.main.angle)  # fmt: skip
        self.pads.append(pad)

    @abstractmethod
    def paint(self, canvas: Canvas) -> None: ...

    @abstractmethod
    def build(self, builder: SceneBuilder, nursery: plants.Nursery, models: Models) -> None: ...


class Homes(Theme):
    """Two houses with gardens, driveways, hedges and a shed."""

    def __init__(self, quarter: layout.Quarter, rng: np.random.Generator) -> None:
        super().__init__(quarter=quarter, rng=rng)
        self.plots: list[tuple[float, House]] = []
        for first in (2.0, 23.0):
            middle = first + 8.2 + rng.uniform(-0.8, 0.8)
            size = (rng.uniform(9.0, 11.5), rng.uniform(7.6, 9.0), float(rng.choice([2.8, 5.6])))
            setback = 9.5 + rng.uniform(0.0, 3.0)
            house = House(centre_xy_m=self.at(middle, setback), angle=quarter.plan.main.angle,
                          size_m=size, ridge_m=rng.uniform(2.6, 3.6))  # fmt: skip
            self.plots.append((first, house))
            self.pad(middle, setback, (0.5 * size[0] + 2.0, 0.5 * size[1] + 2.0))
            self.pad(first + 17.0, 6.0, (1.6, 6.5), 2.0)
            self.openings.append(
                (self.quarter.points(np.array([first + 17.0, -quarter.plan.pavement_m])), 1.9)
            )

    def paint(self, canvas: Canvas) -> None:
        quarter = self.quarter
        for first, house in self.plots:
            s, t = quarter.coordinates(house.centre_xy_m)
            length, width, _ = house.size_m
            canvas.fill(
                quarter.rectangle((first + 15.5, first + 18.5), (-0.2, 12.5)), Ground.PAVERS
            )
            front, back = t - 0.5 * width, t + 0.5 * width
            canvas.fill(quarter.rectangle((s - 0.7, s + 0.7), (-0.2, front)), Ground.PAVERS)
            canvas.fill(quarter.rectangle((s - 4.0, s + 2.5), (back, back + 4.0)), Ground.PAVEMENT)
            bed = (s - 0.5 * length, s - 1.2), (front - 1.1, front)
            canvas.fill(quarter.rectangle(*bed), Ground.MULCH)
            canvas.fill(quarter.rectangle((first + 1.0, first + 5.5), (26.0, 31.0)), Ground.SOIL)

    def build(self, builder: SceneBuilder, nursery: plants.Nursery, models: Models) -> None:
        rng, quarter = self.rng, self.quarter
        for first, house in self.plots:
            add_house(builder, house)
            s, t = quarter.coordinates(house.centre_xy_m)
            way = quarter.away + (np.pi if rng.random() < 0.5 else 0.0)
            park_car(builder, pick(rng, models), self.at(first + 17.0, 6.5), way)
            plants.add_hedge(builder, nursery, self.at(first, 0.9), self.at(s - 1.6, 0.9), 0.9)
            plants.add_hedge(
                builder, nursery, self.at(s + 1.6, 0.9), self.at(first + 14.6, 0.9), 0.9
            )
            shed = House(centre_xy_m=self.at(first + 15.5, 30.0), angle=house.angle,
                         size_m=(3.0, 2.4, 2.1), ridge_m=0.7)  # fmt: skip
            add_house(builder, shed)
            back = t + 0.5 * house.size_m[1]
            add_bench(builder, self.at(s - 1.0, back + 2.2), quarter.away)
            add_bin(builder, self.at(first + 14.4, 4.0), [0.16, 0.30, 0.20, 1])
        fence = [0.86, 0.85, 0.81, 1] if rng.random() < 0.5 else [0.48, 0.36, 0.25, 1]
        for s in (1.0, 21.8, 42.5):
            add_fence(builder, self.at(s, 2.2), self.at(s, 33.5), fence)
        plants.add_hedge(builder, nursery, self.at(1.4, 34.0), self.at(21.4, 34.0), 1.7)
        plants.add_hedge(builder, nursery, self.at(22.2, 34.0), self.at(42.0, 34.0), 1.7)
        for spot in scatter(builder, self, int(rng.integers(4, 7)), (4.0, 40.0), (21.0, 31.0), 2.6):
            plants.add_tree(builder, nursery, spot, rng.uniform(0.7, 1.0))
        for spot in scatter(builder, self, 6, (3.0, 41.0), (2.5, 32.0), 1.0):
            plants.add_bush(builder, nursery, spot)
        for spot in scatter(builder, self, 3, (3.0, 42.0), (37.0, DEPTH_M), 2.6):
            plants.add_tree(builder, nursery, spot, rng.uniform(0.9, 1.25))


class Shop(Theme):
    """A flat-roofed building behind a marked car park."""

    def __init__(self, quarter: layout.Quarter, rng: np.random.Generator) -> None:
        super().__init__(quarter=quarter, rng=rng)
        self.shift = rng.uniform(0.0, 6.0)
        length, width = rng.uniform(17.0, 21.0), rng.uniform(10.5, 13.0)
        size = (length, width, float(rng.choice([2.8, 5.6])) + 0.6)
        self.house = House(centre_xy_m=self.at(18.0 + self.shift, 29.0), size_m=size, ridge_m=0.0,
                           angle=quarter.plan.main.angle)  # fmt: skip
        self.pad(18.0 + self.shift, 29.0, (0.5 * size[0] + 2.5, 0.5 * size[1] + 2.5))
        self.pad(18.0 + self.shift, 12.0, (16.0, 9.0))
        self.gate = 30.5 + self.shift
        self.pad(self.gate, 2.0, (3.0, 3.0), 2.0)
        self.openings.append((self.at(self.gate, -quarter.plan.pavement_m), 3.4))

    def paint(self, canvas: Canvas) -> None:
        quarter, shift = self.quarter, self.shift
        canvas.fill(quarter.rectangle((2.0 + shift, 34.0 + shift), (3.5, 21.0)), Ground.CAR_PARK)
        drive = (self.gate - 2.8, self.gate + 2.8)
        canvas.fill(quarter.rectangle(drive, (-quarter.plan.pavement_m, 4.0)), Ground.CAR_PARK)
        s, t = quarter.coordinates(self.house.centre_xy_m)
        length, width, _ = self.house.size_m
        edge = (s - 0.5 * length - 1.6, s + 0.5 * length + 1.6)
        canvas.fill(quarter.rectangle(edge, (21.0, t + 0.5 * width + 1.6)), Ground.PAVEMENT)
        for row in (4.2, 15.6):
            for bay in np.arange(4.0, 25.6, 2.7):
                line = (bay + shift - 0.05, bay + shift + 0.05)
                canvas.mark(quarter.rectangle(line, (row, row + 5.0)))
            if row > 10.0:
                canvas.mark(
                    quarter.rectangle((4.0 + shift, 25.6 + shift), (row + 4.95, row + 5.05))
                )
        for bay in np.arange(4.0, 25.0, 2.7):
            for row in (6.5, 18.0):
                spot = self.at(bay + 1.35 + shift, row) + self.rng.normal(0.0, 0.3, 2)
                blot = self.rng.uniform(0.1, 0.4) * unit_circle(12)
                canvas.soil(spot + blot, int(self.rng.integers(30, 110)))
        for _ in range(9):
            start = self.at(self.rng.uniform(3, 33) + shift, self.rng.uniform(4, 20))
            trace_crack(canvas, self.rng, start)

    def build(self, builder: SceneBuilder, nursery: plants.Nursery, models: Models) -> None:
        rng, quarter, shift = self.rng, self.quarter, self.shift
        add_house(builder, self.house)
        for bay in np.arange(4.0, 24.0, 2.7):
            for row, toward in ((6.7, np.pi), (18.1, 0.0)):
                if rng.random() < 0.42:
                    way = quarter.away + toward + (np.pi if rng.random() < 0.3 else 0.0)
                    spot = self.at(bay + 1.35 + shift, row)
                    park_car(builder, pick(rng, models), spot, way)
        for s in (9.0, 23.0):
            add_lamp(builder, self.at(s + shift, 3.2), quarter.away, 5.5)
        plants.add_hedge(
            builder, nursery, self.at(1.0 + shift, 1.6), self.at(13.0 + shift, 1.6), 0.8
        )
        plants.add_hedge(
            builder, nursery, self.at(14.0 + shift, 1.6), self.at(26.5 + shift, 1.6), 0.8
        )
        for s in (6.5, 8.0):
            add_bin(builder, self.at(s + shift, 24.0), [0.25, 0.27, 0.30, 1])
        for spot in scatter(builder, self, 5, (2.0, DEPTH_M), (39.0, DEPTH_M), 2.8):
            plants.add_tree(builder, nursery, spot, rng.uniform(0.9, 1.25))
        for spot in scatter(builder, self, 4, (36.0 + shift, DEPTH_M + 2.0), (4.0, 38.0), 2.6):
            plants.add_tree(builder, nursery, spot, rng.uniform(0.8, 1.1))
        for spot in scatter(builder, self, 6, (2.0, DEPTH_M), (22.0, DEPTH_M), 1.0):
            plants.add_bush(builder, nursery, spot)


class Farm(Theme):
    """A bare field behind a ditch, hay bales on a meadow, a row of trees."""

    def __init__(self, quarter: layout.Quarter, rng: np.random.Generator) -> None:
        super().__init__(quarter=quarter, rng=rng)
        self.near = rng.uniform(17.0, 20.0)
        ditch_t = self.near - 3.5
        self.ditches.append(Ditch(start_xy_m=self.at(6.0, ditch_t),
                            end_xy_m=self.at(60.0, ditch_t + 1.0), depth_m=rng.uniform(0.5, 0.8),
                            half_width_m=1.7))  # fmt: skip

    def paint(self, canvas: Canvas) -> None:
        quarter = self.quarter
        canvas.fill(quarter.rectangle((0.5, 70.0), (1.5, 70.0)), Ground.MEADOW)
        canvas.fill(quarter.rectangle((7.0, 39.0), (self.near, 42.0)), Ground.SOIL)
        track = np.array([self.at(2.6, t) for t in np.arange(-0.5, 62.0, 2.0)])
        track += np.column_stack([0.35 * np.sin(np.arange(len(track))), np.zeros(len(track))])
        across = quarter.plan.main.along
        for side in (-0.75, 0.75):
            canvas.track(track + side * across, 0.6, Ground.WORN)
        ditch = self.ditches[0]
        canvas.track(np.array([ditch.start_xy_m, ditch.end_xy_m]), 0.9, Ground.WORN)

    def build(self, builder: SceneBuilder, nursery: plants.Nursery, models: Models) -> None:
        rng = self.rng
        builder.claim(self.at(20.0, 30.0), 6.0)
        for s in np.arange(11.0, 46.0, rng.uniform(6.5, 8.5)):
            spot = self.at(s + rng.uniform(-0.8, 0.8), self.near - 6.6)
            if builder.is_free(spot, 1.5):
                plants.add_tree(builder, nursery, spot, rng.uniform(0.85, 1.2))
        bales = scatter(builder, self, int(rng.integers(4, 7)), (41.5, 52.0), (18.0, 46.0), 1.6)
        for spot in bales:
            self._bale(builder, spot)
        plants.add_hedge(builder, nursery, self.at(7.0, 43.5), self.at(24.0, 43.5), 1.6)
        plants.add_hedge(builder, nursery, self.at(25.5, 43.5), self.at(41.0, 43.5), 1.6)
        add_fence(builder, self.at(5.0, 2.0), self.at(26.0, 2.0), [0.50, 0.40, 0.30, 1])
        add_fence(builder, self.at(26.0, 2.0), self.at(47.0, 2.0), [0.50, 0.40, 0.30, 1])
        for spot in scatter(builder, self, 7, (6.0, 46.0), (3.5, self.near - 6.0), 0.8):
            plants.add_rock(builder, spot, rng.uniform(0.22, 0.55))
        for spot in scatter(builder, self, 6, (5.0, 50.0), (3.5, 50.0), 1.0):
            plants.add_bush(builder, nursery, spot)

    def _bale(self, builder: SceneBuilder, spot: Array) -> None:
        """A round bale on its side."""
        radius, half = 0.72, 0.62
        turn = self.rng.uniform(0.0, np.pi)
        axis = half * np.array([np.cos(turn), np.sin(turn), 0.0])
        at = builder.on_ground(spot, radius) - [0.0, 0.0, 0.05]
        builder.geom("bale", STRAW, fromto=[*(at - axis), *(at + axis)], cylinder=radius,
                     rgba=[0.80, 0.68, 0.40, 1])  # fmt: skip
        across = np.array([-np.sin(turn), np.cos(turn), 0.0]) * radius
        up = np.array([0.0, 0.0, radius])
        rim = unit_circle(16) @ np.stack([across, up])
        builder.cast(np.concatenate([at - axis + rim, at + axis + rim]))


class Common(Theme):
    """A village green with a gravel path, benches and single trees: the take-off spot is here."""

    def __init__(self, quarter: layout.Quarter, rng: np.random.Generator) -> None:
        super().__init__(quarter=quarter, rng=rng)
        self.start = quarter.coordinates(quarter.plan.takeoff_xy_m)
        s = np.arange(-2.0, 80.0, 1.0)
        swing = rng.uniform(1.5, 3.0) * np.sin(s / rng.uniform(7.0, 10.0) + rng.uniform(0.0, 6.0))
        t = self.start[1] + 11.0 + rng.uniform(0.0, 2.0) + swing
        self.path = quarter.points(np.column_stack([s, t]))
        self.path_t = t

    def paint(self, canvas: Canvas) -> None:
        quarter = self.quarter
        far = float(self.path_t.max()) + 4.0
        edge = [self.at(s, far + 1.5 * np.sin(0.23 * s)) for s in np.arange(0.8, 70.0, 2.0)]
        canvas.fill(np.array([*edge, self.at(70.0, 75.0), self.at(0.8, 75.0)]), Ground.MEADOW)
        canvas.track(self.path, 2.0, Ground.GRAVEL)
        bed = self.at(8.0, 6.0)
        if float(np.hypot(*(bed - quarter.plan.takeoff_xy_m))) > 7.0:
            canvas.fill(bed + 1.9 * (1.3 * unit_circle(40)), Ground.MULCH)

    def build(self, builder: SceneBuilder, nursery: plants.Nursery, models: Models) -> None:
        rng, quarter = self.rng, self.quarter
        builder.claim(quarter.plan.takeoff_xy_m, 6.0)
        for spot in self.path[::2]:
            builder.claim(spot, 0.9)
        for index in (12, 30, 42):
            side = self.path[index] - 1.7 * unit(quarter.away)
            if builder.is_free(side, 0.0):
                add_bench(builder, side, quarter.away)
        for s in (9.0, 27.0):
            near = self.path[int(s) + 2] + 1.6 * unit(quarter.away)
            add_lamp(builder, near, quarter.away + np.pi, 4.2)
        for s in np.arange(5.0, 47.0, rng.uniform(8.0, 10.0)):
            spot = self.at(s, 2.4)
            if builder.is_free(spot, 1.5):
                plants.add_tree(builder, nursery, spot, rng.uniform(0.8, 1.05))
        for spot in scatter(builder, self, int(rng.integers(5, 8)), (3.0, 50.0), (6.0, 46.0), 3.0):
            plants.add_tree(builder, nursery, spot, rng.uniform(0.85, 1.3))
        for spot in scatter(builder, self, 6, (3.0, 50.0), (3.0, 48.0), 1.0):
            plants.add_bush(builder, nursery, spot)
        for spot in scatter(builder, self, 5, (3.0, 50.0), (24.0, 48.0), 0.9):
            plants.add_rock(builder, spot, rng.uniform(0.25, 0.6))


CAR_MODELS = 8


def generate(seed: int) -> SceneDraft:
    """Returns the scene of ``seed`` without the vehicle. The same seed gives the same bytes."""
    rng = scene_rng("crossroad", seed)
    plan = layout.draw_plan(rng)
    themes = draw_themes(rng, plan)
    pads = [pad for theme in themes for pad in theme.pads]
    ditches = [ditch for theme in themes for ditch in theme.ditches]
    terrain = layout.shape_ground(rng, plan, pads, ditches)
    builder = start_scene("crossroad", rng, terrain)
    moving = place_objects(builder, plan, themes)
    canvas = paint_ground(rng, plan, themes)
    ground = paint_terrain(builder, canvas, pattern_angles(rng, plan))
    return finish(plan, builder, ground, moving=moving)


def draw_themes(rng: np.random.Generator, plan: layout.Plan) -> list[Theme]:
    """Returns the green in the south-west; houses, a shop and a farm on the other plots in any
    order."""
    kinds: list[Callable[[layout.Quarter, np.random.Generator], Theme]] = [Homes, Shop, Farm]
    order = rng.permutation(3)
    themes: list[Theme] = [Common(layout.Quarter(plan=plan, signs=layout.QUADRANTS["SW"]), rng)]
    for name, index in zip(("NE", "NW", "SE"), order, strict=True):
        themes.append(
            kinds[int(index)](layout.Quarter(plan=plan, signs=layout.QUADRANTS[name]), rng)
        )
    return themes


def place_objects(builder: SceneBuilder, plan: layout.Plan, themes: list[Theme]) -> tuple[Any, ...]:
    """Adds all objects and cars. Returns the moving cars."""
    rng = builder.rng
    nursery = plants.plant_nursery(builder)
    models = add_car_models(builder, CAR_MODELS)
    builder.claim(plan.takeoff_xy_m, 6.0)
    openings = [opening for theme in themes for opening in theme.openings]
    layout.place_kerbs(builder, plan, openings)
    for theme in themes:
        theme.build(builder, nursery, models)
    scatter_edge_trees(builder, plan, nursery)
    for road in (plan.main, plan.side):
        low, high = road.ends_m()
        edge = 0.5 * road.width_m + 0.55
        for index, along in enumerate(np.arange(low + rng.uniform(6.0, 12.0), high - 3.0, 24.0)):
            side = 1.0 if index % 2 else -1.0
            if abs(along) > 12.0 and builder.is_free(road.point(along, side * edge), 0.3):
                heading = road.angle - side * 0.5 * np.pi
                add_lamp(builder, road.point(along, side * edge), heading)
        for sign in (1.0, -1.0):
            spot = road.point(sign * 16.5, sign * (0.5 * road.width_m + 0.6))
            if builder.is_free(spot, 0.2):
                heading = road.angle + (0.0 if sign > 0 else np.pi)
                red = [0.80, 0.10, 0.10, 1.0]
                add_sign(builder, spot, heading, red if road is plan.side else [0.1, 0.25, 0.65, 1])
    for along in (-34.0, 31.0):
        across = (1.0 if along < 0 else -1.0) * (0.5 * plan.side.width_m - 1.05)
        spot = plan.side.point(along + rng.uniform(-4.0, 4.0), across)
        heading = plan.side.angle + (0.0 if across < 0 else np.pi)
        if builder.is_free(spot, 1.0):
            park_car(builder, pick(rng, models), spot, heading)
    return layout.add_traffic(builder, plan, models, rng)


def scatter_edge_trees(builder: SceneBuilder, plan: layout.Plan, nursery: plants.Nursery) -> None:
    """Adds single trees on the outskirts, where the plots end."""
    rng = builder.rng
    for _ in range(14):
        angle = rng.uniform(0.0, 2.0 * np.pi)
        spot = rng.uniform(54.0, 61.0) * unit(angle)
        spot = np.clip(spot * 1.25, -HALF_M + 3.0, HALF_M - 3.0)
        if float(plan.kerb_distance(spot)) > plan.corridor_m + 2.5 and builder.is_free(spot, 2.8):
            plants.add_tree(builder, nursery, spot, rng.uniform(0.9, 1.3))


def paint_ground(rng: np.random.Generator, plan: layout.Plan, themes: list[Theme]) -> Canvas:
    """Paints materials, markings and stains: plots first, roads over them."""
    canvas = Canvas()
    for theme in themes:
        theme.paint(canvas)
    layout.paint_surfaces(canvas, plan)
    layout.wear_down(canvas, plan, rng)
    layout.paint_markings(canvas, plan)
    return canvas


def pattern_angles(rng: np.random.Generator, plan: layout.Plan) -> dict[Ground, float]:
    """Slabs along the roads, mowing stripes askew, furrows along or across."""
    angle = plan.main.angle
    turned = dict.fromkeys(Ground, angle)
    turned[Ground.SIDE_PAVEMENT] = plan.side.angle
    turned[Ground.LAWN] = angle + float(rng.uniform(0.3, 1.2))
    turned[Ground.SOIL] = angle + (0.5 * np.pi if rng.random() < 0.5 else 0.0)
    return turned
