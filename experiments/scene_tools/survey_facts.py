"""Facts of a scene that matter to the configured survey."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from touchdown.experiments.config.schema import Config
from touchdown.landing.api import SurveyParams
from touchdown.scenes.api import Scene

if TYPE_CHECKING:
    from touchdown.scenes.truth.scene_facts import SceneFacts
    from touchdown.scenes.truth.survey_facts import SurveyFacts


def survey_facts(config: Config, scene: Scene) -> SurveyFacts:
    """Ground and safe sites within reach of the configured survey."""
    from touchdown.scenes.truth.survey_facts import survey_facts as facts

    return facts(scene, *_survey_reach(config.survey))


def scene_facts(config: Config, scene: Scene) -> SceneFacts:
    """Size, take-off spot and obstacles of an MJCF file's scene, for the configured survey."""
    from touchdown.scenes.truth.scene_facts import scene_facts as facts

    return facts(scene, *_survey_reach(config.survey))


def _survey_reach(survey: SurveyParams) -> tuple[float, float, float, float]:
    """Length and width of the rectangle of the legs, and the reach of the sensors beyond it along
    and across. A Livox Horizon sees 81.7 x 25.1 degrees: from 30 m, 26 m aside and 6.7 m ahead."""
    ahead, aside = survey.height_m * np.tan(0.5 * np.deg2rad([25.1, 81.7]))
    width = (survey.legs - 1) * survey.leg_spacing_m
    return survey.leg_length_m, width, float(ahead), float(aside)
