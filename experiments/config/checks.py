"""Checks that involve several keys of a configuration."""

from __future__ import annotations

import dataclasses
import functools
import json
import re
from collections.abc import Mapping

import numpy as np

from touchdown.experiments.config.keys import flatten, is_external_key
from touchdown.experiments.config.schema import Config
from touchdown.experiments.errors import UsageError
from touchdown.landing.api import SurveyParams


def check_survey(params: SurveyParams) -> None:
    """Raises ValueError for a survey that cannot be flown in its time."""
    from touchdown.landing.mission.trajectory import survey_trajectory

    survey_trajectory(np.zeros(3), 0.0, params)


POSITIVE = re.compile(
    r"(_hz|_ticks|cell_m|extent_m|_points|_pixels|\.width|\.height|fov_[xy]_deg|range_m|capacity_j"
    r"|ramp_s|timeout_s|divergence_m|period_s|duration_s|leg_length_m|survey\.height_m|\.legs|length_m"
    r"|threads|max_\w+|clear_radius_m)$"
)


NOT_NEGATIVE = re.compile(
    r"(_kmh|sigma(_\w+)?|_density|_walk|weight_\w+|_latency_\w+|^(scene_)?seed)$"
)


POSITIVE_EXCEPT = re.compile(r"[_.]latency_ticks$")


def _check_ranges(config: Config, sources: Mapping[str, str]) -> None:
    """Signs follow the names: a rate, a size or a duration is positive, a spread not negative."""
    for key, value in flatten(json.loads(config.model_dump_json())):
        if isinstance(value, bool) or not isinstance(value, int | float) or is_external_key(key):
            continue
        where = f" in {sources[key]}" if key in sources else ""
        if POSITIVE.search(key) and not POSITIVE_EXCEPT.search(key):
            if value <= 0:
                raise UsageError(f"{key} = {value:g}{where} must be positive")
        elif NOT_NEGATIVE.search(key) and value < 0:
            raise UsageError(f"{key} = {value:g}{where} must not be negative")
    if not 1 <= config.log.jpeg_quality <= 100:
        raise UsageError(f"log.jpeg_quality = {config.log.jpeg_quality} must be within 1 to 100")
    for key in ("fov_x_deg", "fov_y_deg"):
        if getattr(config.camera, key) >= 180.0:
            raise UsageError(f"camera.{key} = {getattr(config.camera, key):g} must be below 180")


def _check_rates(config: Config) -> None:
    """Every rate divides the clock: events fall on whole ticks or not at all."""
    sim = config.sim
    for field in dataclasses.fields(sim):
        if field.name in (
            "control_ticks",
            "imu_ticks",
            "camera_ticks",
            "lidar_scan_ticks",
        ):
            ticks = getattr(sim, field.name)
            if sim.tick_hz % ticks:
                raise UsageError(
                    f"sim.{field.name} = {ticks} must divide sim.tick_hz = {sim.tick_hz}"
                )
    for name in ("imu_ticks", "lidar_scan_ticks"):
        if getattr(sim, name) % sim.control_ticks:
            raise UsageError(
                f"sim.{name} = {getattr(sim, name)} must be a multiple of "
                f"sim.control_ticks = {sim.control_ticks}"
            )
    control_hz = sim.tick_hz // sim.control_ticks
    if config.control.control_hz != control_hz:
        raise UsageError(
            f"control.control_hz = {config.control.control_hz} must be sim.tick_hz / "
            f"sim.control_ticks = {control_hz}"
        )
    camera_clock_hz = sim.tick_hz // sim.camera_ticks
    for group in ("livo", "paper", "optical_flow", "hybrid_flow", "stereo_vo"):
        camera_hz = getattr(config, group).camera_hz
        if camera_clock_hz % camera_hz:
            raise UsageError(
                f"{group}.camera_hz = {camera_hz} must divide the camera's clock of "
                f"{camera_clock_hz} Hz"
            )


def _check_map(config: Config) -> None:
    if not config.mapper.enabled and not config.landing.survey_only:
        raise UsageError(
            "mapper.enabled = false leaves nothing to choose a landing site from: it is for "
            "`touchdown fly`, or with landing.survey_only = true"
        )


def _check_faults(config: Config, sources: Mapping[str, str]) -> None:
    try:
        config.faults.schedule()
    except ValueError as error:
        where = sources.get("faults.events", "the configuration")
        raise UsageError(f"faults.events in {where}: {error}") from None
    try:
        config.faults.check(config.wind.mean_kmh)
    except ValueError as error:
        raise UsageError(str(error)) from None


def _check_survey(config: Config, sources: Mapping[str, str]) -> None:
    path = dataclasses.replace(config.survey, height_m=SurveyParams().height_m)
    problem = "" if path == SurveyParams() else _survey_problem(path)
    if problem:
        given = {source: None for key, source in sources.items() if key.startswith("survey.")}
        raise UsageError(f"{problem} (survey as set in {', '.join(given)})")


@functools.cache
def _survey_problem(params: SurveyParams) -> str:
    """Why a survey cannot be flown, empty where it can."""

    try:
        check_survey(params)
    except ValueError as error:
        return str(error)
    return ""
