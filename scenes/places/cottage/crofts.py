"""A cottage with its wing, courtyard, walls, kitchen garden and lawn."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.authoring.builder import GEOM, SceneBuilder, quat_z
from touchdown.scenes.authoring.ground import Canvas, Ground
from touchdown.scenes.authoring.lot import Lot, scatter
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

Array = NDArray[np.float64]
Models = list[tuple[str, str, CarShape]]

WIDTH_M, YARD_V, DEPTH_M = 21.0, 15.5, 29.0
"""Frontage, depth of the courtyard, and depth of the whole croft."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Croft:
    """lot: u along the lane, v away from it. The cottage stands at the back of the yard, the wing
    on the side of ``wing_u``."""

    lot: Lot
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
            self.lot.pad(0.5 * WIDTH_M, 7.4, (0.5 * WIDTH_M - 0.3, 8.0), 2.4),
            self.lot.pad(0.5 * WIDTH_M, 23.2, (0.5 * WIDTH_M - 0.5, 4.6), 2.4),
        ]


def draw_croft(rng: np.random.Generator, lot: Lot, clutter: str) -> Croft:
    """Returns a long low cottage and a shorter wing at a right angle."""
    left = bool(rng.random() < 0.5)
    length, width = rng.uniform(10.0, 12.5), rng.uniform(5.8, 6.6)
    wing_u = 3.4 if left else WIDTH_M - 3.4
    u = WIDTH_M - 1.2 - 0.5 * length if left else 1.2 + 0.5 * length
    house = House(
        centre_xy_m=lot.at(u, YARD_V - 1.2 - 0.5 * width), angle=lot.angle,
        size_m=(length, width, rng.uniform(2.5, 2.8)), ridge_m=rng.uniform(2.9, 3.5),
    )  # fmt: skip
    wing = House(
        centre_xy_m=lot.at(wing_u, rng.uniform(6.0, 7.0)), angle=lot.away,
        size_m=(rng.uniform(6.0, 7.5), 4.4, 2.4), ridge_m=2.1,
    )  # fmt: skip
    return Croft(
        lot=lot, house=house, wing=wing, wing_u=wing_u,
        gate_u=rng.uniform(9.0, 11.0), clutter=clutter,
        yard=Ground.COBBLES if rng.random() < 0.6 else Ground.GRAVEL,
    )  # fmt: skip


def paint_croft(canvas: Canvas, croft: Croft) -> None:
    """Paints cobbled yard, kitchen garden, lawn."""
    lot = croft.lot
    canvas.fill(lot.rectangle((0.4, WIDTH_M - 0.4), (0.4, YARD_V)), Ground.LAWN)
    inner = (4.6, WIDTH_M - 1.6) if croft.wing_u < 8.0 else (1.6, WIDTH_M - 4.6)
    canvas.fill(lot.rectangle(inner, (2.6, 8.4)), croft.yard)
    gate = (croft.gate_u - 1.5, croft.gate_u + 1.5)
    canvas.fill(lot.rectangle(gate, (-2.0, 3.0)), croft.yard)
    canvas.fill(lot.rectangle((0.4, WIDTH_M - 0.4), (YARD_V, DEPTH_M - 0.6)), Ground.LAWN)
    canvas.fill(lot.rectangle((1.2, 9.6), (19.4, 27.2)), Ground.SOIL)
    for first in (19.8, 23.6):
        canvas.fill(lot.rectangle((1.5, 9.3), (first, first + 3.0)), Ground.CROPS)
    canvas.fill(lot.rectangle((0.9, WIDTH_M - 0.9), (0.7, 1.9)), Ground.MULCH)


def build_croft(
    builder: SceneBuilder, croft: Croft, looks: HouseLooks, nursery: Nursery, models: Models
) -> None:
    """Adds all objects of the croft."""
    rng, lot = builder.rng, croft.lot
    for house in (croft.house, croft.wing):
        add_house(builder, house, looks)
    u, v = lot.coordinates(croft.house.centre_xy_m)
    z = builder.terrain.point(*croft.house.centre_xy_m)
    builder.geom(
        "building_door", WALL, type=GEOM.mjGEOM_BOX, size=[0.5, 0.04, 1.0], quat=quat_z(lot.angle),
        pos=[*lot.at(u + 0.4, v - 0.5 * croft.house.size_m[1] - 0.03), z + 1.0],
        rgba=[*rng.uniform([0.15, 0.2, 0.15], [0.5, 0.4, 0.5]), 1.0],
    )  # fmt: skip
    wall_m = rng.uniform(0.9, 1.15)
    gap = croft.gate_u - 1.6, croft.gate_u + 1.6
    add_stone_wall(builder, lot.points(np.array([[0.0, 10.0], [0.0, 0.3], [gap[0], 0.3]])), wall_m)
    edge = np.array([[gap[1], 0.3], [WIDTH_M, 0.3], [WIDTH_M, 10.0]])
    add_stone_wall(builder, lot.points(edge), wall_m)
    back = [[0.0, YARD_V + 1.2], [0.0, DEPTH_M], [WIDTH_M, DEPTH_M], [WIDTH_M, YARD_V + 1.2]]
    add_stone_wall(builder, lot.points(np.array(back)), 0.85)
    _clutter(builder, croft, models)
    add_crop_rows(builder, lot.at(5.4, 21.3), lot.angle, (7.4, 2.6), rng.uniform(0.25, 0.5))
    add_crop_rows(builder, lot.at(5.4, 25.1), lot.angle, (7.4, 2.6), rng.uniform(0.25, 0.5))
    _bean_poles(builder, lot.at(5.4, 18.6), lot.angle)
    if rng.random() < 0.5:
        add_greenhouse(builder, lot.at(WIDTH_M - 3.0, 26.6), lot.angle)
    else:
        add_shed(builder, lot.at(WIDTH_M - 2.8, 26.4), lot.angle, (3.2, 2.4, 2.0))
    for spot in scatter(builder, lot, 2, (11.0, WIDTH_M - 1.5), (18.0, 27.5), 1.8):
        add_small_tree(builder, nursery, spot, rng.uniform(0.75, 1.05))
    for spot in scatter(builder, lot, 2, (1.2, WIDTH_M - 1.2), (1.2, 1.6), 0.7):
        add_bush(builder, nursery, spot)


def _clutter(builder: SceneBuilder, croft: Croft, models: Models) -> None:
    """Adds objects that make the level courtyard unfit for landing."""
    rng, lot = builder.rng, croft.lot
    inner = (6.6, 18.4) if croft.wing_u < 8.0 else (2.6, 14.4)
    add_log_pile(builder, lot.at(inner[1] - 1.0, 7.3), lot.angle)
    if croft.clutter == "well":
        add_well(builder, lot.at(0.5 * sum(inner) + rng.uniform(-1, 1), 4.9), lot.angle)
        add_table(builder, lot.at(inner[0] + 1.2, 6.6), lot.angle)
    elif croft.clutter == "cart":
        add_cart(builder, lot.at(inner[0] + 2.0, 5.6), lot.angle + rng.uniform(-0.5, 0.5))
        model = models[int(rng.integers(len(models)))]
        park_car(builder, model, lot.at(croft.gate_u + 2.4, 5.0), lot.angle + 0.1)
    else:
        ends = lot.at(inner[0] + 0.3, 5.2), lot.at(inner[1] - 0.3, 4.4)
        add_washing_line(builder, *ends)
        add_toys(builder, lot.at(0.5 * sum(inner), 6.8))


def _bean_poles(builder: SceneBuilder, xy_m: Array, heading: float) -> None:
    """Three wigwams of thin canes, 2.1 m high."""
    along = np.array([np.cos(heading), np.sin(heading)])
    for reach in (-2.2, 0.0, 2.2):
        middle = xy_m + reach * along
        tip = np.array([*middle, builder.terrain.point(*middle) + 2.1])
        for angle in (0.4, 2.5, 4.6):
            foot = middle + 0.45 * np.array([np.cos(angle), np.sin(angle)])
            z = builder.terrain.point(*foot)
            add_wire(builder, np.array([*foot, z]), tip, 0.015, [0.62, 0.50, 0.32, 1])
        builder.claim(middle, 0.9)
