"""Plan of the settlement's streets, and relief of the ground between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from touchdown.scenes.api import Array
from touchdown.scenes.authoring.plots import Plot
from touchdown.scenes.authoring.relief import (
    NODES,
    Ditch,
    HeightField,
    Mound,
    Pad,
    dig_ditches,
    level_pads,
    level_takeoff,
    natural_ground,
    raise_mounds,
    smoothstep,
)
from touchdown.scenes.authoring.streets import Street, smooth_line

HALF_M = 64.0
ROAD_DEPTH_M, GUTTER_M = 0.12, 0.45
TURNING_M = 7.2
"""Radius of the turning circle at the end of the close."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Plan:
    """``frame``: coordinates of the whole scene, its main street about along u. The green, with
    the take-off spot, lies in the quarter of negative u and v."""

    frame: Plot
    main: Street
    south: Street
    close: Street
    takeoff_xy_m: Array
    takeoff_yaw: float

    @property
    def streets(self) -> tuple[Street, Street, Street]:
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

    def street(corners: list[tuple[float, float]], width: float, pavement: float) -> Street:
        line = smooth_line(frame.points(np.array(corners)))
        return Street(line_m=line, width_m=width, pavement_m=pavement)

    level = rng.uniform(1.0, 5.0)
    swing = rng.uniform(2.0, 6.0) * (1.0 if rng.random() < 0.5 else -1.0)
    shape = ((-84.0, -1.0), (-45.0, -1.0), (-14.0, 0.5), (26.0, -0.3), (50.0, 1.0), (84.0, 1.0))
    corners = [(u, level + share * swing) for u, share in shape]
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
    rng: np.random.Generator, plan: Plan, pads: list[Pad], ditches: list[Ditch], mounds: list[Mound]
) -> HeightField:
    """Returns natural ground with mounds, ditches, pads and streets; the take-off spot is at height
    0."""
    terrain = HeightField(heights_m=natural_ground(rng, NODES, HALF_M), half_m=HALF_M)
    xy = np.stack(terrain.node_grid(), axis=-1)
    heights = terrain.heights_m + (0.30 - terrain.heights_m.mean())
    heights = level_pads(heights, xy, pads)
    heights = raise_mounds(dig_ditches(heights, xy, ditches), xy, mounds)
    heights = heights * smoothstep(0.5, 5.5, plan.pavement_distance(xy))
    heights = heights - ROAD_DEPTH_M * smoothstep(0.0, GUTTER_M, -plan.kerb_distance(xy))
    return level_takeoff(heights, HALF_M, plan.takeoff_xy_m)
