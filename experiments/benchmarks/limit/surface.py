"""The true surface of a logged flight, and what rays meet there."""

from __future__ import annotations

import copy
import dataclasses
import warnings
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.config.schema import Config
from touchdown.experiments.flight.wiring import build_scene
from touchdown.sim.airframe.vehicle import sensor_mounts
from touchdown.sim.geometry.ray_target import Hits, RayTarget
from touchdown.sim.lidar.patterns.livox import PATTERNS
from touchdown.sim.lidar.range_errors import RangeErrors
from touchdown.sim.lidar.raycast_scene import FIRST_HIDDEN_GROUP, LidarScene
from touchdown.sim.lidar.rays import Rays
from touchdown.sim.lidar.surface_detail import SurfaceDetail

Array = NDArray[np.float64]

_SHIFT_M = 0.02
"""step of the differences of the reflectivity"""
_DARKEST = 1e-3


class Struck(NamedTuple):
    """What N rays meet."""

    distance: Array
    """(N,) m, inf for a miss"""
    normal: Array
    """(N, 3), towards the ray's origin"""
    hits: Hits


class TrueSurface:
    """The static scene of a flight. Moving bodies are left out; so are, in ``solid``, crowns and
    all else that lets pulses through."""

    def __init__(self, config: Config) -> None:
        scene = build_scene(config)
        everything = LidarScene(scene)
        self.mounts = sensor_mounts(scene.model)
        """true extrinsics"""
        self.optics = everything.optics
        model = copy.copy(scene.model)
        model.geom_group[self.optics.porosity > 0.0] = FIRST_HIDDEN_GROUP
        solid = LidarScene(dataclasses.replace(scene, model=model), self.optics)
        self.seen, self.solid = _target(everything), _target(solid)
        pattern = PATTERNS[config.lidar.preset]
        self._detail = SurfaceDetail.of(
            config.lidar, pattern, scene, self.optics, everything.on_mover
        )
        self._errors = RangeErrors.of(config.lidar, pattern, config.seed)

    def strike(self, target: RayTarget, origins: Array, directions: Array) -> Struck:
        """Casts rays (N, 3) and (N, 3) at `seen` or `solid`."""
        rays = _rays(origins, directions)
        hits = target.cast_all(rays)
        normal = target.embree(rays)["primitive_normals"].numpy().astype(np.float64)
        normal *= -np.sign(np.einsum("ni,ni->n", normal, directions))[:, None]
        return Struck(hits.distance.astype(np.float64), normal, hits)

    def reflectivity_gradient(
        self, origins: Array, directions: Array, hits: Hits
    ) -> tuple[Array, Array]:
        """Logarithm (N,) of the reflectivity, and its derivative (N, 2) in 1/m by a shift of the
        rays (N, 3), (N, 3) to the east and to the north."""
        middle = self._log_reflectivity(_rays(origins, directions), hits)
        slopes = np.empty((len(middle), 2))
        for axis in range(2):
            ends = []
            for sign in (1.0, -1.0):
                rays = _rays(origins + sign * _SHIFT_M * np.eye(3)[axis], directions)
                ends.append(self._log_reflectivity(rays, self.solid.cast_all(rays)))
            slopes[:, axis] = (ends[0] - ends[1]) / (2.0 * _SHIFT_M)
        return middle, slopes

    def _log_reflectivity(self, rays: NDArray[np.float32], hits: Hits) -> Array:
        optics, count = self.optics, len(rays)
        cells = optics.cells(rays, hits)
        ground = optics.ground_reflectivity.ravel()
        rho = optics.reflectivity[hits.geom].astype(np.float64)
        rho[cells >= 0] = ground[cells[cells >= 0]]
        found = np.log(np.maximum(rho, _DARKEST))
        if self._detail is not None:
            still = np.zeros(count)
            pulses = Rays(rays, still, still.astype(np.float32), np.zeros(count, np.uint32))
            gains = self._detail.gains(self._detail.find(pulses, hits, cells), pulses, hits, [])
            if len(gains):
                found += np.log(gains)
        return found

    def range_columns(self, distance: Array, strength: Array, cosine: Array) -> Array:
        """(N, 3) range errors by the constant, by time walk and by incidence of 1 m each."""
        if self._errors is None:
            return np.zeros((len(distance), 3))
        none = {"constant_m": 0.0, "walk_m": 0.0, "incidence_m": 0.0}
        units = [dataclasses.replace(self._errors, **(none | {name: 1.0})) for name in none]
        return np.column_stack([unit.bias_m(distance, strength, cosine) for unit in units])

    def range_sigma_m(self, distance: Array, strength: Array, usual_m: float) -> Array:
        """(N,) standard deviations of the range noise; ``usual_m`` without growth."""
        if self._errors is None:
            return np.full(len(distance), usual_m)
        with warnings.catch_warnings():  # numpy's, of arrays that are broadcast and only read
            warnings.simplefilter("ignore", DeprecationWarning)
            sigma = self._errors.noise_sigma_m(distance, strength)
        return np.asarray(sigma, dtype=np.float64)


def _target(scene: LidarScene) -> RayTarget:
    if scene.static is None:
        raise ValueError("the scene has no ground: nothing can be measured")
    return scene.static


def _rays(origins: Array, directions: Array) -> NDArray[np.float32]:
    return np.hstack([origins, directions]).astype(np.float32)
