"""Dust that the rotors' downwash raises from bare, loose ground.

The rotors' wakes leave with twice the induced velocity of hover (momentum theory) and half the
rotors' area, and spread as turbulent jets: over more than about six of its diameters a jet's
velocity falls with one over the distance (Pope, "Turbulent Flows", 2000; below quadrotors:
Bauersfeld et al., 2024). On the ground the flow turns outwards; its friction velocity is a
twentieth of its speed. Above the threshold u_t the ground gives off dust in proportion to
u^3 (1 + u_t / u) (1 - u_t^2 / u^2) (White, J. Geophys. Res. 84, 1979). u_t is 0.35 m/s, amid the
0.2 to 0.6 m/s of disturbed soils (Gillette et al., J. Geophys. Res. 85, 1980).

The cloud is even between vehicle and ground and without memory: it follows height, thrust and the
ground below at once. Its extinction at full strength is assumed.
"""

import math
from collections import OrderedDict
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from touchdown.scenes.api import LAND_CLASSES, Scene, Surface
from touchdown.sim.airframe.vehicle import rotor_geometry, vehicle_body_id, vehicle_model
from touchdown.sim.api import AIR_DENSITY_KGPM3, GRAVITY_MPS2, DustParams
from touchdown.sim.typing import Array

JET_LENGTHS = 6.2
"""Diameters over which a round jet keeps the speed of its centre"""
FRICTION = 0.05
"""Friction velocity over the speed of the flow along the ground"""
THRESHOLD_MPS = 0.35
FULL_EXTINCTION_PER_M = 0.5
"""Extinction at ``dust.density`` 1 over bare soil, where the wakes reach the ground undiminished: a
visibility of 8 m"""

_DOWN = np.array([0.0, 0.0, -1.0])
_AROUND_M = 1.0
_STEP_TICKS = 15
_KEPT = 64
"""steps of the past that an image or a scan may ask for"""
_NOWHERE = Surface(land_class="other", reflectivity=0.0)


@dataclass(frozen=True)
class DustAir:
    """Dust between the vehicle and the ground at an instant."""

    extinction: float
    """1/m, for all wavelengths of light: grains are larger than these"""
    depth_m: float
    """distance from the vehicle to the ground"""


CLEAR = DustAir(0.0, 0.0)


class DustCloud:
    """The dust of a flight: ``observe`` in the physics thread, ``at`` in any."""

    def __init__(self, scene: Scene, params: DustParams) -> None:
        self._scene, self._params, self._model = scene, params, scene.model
        self._body = vehicle_body_id(self._model)
        self._weight = vehicle_model(self._model).mass_kg * GRAVITY_MPS2
        self._radius = rotor_geometry(self._model).radius_m
        self._geom_id = np.zeros(1, dtype=np.int32)
        self._known: OrderedDict[int, DustAir] = OrderedDict()

    def observe(self, tick: int, data: Any, position_world: Array) -> None:
        """Notes the dust of ``tick``, forty times a second."""
        if tick % _STEP_TICKS:
            return
        self._known[tick // _STEP_TICKS] = self._now(data, position_world)
        if len(self._known) > _KEPT:
            self._known.popitem(last=False)

    def at(self, tick: int) -> DustAir:
        """The dust last noted at or before ``tick``."""
        return self._known.get(tick // _STEP_TICKS, CLEAR)

    def clear(self) -> None:
        """Forgets the flight."""
        self._known.clear()

    def _now(self, data: Any, position_world: Array) -> DustAir:
        distance = mujoco.mj_ray(
            self._model, data, position_world, _DOWN, None, True, self._body, self._geom_id
        )
        if distance < 0.0:
            return CLEAR
        thrust = float(np.linalg.norm(data.xfrc_applied[self._body, :3]))
        strength = dust_strength(distance, thrust, self._weight, self._radius)
        if strength <= 0.0:
            return CLEAR
        loose = self._looseness(int(self._geom_id[0]), position_world)
        extinction = self._params.density * FULL_EXTINCTION_PER_M * loose * strength
        return DustAir(extinction, float(distance)) if extinction > 0.0 else CLEAR

    def _looseness(self, geom_id: int, position_world: Array) -> float:
        """Fraction of loose, bare soil around the place below."""
        ground, name = self._scene.ground, self._model.geom(geom_id).name
        if ground is None or name != ground.geom_name or not ground.material.size:
            return self._scene.surfaces.get(name, _NOWHERE).dust
        low, high = (
            np.floor((position_world[:2] + reach - ground.origin_xy_m) / ground.cell_m).astype(int)
            for reach in (-_AROUND_M, _AROUND_M)
        )
        first, last = np.maximum(low, 0), np.maximum(high + 1, 0)
        rows, cols = slice(first[1], last[1]), slice(first[0], last[0])
        kinds = ground.material[rows, cols]
        if not kinds.size:
            return 0.0
        loose = np.array([surface.dust for surface in ground.materials])[kinds]
        dry = ground.class_id[rows, cols] != LAND_CLASSES.index("water")
        return float((loose * dry).mean())


def ground_speed_mps(height_m: float, thrust_n: float, radius_m: float) -> float:
    """Speed at which the wakes of four rotors meet the ground, ``height_m`` below them."""
    area = math.pi * radius_m**2
    induced = math.sqrt(thrust_n / 4.0 / (2.0 * AIR_DENSITY_KGPM3 * area))
    diameter = math.sqrt(2.0) * radius_m
    return 2.0 * induced * min(1.0, JET_LENGTHS * diameter / max(height_m, 1e-6))


def dust_strength(height_m: float, thrust_n: float, weight_n: float, radius_m: float) -> float:
    """Dust given off, over that of a hover close to the ground; 0 below the threshold."""
    full = _flux(FRICTION * ground_speed_mps(0.0, weight_n, radius_m))
    here = _flux(FRICTION * ground_speed_mps(height_m, thrust_n, radius_m))
    return here / full if full > 0.0 else 0.0


def _flux(friction_mps: float) -> float:
    if friction_mps <= THRESHOLD_MPS:
        return 0.0
    fraction = THRESHOLD_MPS / friction_mps
    return friction_mps**3 * (1.0 + fraction) * (1.0 - fraction * fraction)
