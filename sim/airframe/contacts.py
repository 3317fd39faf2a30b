"""Contacts of the vehicle, by part, and its height over the ground."""

from typing import Any

import mujoco
import numpy as np

from touchdown.scenes.api import TOUCHED
from touchdown.sim.airframe.vehicle import VEHICLE_PREFIX, vehicle_body_id
from touchdown.sim.api import Contact
from touchdown.sim.typing import Array


class ContactSensor:
    """Touching pairs of the vehicle: geoms named ``vehicle/leg*`` are ``leg``, ``vehicle/rotor*``
    ``rotor``, the rest of it ``body``."""

    def __init__(self, model: Any) -> None:
        self._model = model
        self._vehicle = vehicle_body_id(model)
        self._names = [
            model.geom(i).name.removesuffix(TOUCHED) or f"geom {i}" for i in range(model.ngeom)
        ]
        self._of_vehicle = model.body_rootid[model.geom_bodyid] == self._vehicle
        self._force = np.zeros(6)

    def read(self, data: Any) -> tuple[Contact, ...]:
        """The contacts of the last tick, one per pair of geoms, their normal forces added up and
        the point of the largest of them; in ascending order of geom ids."""
        forces: dict[tuple[int, int], float] = {}
        hardest: dict[tuple[int, int], tuple[float, int]] = {}
        for i, (first, second) in enumerate(data.contact.geom[: data.ncon].tolist()):
            own, other = (first, second) if self._of_vehicle[first] else (second, first)
            if not self._of_vehicle[own]:
                continue
            mujoco.mj_contactForce(self._model, data, i, self._force)
            force = float(self._force[0])
            forces[own, other] = forces.get((own, other), 0.0) + force
            hardest[own, other] = max(hardest.get((own, other), (force, i)), (force, i))
        return tuple(
            Contact(
                part=_part(self._names[own]),
                other=self._names[other],
                normal_force_n=force,
                point_world=tuple(data.contact.pos[hardest[own, other][1]].tolist()),
            )
            for (own, other), force in sorted(forces.items())
        )


def _part(geom_name: str) -> str:
    local = geom_name.removeprefix(VEHICLE_PREFIX)
    for part in ("leg", "rotor"):
        if local.startswith(part):
            return part
    return "body"


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
