"""The truly safe ground of a scene, and how far it is."""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from touchdown.scenes.api import Scene, TruthMaps
from touchdown.scenes.truth.maps import truth_maps
from touchdown.sim.typing import Array

MAX_DISTANCE_M = 20.0
_MAP_CELL_M = 0.25
_CLEAR_RADIUS_M = 3.0


@dataclass(frozen=True, slots=True)
class TaskScene:
    """A scene with its true safe ground."""

    scene: Scene
    maps: TruthMaps
    safe_distance_m: Array
    """(rows, cols) to the nearest safe cell, on the grid of ``maps``"""

    def distance_at(self, xy: Array) -> float:
        """Metres to the nearest safe point, at most 20; 20 outside of the maps."""
        cell = _cell_of(self.maps, xy)
        return MAX_DISTANCE_M if cell is None else float(self.safe_distance_m[cell])

    def highest_near(self, xy: Array) -> float:
        """Height of the highest surface within 3 m; 0 where there is none."""
        maps = self.maps
        row, col = np.floor((xy - maps.origin_xy_m) / maps.cell_m).astype(int)[::-1]
        reach = round(_CLEAR_RADIUS_M / maps.cell_m)
        window = maps.height_m[
            max(row - reach, 0) : row + reach + 1, max(col - reach, 0) : col + reach + 1
        ]
        seen = window[np.isfinite(window)]
        return float(seen.max()) if seen.size else 0.0


def task_scene(scene: Scene) -> TaskScene:
    """Returns the scene with its maps, of cells of 0.25 m."""
    maps = truth_maps(scene, _MAP_CELL_M)
    metres = ndimage.distance_transform_edt(~maps.safe) * maps.cell_m
    far = np.full(maps.safe.shape, MAX_DISTANCE_M)
    return TaskScene(scene, maps, np.minimum(metres, far) if maps.safe.any() else far)


def _cell_of(maps: TruthMaps, xy: Array) -> tuple[int, int] | None:
    col, row = np.floor((xy - maps.origin_xy_m) / maps.cell_m).astype(int)
    rows, cols = maps.safe.shape
    return (int(row), int(col)) if 0 <= row < rows and 0 <= col < cols else None
