"""A survey with sensors at planned poses: no physics, no control, no estimate."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from touchdown.estimator.api import Estimate, Mapper, MapView, PoseTrack
from touchdown.experiments.config.schema import Config
from touchdown.experiments.flight.survey_fit import fitted
from touchdown.experiments.flight.survey_path import with_path
from touchdown.experiments.flight.wiring import build_scene, make_world, world_params
from touchdown.landing.api import Selection, SelectorInput, SelectorRig
from touchdown.scenes.api import Scene
from touchdown.sim.api import Observation, SensorRig
from touchdown.sim.frames import Pose
from touchdown.sim.posed_sensors import PosedSensors, track_along


@dataclass(slots=True)
class PosedSurvey:
    """The configured sensors on the planned survey, at its true poses, and what serves them."""

    rig: SensorRig
    sensors: PosedSensors
    mapper: Mapper
    path: Any
    """``landing.mission.trajectory.PiecewiseTrajectory`` of the survey, world frame, yaw ``yaw``"""
    yaw: float
    select: Callable[[MapView, Estimate], Selection]
    """as the lander chooses at the end of its survey"""


def build_posed_survey(config: Config, scene: Scene) -> PosedSurvey:
    """Builds a survey without a flight. Raises ValueError as `build_flight_stack`."""
    from touchdown.estimator.mapping.mapper import GridMapper
    from touchdown.landing.mission.waypoints import survey_path
    from touchdown.landing.selection.selector import select_sites
    from touchdown.sim.frames import yaw_from_rotation

    world = make_world(config, scene)
    rig = world.rig
    world.close()
    start = rig.world_from_body_start
    yaw = yaw_from_rotation(start.rotation)
    above = start.translation + np.array([0.0, 0.0, config.survey.height_m])
    above[2] -= rig.vehicle.leg_height_m
    return PosedSurvey(
        rig=rig,
        sensors=PosedSensors(scene, world_params(config), config.world_seed),
        mapper=GridMapper(rig, config.mapper),
        path=survey_path(above, yaw, config.survey, config.landing),
        yaw=yaw,
        select=lambda map_view, estimate: select_sites(
            SelectorInput(map_view=map_view, estimate=estimate),
            SelectorRig(vehicle=rig.vehicle, landing=config.landing),
        ),
    )


SCAN_PERIOD_S = 0.1
"""of a flight"""
LOOK_PERIOD_S = 0.3
"""between the scans of a posed survey: each third one of a flight"""
_IMAGE_EVERY = 2
"""looks"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Surveyed:
    """One place as a survey mapped it, what was chosen there, and the true ground."""

    scene: Scene
    survey: PosedSurvey
    map_view: MapView
    estimate: Estimate
    """at the end of the survey"""
    selection: Selection


Watch = Callable[[SensorRig, Observation, Estimate], None]
"""Called with everything that a posed survey sees."""


def posed_survey(
    config: Config, period_s: float = LOOK_PERIOD_S, watch: Watch | None = None
) -> Surveyed:
    """Maps the configured scene along the survey and selects. Raises ValueError as `build_scene`.

    A scan every ``period_s``, at least the duration of one scan; with every second one a picture.
    """
    scene = build_scene(config)
    config = with_path(fitted(config, scene), scene)
    survey = build_posed_survey(config, scene)
    *_, (estimate, view) = observe(survey, survey.path, start_s=0.0, period_s=period_s, watch=watch)
    selection = survey.select(view, estimate)
    return Surveyed(
        scene=scene, survey=survey, map_view=view, estimate=estimate, selection=selection
    )


def observe(
    survey: PosedSurvey,
    path: Any,
    *,
    start_s: float,
    period_s: float = LOOK_PERIOD_S,
    watch: Watch | None = None,
    images: bool = True,
) -> Iterator[tuple[Estimate, MapView]]:
    """Moves the sensors along ``path`` from ``start_s`` on and yields after every scan, without
    ``images`` by the LIDAR alone. The camera is free again at the end."""
    rig, sensors = survey.rig, survey.sensors
    period = max(round(period_s * rig.tick_hz), rig.lidar_scan_ticks)
    first = round(start_s * rig.tick_hz)
    try:
        starts = range(first, first + round(path.duration_s * rig.tick_hz), period)
        for number, start in enumerate(starts):
            body = track_along(path, sensors.scan_times(start), start_s, survey.yaw)
            end, middle = start + rig.lidar_scan_ticks, start + rig.lidar_scan_ticks // 2
            takes = images and number % _IMAGE_EVERY == 0
            obs = Observation(
                tick=end,
                time_s=end / rig.tick_hz,
                scans=(sensors.scan(body, start),),
                images=(sensors.image(body, middle),) if takes else (),
                rotor_speed_radps=np.zeros(4),
                battery_fraction=1.0,
            )
            track = PoseTrack(
                times_s=body.times_s, positions_odom=body.positions, quats_wxyz=body.quats_wxyz
            )
            estimate = true_estimate(obs.tick, obs.time_s, body.last_pose, track)
            if watch is not None:
                watch(rig, obs, estimate)
            yield estimate, survey.mapper.update(obs, estimate)
    finally:
        sensors.close()


def true_estimate(tick: int, time_s: float, pose: Pose, track: PoseTrack | None = None) -> Estimate:
    """An estimate that is the true ``pose``, at rest, without doubt."""
    return Estimate(
        tick=tick,
        time_s=time_s,
        odom_from_body=pose,
        world_from_odom=Pose.identity(),
        velocity_odom=np.zeros(3),
        angular_velocity_body=np.zeros(3),
        acceleration_odom=np.zeros(3),
        position_covariance=np.zeros((3, 3)),
        rotation_covariance=np.zeros((3, 3)),
        scan_track=track,
    )
