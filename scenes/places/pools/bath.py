"""Basins, loungers, sunshades and buildings of the bath."""

from __future__ import annotations

import numpy as np

from touchdown.scenes.api import Array
from touchdown.scenes.authoring.builder import SceneBuilder
from touchdown.scenes.authoring.plane import pick
from touchdown.scenes.places.pools.layout import Plan
from touchdown.scenes.props.garden import SHED, add_table
from touchdown.scenes.props.houses import House, add_house
from touchdown.scenes.props.plants import Nursery, add_hedge
from touchdown.scenes.props.playground import add_flag
from touchdown.scenes.props.pools import (
    Pool,
    add_guard_chair,
    add_lounger,
    add_lounger_models,
    add_pool,
    add_umbrella,
    add_water_slide,
    add_whirlpool,
)
from touchdown.scenes.props.street import add_bench, add_bin, add_lamp

Shades = list[tuple[str, str]]
"""(mesh, material) of sunshades"""


def build_bath(builder: SceneBuilder, plan: Plan, nursery: Nursery, shades: Shades) -> None:
    """Adds all objects on the deck and behind it."""
    for pool in plan.pools:
        add_pool(builder, pool)
    _add_slide(builder, plan)
    _add_guards(builder, plan)
    _add_buildings(builder, plan)
    _add_loungers(builder, plan, shades)
    (u0, u1), (v0, v1) = plan.deck
    rng, frame = builder.rng, plan.frame
    for u in (u0 - 0.8, u1 + 0.8):
        for low, high in ((v0 + 2.0, v0 + 8.0), (v0 + 10.0, v1 - 1.0)):
            add_hedge(builder, nursery, frame.at(u, low), frame.at(u, high), 1.1)
    for u in np.arange(u0 + 6.0, u1, 21.0):
        spot = frame.at(u + rng.uniform(-1.0, 1.0), v1 - 0.7)
        if builder.is_free(spot, 0.3):
            add_lamp(builder, spot, frame.away + np.pi, 4.6)
    for u in (u0 + 3.0, u1 - 3.0):
        add_bin(builder, frame.at(u, v0 + 0.9), [0.20, 0.42, 0.62, 1])


def _add_slide(builder: SceneBuilder, plan: Plan) -> None:
    """Adds a chute that ends in the leisure pool, coming from behind it."""
    pool = plan.pool("leisure")
    low, high = pool.box_m
    u = 0.5 * (low[0] + high[0]) + builder.rng.uniform(-1.5, 1.5)
    inside = pool.outline_m[np.abs(pool.outline_m[:, 0] - u) < 1.2]
    add_water_slide(
        builder, plan.frame.at(u, float(inside[:, 1].max()) - 0.6), plan.frame.away + np.pi
    )


def _add_guards(builder: SceneBuilder, plan: Plan) -> None:
    low, high = plan.pool("lanes").box_m
    frame = plan.frame
    add_guard_chair(builder, frame.at(0.5 * (low[0] + high[0]), low[1] - 1.3), frame.away)
    # Starting blocks, one for each lane.
    lanes = plan.pool("lanes").lanes
    for lane in range(lanes):
        v = low[1] + (lane + 0.5) * (high[1] - low[1]) / lanes
        spot = frame.at(float(high[0]) + 0.75, float(v))
        z = builder.terrain.point(*spot)
        builder.geom("block", SHED, box=[0.28, 0.26, 0.32], pos=[*spot, z + 0.3],
                     heading=frame.angle, rgba=[0.92, 0.92, 0.9, 1])  # fmt: skip
        builder.claim(spot, 0.6)
    (u0, u1), (v0, _) = plan.deck
    spot = frame.at(u0 + 5.0 if builder.rng.random() < 0.5 else u1 - 5.0, v0 + 3.5)
    if builder.is_free(spot, 2.0):
        add_whirlpool(builder, spot)


def _add_buildings(builder: SceneBuilder, plan: Plan) -> None:
    """Adds the flat-roofed service building, a row of coloured cabins and a kiosk."""
    rng, frame, u = builder.rng, plan.frame, plan.house_u
    add_house(builder, House(centre_xy_m=frame.at(u, 36.5), angle=frame.angle,
              size_m=(rng.uniform(21.0, 25.0), rng.uniform(8.5, 10.0), 3.5),
              ridge_m=0.0))  # fmt: skip
    side = -1.0 if u > 0.0 else 1.0
    first = u + side * 17.0
    tints = (
        [0.80, 0.26, 0.20, 1],
        [0.93, 0.80, 0.28, 1],
        [0.22, 0.48, 0.70, 1],
        [0.93, 0.92, 0.88, 1],
    )
    for index in range(9):
        spot = frame.at(first + side * 1.55 * index, 34.5)
        z = builder.terrain.point(*spot)
        builder.geom("building_cabin", SHED, box=[0.74, 0.8, 1.25], pos=[*spot, z + 1.0],
                     heading=frame.angle, rgba=tints[index % 4])  # fmt: skip
        corners = [[*frame.at(first + side * 1.55 * index + sx * 0.74, 34.5 + sy * 0.8), z + h]
                   for sx in (-1, 1) for sy in (-1, 1) for h in (0.0, 2.25)]  # fmt: skip
        builder.cast(np.array(corners))
        builder.claim(spot, 1.1)
    kiosk = House(centre_xy_m=frame.at(first + side * 8.0, 41.0), angle=frame.angle,
                  size_m=(5.0, 4.0, 2.8), ridge_m=1.3, hipped=True)  # fmt: skip
    add_house(builder, kiosk)
    for index in range(3):
        add_table(builder, frame.at(first + side * (3.0 + 3.4 * index), 38.0), frame.angle)
    for index, rgba in enumerate(([0.2, 0.4, 0.7, 1], [0.92, 0.9, 0.88, 1], [0.8, 0.2, 0.2, 1])):
        add_flag(builder, frame.at(u - side * (14.0 + 1.8 * index), 43.0), 6.5, rgba)
    add_bench(builder, frame.at(u, 30.4), frame.away + np.pi)


def _add_loungers(builder: SceneBuilder, plan: Plan, shades: Shades) -> None:
    """Adds rows of loungers beside the basins, a sunshade between every other pair."""
    rng, frame = builder.rng, plan.frame
    loungers = add_lounger_models(builder, 5)
    (u0, u1), (v0, v1) = plan.deck
    for row in (v1 - 2.2, v0 + 2.4):
        heading = frame.away if row > 0.5 * (v0 + v1) else frame.away + np.pi
        for index, u in enumerate(np.arange(u0 + 2.0, u1 - 1.5, 1.75)):
            spot = frame.at(u, row + rng.normal(0.0, 0.12))
            if index % 3 == 2:
                shade = frame.at(u, row + 0.3 * np.sin(heading - frame.angle))
                if rng.random() < 0.7 and builder.is_free(shade, -0.2):
                    add_umbrella(builder, pick(rng, shades), shade)
            elif rng.random() < 0.8 and builder.is_free(spot, 0.0):
                model = pick(rng, loungers)
                add_lounger(builder, model, spot, heading + rng.normal(0.0, 0.06))


def outline(pool: Pool, beyond_m: float) -> Array:
    """(N, 2) world outline of a basin, widened."""
    middle = pool.outline_m.mean(axis=0)
    offset = pool.outline_m - middle
    reach = np.linalg.norm(offset, axis=1, keepdims=True)
    return pool.plot.points(middle + offset * (1.0 + beyond_m / reach))
