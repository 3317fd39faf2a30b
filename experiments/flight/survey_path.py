"""Reads the path of a survey from its file."""

import dataclasses
from pathlib import Path

import numpy as np

from touchdown.experiments.config.schema import Config
from touchdown.experiments.errors import UsageError
from touchdown.experiments.io.flight_plan import read_path
from touchdown.scenes.api import Scene

PATTERNS = ("serpentine", "spiral")


def with_path(config: Config, scene: Scene) -> Config:
    """Returns ``config`` with the waypoints of the file that ``survey.path`` names. A plan that
    lands commands the site, one that returns lands at the take-off spot. Raises UsageError for a
    file that cannot be read, and for a waypoint outside the scene."""
    survey, landing = config.survey, config.landing
    if survey.path in PATTERNS or survey.waypoints_m:
        return config
    plan = read_path(Path(survey.path), survey.height_m, survey.leg_spacing_m, survey.home_wgs84)
    low, high = scene.bounds_xy_m - scene.takeoff_xy_m
    for number, (east, north, _) in enumerate(plan.waypoints_m, start=1):
        if not ((low <= (east, north)) & ((east, north) <= high)).all():
            raise UsageError(
                f"survey.path: '{survey.path}': waypoint {number} is {east:.0f} m east and "
                f"{north:.0f} m north of the take-off, outside '{scene.name}' ({low[0]:.0f} to "
                f"{high[0]:.0f} and {low[1]:.0f} to {high[1]:.0f} m)"
            )
    heights = [up for *_, up in plan.waypoints_m]
    survey = dataclasses.replace(
        survey,
        waypoints_m=plan.waypoints_m, home_wgs84=plan.home_wgs84, height_m=heights[0],
        min_height_m=min(survey.min_height_m, *heights),
    )  # fmt: skip
    if not landing.survey_only and plan.land_m is not None and landing.site_xy_m is None:
        site = scene.takeoff_xy_m + np.array(plan.land_m)
        landing = dataclasses.replace(landing, site_xy_m=(float(site[0]), float(site[1])))
    if not landing.survey_only and plan.returns:
        landing = dataclasses.replace(landing, return_home=True)
    return config.model_copy(update={"survey": survey, "landing": landing})
