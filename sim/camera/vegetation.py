"""Plants in the picture: the terrain's height field, raised by the height from which light returns.

The LIDAR's pulses end in grass and crops some way above the ground; the camera draws the surface at
the mean height of their returns, so that depths of both agree. Physics and truth keep the ground.
"""

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from touchdown.scenes.api import Scene
from touchdown.sim.camera.visible import Terrain, heights_of
from touchdown.sim.geometry.tessellation import FIRST_HIDDEN_GROUP, may_move
from touchdown.sim.lidar.surface_detail import SurfaceDetail
from touchdown.sim.typing import Array

_CLEARANCE_M = 0.1
"""A camera lower than this above the plants' surface stands in them, and is shown the ground."""
_ENDLESS_M = 1e6


@dataclass(frozen=True)
class Vegetation:
    """Visible surface of the plants on a scene's terrain."""

    terrain: Terrain
    ground_m: Array
    """(rows, cols) heights of the ground at the vertices, world frame"""
    raised_m: Array
    """(rows, cols) heights of the plants' surface above it"""
    model: Any
    """mujoco.MjModel of nothing but height fields, the one of ``terrain`` with plants"""

    @staticmethod
    def of(scene: Scene, plants: SurfaceDetail | None) -> "Vegetation | None":
        """None where no plants are seen, or the ground is no level height field along x and y."""
        model = scene.model
        if plants is None or (geom := plants.optics.ground_geom) < 0:
            return None
        terrain = next((one for one in Terrain.all_of(model).values() if one.geom == geom), None)
        if terrain is None:
            return None
        rest = mujoco.MjData(model)
        mujoco.mj_kinematics(model, rest)
        field, origin, size = terrain.field, terrain.origin_m, model.hfield_size[terrain.field]
        data = heights_of(model, field).astype(np.float64)
        rows, cols = data.shape
        x = origin[0] + np.linspace(-size[0], size[0], cols)
        y = origin[1] + np.linspace(-size[1], size[1], rows)
        ground = origin[2] + size[2] * data
        places = [axis.ravel() for axis in np.meshgrid(x, y)]
        raised = plants.visible_height_m(*places).reshape(rows, cols)
        _keep_clear_of_objects(model, rest, geom, x, y, ground, raised)
        if not raised.any():
            return None
        fields = _fields(model, field, (data + raised / size[2]).ravel())
        return Vegetation(terrain, ground, raised, fields)

    def raised_at(self, x: Array, y: Array) -> Array:
        """(N,) heights of the plants' surface above the ground at places (N,); 0 beyond it."""
        return self._between(self.raised_m, x, y)

    def ground_at(self, x: Array, y: Array) -> Array:
        """(N,) heights of the ground at places (N,), world frame; 0 beyond it."""
        return self._between(self.ground_m, x, y)

    def hides(self, eye: Array) -> bool:
        """True where ``eye`` (3,), world frame, is in the plants or just above."""
        x, y = eye[:1], eye[1:2]
        raised = self.raised_at(x, y)[0]
        if raised <= 0.0:
            return False
        return bool(eye[2] < self.ground_at(x, y)[0] + raised + _CLEARANCE_M)

    def _between(self, heights: Array, x: Array, y: Array) -> Array:
        rows, cols = heights.shape
        origin, half = self.terrain.origin_m, self.terrain.half_m
        u = (x - origin[0] + half[0]) * (0.5 * (cols - 1) / half[0])
        v = (y - origin[1] + half[1]) * (0.5 * (rows - 1) / half[1])
        inside = (u >= 0.0) & (v >= 0.0) & (u <= cols - 1) & (v <= rows - 1)
        col = np.clip(np.floor(u), 0, cols - 2).astype(int)
        row = np.clip(np.floor(v), 0, rows - 2).astype(int)
        u, v = u - col, v - row
        low = (1.0 - u) * heights[row, col] + u * heights[row, col + 1]
        high = (1.0 - u) * heights[row + 1, col] + u * heights[row + 1, col + 1]
        return np.where(inside, (1.0 - v) * low + v * high, 0.0)


def _keep_clear_of_objects(
    model: Any,
    rest: mujoco.MjData,
    ground_geom: int,
    x: Array,
    y: Array,
    ground: Array,
    raised: Array,
) -> None:
    """No plants where they would bury a resting object that is lower than they are, such as a pad:
    at the vertices (rows of ``y``, columns of ``x``) in and next to its box."""
    step = max(x[1] - x[0], y[1] - y[0])
    for geom in range(model.ngeom):
        hidden = model.geom_group[geom] >= FIRST_HIDDEN_GROUP
        if geom == ground_geom or hidden or may_move(model, geom):
            continue
        middle, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
        if int(model.geom_type[geom]) == int(mujoco.mjtGeom.mjGEOM_PLANE):
            size = model.geom_size[geom, :2]
            middle, half = np.zeros(3), np.append(np.where(size > 0.0, size, _ENDLESS_M), 0.0)
        axes = rest.geom_xmat[geom].reshape(3, 3)
        center, reach = rest.geom_xpos[geom] + axes @ middle, np.abs(axes) @ half
        low, high = center - reach - step, center + reach + step
        cols = slice(*np.searchsorted(x, (low[0], high[0])).tolist())
        rows = slice(*np.searchsorted(y, (low[1], high[1])).tolist())
        top, bare = center[2] + reach[2], ground[rows, cols]
        buried = (top >= bare) & (top <= bare + raised[rows, cols])
        raised[rows, cols][buried] = 0.0


def _fields(model: Any, field: int, data: Array) -> mujoco.MjModel:
    """A model with the height field ``field`` of ``model`` under the same id, and this data."""
    rows, cols = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
    shapes = [(2, 2)] * field + [(rows, cols)]
    assets = "".join(
        f'<hfield name="{k}" nrow="{r}" ncol="{c}" size="1 1 1 1"/>'
        for k, (r, c) in enumerate(shapes)
    )
    small = mujoco.MjModel.from_xml_string(f"<mujoco><asset>{assets}</asset></mujoco>")
    small.hfield_size[field] = model.hfield_size[field]
    small.hfield_data[int(small.hfield_adr[field]) :] = data
    return small
