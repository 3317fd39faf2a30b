"""How soon a flight answers to an intruder: the time from his first sight to a changed setpoint,
one that no longer sinks since the watch has seen something in the way.

He is in view where a part of him lies in the camera's image, or where a scan has returns from him,
less than 8 m beside a vehicle that descends or returns, its legs below the height from which it is
watched. A scan counts when it has arrived. Whether something hides him from the camera is not
asked.
"""

import numpy as np

from touchdown.experiments.io.result_parts import Intrusion
from touchdown.experiments.recording.recorder import StepRecord
from touchdown.landing.api import Phase, Verdict
from touchdown.sim.api import GRAVITY_MPS2, LidarScan, SensorRig, VehicleModel
from touchdown.sim.frames import Pose, PoseHistory
from touchdown.sim.geometry.lens import bearing, project
from touchdown.sim.typing import Array

WATCHED_M, NEAR_M = 15.0, 8.0
_WATCHED = frozenset({Phase.DESCEND, Phase.RETURN})
_PARTS_M = (0.2, 0.9, 1.6)
"""heights of the parts that are looked for in images"""
_ROUND_M, _LOW_M, _HIGH_M, _RETURNS = 0.8, 0.2, 2.2, 6
"""returns of a scan from him: within a radius, between two heights, that many"""
_KEPT = 400
"""control steps: two seconds, longer than a scan is under way"""
_LEVEL_M = 1e-3
"""by which a setpoint that holds its height may be lower than that of the step before"""
_REACH_M, _REACT_S = 2.0, 0.3
"""height above which nobody reaches, and time that an answer takes"""


class IntrusionObserver:
    """Follows the first intruder of a flight; call ``tick`` with every control step."""

    def __init__(self, rig: SensorRig) -> None:
        self._rig, self._brake_mps2 = rig, _brake_mps2(rig.vehicle)
        self._body, self._foot = PoseHistory(_KEPT), PoseHistory(_KEPT)
        width, height = rig.camera.width, rig.camera.height
        corners = np.array([[0, 0], [0, height], [width, 0], [width, height]], float)
        self._widest = float(np.linalg.norm(bearing(rig.camera, corners)[:, :2], axis=1).max())
        self._seen: tuple[float, float, float] | None = None
        self._answered_s: float | None = None
        self._reference_z = np.inf
        self._sent = False

    def tick(self, step: StepRecord) -> None:
        """Takes one control step."""
        truth, watch = step.truth, step.lander_view.watch
        before, self._reference_z = self._reference_z, float(step.lander_view.reference_world[2])
        blocked = watch is not None and watch.verdict is not Verdict.GO
        stays = self._reference_z > before - _LEVEL_M
        if not blocked and self._seen is None:
            self._answered_s = None  # an interruption has ended before he came
        elif blocked and stays and self._answered_s is None:
            self._answered_s = truth.time_s
        if not len(truth.intruders_world):
            return
        self._sent = True
        if self._seen is None:
            foot, body = truth.intruders_world[0], truth.world_from_body
            self._body.add(truth.time_s, body)
            self._foot.add(truth.time_s, Pose(np.eye(3), foot))
            away = body.translation - foot
            height = float(away[2]) - self._rig.vehicle.leg_height_m
            watched = height < WATCHED_M and step.lander_view.phase in _WATCHED
            near = watched and np.hypot(away[0], away[1]) < NEAR_M
            if near and (self._in_image(body, foot) or any(map(self._in_scan, step.obs.scans))):
                self._seen = truth.time_s, height, max(-float(truth.velocity_world[2]), 0.0)

    def summary(self) -> Intrusion | None:
        """The figures; None where nobody was sent."""
        if not self._sent:
            return None
        if self._seen is None:
            return Intrusion(answered_s=self._answered_s, avoidable=False)
        time_s, height, sink = self._seen
        late = None if self._answered_s is None else max(self._answered_s - time_s, 0.0)
        stopping = sink**2 / (2.0 * self._brake_mps2)
        return Intrusion(
            in_view_s=time_s, in_view_height_m=height, stopping_m=stopping,
            avoidable=height - sink * _REACT_S - stopping > _REACH_M,
            answered_s=self._answered_s, reaction_s=late,
        )  # fmt: skip

    def _in_image(self, body: Pose, foot: Array) -> bool:
        k = self._rig.camera
        parts = foot + np.array([[0.0, 0.0, up] for up in _PARTS_M])
        points = (body @ self._rig.body_from_camera).inverse().apply(parts)
        (u, v), ahead = (pixels := project(k, points))[0].T, pixels[1]
        # far outside the image the model of a lens folds back into it
        aside = np.linalg.norm(points[:, :2], axis=1)
        ahead &= aside <= self._widest * np.maximum(points[:, 2], 0.0)
        return bool((ahead & (u >= 0) & (v >= 0) & (u < k.width) & (v < k.height)).any())

    def _in_scan(self, scan: LidarScan) -> bool:
        body, foot = self._body.at(scan.end_time_s), self._foot.at(scan.end_time_s)
        if body is None or foot is None:
            return False
        returned = scan.points[scan.ranges > 0.0].astype(np.float64)
        points = (body @ self._rig.body_from_lidar).apply(returned)
        away = points - foot.translation
        beside = np.hypot(away[:, 0], away[:, 1]) < _ROUND_M
        hit = beside & (away[:, 2] > _LOW_M) & (away[:, 2] < _HIGH_M)
        return int(hit.sum()) >= _RETURNS


def _brake_mps2(vehicle: VehicleModel) -> float:
    """The greatest upward acceleration."""
    thrust = len(vehicle.rotor_spin) * vehicle.thrust_coefficient * vehicle.rotor_speed_max**2
    return float(thrust / vehicle.mass_kg - GRAVITY_MPS2)
