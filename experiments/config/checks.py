"""Checks that involve several keys of a configuration. The range of a single key is part of its
type; see `sim.params`."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping

import numpy as np

from touchdown.experiments.config.schema import Config
from touchdown.experiments.errors import UsageError
from touchdown.landing.api import SurveyParams


def check_rates(config: Config) -> None:
    """Raises UsageError unless every rate divides the clock: events fall on whole ticks."""
    sim = config.sim
    for name in ("control_ticks", "imu_ticks", "camera_ticks", "lidar_scan_ticks"):
        ticks = getattr(sim, name)
        if sim.tick_hz % ticks:
            raise UsageError(f"sim.{name} = {ticks} must divide sim.tick_hz = {sim.tick_hz}")
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
    for group in ("livo", "zou2024", "optical_flow", "hybrid_flow", "stereo_vo"):
        camera_hz = getattr(config, group).camera_hz
        if camera_clock_hz % camera_hz:
            raise UsageError(
                f"{group}.camera_hz = {camera_hz} must divide the camera's clock of "
                f"{camera_clock_hz} Hz"
            )


MAX_CELLS = 2048
"""along a side of a map: its layers then take some hundred MB"""


def check_map(config: Config) -> None:
    """Raises UsageError for a landing without a map, and for a map that memory has no room for."""
    for extent, cell in (("extent_m", "cell_m"), ("fine_extent_m", "fine_cell_m")):
        sides = (getattr(config.mapper, extent), getattr(config.mapper, cell))
        if sides[0] > MAX_CELLS * sides[1]:
            raise UsageError(
                f"mapper.{extent} = {sides[0]:g} over mapper.{cell} = {sides[1]:g} gives a map of "
                f"more than {MAX_CELLS} cells along a side; take larger cells"
            )
    if not config.mapper.enabled and not config.landing.survey_only:
        raise UsageError(
            "mapper.enabled = false leaves nothing to choose a landing site from: it is for "
            "`touchdown fly`, or with landing.survey_only = true"
        )


def check_faults(config: Config, sources: Mapping[str, str]) -> None:
    """Raises UsageError for a schedule of faults that cannot happen."""
    try:
        config.faults.schedule()
    except ValueError as error:
        where = sources.get("faults.events", "the configuration")
        raise UsageError(f"faults.events in {where}: {error}") from None
    try:
        config.faults.check(config.wind.mean_kmh)
    except ValueError as error:
        raise UsageError(str(error)) from None
    if config.light != "day" and any(f.kind == "low_sun" for f in config.faults.schedule()):
        raise UsageError(
            f"fault 'low_sun' needs light = 'day', not {config.light!r}: it is the sun that is low"
        )


def check_survey(config: Config, sources: Mapping[str, str]) -> None:
    """Raises UsageError for a survey that does not fit into its duration."""
    path = dataclasses.replace(config.survey, height_m=SurveyParams().height_m)
    problem = "" if path == SurveyParams() else survey_problem(path)
    if problem:
        given = {
            source: None
            for key, source in sources.items()
            if key.startswith("survey.") and not source.startswith("profile ")
        }
        raise UsageError(f"{problem} (survey as set in {', '.join(given)})")


@functools.cache
def survey_problem(params: SurveyParams) -> str:
    """The reason why a survey cannot be flown in its duration; "" if it can."""
    from touchdown.landing.mission.trajectory import survey_trajectory

    try:
        survey_trajectory(np.zeros(3), 0.0, params)
    except ValueError as error:
        return str(error)
    return ""
