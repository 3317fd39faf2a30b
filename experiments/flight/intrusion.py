"""How soon a flight answers to an intruder: the time from his first sight to a changed setpoint.

He is in view where a part of him lies in the camera's image or in the LIDAR's field of view, the
legs being below the height from which a descent is watched; whether something hides him is not
asked.
"""

from __future__ import annotations

import math

import numpy as np

from touchdown.experiments.io.result_parts import Intrusion
from touchdown.experiments.recording.recorder import StepRecord
from touchdown.sim.api import GRAVITY_MPS2, SensorRig, VehicleModel
from touchdown.sim.geometry.lens import project
from touchdown.sim.lidar.patterns import PATTERNS
from touchdown.sim.typing import Array

WATCHED_M = 15.0
RULE = "site_not_clear"
_ROUND_DEG = 35.0
"""half angle of the cone about the camera's axis that counts for a LIDAR that looks all round"""
_PARTS_M = (0.2, 0.9, 1.6)
"""heights of the parts that are looked for"""


class IntrusionObserver:
    """Follows the first intruder of a flight; call ``tick`` with every control step."""

    def __init__(self, rig: SensorRig) -> None:
        self._rig, self._brake_mps2 = rig, _brake_mps2(rig.vehicle)
        self._seen: tuple[float, float, float] | None = None
        self._answered_s: float | None = None
        self._sent = False

    def tick(self, step: StepRecord) -> None:
        """Takes one control step."""
        truth = step.truth
        if not len(truth.intruders_world):
            return
        self._sent = True
        if self._seen is None:
            height = float(truth.world_from_body.translation[2] - truth.intruders_world[0, 2])
            height -= self._rig.vehicle.leg_height_m
            if height < WATCHED_M and self._in_view(step, truth.intruders_world[0]):
                self._seen = truth.time_s, height, max(-float(truth.velocity_world[2]), 0.0)
        told = any(f" {RULE}: " in text for text in step.lander_view.events)
        if told and self._answered_s is None:
            self._answered_s = truth.time_s

    def summary(self) -> Intrusion | None:
        """The figures; None where nobody was sent."""
        if not self._sent:
            return None
        if self._seen is None:
            return Intrusion(answered_s=self._answered_s)
        time_s, height, sink = self._seen
        late = None if self._answered_s is None else max(self._answered_s - time_s, 0.0)
        stopping = sink**2 / (2.0 * self._brake_mps2)
        return Intrusion(
            in_view_s=time_s, in_view_height_m=height, stopping_m=stopping,
            answered_s=self._answered_s, reaction_s=late,
        )  # fmt: skip

    def _in_view(self, step: StepRecord, foot: Array) -> bool:
        k = self._rig.camera
        world_from_camera = step.truth.world_from_body @ self._rig.body_from_camera
        parts = foot + np.array([[0.0, 0.0, up] for up in _PARTS_M])
        points = world_from_camera.inverse().apply(parts)
        points[:, 2] = np.maximum(points[:, 2], 0.1)
        u, v = project(k, points)[0].T
        ahead = points[:, 2] > 0.1
        image = ahead & (u >= 0) & (v >= 0) & (u < k.width) & (v < k.height)
        return bool((image | self._in_scans(step, parts)).any())

    def _in_scans(self, step: StepRecord, parts: Array) -> Array:
        """(K,) whether points (K, 3) lie in the LIDAR's field of view."""
        wide = PATTERNS[self._rig.lidar.preset].field_of_view_deg
        round_about = max(wide) > 180.0
        sensor = self._rig.body_from_camera if round_about else self._rig.body_from_lidar
        points = (step.truth.world_from_body @ sensor).inverse().apply(parts)
        x, y, z = points[:, 0], points[:, 1], np.maximum(points[:, 2], 1e-3)
        if round_about:
            inside = np.hypot(x, y) < z * math.tan(math.radians(_ROUND_DEG))
        else:
            limits = np.tan(np.radians(wide) / 2.0)
            inside = (np.abs(x) < z * limits[0]) & (np.abs(y) < z * limits[1])
        return np.asarray(inside & (points[:, 2] > 0.1))


def _brake_mps2(vehicle: VehicleModel) -> float:
    """The greatest upward acceleration."""
    thrust = len(vehicle.rotor_spin) * vehicle.thrust_coefficient * vehicle.rotor_speed_max**2
    return float(thrust / vehicle.mass_kg - GRAVITY_MPS2)
