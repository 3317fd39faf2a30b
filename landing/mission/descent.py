"""The descent: second look at 10 m, commitment at 4 m, final descent, touchdown."""

from __future__ import annotations

from collections.abc import Generator

import numpy as np
from numpy.typing import NDArray

from touchdown.controller.api import Setpoint
from touchdown.landing.api import Phase
from touchdown.landing.mission.mission_state import Mission, Steps, vertical_move
from touchdown.landing.mission.second_look import ground_under, look_again
from touchdown.landing.mission.touchdown import TouchdownDetector
from touchdown.landing.mission.trajectory import descent_trajectory, straight_trajectory

Array = NDArray[np.float64]

_LOOK_PATIENCE_S = 3.0
_MAX_SHIFT_M = 3.0
_MAX_LOW_SHIFT_M = 0.8
_SHIFT_SPEED_MPS = 1.5
_SWEEP_SPEED_MPS = 1.2
_SLOW_ABOVE_M = 0.2
"""height of the legs at which touchdown speed is reached"""
_FREEZE_ABOVE_M = 1.5
"""below this height, near the shortest LIDAR range, the ground height is no longer updated"""
_GROUND_RATE_MPS = 0.05
"""rate limit of corrections of the ground height"""
_DETECT_BELOW_M = 0.6
_THRUST_RAMP_S = 0.5
_MOTORS_OFF_S = 1.0


def descend_to(mission: Mission) -> Generator[Setpoint, None, str | None]:
    """Descends to the commitment height with both looks.

    Returns None once committed, else the reason of the refusal as text. In an emergency there is
    one look, which may move the site but refuses nothing."""
    mission.phase = Phase.DESCEND
    params = mission.params
    looks = params.second_look and (params.check_site or params.site_xy_m is None)
    yield from _sink_to(mission, params.look_height_m)
    if looks:
        refusal = yield from _look(mission, _MAX_SHIFT_M, "10 m")
        if refusal is not None and mission.deadline_s is None:
            return refusal
    yield from _sink_to(mission, params.commit_height_m)
    if looks and mission.deadline_s is None:
        yield from _sweep(mission)
        refusal = yield from _look(mission, _MAX_LOW_SHIFT_M, "4 m")
        if refusal is not None:
            return refusal
    _commit(mission)
    return None


def _sink_to(mission: Mission, height_m: float) -> Steps:
    """Sinks until the legs are ``height_m`` above the site, if they are higher."""
    _refresh_ground(mission)
    assert mission.site_odom is not None
    here = mission.odom(mission.reference_world)
    target = mission.site_odom[2] + height_m + mission.leg_height
    if target < here[2] - 0.05:
        speed = mission.params.descent_speed_mps
        yield from mission.follow(vertical_move(here, target, speed))


def _refresh_ground(mission: Mission) -> None:
    """Updates the height of the site. A selected site is fixed in the map, a commanded one at its
    world coordinates."""
    assert mission.site_odom is not None
    commanded = mission.commanded_odom
    xy = mission.site_odom[:2] if commanded is None else commanded
    ground = ground_under(mission.map_view, xy)
    mission.site_odom = np.array([*xy, ground if np.isfinite(ground) else mission.site_odom[2]])


def _look(mission: Mission, max_shift_m: float, name: str) -> Generator[Setpoint, None, str | None]:
    """Hovers, checks the site, and moves to where it is landable. Returns None for a good site (as
    moved), else the reason of the refusal."""
    assert mission.site_odom is not None
    yield from mission.hover(mission.params.look_s)
    shift = 0.0 if mission.params.site_xy_m is not None else max_shift_m
    look = look_again(mission.map_view, mission.site_odom, shift, mission.params)
    waited = 0.0
    patience = _LOOK_PATIENCE_S if mission.deadline_s is None else 0.0
    while look.position_odom is None and waited < patience:
        yield from mission.hover(1.0)
        waited += 1.0
        look = look_again(mission.map_view, mission.site_odom, shift, mission.params)
    yield from mission.hover(mission.params.decision_latency_s)
    if look.position_odom is None:
        return f"at {name}: {look.reason}"
    unsafe = _class_refusal(mission, look.position_odom) if max_shift_m == _MAX_SHIFT_M else None
    if unsafe is not None:
        return f"at {name}: {unsafe}"
    mission.note = f"look at {name}: {look.reason}"
    moved = float(np.linalg.norm(look.position_odom[:2] - mission.site_odom[:2]))
    mission.site_odom = look.position_odom
    if moved > 1e-6:
        here = mission.odom(mission.reference_world)
        yield from _move(mission, np.array([*look.position_odom[:2], here[2]]), _SHIFT_SPEED_MPS)
    return None


def _class_refusal(mission: Mission, position: Array) -> str | None:
    """Returns the reason why the class of the ground at ``position`` (3,) is refused, as text.

    None where it is safe, or without ground classification. At 4 m the camera sees too small a part
    of the site to classify it."""
    if mission.class_check is None:
        return None
    site_class = mission.class_check.reclassify(
        mission.site_class, position, mission.map_view, mission.obs.time_s
    )
    refusal = mission.class_check.refusal(site_class, mission.takes_risky)
    mission.site_class = site_class
    return None if refusal is None else refusal.text


def _sweep(mission: Mission) -> Steps:
    """Moves forward, back and home along the heading, where the LIDAR's field of view is narrow."""
    centre = mission.odom(mission.reference_world)
    yaw = mission.setpoint(centre).yaw_odom
    ahead = mission.params.sweep_m * np.array([np.cos(yaw), np.sin(yaw), 0.0])
    for end in (centre + ahead, centre - ahead, centre):
        yield from _move(mission, end, _SWEEP_SPEED_MPS)


def _move(mission: Mission, end: Array, speed: float) -> Steps:
    here = mission.odom(mission.reference_world)
    path = straight_trajectory(here, np.zeros(3), end, speed, mission.params.accel_mps2)
    yield from mission.follow(path)


def _commit(mission: Mission) -> None:
    """Fixes the site that the touchdown is measured against."""
    _refresh_ground(mission)
    assert mission.site_odom is not None
    mission.committed_site_world = mission.world(mission.site_odom)


class _Drift:
    """Whether nothing measures the horizontal position any more: its variance has grown by more
    than ``growth_m`` squared. Stays true."""

    def __init__(self, growth_m: float) -> None:
        self._growth, self._least, self.found = growth_m**2, np.inf, False

    def update(self, covariance: Array) -> bool:
        variance = float(np.linalg.eigvalsh(covariance[:2, :2])[1])
        self._least = min(self._least, variance)
        self.found = self.found or variance > self._least + self._growth
        return self.found


def final_descent(mission: Mission) -> Steps:
    """Descends until ground contact is detected, then stops the motors.

    Near the ground LIDAR and, in the dark, camera see nothing. Once the estimate drifts, the
    vehicle sinks no slower than at ``drift_speed_mps``: less time is left to drift in."""
    mission.phase = Phase.DESCEND
    mission.final = True
    assert mission.site_odom is not None
    params = mission.params
    ground = float(mission.site_odom[2])
    here = mission.odom(mission.reference_world)
    path = descent_trajectory(
        np.array([*mission.site_odom[:2], here[2]]),
        ground + mission.leg_height + _SLOW_ABOVE_M,
        cruise_speed=params.final_speed_mps,
        touchdown_speed=params.touchdown_speed_mps,
        max_accel=params.final_accel_mps2,
    )
    detector = TouchdownDetector(mission.rig)
    drift = _Drift(params.drift_growth_m)
    start, before, correction = mission.now, mission.now, 0.0
    wanted, version = 0.0, -1
    path_s, rate = 0.0, 1.0
    offset = here[:2] - mission.site_odom[:2]
    while True:
        step = mission.now - before
        path_s += rate * step
        position, velocity, acceleration = path.sample(path_s)
        drifts = drift.update(mission.estimate.position_covariance)
        if drifts and acceleration[2] >= 0.0:  # not while it gathers speed
            sinking = max(-float(velocity[2]), 1e-3)
            faster = rate + params.final_accel_mps2 * step / sinking
            rate = min(max(params.drift_speed_mps / sinking, 1.0), faster)
            velocity = rate * velocity
        legs_above = mission.position_odom[2] - mission.leg_height - ground - correction
        if legs_above > _FREEZE_ABOVE_M:
            if mission.map_view.version != version:
                version = mission.map_view.version
                seen = ground_under(mission.map_view, mission.site_odom)
                wanted = seen - ground if np.isfinite(seen) else correction
            limit = _GROUND_RATE_MPS * step
            correction += float(np.clip(wanted - correction, -limit, limit))
        before = mission.now
        fade = float(np.exp(-(mission.now - start)))
        position = position + np.array([*(fade * offset), correction])
        if legs_above < _DETECT_BELOW_M and detector.update(mission.obs, mission.estimate):
            break
        yield mission.setpoint(position, velocity, acceleration)
    yield from stop_motors(mission)


def stop_motors(mission: Mission) -> Steps:
    """Reduces thrust to zero over half a second, stops the motors and rests for a second."""
    mission.phase = Phase.TOUCHDOWN
    mission.note = "ground contact: motors off"
    position = mission.position_odom.copy()
    start = mission.now
    while (t := mission.now - start) < _THRUST_RAMP_S:
        limit = 0.5 * (1.0 - t / _THRUST_RAMP_S)
        yield mission.setpoint(position, thrust_limit=limit)
    while mission.now - start < _THRUST_RAMP_S + _MOTORS_OFF_S:
        yield mission.setpoint(position, motors_on=False)
