"""Flights along the trajectory of a file: the lander that only watches, and the path."""

from pathlib import Path

import numpy as np

from touchdown.controller.api import Setpoint
from touchdown.estimator.api import Estimate, MapView
from touchdown.experiments.config.schema import Config
from touchdown.experiments.errors import UsageError
from touchdown.experiments.io.tum import read_tum
from touchdown.landing.api import LanderView, Phase
from touchdown.scenes.api import Scene
from touchdown.sim.api import Observation, SensorNeeds, WorldParams
from touchdown.sim.carried import REST_S, CarriedWorld, FlownPath
from touchdown.sim.files.opening import no_file


def carried_world(config: Config, scene: Scene, params: WorldParams, drawn: bool) -> CarriedWorld:
    """The world of ``survey.trajectory``. Raises UsageError for a file that holds no trajectory, or
    one that the scene has no room for, and where more than a survey is asked for."""
    file = Path(config.survey.trajectory)
    if not config.landing.survey_only:
        raise UsageError("nothing lands on survey.trajectory; use `touchdown fly`")
    if reason := no_file(file):
        raise UsageError(f"survey.trajectory: '{file}' {reason}")
    try:
        path = FlownPath(*read_tum(file))
        height = config.survey.trajectory_lowest_m
        return CarriedWorld(scene, params, config.world_seed, path, height, drawn)
    except ValueError as error:
        raise UsageError(f"survey.trajectory: '{file}': {error}") from None


class Passenger:
    """A lander that leaves the flying to the trajectory: a survey until it ends."""

    needs = SensorNeeds()

    def __init__(self, duration_s: float) -> None:
        self._duration_s = duration_s
        self._view = LanderView(phase=Phase.INIT, reference_world=np.zeros(3))

    def update(self, obs: Observation, estimate: Estimate, map_view: MapView) -> Setpoint:
        """Returns the estimate as the setpoint: nothing is to be corrected."""
        pose = estimate.odom_from_body
        phase = Phase.INIT if obs.time_s < REST_S else Phase.SURVEY
        over = obs.time_s >= self._duration_s
        self._view = LanderView(
            phase=Phase.DONE if over else phase,
            reference_world=estimate.world_from_body.translation,
        )
        return Setpoint(
            position_odom=pose.translation,
            velocity_odom=estimate.velocity_odom,
            acceleration_odom=np.zeros(3),
            yaw_odom=0.0,
            motors_on=False,
        )

    def view(self) -> LanderView:
        """The phase; no site is chosen."""
        return self._view
