"""The descent of a vehicle without a site that it can fly to: by velocity, on the best ground in
view. Its position is not measured, or the wind is too strong to keep one, or no time is left.

A position that nothing measures, or that jumps, is not worth flying to. The velocity of the
estimate errs by a few decimetres a second after ten seconds with the inertial sensors alone; its
integral from the moment of the loss leads to ground that was seen before it. Time is what lets both
grow: the descent is fast, and its end that of a vehicle which does not know its height.
"""

import math

import numpy as np

from touchdown.landing.mission.descent import stop_motors
from touchdown.landing.mission.mission import Mission, Steps
from touchdown.landing.mission.site_recheck import REACH_M, best_ground, ground_under
from touchdown.landing.mission.touchdown import TouchdownDetector
from touchdown.landing.mission.wind import ROUGHNESS_M
from touchdown.sim.typing import Array

_ACCEL_MPS2 = 2.5
_PER_S, _SPEED_MPS = 1.0, 2.5
"""gain and limit of the horizontal velocity towards the ground to land on"""
_SINK_MPS = 4.0
"""least vertical speed of the descent to there"""
_SLOW_ABOVE_M, _SLOW_SOONER_MPS = 1.0, 0.05
"""height of the legs, as it is known, from which the ground may come at any moment, and what is
added for each second without a measurement"""
_TOUCHDOWN_MPS = 0.5
"""vertical speed from there on; the legs take it with the error of the estimate on top"""
_ABOVE_SITE_M = 1.0
_WAIT_S = 6.0
"""horizontal distance to the ground to land on from which it sinks, and how long it waits, above
and again near the ground, where the wind is weaker"""
_HELD_S = 0.05
"""time beside the mission's clock from which the descent has been interrupted"""
_GUST, _GUST_MPS = 0.5, 2.0
"""change of the felt wind, over the wind before and in m/s, that may be one of the wind"""


def blind_descent(mission: Mission) -> Steps:
    """Brakes, moves above the best ground in view and sinks there, at last with no velocity across,
    until ground contact is detected; then stops the motors."""
    state, view = mission.state, mission.view
    velocity = view.estimate.velocity_odom.copy()
    speed = float(np.hypot(velocity[0], velocity[1]))
    here = view.position_odom.copy()
    here[:2] += velocity[:2] * speed / (2.0 * _ACCEL_MPS2)  # where it comes to rest
    site = _ground_ahead(mission, here)
    state.choose(site)
    state.commit(view.world(site))
    state.descend_for_good(blind=max(view.blind_s, view.unhealthy_s) > 0.0)
    left = site - view.position_odom
    left[2] += mission.leg_height
    wind, wind_legs = view.felt_wind_odom.copy(), -float(left[2])
    detector, drift = TouchdownDetector(mission.rig), np.zeros(3)
    slow_s = low_s = 0.0
    start, before, arrived = mission.now, mission.now, False
    seen_s = view.obs.time_s
    slow_above = _SLOW_ABOVE_M + _SLOW_SOONER_MPS * max(view.blind_s, view.unhealthy_s, 0.0)
    fastest = max(mission.params.descent_speed_mps, _SINK_MPS)
    while True:
        step = mission.now - before
        before = mission.now
        legs, estimate = -float(left[2]), mission.view.estimate
        if mission.view.obs.time_s - seen_s > step + _HELD_S:  # the watch has made it wait
            velocity = estimate.velocity_odom.copy()
        seen_s = mission.view.obs.time_s
        slow_above += _SLOW_SOONER_MPS * step
        low = legs < slow_above
        if not low:  # on the ground friction looks like wind
            known = wind * _profile(legs) / _profile(wind_legs)
            drift = runaway(mission.view.felt_wind_odom - known, wind)
        left -= (estimate.velocity_odom - drift) * step
        low_s += step * low
        wanted = np.zeros(3)
        away = float(np.hypot(left[0], left[1]))
        seeks = away > _ABOVE_SITE_M and low_s < _WAIT_S
        if not low or seeks:
            wanted[:2] = left[:2] * min(_PER_S, _SPEED_MPS / max(away, 1e-6))
        over = max(legs - slow_above, 0.0)
        sink = min(fastest, math.sqrt(2.0 * 0.6 * _ACCEL_MPS2 * over))
        arrived = arrived or away < _ABOVE_SITE_M or mission.now - start > _WAIT_S
        wanted[2] = -max(sink, _TOUCHDOWN_MPS) if arrived and not (low and seeks) else 0.0
        change = wanted - velocity
        most = _ACCEL_MPS2 * step
        change[:2] *= min(1.0, most / max(float(np.hypot(change[0], change[1])), 1e-9))
        change[2] = min(max(change[2], -most), most)
        velocity = velocity + change
        slow_s = slow_s + step if low and velocity[2] > -1.2 * _TOUCHDOWN_MPS else 0.0
        if slow_s > 0.5 and detector.update(mission.view.obs, estimate):
            break
        yield mission.velocity_setpoint(
            velocity + drift, change / step if step > 0.0 else 0 * change
        )
    yield from stop_motors(mission)


def _ground_ahead(mission: Mission, here: Array) -> Array:
    """(3,) the site, where one is chosen and near, else the best ground in view, else that below
    ``here`` (3,)."""
    state, view = mission.state, mission.view
    site = state.site_odom
    if site is not None and float(np.linalg.norm((site - here)[:2])) < REACH_M:
        state.report(f"{state.note}: coming down on the site")
        return site
    legs = float(here[2]) - mission.leg_height
    found = best_ground(view.map_view, here, legs, mission.params, view.obs.time_s)
    state.report(f"{state.note}: coming down on the best ground in view, {found.reason}")
    if found.position_odom is not None:
        return found.position_odom
    ground = ground_under(view.map_view, here[:2])
    return np.array([*here[:2], ground if np.isfinite(ground) else view.ground_odom])


def _profile(height_m: float) -> float:
    return math.log(max(height_m, 1.0) / ROUGHNESS_M)


def runaway(change: Array, wind: Array) -> Array:
    """(3,) m/s, the error of the estimated velocity that a ``change`` (3,) of the felt wind beyond
    what gusts make shows: drag tells the velocity through the air, whatever the estimate."""
    size = float(np.linalg.norm(change))
    bound = max(_GUST_MPS, _GUST * float(np.linalg.norm(wind)))
    return change * max(size - bound, 0.0) / max(size, 1e-9)
