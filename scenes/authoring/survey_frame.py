"""Position and heading of the survey in a scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.authoring.lot import Lot

Array = NDArray[np.float64]

SURVEY_MIDDLE_M = np.array([25.0, 20.0])
"""Middle of the survey's 50 x 40 m: ahead of the take-off spot, to the left of it."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SurveyFrame:
    """Coordinates of the survey: u along the take-off heading, v to its left."""

    takeoff_xy_m: Array
    takeoff_yaw: float

    @property
    def from_takeoff(self) -> Lot:
        """Coordinates from the take-off spot."""
        return Lot(origin_xy_m=self.takeoff_xy_m, angle=self.takeoff_yaw)

    @property
    def from_middle(self) -> Lot:
        """Coordinates from the survey's middle."""
        return Lot(origin_xy_m=self.from_takeoff.points(SURVEY_MIDDLE_M), angle=self.takeoff_yaw)


def draw_frame(rng: np.random.Generator) -> SurveyFrame:
    """A frame whose survey's middle is within 2 m of the scene's along each axis: the survey
    lies in a square of 128 m for every heading."""
    yaw = float(rng.uniform(-np.pi, np.pi))
    middle = Lot(origin_xy_m=rng.uniform(-2.0, 2.0, 2), angle=yaw)
    return SurveyFrame(takeoff_xy_m=middle.points(-SURVEY_MIDDLE_M), takeoff_yaw=yaw)
