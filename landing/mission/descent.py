"""The descent: rechecks at 10 m and 4 m, commitment, final descent, touchdown."""

import dataclasses

import numpy as np

from touchdown.landing.api import Phase
from touchdown.landing.mission.mission import Mission, RuledSteps, SiteMovedError, Steps
from touchdown.landing.mission.rules import Action, Moment
from touchdown.landing.mission.site_recheck import best_ground, ground_under, recheck_site
from touchdown.landing.mission.touchdown import TouchdownDetector
from touchdown.landing.mission.trajectory import (
    descent_trajectory,
    straight_trajectory,
    vertical_move,
)
from touchdown.sim.typing import Array

_RECHECK_S = 3.0
"""time for which a recheck waits for more returns before it refuses the site"""
_MAX_SHIFT_M = 3.0
_MAX_LOW_SHIFT_M = 0.8
_SHIFT_SPEED_MPS = 1.5
_SWEEP_SPEED_MPS = 1.2
_SLOW_ABOVE_M = 0.2
"""height of the legs at which touchdown speed is reached"""
_FREEZE_ABOVE_M = 1.5
"""height below which, near the shortest LIDAR range, the ground height is no longer updated"""
_GROUND_RATE_MPS = 0.05
"""rate limit of corrections of the ground height"""
_DETECT_BELOW_M, _DETECT_DRIFTING_M = 0.6, 2.0
"""height of the legs below which contact is looked for; the height drifts with the position"""
_THRUST_RAMP_S = 0.5
_MOTORS_OFF_S = 1.0


def descend_to(mission: Mission) -> RuledSteps:
    """Descends to the commitment height with both rechecks.

    Returns None once committed, else the rule that refuses the site. In an emergency there is one
    recheck, which may move the site. The take-off spot is never refused: see `home_recheck`."""
    state, params = mission.state, mission.params
    if not _is_home(mission):
        state.enter(Phase.DESCEND)
    rechecks = params.site_recheck and (params.check_site or not _is_commanded(mission))
    yield from _sink_to(mission, params.look_height_m)
    if rechecks:
        refusal = yield from _recheck(mission, "10 m", _MAX_SHIFT_M)
        if refusal is not None:
            return refusal
    yield from _sink_to(mission, params.commit_height_m)
    if rechecks and state.deadline_s is None:
        yield from _sweep(mission)
        refusal = yield from _recheck(mission, "4 m", _MAX_LOW_SHIFT_M, classify=False)
        if refusal is not None:
            return refusal
    state.commit(mission.view.world(_refreshed_site(mission)))
    return None


def _is_home(mission: Mission) -> bool:
    return mission.state.phase is Phase.RETURN


def _is_commanded(mission: Mission) -> bool:
    return mission.params.site_xy_m is not None and not _is_home(mission)


def _sink_to(mission: Mission, height_m: float) -> Steps:
    """Sinks until the legs are ``height_m`` above the site, if they are higher."""
    site, here = _refreshed_site(mission), mission.reference_odom
    target = site[2] + height_m + mission.leg_height
    if target < here[2] - 0.05:
        speed = mission.params.descent_speed_mps
        yield from mission.follow(vertical_move(here, target, speed))


def _refreshed_site(mission: Mission) -> Array:
    """Returns the site at the height that the ground has now, and takes it over. A selected site is
    fixed in the map, a commanded one at its world coordinates."""
    state = mission.state
    commanded = mission.view.commanded_odom if _is_commanded(mission) else None
    assert state.site_odom is not None
    xy = state.site_odom[:2] if commanded is None else commanded
    ground = ground_under(mission.view.map_view, xy)
    site = np.array([*xy, ground if np.isfinite(ground) else state.site_odom[2]])
    state.choose(site, state.site_class)
    return site


def _recheck(
    mission: Mission, height: str, max_shift_m: float, *, classify: bool = True
) -> RuledSteps:
    """Hovers, checks the site, and moves to where it is landable. Returns the rule that refuses the
    site; None for a good one (as moved)."""
    state, params, site = mission.state, mission.params, mission.state.site_odom
    assert site is not None
    yield from mission.hover(params.look_s)
    shift = 0.0 if _is_commanded(mission) else max_shift_m
    found = recheck_site(mission.view.map_view, site, shift, params)
    waited = 0.0
    while found.position_odom is None and waited < _RECHECK_S and state.deadline_s is None:
        yield from mission.hover(1.0)
        waited += 1.0
        found = recheck_site(mission.view.map_view, site, shift, params)
    yield from mission.hover(params.decision_latency_s)
    unsafe = ""
    if classify and found.position_odom is not None and not _is_home(mission):
        unsafe = _class_refusal(mission, found.position_odom)
    found = dataclasses.replace(found, height=height, unsafe_class=unsafe)
    state.examine(found)
    refusal = mission.ask(Moment.RECHECK)
    if refusal is not None and refusal.action is Action.BEST_GROUND:
        legs = mission.reference_odom[2] - mission.leg_height
        now_s = mission.view.obs.time_s
        found, refusal = best_ground(mission.view.map_view, site, legs, params, now_s), None
        state.report(found.reason)
    if refusal is not None or found.position_odom is None or unsafe:
        return refusal
    state.choose(found.position_odom, state.site_class)
    if float(np.linalg.norm(found.position_odom[:2] - site[:2])) > 1e-6:
        end = np.array([*found.position_odom[:2], mission.reference_odom[2]])
        yield from _move(mission, end, _SHIFT_SPEED_MPS)
    return None


def _class_refusal(mission: Mission, position: Array) -> str:
    """Returns the reason why the class of the ground at ``position`` (3,) is refused, as text.

    Empty where it is safe, or without ground classification. At 4 m the camera sees too small a
    part of the site to classify it."""
    check, state, view = mission.class_check, mission.state, mission.view
    if check is None or state.site_odom is None:
        return ""
    site_class = check.reclassify(state.site_class, position, view.map_view, view.obs.time_s)
    state.choose(state.site_odom, site_class)
    refusal = check.refusal(site_class, view.takes_risky)
    return "" if refusal is None else refusal.text


def _sweep(mission: Mission) -> Steps:
    """Moves forward, back and home along the heading, where the LIDAR's field of view is narrow."""
    centre = mission.reference_odom
    yaw = mission.setpoint(centre).yaw_odom
    ahead = mission.params.sweep_m * np.array([np.cos(yaw), np.sin(yaw), 0.0])
    for end in (centre + ahead, centre - ahead, centre):
        yield from _move(mission, end, _SWEEP_SPEED_MPS)


def _move(mission: Mission, end: Array, speed: float) -> Steps:
    here = mission.reference_odom
    path = straight_trajectory(here, np.zeros(3), end, speed, mission.params.accel_mps2)
    yield from mission.follow(path)


class _Drift:
    """Whether nothing measures the horizontal position any more: its variance has grown by more
    than ``growth_m`` squared. Stays true."""

    def __init__(self, growth_m: float) -> None:
        self._growth, self._min, self.found = growth_m**2, np.inf, False

    def update(self, covariance: Array) -> bool:
        variance = float(np.linalg.eigvalsh(covariance[:2, :2])[1])
        self._min = min(self._min, variance)
        self.found = self.found or variance > self._min + self._growth
        return self.found


def watched_descent(mission: Mission) -> Steps:
    """The final descent; where the watch moves the site, from the height of the commitment
    again."""
    while True:
        try:
            mission.may_move = True
            yield from final_descent(mission)
            return
        except SiteMovedError as moved:
            mission.may_move = False
            yield from _go_aside(mission, moved.aside_odom)
        finally:
            mission.may_move = False


def _go_aside(mission: Mission, aside: Array) -> Steps:
    """Goes over to a site beside the present one, at the height of the commitment at the least, and
    commits to it."""
    state, params, here = mission.state, mission.params, mission.reference_odom
    assert state.site_odom is not None
    state.choose(np.array([*aside, state.site_odom[2]]), state.site_class)
    low = state.site_odom[2] + params.commit_height_m + mission.leg_height
    state.report(f"the site is moved by {np.linalg.norm(aside - here[:2]):.1f} m")
    if low > here[2] + _SLOW_ABOVE_M:
        yield from mission.follow(vertical_move(here, low, params.descent_speed_mps))
    end = np.array([*aside, mission.reference_odom[2]])
    yield from _move(mission, end, _SHIFT_SPEED_MPS)
    ground = ground_under(mission.view.map_view, aside)
    if np.isfinite(ground):
        state.choose(np.array([*aside, ground]), state.site_class)
    state.commit(mission.view.world(state.site_odom))


def final_descent(mission: Mission) -> Steps:
    """Descends until ground contact is detected, then stops the motors.

    Near the ground LIDAR and, in the dark, camera see nothing. Once the estimate drifts, the
    vehicle sinks no slower than at ``drift_speed_mps``: less time is left to drift in."""
    mission.state.descend_for_good()
    site, params, here = mission.state.site_odom, mission.params, mission.reference_odom
    assert site is not None
    ground = float(site[2])
    path = descent_trajectory(
        np.array([*site[:2], here[2]]),
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
    offset = here[:2] - site[:2]
    while True:
        step = mission.now - before
        path_s += rate * step
        position, velocity, acceleration = path.sample(path_s)
        drifts = drift.update(mission.view.estimate.position_covariance)
        if drifts and acceleration[2] >= 0.0:  # not while it gathers speed
            sinking = max(-float(velocity[2]), 1e-3)
            faster = rate + params.final_accel_mps2 * step / sinking
            rate = min(max(params.drift_speed_mps / sinking, 1.0), faster)
            velocity = rate * velocity
        legs_above = mission.view.position_odom[2] - mission.leg_height - ground - correction
        if legs_above > _FREEZE_ABOVE_M:
            if mission.view.map_view.version != version:
                version = mission.view.map_view.version
                seen = ground_under(mission.view.map_view, site)
                wanted = seen - ground if np.isfinite(seen) else correction
            limit = _GROUND_RATE_MPS * step
            correction += float(np.clip(wanted - correction, -limit, limit))
        before = mission.now
        fade = float(np.exp(-(mission.now - start)))
        position = position + np.array([*(fade * offset), correction])
        near = _DETECT_DRIFTING_M if drifts else _DETECT_BELOW_M
        if legs_above < near and detector.update(mission.view.obs, mission.view.estimate):
            break
        yield mission.setpoint(position, velocity, acceleration)
    yield from stop_motors(mission)


def stop_motors(mission: Mission) -> Steps:
    """Reduces thrust to zero over half a second, stops the motors and rests for a second."""
    mission.state.enter(Phase.TOUCHDOWN, "ground contact: motors off")
    position = mission.view.position_odom.copy()
    start = mission.now
    while (t := mission.now - start) < _THRUST_RAMP_S:
        limit = 0.5 * (1.0 - t / _THRUST_RAMP_S)
        yield mission.setpoint(position, thrust_limit=limit)
    while mission.now - start < _THRUST_RAMP_S + _MOTORS_OFF_S:
        yield mission.setpoint(position, motors_on=False)
