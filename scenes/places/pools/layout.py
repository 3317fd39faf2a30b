"""Plan of the bath: basins, deck, buildings and sports grounds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from touchdown.scenes.api import Array
from touchdown.scenes.authoring.ground import Ground
from touchdown.scenes.authoring.plane import unit
from touchdown.scenes.authoring.plots import Plot
from touchdown.scenes.authoring.relief import (
    NODES,
    HeightField,
    Mound,
    Pad,
    level_pads,
    level_takeoff,
    natural_ground,
    raise_mounds,
)
from touchdown.scenes.props.pools import Pool, kidney_outline, rectangle_outline

Span = tuple[float, float]

HALF_M = 64.0


@dataclass(frozen=True, kw_only=True, slots=True)
class Plan:
    """All spans in ``frame`` coordinates, (first, last) metres; the car park lies towards +v."""

    frame: Plot
    pools: tuple[Pool, ...]
    """lanes, leisure, covered, paddling: in no fixed order along u"""
    deck: tuple[Span, Span]
    pitch: tuple[Span, Span]
    pitch_ground: Ground
    court_uv: Array
    """middle of the beach court"""
    house_u: float
    """middle of the service building"""
    mounds: tuple[Mound, ...]
    takeoff_xy_m: Array
    takeoff_yaw: float

    def pads(self) -> list[Pad]:
        (u0, u1), (v0, v1) = self.deck
        (p0, p1), (q0, q1) = self.pitch
        pad = self.frame.pad
        return [
            # The paddling pool lies 5 m before the deck.
            pad(
                0.5 * (u0 + u1),
                0.5 * (v0 + v1) - 2.5,
                (0.5 * (u1 - u0) + 0.8, 0.5 * (v1 - v0) + 3.3),
            ),
            pad(0.5 * (p0 + p1), 0.5 * (q0 + q1), (0.5 * (p1 - p0) + 1.0, 0.5 * (q1 - q0) + 1.0)),
            pad(self.house_u, 36.0, (17.0, 7.5)),
            pad(0.0, 54.5, (40.0, 8.0)),
            pad(float(self.court_uv[0]), float(self.court_uv[1]), (9.5, 5.5), 2.0),
        ]

    def pool(self, kind: str) -> Pool:
        """`lanes`, `leisure`, `covered` or `paddling`."""
        return dict(zip(("lanes", "leisure", "covered", "paddling"), self.pools, strict=True))[kind]


def draw_plan(rng: np.random.Generator) -> Plan:
    """Returns three large basins side by side in any order, the paddling pool before them."""
    angle = 0.5 * np.pi * int(rng.integers(4)) + rng.uniform(-0.06, 0.06)
    frame = Plot(origin_xy_m=rng.uniform(-1.0, 1.0, 2), angle=angle)
    shift = rng.uniform(-1.5, 1.5)
    widths = {"lanes": 25.0, "leisure": 18.0, "covered": 9.0}
    order = [list(widths)[int(k)] for k in rng.permutation(3)]
    gap = rng.uniform(4.5, 6.0)
    start = -0.5 * (sum(widths.values()) + 2.0 * gap) + rng.uniform(-3.0, 3.0)
    middle: dict[str, float] = {}
    for kind in order:
        middle[kind] = start + 0.5 * widths[kind]
        start += widths[kind] + gap
    v = 15.5 + shift
    lanes = int(rng.integers(4, 7))
    outlines = {
        "lanes": rectangle_outline(middle["lanes"], v, 25.0, 2.1 * lanes, 0.15),
        "leisure": kidney_outline(rng, middle["leisure"], v - 0.5, rng.uniform(5.4, 6.2)),
        "covered": rectangle_outline(middle["covered"], v, 8.0, 5.5, 0.3),
    }
    small_u = middle["leisure"] + (13.5 if order.index("leisure") < 1 else -13.5)
    small_u = float(np.clip(small_u, -34.0, 34.0))
    turn = np.linspace(0.0, 2.0 * np.pi, 28, endpoint=False)
    round_ = 2.4 * unit(turn) + [small_u, v - 10.6]
    pools = (
        Pool(plot=frame, outline_m=outlines["lanes"], lanes=lanes),
        Pool(plot=frame, outline_m=outlines["leisure"]),
        Pool(plot=frame, outline_m=outlines["covered"], covered=True),
        Pool(plot=frame, outline_m=round_),
    )
    first = rng.uniform(-6.0, 1.0)
    takeoff = np.array([-25.0, -20.0]) + rng.uniform(-1.5, 1.5, 2)
    low = -28.0 + rng.uniform(-2.0, 2.0)
    slope = Mound(centre_xy_m=frame.at(rng.uniform(-42.0, -36.0), rng.uniform(-8.0, -3.0)),
                  height_m=rng.uniform(1.0, 1.5), radius_m=rng.uniform(4.0, 5.0))  # fmt: skip
    return Plan(
        frame=frame,
        pools=pools,
        deck=((-38.0, 38.0), (v - 9.0, v + 9.5)),
        pitch=((first, first + rng.uniform(34.0, 38.0)), (low, low + rng.uniform(20.0, 23.0))),
        pitch_ground=Ground.PITCH if rng.random() < 0.7 else Ground.CLAY,
        court_uv=np.array([-40.0 + rng.uniform(-3.0, 3.0), -39.0 + rng.uniform(-3.0, 1.0)]),
        house_u=rng.uniform(-14.0, 14.0),
        mounds=(slope,),
        takeoff_xy_m=frame.points(takeoff),
        takeoff_yaw=float(angle + rng.uniform(-0.05, 0.05)),
    )


def shape_ground(rng: np.random.Generator, plan: Plan) -> HeightField:
    """Returns uneven lawns with level pads below all buildings; the take-off spot is at height
    0."""
    terrain = HeightField(heights_m=natural_ground(rng, NODES, HALF_M), half_m=HALF_M)
    xy = np.stack(terrain.node_grid(), axis=-1)
    heights = terrain.heights_m + (0.35 - terrain.heights_m.mean())
    heights = level_pads(raise_mounds(heights, xy, plan.mounds), xy, plan.pads())
    return level_takeoff(heights, HALF_M, plan.takeoff_xy_m)
