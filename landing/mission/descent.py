"""From above the site to motors off: two looks, the commitment, the last metres, the touchdown."""

from __future__ import annotations

from collections.abc import Generator

import numpy as np
from numpy.typing import NDArray

from touchdown.controller.api import Setpoint
from touchdown.landing.api import Phase
from touchdown.landing.mission.mission_state import Flight, Steps, vertical_move
from touchdown.landing.mission.second_look import ground_under, look_again
from touchdown.landing.mission.touchdown import TouchdownDetector
from touchdown.landing.mission.trajectory import descent_trajectory, straight_trajectory

Array = NDArray[np.float64]

_LOOK_HOVER_S = 1.0
_LOOK_PATIENCE_S = 3.0
_MAX_SHIFT_M = 3.0
_MAX_LOW_SHIFT_M = 0.8
_SHIFT_SPEED_MPS = 1.5
_SWEEP_SPEED_MPS = 1.2
_ACCEL_MPS2 = 1.5
_SLOW_ABOVE_M = 0.2
"""height of the legs at which touchdown speed is reached"""
_FREEZE_ABOVE_M = 1.5
"""below this the LIDAR's shortest range is near: the ground height stays as last seen"""
_GROUND_RATE_MPS = 0.05
"""how fast a correction of the ground height moves the reference"""
_FEEL_BELOW_M = 0.6
_THRUST_RAMP_S = 0.5
_MOTORS_OFF_S = 1.0


def descend_to(flight: Flight) -> Generator[Setpoint, None, str | None]:
    """Down to the commitment height with both looks. None: committed; else why not, in words. In an
    emergency one look, which may move the site but refuses nothing."""
    flight.phase = Phase.DESCEND
    params = flight.params
    looks = params.second_look and (params.check_site or params.site_xy_m is None)
    yield from _sink_to(flight, params.look_height_m)
    if looks:
        refusal = yield from _look(flight, _MAX_SHIFT_M, "10 m")
        if refusal is not None and flight.deadline_s is None:
            return refusal
    yield from _sink_to(flight, params.commit_height_m)
    if looks and flight.deadline_s is None:
        yield from _sweep(flight)
        refusal = yield from _look(flight, _MAX_LOW_SHIFT_M, "4 m")
        if refusal is not None:
            return refusal
    _commit(flight)
    return None


def _sink_to(flight: Flight, height_m: float) -> Steps:
    """Vertically to ``height_m`` of the legs above the site, if that is below."""
    _refresh_ground(flight)
    assert flight.site_odom is not None
    here = flight.odom(flight.reference_world)
    target = flight.site_odom[2] + height_m + flight.leg_height
    if target < here[2] - 0.05:
        speed = flight.params.descent_speed_mps
        yield from flight.follow(vertical_move(here, target, speed))


def _refresh_ground(flight: Flight) -> None:
    """Height of the site as it is seen now. A site of the map stays where the map is, a commanded
    one at its world coordinates, should the two have moved."""
    assert flight.site_odom is not None
    commanded = flight.commanded_odom
    xy = flight.site_odom[:2] if commanded is None else commanded
    ground = ground_under(flight.map_view, xy)
    flight.site_odom = np.array([*xy, ground if np.isfinite(ground) else flight.site_odom[2]])


def _look(flight: Flight, max_shift_m: float, name: str) -> Generator[Setpoint, None, str | None]:
    """Hover, look, and move where the look says. None: the site (as moved) is good."""
    assert flight.site_odom is not None
    yield from flight.hover(_LOOK_HOVER_S)
    shift = 0.0 if flight.params.site_xy_m is not None else max_shift_m
    look = look_again(flight.map_view, flight.site_odom, shift, flight.params)
    waited = 0.0
    patience = _LOOK_PATIENCE_S if flight.deadline_s is None else 0.0
    while look.position_odom is None and waited < patience:
        yield from flight.hover(1.0)
        waited += 1.0
        look = look_again(flight.map_view, flight.site_odom, shift, flight.params)
    yield from flight.hover(flight.params.decision_latency_s)
    if look.position_odom is None:
        return f"at {name}: {look.reason}"
    unsafe = _unsafe_place(flight, look.position_odom) if max_shift_m == _MAX_SHIFT_M else None
    if unsafe is not None:
        return f"at {name}: {unsafe}"
    flight.note = f"look at {name}: {look.reason}"
    moved = float(np.linalg.norm(look.position_odom[:2] - flight.site_odom[:2]))
    flight.site_odom = look.position_odom
    if moved > 1e-6:
        here = flight.odom(flight.reference_world)
        yield from _move(flight, np.array([*look.position_odom[:2], here[2]]), _SHIFT_SPEED_MPS)
    return None


def _unsafe_place(flight: Flight, position: Array) -> str | None:
    """Why the kind of ground at ``position`` (3,) is refused from closer, in words; None: it is
    safe, or ground classification is off. At 4 m the camera sees too little of the place to ask."""
    if flight.places is None:
        return None
    place = flight.places.look_again(
        flight.site_place, position, flight.map_view, flight.obs.time_s
    )
    why = flight.places.refusal(place, flight.takes_risky)
    flight.site_place = place
    return why


def _sweep(flight: Flight) -> Steps:
    """Forward, back and home along the heading: the LIDAR's field of view is narrow that way."""
    centre = flight.odom(flight.reference_world)
    yaw = flight.setpoint(centre).yaw_odom
    ahead = flight.params.sweep_m * np.array([np.cos(yaw), np.sin(yaw), 0.0])
    for place in (centre + ahead, centre - ahead, centre):
        yield from _move(flight, place, _SWEEP_SPEED_MPS)


def _move(flight: Flight, end: Array, speed: float) -> Steps:
    here = flight.odom(flight.reference_world)
    path = straight_trajectory(here, np.zeros(3), end, speed, _ACCEL_MPS2)
    yield from flight.follow(path)


def _commit(flight: Flight) -> None:
    """From here on the site is what the touchdown is measured against."""
    _refresh_ground(flight)
    assert flight.site_odom is not None
    flight.committed_site_world = flight.world(flight.site_odom)


def final_descent(flight: Flight) -> Steps:
    """The last metres, until the ground is felt; then motors off."""
    flight.phase = Phase.DESCEND
    flight.final = True
    assert flight.site_odom is not None
    params = flight.params
    ground = float(flight.site_odom[2])
    here = flight.odom(flight.reference_world)
    path = descent_trajectory(
        np.array([*flight.site_odom[:2], here[2]]),
        ground + flight.leg_height + _SLOW_ABOVE_M,
        cruise_speed=params.final_speed_mps,
        touchdown_speed=params.touchdown_speed_mps,
        max_accel=0.5,
    )
    detector = TouchdownDetector(flight.rig)
    start, before, correction = flight.now, flight.now, 0.0
    offset = here[:2] - flight.site_odom[:2]
    while True:
        position, velocity, acceleration = path.sample(flight.now - start)
        legs_above = flight.position_odom[2] - flight.leg_height - ground - correction
        if legs_above > _FREEZE_ABOVE_M:
            seen = ground_under(flight.map_view, flight.site_odom)
            wanted = seen - ground if np.isfinite(seen) else correction
            limit = _GROUND_RATE_MPS * (flight.now - before)
            correction += float(np.clip(wanted - correction, -limit, limit))
        before = flight.now
        fade = float(np.exp(-(flight.now - start)))
        position = position + np.array([*(fade * offset), correction])
        if legs_above < _FEEL_BELOW_M and detector.update(flight.obs, flight.estimate):
            break
        yield flight.setpoint(position, velocity, acceleration)
    yield from settle(flight)


def settle(flight: Flight) -> Steps:
    """Touchdown: thrust to nothing over half a second, motors off, a moment of rest."""
    flight.phase = Phase.TOUCHDOWN
    flight.note = "ground felt: motors off"
    place = flight.position_odom.copy()
    start = flight.now
    while (t := flight.now - start) < _THRUST_RAMP_S:
        limit = 0.5 * (1.0 - t / _THRUST_RAMP_S)
        yield flight.setpoint(place, thrust_limit=limit)
    while flight.now - start < _THRUST_RAMP_S + _MOTORS_OFF_S:
        yield flight.setpoint(place, motors_on=False)
