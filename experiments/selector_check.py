"""Choosing sites without flying: towed surveys of many places, judged by the true maps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.api import Estimate, MapView, PoseTrack
from experiments.build import build_scene
from experiments.build_tools import TowedSurvey, build_towed_survey
from experiments.config import Config
from landing.api import Selection
from scenes.api import Scene
from sim.api import Observation
from sim.frames import Pose

Array = NDArray[np.float64]

SCENES = (
    "cottage", "crossroad", "footbridge", "forest", "houses", "lake", "pools", "rooftop_parking",
    "turf",
)  # fmt: skip
"""All but ``flat`` and ``open_water``, where there is nothing to choose."""
SCAN_PERIOD_S = 0.1
"""of a flight"""
LOOK_PERIOD_S = 0.3
"""between the scans of a towed survey: each third one of a flight"""
_PICTURE_EVERY = 2
"""looks"""
ROOM_CAP_M = 3.0
"""truly safe ground farther than this from any unsafe one has all the room that counts"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Surveyed:
    """One place as a survey mapped it, what was chosen there, and the true ground."""

    scene: Scene
    survey: TowedSurvey
    map_view: MapView
    estimate: Estimate
    """at the end of the survey"""
    selection: Selection


def tow_survey(config: Config, period_s: float = LOOK_PERIOD_S) -> Surveyed:
    """Maps the configured scene along the survey and selects. Raises ValueError as `build_scene`.

    A scan every ``period_s``, at least the duration of one scan; with every second one a picture.
    """
    scene = build_scene(config)
    survey = build_towed_survey(config, scene)
    sim = config.sim
    period = max(round(period_s * sim.tick_hz), sim.lidar_scan_ticks)
    view, estimate = None, None
    try:
        starts = range(0, round(survey.path.duration_s * sim.tick_hz), period)
        for number, start in enumerate(starts):
            picture = number % _PICTURE_EVERY == 0
            look = survey.tow.look(start, survey.path, 0.0, survey.yaw, picture=picture)
            end = start + sim.lidar_scan_ticks
            obs = Observation(
                tick=end,
                time_s=end / sim.tick_hz,
                scans=(look.scan,),
                images=() if look.image is None else (look.image,),
                rotor_speed_radps=np.zeros(4),
                battery_fraction=1.0,
            )
            track = PoseTrack(
                times_s=look.times_s,
                positions_odom=look.positions_world,
                quats_wxyz=look.quats_wxyz,
            )
            estimate = _true_estimate(obs, look.world_from_body, track)
            view = survey.mapper.update(obs, estimate)
    finally:
        survey.tow.close()
    assert view is not None
    assert estimate is not None
    selection = survey.select(view, estimate)
    return Surveyed(
        scene=scene, survey=survey, map_view=view, estimate=estimate, selection=selection
    )


def _true_estimate(obs: Observation, pose: Pose, track: PoseTrack) -> Estimate:
    return Estimate(
        tick=obs.tick,
        time_s=obs.time_s,
        odom_from_body=pose,
        world_from_odom=Pose.identity(),
        velocity_odom=np.zeros(3),
        angular_velocity_body=np.zeros(3),
        acceleration_odom=np.zeros(3),
        position_covariance=np.zeros((3, 3)),
        rotation_covariance=np.zeros((3, 3)),
        scan_track=track,
    )
