"""Surveys along waypoints: spirals, and the paths of files.

Straight ways at constant speed are joined by turns. A turn begins and ends at one distance from its
corner, at one speed, and its velocity passes from one direction to the other without acceleration
at its ends: ``v (u + (3 s^2 - 2 s^3) (w - u))`` for s from 0 to 1, whose largest acceleration is
``1.5 v |w - u| / T``. The speed of a turn is the one that this allows.
"""

import numpy as np

from touchdown.landing.api import LandingParams, SurveyParams
from touchdown.landing.mission.trajectory import (
    PiecewiseTrajectory,
    State,
    survey_trajectory,
    through,
)
from touchdown.sim.frames import rotation_from_yaw
from touchdown.sim.typing import Array

_CORNER_M = 5.0
"""largest distance from a corner at which its turn begins"""
_CORNER_FRACTION = 0.4
"""the same, of the shorter way that meets there"""
_APART_M = 0.1
"""distance from which two waypoints are two"""
_SPIRAL_STEP = np.radians(30.0)
_BLEND = 1.5
"""largest acceleration of a change of velocity without acceleration at its ends, over its mean"""


def survey_path(
    start: Array, yaw: float, survey: SurveyParams, landing: LandingParams
) -> PiecewiseTrajectory:
    """Returns the path of a survey from ``start`` (3,), above the take-off spot at survey height,
    at the heading ``yaw`` (rad). Raises ValueError as `survey_trajectory`, and for waypoints
    without a way."""
    if survey.is_serpentine:
        return survey_trajectory(start, yaw, survey)
    ways = start + survey_waypoints(yaw, survey) - [0.0, 0.0, survey.height_m]
    return waypoint_trajectory(
        np.vstack([start, ways]),
        landing.cruise_speed_mps, landing.climb_speed_mps, landing.accel_mps2,
    )  # fmt: skip


def survey_waypoints(yaw: float, survey: SurveyParams) -> Array:
    """(N, 3) corners of a survey: metres east and north of the take-off spot, and height above it.
    ``yaw``: heading of the take-off, rad. Raises ValueError for a file that has not been read."""
    if survey.waypoints_m:
        return np.array(survey.waypoints_m)
    if survey.path == "spiral":
        angle = np.arange(_SPIRAL_STEP, 2.0 * np.pi * survey.legs + 1e-6, _SPIRAL_STEP)
        radius = survey.leg_spacing_m * angle / (2.0 * np.pi)
        places = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
    elif survey.path != "serpentine":
        raise ValueError(f"survey.path: '{survey.path}' is read in flights and maps alone")
    else:
        legs = np.repeat(np.arange(survey.legs), 2)
        far = np.isin(np.arange(legs.size) % 4, (1, 2))
        places = np.column_stack([survey.leg_length_m * far, survey.leg_spacing_m * legs])
    corners = np.column_stack([places, np.full(len(places), survey.height_m)])
    return np.asarray(corners @ rotation_from_yaw(yaw).T)


def waypoint_trajectory(
    places: Array, speed_mps: float, climb_mps: float, accel_mps2: float
) -> PiecewiseTrajectory:
    """Returns the path from rest at the first of ``places`` (N, 3) past the others to rest at the
    last. It passes a corner at less than half of the distance at which its turn begins, and keeps
    the limits of speed, of its vertical part and of acceleration. Raises ValueError where no two
    places are apart."""
    places = places[np.insert(np.linalg.norm(np.diff(places, axis=0), axis=1) > _APART_M, 0, True)]
    ways = np.diff(places, axis=0)
    if len(ways) == 0:
        raise ValueError("the survey goes nowhere: its waypoints are at the take-off spot")
    lengths = np.linalg.norm(ways, axis=1)
    along = ways / lengths[:, None]
    limits = np.minimum(speed_mps, climb_mps / np.maximum(np.abs(along[:, 2]), 1e-9))
    turn = np.linalg.norm(np.diff(along, axis=0), axis=1)
    room = np.minimum(_CORNER_FRACTION * np.minimum(lengths[:-1], lengths[1:]), _CORNER_M)
    room = np.where(turn > 1e-6, room, 0.0)
    # T = 2 room / v, so that 1.5 v |w - u| / T stays below the limit.
    with np.errstate(divide="ignore", invalid="ignore"):
        allowed = np.where(turn > 1e-6, np.sqrt(2.0 * accel_mps2 * room / (_BLEND * turn)), np.inf)
    speeds = np.minimum(allowed, np.minimum(limits[:-1], limits[1:]))
    speeds = np.concatenate([[0.0], speeds, [0.0]])
    room = np.concatenate([[0.0], room, [0.0]])
    straight = lengths - room[:-1] - room[1:]
    # A change of speed from v to w takes the way 0.75 |w^2 - v^2| / a.
    gain = accel_mps2 * straight / (0.5 * _BLEND)
    for k in range(len(ways)):
        speeds[k + 1] = min(speeds[k + 1], np.sqrt(speeds[k] ** 2 + gain[k]))
    for k in reversed(range(len(ways))):
        speeds[k] = min(speeds[k], np.sqrt(speeds[k + 1] ** 2 + gain[k]))
    states, durations = [State(places[0])], list[float]()

    def go(to: Array, velocity: Array, seconds: float) -> None:
        states.append(State(to, velocity))
        durations.append(seconds)

    for k, direction in enumerate(along):
        before, after = speeds[k], speeds[k + 1]
        here, end = places[k] + room[k] * direction, places[k + 1] - room[k + 1] * direction
        fastest = min(limits[k], np.sqrt(0.5 * (before**2 + after**2 + gain[k])))
        for old, new, last in ((before, fastest, False), (fastest, after, True)):
            change = _BLEND * abs(new - old) / accel_mps2
            way = 0.5 * (old + new) * change
            if last and (left := float((end - here) @ direction) - way) > 1e-6 * lengths[k]:
                here = here + left * direction
                go(here, fastest * direction, left / fastest)
            if change > 1e-9:
                here = here + way * direction
                go(here, new * direction, change)
        if room[k + 1] > 0.0:
            turned = along[k + 1]
            go(places[k + 1] + room[k + 1] * turned, after * turned, 2.0 * room[k + 1] / after)
    return through(states, durations)
