"""Regular height fields, triangulated as MuJoCo triangulates them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from touchdown.scenes.api import Array


@dataclass(frozen=True, kw_only=True, slots=True)
class HeightField:
    """Heights at the nodes of a square grid, world frame.

    heights_m: (N, N) float64, row = y, column = x; node (0, 0) is at (-half_m, -half_m) and node
    (N-1, N-1) at (half_m, half_m).
    """

    heights_m: Array
    half_m: float

    @property
    def cell_m(self) -> float:
        """Distance between neighbouring nodes in metres."""
        return 2.0 * self.half_m / (self.heights_m.shape[0] - 1)

    def node_grid(self) -> tuple[Array, Array]:
        """(N, N) x and y of the nodes in metres."""
        axis = np.linspace(-self.half_m, self.half_m, self.heights_m.shape[0])
        x, y = np.meshgrid(axis, axis)
        return x, y

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
