"""The lane, the hillside that it follows, and the plots of the cottages."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from touchdown.scenes.api import Array
from touchdown.scenes.authoring.plots import Plot
from touchdown.scenes.authoring.relief import (
    NODES,
    Ditch,
    HeightField,
    Pad,
    dig_ditches,
    level_pads,
    level_takeoff,
    natural_ground,
    smoothstep,
)
from touchdown.scenes.authoring.streets import Street, smooth_line

HALF_M = 64.0
VERGE_M = 0.8
"""Level ground beside the lane."""
_LIFT_M = 40.0
"""`level_pads` keeps pads above 0: the hillside is shaped well above it and lowered at the end."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Plan:
    """``frame``: v points uphill, the lane runs about along u."""

    frame: Plot
    lane: Street
    below_deg: float
    """slope of the meadow below the lane"""
    above_deg: float
    """slope of the hill above it"""
    lawn_uv: Array
    """middle of a level drying green near the take-off spot"""
    takeoff_xy_m: Array
    takeoff_yaw: float


def draw_plan(rng: np.random.Generator) -> Plan:
    """Returns a lane with bends along the contour."""
    angle = 0.5 * np.pi * int(rng.integers(4)) + rng.uniform(-0.06, 0.06)
    frame = Plot(origin_xy_m=rng.uniform(-1.0, 1.0, 2), angle=angle)
    level, bend = rng.uniform(1.0, 4.0), rng.uniform(-4.5, 4.5, 5)
    corners = [(u, level + b) for u, b in zip((-84.0, -44.0, -8.0, 30.0, 84.0), bend, strict=True)]
    corners.insert(1, (-64.0, level + bend[0]))
    lane = Street(
        line_m=smooth_line(frame.points(np.array(corners))), width_m=rng.uniform(3.9, 4.7)
    )
    takeoff = np.array([-25.0, -20.0]) + rng.uniform(-1.5, 1.5, 2)
    return Plan(
        frame=frame,
        lane=lane,
        below_deg=rng.uniform(5.8, 8.0),
        above_deg=rng.uniform(7.5, 10.0),
        lawn_uv=takeoff + np.array([rng.uniform(10.0, 13.0), rng.uniform(2.0, 5.0)]),
        takeoff_xy_m=frame.points(takeoff),
        takeoff_yaw=float(angle + rng.uniform(-0.05, 0.05)),
    )


def hillside(plan: Plan, xy_m: Array) -> Array:
    """(..., 2) -> (...) metres: gentle near the lane, steeper above and below."""
    v = plan.frame.coordinates(xy_m)[..., 1]
    below = np.tan(np.deg2rad(plan.below_deg)) * np.minimum(v + 6.0, 0.0)
    above = np.tan(np.deg2rad(plan.above_deg)) * np.maximum(v - 14.0, 0.0)
    # Towards the border the slopes ease, as hills do.
    return 0.02 * v + below + above - 0.0022 * np.maximum(v - 40.0, 0.0) ** 2


def shape_ground(
    rng: np.random.Generator, plan: Plan, pads: list[Pad], ditches: list[Ditch]
) -> HeightField:
    """Returns hillside, terraces, and the lane as a bench along it; the take-off spot is at height
    0."""
    terrain = HeightField(heights_m=natural_ground(rng, NODES, HALF_M), half_m=HALF_M)
    xy = np.stack(terrain.node_grid(), axis=-1)
    heights = terrain.heights_m + hillside(plan, xy) + _LIFT_M
    heights = level_pads(dig_ditches(heights, xy, ditches), xy, pads)
    rough = HeightField(heights_m=heights, half_m=HALF_M)
    along_line = rough.at(plan.lane.line_m)
    window = np.hanning(61)
    padded = np.pad(along_line, 30, mode="edge")
    profile = np.convolve(padded, window / window.sum(), mode="valid")
    distance, along = plan.lane.nearest(xy)
    level = np.interp(along, 0.5 * np.arange(len(profile)), profile)
    half = 0.5 * plan.lane.width_m + VERGE_M
    heights = level + (heights - level) * smoothstep(half, half + 4.0, distance)
    return level_takeoff(heights, HALF_M, plan.takeoff_xy_m)
