"""A cottage with its wing, courtyard, walls, kitchen garden and lawn."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from touchdown.scenes.api import Array
from touchdown.scenes.authoring.builder import SceneBuilder
from touchdown.scenes.authoring.ground import Canvas, Ground
from touchdown.scenes.authoring.plane import pick, unit
from touchdown.scenes.authoring.plots import Plot, scatter
from touchdown.scenes.authoring.relief import Pad
from touchdown.scenes.props.cars import CarShape, park_car
from touchdown.scenes.props.garden import (
    add_crop_rows,
    add_greenhouse,
    add_shed,
    add_table,
    add_toys,
    add_washing_line,
)
from touchdown.scenes.props.houses import WALL, House, HouseLooks, add_house
from touchdown.scenes.props.plants import Nursery, add_bush, add_small_tree
from touchdown.scenes.props.stonework import add_cart, add_log_pile, add_stone_wall, add_well
from touchdown.scenes.props.wires import add_wire

Models = list[tuple[str, str, CarShape]]

WIDTH_M, YARD_V, DEPTH_M = 21.0, 15.5, 29.0
"""Frontage, depth of the courtyard, and depth of the whole farmstead."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Farmstead:
    """plot: u along the lane, v away from it. The cottage stands at the back of the yard, the wing
    on the side of ``wing_u``."""

    plot: Plot
    house: House
    wing: House
    wing_u: float
    gate_u: float
    yard: Ground
    clutter: str
    """`well`, `cart` or `washing`"""

    def pads(self) -> list[Pad]:
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
    house = House(centre_xy_m=plot.at(u, YARD_V - 1.2 - 0.5 * width), angle=plot.angle,
                  size_m=(length, width, rng.uniform(2.5, 2.8)),
                  ridge_m=rng.uniform(2.9, 3.5))  # fmt: skip
    wing = House(centre_xy_m=plot.at(wing_u, rng.uniform(6.0, 7.0)), angle=plot.away,
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
    builder: SceneBuilder, farmstead: Farmstead, looks: HouseLooks, nursery: Nursery, models: Models
) -> None:
    """Adds all objects of the farmstead."""
    rng, plot = builder.rng, farmstead.plot
    for house in (farmstead.house, farmstead.wing):
        add_house(builder, house, looks)
    u, v = plot.coordinates(farmstead.house.centre_xy_m)
    z = builder.terrain.point(*farmstead.house.centre_xy_m)
    builder.geom("building_door", WALL, box=[0.5, 0.04, 1.0], heading=plot.angle,
                 pos=[*plot.at(u + 0.4, v - 0.5 * farmstead.house.size_m[1] - 0.03), z + 1.0],
                 rgba=[*rng.uniform([0.15, 0.2, 0.15], [0.5, 0.4, 0.5]), 1.0])  # fmt: skip
    wall_m = rng.uniform(0.9, 1.15)
    gap = farmstead.gate_u - 1.6, farmstead.gate_u + 1.6
    add_stone_wall(builder, plot.points(np.array([[0.0, 10.0], [0.0, 0.3], [gap[0], 0.3]])), wall_m)
    edge = np.array([[gap[1], 0.3], [WIDTH_M, 0.3], [WIDTH_M, 10.0]])
    add_stone_wall(builder, plot.points(edge), wall_m)
    back = [[0.0, YARD_V + 1.2], [0.0, DEPTH_M], [WIDTH_M, DEPTH_M], [WIDTH_M, YARD_V + 1.2]]
    add_stone_wall(builder, plot.points(np.array(back)), 0.85)
    _clutter(builder, farmstead, models)
    add_crop_rows(builder, plot.at(5.4, 21.3), plot.angle, (7.4, 2.6), rng.uniform(0.25, 0.5))
    add_crop_rows(builder, plot.at(5.4, 25.1), plot.angle, (7.4, 2.6), rng.uniform(0.25, 0.5))
    _bean_poles(builder, plot.at(5.4, 18.6), plot.angle)
    if rng.random() < 0.5:
        add_greenhouse(builder, plot.at(WIDTH_M - 3.0, 26.6), plot.angle)
    else:
        add_shed(builder, plot.at(WIDTH_M - 2.8, 26.4), plot.angle, (3.2, 2.4, 2.0))
    for spot in scatter(builder, plot, 2, (11.0, WIDTH_M - 1.5), (18.0, 27.5), 1.8):
        add_small_tree(builder, nursery, spot, rng.uniform(0.75, 1.05))
    for spot in scatter(builder, plot, 2, (1.2, WIDTH_M - 1.2), (1.2, 1.6), 0.7):
        add_bush(builder, nursery, spot)


def _clutter(builder: SceneBuilder, farmstead: Farmstead, models: Models) -> None:
    """Adds objects that make the level courtyard unfit for landing."""
    rng, plot = builder.rng, farmstead.plot
    inner = (6.6, 18.4) if farmstead.wing_u < 8.0 else (2.6, 14.4)
    add_log_pile(builder, plot.at(inner[1] - 1.0, 7.3), plot.angle)
    if farmstead.clutter == "well":
        add_well(builder, plot.at(0.5 * sum(inner) + rng.uniform(-1, 1), 4.9), plot.angle)
        add_table(builder, plot.at(inner[0] + 1.2, 6.6), plot.angle)
    elif farmstead.clutter == "cart":
        add_cart(builder, plot.at(inner[0] + 2.0, 5.6), plot.angle + rng.uniform(-0.5, 0.5))
        model = pick(rng, models)
        park_car(builder, model, plot.at(farmstead.gate_u + 2.4, 5.0), plot.angle + 0.1)
    else:
        ends = plot.at(inner[0] + 0.3, 5.2), plot.at(inner[1] - 0.3, 4.4)
        add_washing_line(builder, *ends)
        add_toys(builder, plot.at(0.5 * sum(inner), 6.8))


def _bean_poles(builder: SceneBuilder, xy_m: Array, heading: float) -> None:
    """Three wigwams of thin canes, 2.1 m high."""
    along = unit(heading)
    for reach in (-2.2, 0.0, 2.2):
        middle = xy_m + reach * along
        tip = builder.on_ground(middle, 2.1)
        for angle in (0.4, 2.5, 4.6):
            foot = middle + 0.45 * unit(angle)
            z = builder.terrain.point(*foot)
            add_wire(builder, np.array([*foot, z]), tip, 0.015, [0.62, 0.50, 0.32, 1])
        builder.claim(middle, 0.9)
