"""Shape of the ground: natural relief, pads, ditches and mounds."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from touchdown.scenes.api import Array
from touchdown.scenes.authoring.noise import fractal_noise

HALF_M = 64.0
"""Half the side of places"""
NODES = 193
TAKEOFF_FLAT_M = 2.0
TAKEOFF_BLEND_M = 5.0


@dataclass(frozen=True, kw_only=True, slots=True)
class Pad:
    """A rectangle that the ground is levelled for (a house, a car park, a terrace)."""

    centre_xy_m: Array
    half_size_m: Array
    angle: float
    blend_m: float = 3.0

    def distance(self, xy_m: Array) -> Array:
        """(..., 2) -> (...) metres to the rectangle, 0 inside."""
        c, s = np.cos(self.angle), np.sin(self.angle)
        local = (np.asarray(xy_m) - self.centre_xy_m) @ np.array([[c, -s], [s, c]])
        outside = np.maximum(np.abs(local) - self.half_size_m, 0.0)
        return np.hypot(outside[..., 0], outside[..., 1])


@dataclass(frozen=True, kw_only=True, slots=True)
class Ditch:
    """A drainage ditch along a segment."""

    start_xy_m: Array
    end_xy_m: Array
    depth_m: float
    half_width_m: float


@dataclass(frozen=True, kw_only=True, slots=True)
class Mound:
    """A round bell-shaped rise; the steepest slope, at ``radius_m`` from the middle, is
    0.61 height / radius."""

    centre_xy_m: Array
    height_m: float
    radius_m: float


def smoothstep(edge0: float, edge1: float, value: Array) -> Array:
    """Cubic ramp from 0 at ``edge0`` to 1 at ``edge1``."""
    t = np.clip((value - edge0) / (edge1 - edge0), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def segment_distance(xy_m: Array, start_xy_m: Array, end_xy_m: Array) -> Array:
    """(..., 2) -> (...) metres to the segment."""
    span = end_xy_m - start_xy_m
    t = np.clip((xy_m - start_xy_m) @ span / (span @ span), 0.0, 1.0)
    return np.linalg.norm(xy_m - start_xy_m - t[..., None] * span, axis=-1)


def cell_grid(count: int, half_m: float = HALF_M) -> Array:
    """(count, count, 2) world points of the middles of cells of a square, row 0 at y_min."""
    axis = (np.arange(count) + 0.5) / count * 2.0 * half_m - half_m
    return np.stack(np.meshgrid(axis, axis), axis=-1)


def natural_ground(rng: np.random.Generator, nodes: int = NODES) -> tuple[Array, Array]:
    """(nodes, nodes) metres: long swells, and hummocks of a step's size that come in patches, so
    that part of the lawns cannot be landed on; and (nodes, nodes, 2) world points of the nodes."""
    cell = 2.0 * HALF_M / (nodes - 1)
    shape = (nodes, nodes)
    swell = rng.uniform(0.35, 0.6) * fractal_noise(rng, shape, 38.0 / cell, 2, 0.35)
    hummocks = fractal_noise(rng, shape, 3.2 / cell, 3, 0.6)
    patches = smoothstep(-0.2, 1.1, fractal_noise(rng, shape, 16.0 / cell, 2).astype(np.float64))
    roughness = 0.006 + rng.uniform(0.07, 0.11) * patches
    heights = np.asarray(swell + roughness * hummocks, np.float64)
    return heights, HeightField(heights_m=heights).node_grid()


def dig_ditches(heights: Array, xy: Array, ditches: Iterable[Ditch]) -> Array:
    """Heights (N, N) at the nodes ``xy`` (N, N, 2) with ``ditches`` cut into them."""
    for ditch in ditches:
        distance = segment_distance(xy, ditch.start_xy_m, ditch.end_xy_m)
        heights = heights - ditch.depth_m * (1.0 - smoothstep(0.3, ditch.half_width_m, distance))
    return heights


def raise_mounds(heights: Array, xy: Array, mounds: Iterable[Mound]) -> Array:
    """Heights (N, N) at the nodes ``xy`` (N, N, 2) raised by ``mounds``."""
    for mound in mounds:
        reach = np.linalg.norm(xy - mound.centre_xy_m, axis=-1) / mound.radius_m
        heights = heights + mound.height_m * np.exp(-0.5 * reach**2)
    return heights


def level_pads(heights: Array, xy: Array, pads: Iterable[Pad]) -> Array:
    """Heights (N, N) at the nodes ``xy`` (N, N, 2) with each pad level at its mean height, never
    below 0.05 m."""
    for pad in pads:
        distance = pad.distance(xy)
        inside = distance <= 0.0
        level = max(float(heights[inside].mean()), 0.05) if inside.any() else 0.2
        heights = level + (heights - level) * smoothstep(0.4, pad.blend_m, distance)
    return heights


def level_takeoff(heights: Array, takeoff_xy_m: Array, half_m: float = HALF_M) -> "HeightField":
    """The terrain of ``heights`` (N, N) with a level disc of 2 m around the take-off spot, moved
    up or down so that the height there is 0."""
    terrain = HeightField(heights_m=heights, half_m=half_m)
    spot = np.linalg.norm(terrain.node_grid() - takeoff_xy_m, axis=-1)
    level = float(terrain.at(takeoff_xy_m))
    heights = level + (heights - level) * smoothstep(TAKEOFF_FLAT_M + 0.5, TAKEOFF_BLEND_M, spot)
    return HeightField(heights_m=heights - level, half_m=half_m)


@dataclass(frozen=True, kw_only=True, slots=True)
class HeightField:
    """Heights at the nodes of a square grid, world frame.

    heights_m: (N, N) float64, row = y, column = x; node (0, 0) is at (-half_m, -half_m) and node
    (N-1, N-1) at (half_m, half_m).
    """

    heights_m: Array
    half_m: float = HALF_M

    @property
    def cell_m(self) -> float:
        """Distance between neighbouring nodes in metres."""
        return 2.0 * self.half_m / (self.heights_m.shape[0] - 1)

    def node_grid(self) -> Array:
        """(N, N, 2) world points of the nodes."""
        axis = np.linspace(-self.half_m, self.half_m, self.heights_m.shape[0])
        return np.stack(np.meshgrid(axis, axis), axis=-1)

    def at(self, xy_m: Array) -> Array:
        """Height in metres at (..., 2) world points, exactly on MuJoCo's triangles: each cell is
        cut along the diagonal from (x_min, y_min) to (x_max, y_max). Points outside are clamped
        to the border."""
        heights = self.heights_m
        last = heights.shape[0] - 1
        grid = np.clip((np.asarray(xy_m) + self.half_m) / self.cell_m, 0.0, last - 1e-9)
        col, row = np.floor(grid[..., 0]).astype(int), np.floor(grid[..., 1]).astype(int)
        u, v = grid[..., 0] - col, grid[..., 1] - row
        h00, h10 = heights[row, col], heights[row, col + 1]
        h01, h11 = heights[row + 1, col], heights[row + 1, col + 1]
        lower = h00 + u * (h10 - h00) + v * (h11 - h10)
        upper = h00 + v * (h01 - h00) + u * (h11 - h01)
        return np.where(u >= v, lower, upper)

    def point(self, x_m: float, y_m: float) -> float:
        """Height in metres at one world point."""
        return float(self.at(np.array([x_m, y_m])))


def write_hfield(spec: Any, name: str, geom_name: str, terrain: HeightField, base_m: float) -> None:
    """Stores ``terrain`` in the MjSpec's height field ``name`` and lowers ``geom_name`` so that the
    surface lies at the world heights. MuJoCo keeps data in [0, 1] times the elevation scale."""
    lowest = float(terrain.heights_m.min())
    span = max(float(np.ptp(terrain.heights_m)), 1e-3)
    hfield = spec.hfield(name)
    rows, cols = terrain.heights_m.shape
    hfield.nrow, hfield.ncol = rows, cols
    hfield.size = [terrain.half_m, terrain.half_m, span, base_m]
    hfield.userdata = ((terrain.heights_m - lowest) / span).astype(np.float32).ravel()
    spec.geom(geom_name).pos = [0.0, 0.0, lowest]
