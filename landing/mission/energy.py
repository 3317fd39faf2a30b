"""Cost of flight segments in seconds of the battery's remaining flight time."""

import numpy as np

from touchdown.landing.api import LandingParams, SurveyParams
from touchdown.landing.mission.state import MissionState
from touchdown.landing.mission.trajectory import PEAK_SPEED, RAMP_S
from touchdown.landing.mission.view import MissionView

_LOOK_S = 2.5
_SWEEP_S = 8.0
_FINAL_S = 6.0
"""deceleration above the ground, the last decimetres, motors off"""
_MARGIN = 1.2
"""safety factor for gusts, tracking errors and the lower yield of a low battery"""


def travel_time_s(distance_m: float, params: LandingParams) -> float:
    """Returns the time from rest to rest by the minimum-jerk segment of
    ``landing.mission.trajectory``."""
    shortest = np.sqrt(6.0 * max(distance_m, 0.0) / params.accel_mps2)
    return max(PEAK_SPEED * distance_m / params.cruise_speed_mps, shortest)


def landing_time_s(height_m: float, params: LandingParams, *, emergency: bool = False) -> float:
    """Returns the time from a hover at ``height_m`` above the site to motors off; in an
    ``emergency`` with one look only."""
    sink = max(height_m - params.commit_height_m, 0.0) / params.descent_speed_mps
    last = params.commit_height_m / params.final_speed_mps + _FINAL_S
    looks = _LOOK_S if emergency else 2.0 * _LOOK_S + _SWEEP_S
    return sink + 2.0 * RAMP_S + last + (looks if params.site_recheck else 0.0)


def return_time_s(away_m: float, height_m: float, params: LandingParams) -> float:
    """Returns the time to the take-off spot ``away_m`` away and down from ``height_m``."""
    return _MARGIN * (travel_time_s(away_m, params) + landing_time_s(height_m, params))


def search_leg_time_s(survey: SurveyParams, params: LandingParams) -> float:
    """Returns the time for another leg and the way to its start."""
    way = travel_time_s(survey.leg_spacing_m, params)
    return _MARGIN * (way + travel_time_s(survey.leg_length_m, params))


def go_around_time_s(height_m: float, params: LandingParams) -> float:
    """Returns the time for the climb back to ``height_m`` and another landing from there."""
    climb = height_m / params.climb_speed_mps + RAMP_S
    return _MARGIN * (climb + landing_time_s(height_m, params))


def affords(seconds: float, view: MissionView, state: MissionState) -> bool:
    """True if the battery lasts for ``seconds`` and then the way home and a landing there."""
    home = return_time_s(view.away_m, state.survey.height_m, view.params)
    return view.time_left_s >= seconds + home


def affords_search_leg(view: MissionView, state: MissionState) -> bool:
    """True if the battery lasts for another leg of the survey."""
    return affords(search_leg_time_s(state.survey, view.params), view, state)


def affords_go_around(view: MissionView, state: MissionState) -> bool:
    """True if the battery lasts for a go-around."""
    return affords(go_around_time_s(state.survey.height_m, view.params), view, state)


def reach_m(view: MissionView, state: MissionState) -> float:
    """Returns the largest distance to a site (the energy threshold of Eq. 18): the battery must
    last for a landing there and a go-around, in an emergency for a landing in time."""
    params, height, left = view.params, state.survey.height_m, view.time_left_s
    if view.in_emergency:
        if state.deadline_s is not None:
            left = min(left, state.deadline_s - view.now_s)
        reserve = landing_time_s(height, params, emergency=True)
    else:
        reserve = 2.0 * go_around_time_s(height, params)
    return max(left - reserve, 0.0) * params.cruise_speed_mps / PEAK_SPEED
