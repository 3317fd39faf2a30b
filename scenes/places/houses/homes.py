"""A house with its drive, front garden and back garden."""

from dataclasses import dataclass

import numpy as np

from touchdown.scenes.api import Surface
from touchdown.scenes.authoring.builder import SceneBuilder
from touchdown.scenes.authoring.ground import Canvas, Ground
from touchdown.scenes.authoring.plane import pick
from touchdown.scenes.authoring.plots import Plot, scatter
from touchdown.scenes.authoring.relief import Pad
from touchdown.scenes.props.cars import Models, park_car
from touchdown.scenes.props.garden import (
    add_crop_rows,
    add_greenhouse,
    add_shed,
    add_table,
    add_toys,
    add_trampoline,
    add_washing_line,
)
from touchdown.scenes.props.houses import House, HouseLooks, add_house
from touchdown.scenes.props.plants import Nursery, add_bush, add_hedge, add_small_tree, add_tree
from touchdown.scenes.props.playground import add_swing
from touchdown.scenes.props.pools import Pool, add_pool, kidney_outline, rectangle_outline
from touchdown.scenes.props.street import add_bin, add_fence

DOOR = Surface(land_class="building", reflectivity=0.35)
GARDENS = ("pool", "play", "vegetables", "lawn", "orchard")
DRIVE_M = 3.0
SETBACK_M = 5.5
"""From the pavement to the house front."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Home:
    """plot: u along the street, v away from it; width_m, depth_m: its size."""

    plot: Plot
    width_m: float
    depth_m: float
    house: House
    drive_u: float
    """middle of the drive"""
    garden: str
    """one of GARDENS"""
    has_garage: bool
    pool: Pool | None

    @property
    def front_v(self) -> float:
        return float(self.plot.coordinates(self.house.centre_xy_m)[1]) - 0.5 * self.house.size_m[1]

    @property
    def back_v(self) -> float:
        return self.front_v + self.house.size_m[1]

    @property
    def house_u(self) -> float:
        return float(self.plot.coordinates(self.house.centre_xy_m)[0])

    def pads(self) -> list[Pad]:
        """Level ground for the house with its drive, and for a pool."""
        middle_v = 0.5 * (self.front_v + self.back_v) - 1.0
        half = 0.5 * self.width_m - 0.8, 0.5 * self.house.size_m[1] + 3.0
        pads = [self.plot.pad(0.5 * self.width_m, middle_v, half, 2.5)]
        if self.pool is not None:
            low, high = self.pool.box_m
            middle, reach = 0.5 * (low + high), 0.5 * (high - low) + 1.3
            half = float(reach[0]), float(reach[1])
            pads.append(self.plot.pad(float(middle[0]), float(middle[1]), half, 2.0))
        return pads


def draw_home(
    rng: np.random.Generator, plot: Plot, width: float, depth: float, garden: str
) -> Home:
    """Returns a house of a size that fits the plot, its drive on one side."""
    left = bool(rng.random() < 0.5)
    drive_u = 2.1 if left else width - 2.1
    length = float(np.clip(width - 7.6, 7.5, 11.5))
    across = rng.uniform(7.2, 8.8)
    middle = 4.4 + 0.5 * length if left else width - 4.4 - 0.5 * length
    style = rng.choice(["gable", "gable", "hip", "flat"])
    storeys = float(rng.choice([2.8, 5.6]))
    ridge = 0.0 if style == "flat" else rng.uniform(2.4, 3.4)
    setback = SETBACK_M + rng.uniform(0.0, 1.5)
    house = House(centre_xy_m=plot.at(middle, setback + 0.5 * across), angle=plot.angle,
                  size_m=(length, across, storeys + (0.5 if style == "flat" else 0.0)),
                  ridge_m=ridge, hipped=style == "hip")  # fmt: skip
    pool = None
    if garden == "pool":
        u, v = 0.5 * width + rng.uniform(-1.5, 1.5), setback + across + 6.9
        if rng.random() < 0.5:
            outline = rectangle_outline(u, v, 7.0, 3.6, 0.3)
        else:
            outline = kidney_outline(rng, u, v, 2.7)
        pool = Pool(plot=plot, outline_m=outline, covered=bool(rng.random() < 0.25))
    return Home(plot=plot, width_m=width, depth_m=depth, house=house, drive_u=drive_u,
                garden=garden, has_garage=bool(rng.random() < 0.5), pool=pool)  # fmt: skip


def paint_home(canvas: Canvas, home: Home, rng: np.random.Generator) -> None:
    """Paints drive, path, terrace, beds and the ground of the garden's use."""
    plot, u, front, back = home.plot, home.house_u, home.front_v, home.back_v
    paving = Ground.PAVERS if rng.random() < 0.6 else Ground.GRAVEL
    drive = (home.drive_u - 0.5 * DRIVE_M, home.drive_u + 0.5 * DRIVE_M)
    canvas.fill(plot.rectangle(drive, (-0.4, front + 5.5)), paving)
    canvas.fill(plot.rectangle((u - 0.6, u + 0.6), (-0.2, front)), Ground.PAVERS)
    half = 0.5 * home.house.size_m[0]
    canvas.fill(plot.rectangle((u - half, u - 1.0), (front - 1.0, front)), Ground.MULCH)
    terrace = Ground.PLANKS if rng.random() < 0.4 else Ground.PAVEMENT
    canvas.fill(plot.rectangle((u - 3.6, u + 2.6), (back, back + 3.4)), terrace)
    if home.pool is not None:
        low, high = home.pool.box_m
        deck = Ground.DECK if rng.random() < 0.6 else Ground.PLANKS
        span = (low[0] - 1.3, high[0] + 1.3), (low[1] - 1.2, high[1] + 1.2)
        canvas.fill(plot.rectangle(*span), deck)
    elif home.garden == "vegetables":
        canvas.fill(plot.rectangle((1.4, home.width_m - 5.0), _bed(home)), Ground.CROPS)
    elif home.garden == "play":
        canvas.fill(plot.rectangle((1.2, 4.2), (back + 1.0, back + 4.0)), Ground.SAND)
    elif home.garden == "orchard":
        canvas.fill(
            plot.rectangle((0.6, home.width_m - 0.6), (back + 6.0, home.depth_m)), Ground.MEADOW
        )


def _bed(home: Home) -> tuple[float, float]:
    return home.depth_m - 6.6, home.depth_m - 1.6


def build_home(
    builder: SceneBuilder, home: Home, looks: HouseLooks, nursery: Nursery, models: Models
) -> None:
    """Adds all objects of the plot but its fences."""
    rng, plot = builder.rng, home.plot
    add_house(builder, home.house, looks)
    door = builder.terrain.point(*home.house.centre_xy_m)
    builder.geom("building_door", DOOR, box=[0.55, 0.04, 1.08],
                 pos=[*plot.at(home.house_u, home.front_v - 0.03), door + 1.05], heading=plot.angle,
                 rgba=[*rng.uniform(0.2, 0.6, 3), 1.0])  # fmt: skip
    away = plot.away + (np.pi if rng.random() < 0.6 else 0.0)
    model = pick(rng, models)
    if home.has_garage:
        _add_garage(builder, home)
        if rng.random() < 0.5:
            park_car(builder, model, plot.at(home.drive_u, 2.9), away)
    else:
        park_car(builder, model, plot.at(home.drive_u, home.front_v - 0.5), away)
    if rng.random() < 0.45:
        ends = sorted((home.house_u - 1.2, 0.4 if home.drive_u > 5.0 else home.drive_u + 2.0))
        if ends[1] - ends[0] > 2.0:
            add_hedge(builder, nursery, plot.at(ends[0], 0.8), plot.at(ends[1], 0.8), 0.9)
    if rng.random() < 0.3:
        add_bin(builder, plot.at(home.drive_u + 1.0, home.front_v - 3.2), [0.16, 0.30, 0.20, 1])
    _furnish(builder, home, nursery)


def _add_garage(builder: SceneBuilder, home: Home) -> None:
    v = home.front_v + 5.2
    spot = home.plot.at(home.drive_u, v)
    z = builder.terrain.point(*spot)
    heading = home.plot.angle
    builder.geom("building_garage", DOOR, box=[1.55, 2.9, 1.5], pos=[*spot, z + 1.0],
                 rgba=[0.80, 0.77, 0.72, 1], heading=heading)  # fmt: skip
    builder.geom("building_garage_roof", DOOR, box=[1.65, 3.0, 0.06], pos=[*spot, z + 2.55],
                 rgba=[0.34, 0.35, 0.36, 1], heading=heading)  # fmt: skip
    gate = home.plot.at(home.drive_u, v - 2.92)
    builder.geom("building_gate", DOOR, box=[1.25, 0.03, 1.05], pos=[*gate, z + 1.05],
                 rgba=[0.92, 0.92, 0.90, 1], heading=heading)  # fmt: skip
    builder.cast_box((1.6, 2.95), (0.0, 2.55), heading, np.array([*spot, z]))
    builder.claim(spot, 3.4)


def _furnish(builder: SceneBuilder, home: Home, nursery: Nursery) -> None:
    """The back garden."""
    rng, plot, width, back = builder.rng, home.plot, home.width_m, home.back_v
    inside = (1.8, width - 1.8)
    if home.pool is not None:
        add_pool(builder, home.pool)
    add_table(builder, plot.at(home.house_u - 0.6, back + 1.9), plot.angle)
    if home.pool is None and rng.random() < 0.8:
        size = (rng.uniform(2.4, 3.4), rng.uniform(1.9, 2.4), 2.0)
        add_shed(builder, plot.at(width - 2.6, home.depth_m - 2.4), plot.angle, size)
    if home.garden == "play":
        add_trampoline(builder, plot.at(width - 3.2, back + 4.2))
        add_swing(builder, plot.at(0.45 * width, back + 9.0), plot.angle)
        add_toys(builder, plot.at(3.0, back + 5.5))
    elif home.garden == "vegetables":
        low, high = _bed(home)
        bed = 0.5 * (width - 6.8), high - low - 0.4
        for fraction in (0.27, 0.75):
            u = 1.4 + fraction * (width - 6.4)
            middle = plot.at(u, 0.5 * (low + high))
            add_crop_rows(builder, middle, plot.angle, bed, rng.uniform(0.25, 0.6))
        if rng.random() < 0.6:
            add_greenhouse(builder, plot.at(width - 2.8, home.depth_m - 6.2), plot.away)
    elif home.garden == "lawn":
        v = back + rng.uniform(6.0, 8.0)
        add_washing_line(builder, plot.at(2.6, v), plot.at(width - 2.6, v + rng.uniform(-1, 1)))
    for spot in scatter(
        builder,
        plot,
        3 if home.garden == "orchard" else int(rng.random() < 0.3),
        inside,
        (back + 5, home.depth_m - 2),
        1.7,
    ):
        add_small_tree(builder, nursery, spot, rng.uniform(0.75, 1.0))
    if rng.random() < 0.25:
        for spot in scatter(builder, plot, 1, inside, (back + 6.0, home.depth_m - 2.5), 2.6):
            add_tree(builder, nursery, spot, rng.uniform(0.75, 0.95))
    for spot in scatter(builder, plot, 1, inside, (1.0, 4.0), 0.9):
        add_bush(builder, nursery, spot)


def fence_home(builder: SceneBuilder, home: Home, nursery: Nursery, first: bool) -> None:
    """Adds back boundary and the boundary at u = width; the one at u = 0 where it is the ``first``
    of a row. Fence or hedge."""
    rng, plot = builder.rng, home.plot
    tint = ([0.86, 0.85, 0.81, 1], [0.48, 0.36, 0.25, 1], [0.58, 0.47, 0.34, 1])
    colour = tint[int(rng.integers(3))]
    runs = [((0.4, home.depth_m), (home.width_m - 0.4, home.depth_m)),
            ((home.width_m, home.front_v), (home.width_m, home.depth_m - 0.3))]  # fmt: skip
    if first:
        runs.append(((0.0, home.front_v), (0.0, home.depth_m - 0.3)))
    for start, end in runs:
        if rng.random() < 0.4:
            add_hedge(builder, nursery, plot.at(*start), plot.at(*end), rng.uniform(1.2, 1.8))
        else:
            add_fence(builder, plot.at(*start), plot.at(*end), colour)
