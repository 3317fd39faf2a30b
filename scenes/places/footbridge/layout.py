"""The stream or road, the bridge across it, and the ground that both are cut into."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from touchdown.scenes.api import Array
from touchdown.scenes.authoring.noise import fractal_noise
from touchdown.scenes.authoring.plots import Plot
from touchdown.scenes.authoring.relief import NODES, HeightField, natural_ground, smoothstep
from touchdown.scenes.authoring.streets import Street, smooth_line

HALF_M = 64.0
ROAD_M, VERGE_M = 7.0, 1.7
ROAD_DEPTH_M, GUTTER_M = 0.12, 0.45
LANDING_M = 1.6
"""Level ground between the top of the bank and the end of the deck's approach."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Bridge:
    """A deck that rises from both ends to its middle, with a ramp down from each end. Plot: ``u``
    along the deck from its middle, ``v`` to the left."""

    plot: Plot
    half_length_m: float
    width_m: float
    end_m: float
    """height of the deck's ends over the banks, which are about at height 0"""
    rise_m: float
    """of the middle over the ends"""
    ramp_m: float
    thick_m: float = 0.40

    def top(self, u: Array) -> Array:
        """World height of deck and ramps at ``u``; below the ground beyond the ramps."""
        u = np.abs(np.asarray(u, np.float64))
        deck = self.end_m + self.rise_m * (1.0 - (u / self.half_length_m) ** 2)
        ramp = self.end_m * (1.0 - (u - self.half_length_m) / self.ramp_m)
        return np.where(u <= self.half_length_m, deck, ramp)

    @property
    def reach_m(self) -> float:
        """From the middle to the foot of a ramp."""
        return self.half_length_m + self.ramp_m


@dataclass(frozen=True, kw_only=True, slots=True)
class Plan:
    """A course that winds from south to north and the bridge over it."""

    over_road: bool
    course: Street
    """the roadway, or the stream's bed"""
    floor_m: float
    """from the course's middle line to the foot of the bank"""
    bank_m: float
    """horizontal width of a bank"""
    depth_m: float
    """of the floor below the banks' top"""
    water_m: float
    """of the water over the stream's bed, 0: none"""
    bridge: Bridge
    takeoff_xy_m: Array
    takeoff_yaw: float

    @property
    def level_m(self) -> float:
        """World height of the water."""
        return self.water_m - self.depth_m

    def bank_distance(self, xy_m: Array) -> Array:
        """(..., 2) -> (...) metres to the top of the nearer bank, negative below it."""
        return self.course.nearest(xy_m)[0] - self.floor_m - self.bank_m


def draw_plan(rng: np.random.Generator) -> Plan:
    """Returns a stream or a road, east of a lawn for the take-off."""
    over_road = bool(rng.random() < 0.5)
    y = np.linspace(-HALF_M, HALF_M, 9)
    swing = rng.uniform(1.5, 3.0) if over_road else rng.uniform(3.0, 5.5)
    wave = swing * np.sin(2.0 * np.pi * y / rng.uniform(75.0, 110.0) + rng.uniform(0.0, 6.28))
    lean = rng.uniform(-0.10, 0.10)
    x = rng.uniform(-1.0, 5.0) + lean * y + wave - np.interp(0.0, y, wave)
    width = ROAD_M if over_road else rng.uniform(5.0, 7.0)
    course = Street(line_m=smooth_line(np.column_stack([x, y])), width_m=width, pavement_m=VERGE_M)
    floor = 0.5 * width + (VERGE_M if over_road else 0.0)
    bank = rng.uniform(6.0, 7.5) if over_road else rng.uniform(5.0, 7.0)
    middle = float(course.nearest(np.array([0.0, rng.uniform(-4.0, 6.0)]))[1])
    angle = course.heading(middle) - 0.5 * np.pi + rng.uniform(-0.06, 0.06)
    end = rng.uniform(1.3, 1.6) if over_road else rng.uniform(0.35, 0.6)
    half_length = floor + bank + LANDING_M
    bridge = Bridge(
        plot=Plot(origin_xy_m=course.point(middle, 0.0), angle=angle),
        half_length_m=half_length,
        width_m=rng.uniform(4.6, 5.6),
        end_m=end,
        # No steeper than 3.2 degrees at the ends.
        rise_m=float(rng.uniform(0.35, 0.5) * half_length * np.tan(np.deg2rad(3.2))),
        ramp_m=end * (11.0 if over_road else 14.0),
    )
    return Plan(over_road=over_road, course=course, floor_m=floor, bank_m=bank,
                depth_m=rng.uniform(3.5, 3.9) if over_road else rng.uniform(2.2, 3.0),
                water_m=0.0 if over_road else rng.uniform(0.55, 0.9), bridge=bridge,
                takeoff_xy_m=np.array([-40.0, -22.0]) + rng.uniform(-2.0, 2.0, 2),
                takeoff_yaw=float(rng.uniform(-0.10, 0.10)))  # fmt: skip


def shape_ground(rng: np.random.Generator, plan: Plan) -> Array:
    """Returns (N, N) heights without the water. The banks' tops are rugged lawns about height 0;
    level at 0 around the take-off spot and along the way over the bridge."""
    terrain = HeightField(heights_m=natural_ground(rng, NODES, HALF_M), half_m=HALF_M)
    xy = np.stack(terrain.node_grid(), axis=-1)
    heights = terrain.heights_m - terrain.heights_m.mean() + 0.15
    spot = np.linalg.norm(xy - plan.takeoff_xy_m, axis=-1)
    heights = heights * smoothstep(2.5, 7.0, spot)
    u, v = np.moveaxis(plan.bridge.plot.coordinates(xy), -1, 0)
    beyond = np.maximum(np.abs(u) - plan.bridge.reach_m - 3.0, 0.0)
    beside = np.maximum(np.abs(v) - 0.5 * plan.bridge.width_m - 1.0, 0.0)
    heights = heights * smoothstep(0.0, 5.0, np.hypot(beyond, beside))
    distance, _ = plan.course.nearest(xy)
    foot = distance - plan.floor_m
    if not plan.over_road:
        # A stream's banks are nowhere alike.
        ragged = fractal_noise(rng, heights.shape, 7.0 / terrain.cell_m, 3, 0.6)
        foot = foot + 0.7 * ragged * smoothstep(3.0, 9.0, np.abs(u) + np.abs(v))
    share = np.clip(foot / plan.bank_m, 0.0, 1.0)
    bank = 0.25 * smoothstep(0.0, 1.0, share) + 0.75 * share
    heights = heights * smoothstep(-3.0, 4.0, foot - plan.bank_m) - plan.depth_m * (1.0 - bank)
    if plan.over_road:
        return heights - ROAD_DEPTH_M * smoothstep(0.0, GUTTER_M, 0.5 * ROAD_M - distance)
    bed = 0.08 * fractal_noise(rng, heights.shape, 4.0 / terrain.cell_m, 3, 0.6)
    return heights + bed * (1.0 - share)
