"""A single-beam laser altimeter that looks down along body -z."""

import math

import mujoco
import numpy as np

from touchdown.scenes.api import LAND_CLASSES, Scene, Surface
from touchdown.sim.airframe.vehicle import vehicle_body_id
from touchdown.sim.api import RangefinderParams, RangefinderSample
from touchdown.sim.lidar.surface_detail import SurfaceDetail
from touchdown.sim.noise import random_stream
from touchdown.sim.typing import Array

_RATED_REFLECTIVITY = 0.7
_WATER_HALF_ANGLE = math.radians(10.0)
"""Beyond it a rippled surface mirrors the beam away instead of sending it back."""
_WATER_REFLECTIVITY = 0.1
_UNKNOWN = Surface(land_class="other", reflectivity=0.3)
_SKIP_M = 0.01
_MAX_LAYERS = 8
_SEEN_GROUPS = np.array([1, 1, 1, 0, 0, 0], dtype=np.uint8)


class RangefinderSensor:
    """Slant range of one ray. The echo fades with reflectivity, incidence and the square of the
    distance: a surface of diffuse reflectivity rho under the incidence angle i is seen up to
    ``max_range_m`` sqrt(rho cos i / 0.7). Porous things (crowns, reeds) let the beam through at
    random, water sends it back near the vertical only. Over ``plants`` the echo comes from the mean
    height of the LIDAR's."""

    def __init__(
        self,
        scene: Scene,
        params: RangefinderParams,
        tick_hz: int,
        seed: int,
        plants: SurfaceDetail | None = None,
    ) -> None:
        if not 0.0 <= params.min_range_m < params.max_range_m:
            raise ValueError(
                f"rangefinder.min_range_m ({params.min_range_m:g}) must lie between 0 and "
                f"rangefinder.max_range_m ({params.max_range_m:g})"
            )
        self._scene, self._params, self._tick_hz = scene, params, tick_hz
        self._plants = plants
        self._mount = np.array(params.position_body_m)
        self._vehicle = vehicle_body_id(scene.model)
        self._rng = random_stream(seed, "rangefinder")
        self._geom_id = np.zeros(1, dtype=np.int32)
        self._normal = np.zeros(3)

    def sample(
        self, tick: int, data: mujoco.MjData, rotation: Array, position: Array
    ) -> RangefinderSample:
        """The reading from a true world_from_body pose. ``data`` holds the kinematics of now or of
        the last tick."""
        start = position + rotation @ self._mount
        noise = self._rng.standard_normal()
        distance = self._cast(data, start, -rotation[:, 2])
        p = self._params
        if distance > 0.0:
            measured = distance + p.sigma_m * noise
            distance = p.resolution_m * round(measured / p.resolution_m)
        return RangefinderSample(tick=tick, time_s=tick / self._tick_hz, range_m=max(distance, 0.0))

    def _cast(self, data: mujoco.MjData, start: Array, direction: Array) -> float:
        """Metres to the surface that sends the beam back, 0 for none."""
        travelled = 0.0
        for _ in range(_MAX_LAYERS):
            step = mujoco.mj_ray(
                self._scene.model,
                data,
                start + travelled * direction,
                direction,
                _SEEN_GROUPS,
                True,
                self._vehicle,
                self._geom_id,
                self._normal,
            )
            if step < 0.0:
                return 0.0
            travelled += float(step)
            surface = self._surface(start + travelled * direction)
            if surface.porosity <= 0.0 or self._rng.random() >= surface.porosity:
                cosine = abs(float(self._normal @ direction))
                travelled -= self._in_plants(start + travelled * direction, travelled, cosine)
                return travelled if self._echoes(surface, travelled, cosine) else 0.0
            travelled += _SKIP_M
        return 0.0

    def _in_plants(self, point: Array, distance: float, cosine: float) -> float:
        """Metres of the way to ``point`` (3,), world frame, that lie behind the plants' echo."""
        plants = self._plants
        if plants is None or int(self._geom_id[0]) != plants.optics.ground_geom or cosine <= 0.0:
            return 0.0
        height = plants.visible_height_m(point[:1], point[1:2], distance * cosine)
        return float(height[0]) / cosine

    def _echoes(self, surface: Surface, distance: float, cosine: float) -> bool:
        rho = surface.reflectivity
        if surface.water:
            if cosine < math.cos(_WATER_HALF_ANGLE):
                return False
            rho = _WATER_REFLECTIVITY
        p = self._params
        reach = p.max_range_m * min(1.0, math.sqrt(rho * cosine / _RATED_REFLECTIVITY))
        return p.min_range_m <= distance <= reach

    def _surface(self, point: Array) -> Surface:
        """What was hit at ``point`` (3,), world frame."""
        name = self._scene.model.geom(int(self._geom_id[0])).name
        surface = self._scene.surfaces.get(name, _UNKNOWN)
        ground = self._scene.ground
        if ground is None or name != ground.geom_name:
            return surface
        col, row = np.floor((point[:2] - ground.origin_xy_m) / ground.cell_m).astype(int)
        rows, cols = ground.class_id.shape
        if not (0 <= row < rows and 0 <= col < cols):
            return surface
        return Surface(
            land_class=surface.land_class,
            reflectivity=float(ground.reflectivity[row, col]),
            water=bool(ground.class_id[row, col] == LAND_CLASSES.index("water")),
        )
