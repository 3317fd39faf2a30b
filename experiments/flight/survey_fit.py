"""Fits the standard survey to the ground of a file's scene: smaller where ground ends, higher where
something stands."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from touchdown.experiments.config.loading import survey_problem
from touchdown.experiments.config.schema import Config
from touchdown.landing.api import SurveyParams
from touchdown.scenes.api import Scene

if TYPE_CHECKING:
    from touchdown.scenes.truth.survey_facts import SurveyGround

GROUND_FRACTION = 0.95
"""least fraction of the survey with ground below"""
CLEARANCE_M = 2.0
"""least clearance of the legs above objects; below it the survey is raised"""
TURN_M = 3.0
"""width of the ground beyond a turn"""
SHORTEST_M = 8.0
"""length of the shortest leg that is tried"""
SWATH_M = 20.0
"""width of the ground that a leg sees to either side, when two surveys are compared"""
_RAISED_M = 6.0
"""clearance above objects of a survey that is raised"""
_HIGHEST_M = 60.0
"""maximum height to which a survey is raised"""
_LOW_M = 20.0
"""height over a place that holds one leg of less than 24 m"""
_STEP_M = 2.0
"""difference of the lengths that are tried"""


@dataclasses.dataclass(frozen=True, slots=True)
class Fit:
    """A survey that fits, and the keys that differ from those configured."""

    survey: SurveyParams
    search_legs: int
    changed: dict[str, Any]


def fitted(config: Config, scene: Scene) -> Config:
    """Returns ``config`` with the survey of `fit_survey` and warns of what differs. Only the
    standard survey over a file that is made ready is fitted."""
    fit = fit_survey(config, scene)
    if fit is None or not fit.changed:
        return config
    keys = ", ".join(f"{key}={value:g}" for key, value in fit.changed.items())
    warnings.warn(f"{scene.source}: the survey is fitted to the ground: {keys}", stacklevel=3)
    landing = dataclasses.replace(config.landing, search_legs=fit.search_legs)
    return config.model_copy(update={"survey": fit.survey, "landing": landing})


def fit_survey(config: Config, scene: Scene) -> Fit | None:
    """The largest survey of no more than the configured size with ground below its legs and turns.

    None where not even the shortest leg has ground below it, where the survey is not the standard
    one, and over a scene that is not of a file or is taken as it is. In a turn over an edge half of
    the pictures and scans are empty, and an estimate moves by up to a metre."""
    survey = config.survey
    standard = dataclasses.replace(SurveyParams(), climb_turn_deg=survey.climb_turn_deg)
    if scene.options is None or survey != standard:
        return None
    from touchdown.scenes.truth.survey_facts import survey_ground

    width = survey.legs * survey.leg_spacing_m
    ground = survey_ground(scene, survey.leg_length_m, width)
    for one in sorted(_surveys(survey), key=lambda one: (-_seen_m2(one), one.legs)):
        if _fraction(ground, one, one.legs) < GROUND_FRACTION:
            continue
        one = one if one == survey else _timed(one, survey)
        highest = ground.highest_m(one.leg_length_m, _width(one))
        height = one.height_m
        if highest > height - CLEARANCE_M:
            height = min(float(np.ceil(highest + _RAISED_M)), _HIGHEST_M)
        one = dataclasses.replace(one, height_m=height)
        next_leg = _fraction(ground, one, one.legs + 1)
        legs = config.landing.search_legs if next_leg >= GROUND_FRACTION else 0
        return Fit(one, legs, _changed(survey, one, config.landing.search_legs, legs))
    return None


def _fraction(ground: SurveyGround, survey: SurveyParams, legs: int) -> float:
    """Of the legs or of the turns of ``survey`` with so many ``legs``, whichever is less."""
    length, spacing = survey.leg_length_m, survey.leg_spacing_m
    below = ground.fraction(length, (legs - 1) * spacing)
    return min(below, ground.turns_fraction(length, legs, spacing, TURN_M))


def _surveys(survey: SurveyParams) -> Iterator[SurveyParams]:
    """``survey`` and smaller ones, at its duration."""
    yield survey
    lengths = np.arange(survey.leg_length_m, SHORTEST_M - 0.1, -_STEP_M)
    for legs in range(survey.legs, 0, -1):
        for spacing in (survey.leg_spacing_m, 15.0, 10.0)[: 3 if legs > 1 else 1]:
            for length in lengths.tolist():
                one = dataclasses.replace(
                    survey, legs=legs, leg_spacing_m=spacing, leg_length_m=length
                )
                if one != survey:
                    yield one


def _timed(one: SurveyParams, standard: SurveyParams) -> SurveyParams:
    """A survey at the speed of the standard one, slower where it would need too much."""
    low = one.height_m
    if one.legs == 1 and one.leg_length_m < 24.0:
        low = min(_LOW_M, low)
    seconds = max(standard.duration_s * _way_m(one) / _way_m(standard), 5.0)
    one = dataclasses.replace(
        one, duration_s=float(np.ceil(seconds)), height_m=low,
        min_height_m=min(one.min_height_m, low),
    )  # fmt: skip
    while survey_problem(one):
        one = dataclasses.replace(one, duration_s=one.duration_s + 2.0)
    return one


def _way_m(survey: SurveyParams) -> float:
    return survey.legs * survey.leg_length_m + _width(survey)


def _width(survey: SurveyParams) -> float:
    return (survey.legs - 1) * survey.leg_spacing_m


def _seen_m2(survey: SurveyParams) -> float:
    return survey.leg_length_m * (_width(survey) + 2.0 * SWATH_M)


def _changed(
    before: SurveyParams, after: SurveyParams, search_before: int, search_after: int
) -> dict[str, Any]:
    found = {
        f"survey.{field.name}": getattr(after, field.name)
        for field in dataclasses.fields(SurveyParams)
        if getattr(after, field.name) != getattr(before, field.name)
    }
    return found | ({"landing.search_legs": search_after} if search_after != search_before else {})
