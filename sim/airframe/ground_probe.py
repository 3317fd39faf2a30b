"""Height of the vehicle over the surface below it."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from touchdown.sim.airframe.vehicle import vehicle_body_id
from touchdown.sim.typing import Array

_DOWN = np.array([0.0, 0.0, -1.0])


class GroundProbe:
    """A vertical ray that ignores the vehicle."""

    def __init__(self, model: Any) -> None:
        self._model = model
        self._vehicle = vehicle_body_id(model)
        self._geom_id = np.zeros(1, dtype=np.int32)

    def clearance(self, data: Any, position_world: Array) -> float:
        """Metres from (3,) ``position_world`` straight down to the next surface, ``inf`` where
        there is none. ``data`` must hold the kinematics of now or of the last tick."""
        distance = mujoco.mj_ray(
            self._model, data, position_world, _DOWN, None, True, self._vehicle, self._geom_id
        )
        return float(distance) if distance >= 0.0 else float("inf")
