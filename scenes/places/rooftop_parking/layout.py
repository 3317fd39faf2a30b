"""Plan of the building, the bays on its roof and the streets."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.api import Array
from touchdown.scenes.authoring.plots import Plot
from touchdown.scenes.authoring.streets import Street, smooth_line

HALF_M = 64.0
NODE_M = 2.0 / 3.0
"""Node spacing of ground and deck; three of it are 80 texels."""
STOREY_M = 2.9
BAY_DEPTH_M, BAY_WIDTH_M, AISLE_M = 5.0, 2.5, 6.5
RAMP_DEPTH_M = 3.1
STREET_M, PAVEMENT_M = 7.0, 2.4
EDGE_M = 1.0
"""From the parapet to the first marking."""


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
        share = (x - self.top_x_m) / (self.foot_x_m - self.top_x_m)
        inside = (y > self.low_y_m + 1e-6) & (y < self.high_y_m - 1e-6) & (share > 0) & (share <= 1)
        return np.where(inside, RAMP_DEPTH_M * share, 0.0)


@dataclass(frozen=True, kw_only=True, slots=True)
class Plan:
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
    takeoff_xy_m: Array
    takeoff_yaw: float

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

    def plot(self) -> Plot:
        return Plot(origin_xy_m=np.zeros(2), angle=0.0)


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
    return Plan(**{**{f: getattr(plan, f) for f in Plan.__slots__}, "takeoff_xy_m": spot})


def _on_node(value: float) -> float:
    return round((value + HALF_M) / NODE_M) * NODE_M - HALF_M
