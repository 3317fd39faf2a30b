"""The configuration: its schema is the code, files and options override it.

Order of precedence, lowest first: the defaults of the ``*Params`` dataclasses in the ``api.py``
files, a TOML file (or the ``config.json`` of an earlier run), ``--set a.b=c``, explicit options.
Every mistake is a ``UsageError`` with one line: what is wrong, where, what would be right.
"""

from __future__ import annotations

import dataclasses
import difflib
import functools
import json
import math
import re
import tomllib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from controller.api import ControlParams
from estimator.api import (
    GpsEstimatorParams,
    HybridFlowParams,
    LivoParams,
    MapperParams,
    OpticalFlowParams,
    PaperParams,
    StereoParams,
)
from experiments.api import BiasParams, RefereeParams, RigErrorParams
from experiments.outside_keys import PREFIX, wrong_outside_key
from experiments.suggest import nearest
from landing.api import LandingParams, SurveyParams
from sim.api import (
    FORBID_EXTRA,
    BarometerParams,
    CameraParams,
    FaultParams,
    GpsParams,
    ImuParams,
    LidarParams,
    MagnetometerParams,
    NavParams,
    RangefinderParams,
    SimParams,
    WindParams,
)


class UsageError(ValueError):
    """A mistake of the user, told in one line; the command line turns it into exit code 2."""


@dataclass(frozen=True, kw_only=True, slots=True)
class LogParams:
    """What a run directory keeps, and how densely."""

    __pydantic_config__ = FORBID_EXTRA

    trajectory_hz: float = 50.0
    """rows a second in the .tum files"""
    camera_hz: float = 2.0
    """most images a second in the recording"""
    jpeg_quality: int = 70
    scan_hz: float = 5.0
    """most LIDAR scans a second in the recording"""
    scan_points: int = 2500
    """most points of a recorded scan"""
    map_period_s: float = 2.5
    """between two updates of the recorded map"""
    texture_pixels: int = 1600
    """longer side of the ground texture in the recording"""
    sensors: bool = False
    """write ``sensors.mcap``: every message that reached the estimator, for replay"""


class Config(BaseModel):
    """Everything that decides a flight; written as ``config.json`` beside its results."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    scene: str = "crossroad"
    seed: int = 0
    scene_seed: int | None = None
    """seed of the place alone, for flights over one place in other winds and noises; None: ``seed``
    decides that too"""
    estimator: str = "livo"
    outside: dict[str, Any] = Field(default_factory=dict)
    """what an estimator of somebody's own, MODULE:FUNCTION, is built with: any keys"""
    calibration: str | None = None
    """path of a file of `touchdown calibrate` that estimators are told instead of the rig's own
    calibration with the errors of ``rig_error``"""
    record: bool = True
    """write the Rerun recording (trajectories, map and costmap are always written)"""
    sim: SimParams = Field(default_factory=SimParams)
    wind: WindParams = Field(default_factory=WindParams)
    lidar: LidarParams = Field(default_factory=LidarParams)
    camera: CameraParams = Field(default_factory=CameraParams)
    imu: ImuParams = Field(default_factory=ImuParams)
    gps: GpsParams = Field(default_factory=GpsParams)
    barometer: BarometerParams = Field(default_factory=BarometerParams)
    magnetometer: MagnetometerParams = Field(default_factory=MagnetometerParams)
    rangefinder: RangefinderParams = Field(default_factory=RangefinderParams)
    faults: FaultParams = Field(default_factory=FaultParams)
    mapper: MapperParams = Field(default_factory=MapperParams)
    livo: LivoParams = Field(default_factory=LivoParams)
    paper: PaperParams = Field(default_factory=PaperParams)
    gps_estimator: GpsEstimatorParams = Field(default_factory=GpsEstimatorParams)
    optical_flow: OpticalFlowParams = Field(default_factory=OpticalFlowParams)
    hybrid_flow: HybridFlowParams = Field(default_factory=HybridFlowParams)
    stereo_vo: StereoParams = Field(default_factory=StereoParams)
    control: ControlParams = Field(default_factory=ControlParams)
    survey: SurveyParams = Field(default_factory=SurveyParams)
    landing: LandingParams = Field(default_factory=LandingParams)
    referee: RefereeParams = Field(default_factory=RefereeParams)
    bias: BiasParams = Field(default_factory=BiasParams)
    rig_error: RigErrorParams = Field(default_factory=RigErrorParams)
    log: LogParams = Field(default_factory=LogParams)

    @property
    def nav(self) -> NavParams:
        """The small sensors together, as the world takes them."""
        return NavParams(
            gps=self.gps,
            barometer=self.barometer,
            magnetometer=self.magnetometer,
            rangefinder=self.rangefinder,
        )


OPTION_KEYS: Mapping[str, str] = {
    "scene": "scene",
    "seed": "seed",
    "estimator": "estimator",
    "calibration": "calibration",
    "record": "record",
    "log_sensors": "log.sensors",
    "wind_kmh": "wind.mean_kmh",
    "site": "landing.site_xy_m",
    "emergency": "landing.emergency",
    "survey_only": "landing.survey_only",
    "fault": "faults.events",
}
"""Explicit options of ``load_config`` and the keys that they set."""


def load_config(
    file: Path | None = None,
    overrides: list[str] | tuple[str, ...] = (),
    take: Callable[[str], bool] = lambda _key: True,
    **options: Any,
) -> Config:
    """Builds the configuration of a flight.

    ``file`` is a TOML file or a ``config.json``; ``overrides`` are ``a.b=c`` strings whose values
    are TOML (bare words count as text); ``options`` are the names in ``OPTION_KEYS``, where None
    means not given. ``take`` says of each key of the file whether it counts. Raises ``UsageError``.
    """
    values: dict[str, Any] = {}
    sources: dict[str, str] = {}
    if file is not None:
        for key, value in flatten(read_tree(file)):
            if take(key):
                values[key], sources[key] = value, str(file)
    for text in overrides:
        key, value = _parse_override(text)
        values[key], sources[key] = value, f"--set {text}"
    for name, value in options.items():
        if value is not None:
            key = OPTION_KEYS[name]
            values[key] = list(value) if isinstance(value, tuple) else value
            sources[key] = f"--{name.replace('_', '-')}"
    return config_of(values, sources)


def config_of(values: Mapping[str, Any], sources: Mapping[str, str]) -> Config:
    """The configuration that sets ``values``, by dotted key; ``sources`` says where each comes
    from. Raises ``UsageError``."""
    for key, value in values.items():
        _check_key(key, sources[key])
        _check_finite(key, value, sources[key])
    if found := wrong_outside_key(values, values.get("estimator", "livo")):
        key, reason = found
        raise UsageError(f"{key} in {sources.get(key, 'the configuration')} {reason}")
    config = _validate(values, sources)
    _check_ranges(config, sources)
    _check_rates(config)
    _check_map(config)
    _check_faults(config, sources)
    _check_survey(config, sources)
    return config


def dump_config(config: Config) -> str:
    """JSON text that ``load_config`` reads back to an equal configuration."""
    return config.model_dump_json(indent=2) + "\n"


@functools.cache
def known_keys() -> tuple[str, ...]:
    """Every dotted key of the schema, in its order."""
    return tuple(key for key, _ in flatten(json.loads(Config().model_dump_json())))


def is_key(key: str) -> bool:
    """Whether a dotted key may be set."""
    return key in known_keys() or is_outside_key(key)


def is_outside_key(key: str) -> bool:
    """Whether it is of the table that outside estimators are built with, where any key may be."""
    return key.startswith(PREFIX)


# ------------------------------------------------------------------------------------- reading


def read_tree(file: Path) -> dict[str, Any]:
    """The tables of a TOML or JSON file. Raises ``UsageError``."""
    if not file.is_file():
        raise UsageError(f"configuration file '{file}' does not exist")
    try:
        text = file.read_text(encoding="utf-8")
        data = json.loads(text) if file.suffix == ".json" else tomllib.loads(text)
    except (tomllib.TOMLDecodeError, json.JSONDecodeError) as error:
        kind = "JSON" if file.suffix == ".json" else "TOML"
        raise UsageError(f"'{file}' is not valid {kind}: {_one_line(error)}") from None
    except (UnicodeDecodeError, OSError) as error:
        raise UsageError(f"'{file}' cannot be read as text: {_one_line(error)}") from None
    except RecursionError:
        raise UsageError(f"'{file}' is nested too deeply for a configuration") from None
    if not isinstance(data, dict):
        raise UsageError(f"'{file}' must hold one object of keys and values")
    return data


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())


def _parse_override(text: str) -> tuple[str, Any]:
    key, equals, raw = text.partition("=")
    key = key.strip()
    if not equals or not re.fullmatch(r"[A-Za-z0-9_]+(\.[A-Za-z0-9_]+)*", key):
        raise UsageError(f"--set '{text}' is not of the form key=value, such as wind.mean_kmh=20")
    try:
        return key, tomllib.loads(f"value = {raw.strip()}")["value"]
    except (tomllib.TOMLDecodeError, KeyError, RecursionError):
        return key, raw.strip()


def flatten(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """(dotted key, value) of every leaf of nested tables."""
    for name, value in tree.items():
        if isinstance(value, dict):
            yield from flatten(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


# ----------------------------------------------------------------------------------- validation


def _check_key(key: str, source: str) -> None:
    keys = known_keys()
    if is_key(key):
        return
    if key == "outside":
        keys = ("outside.gain",)
    inside = [known for known in keys if known.startswith(f"{key}.")]
    if inside:
        raise UsageError(
            f"'{key}' in {source} is a group, set one of its keys, such as '{inside[0]}'"
        )
    group, _, rest = key.partition(".")
    if rest and difflib.get_close_matches(group, ["outside"], cutoff=0.7):
        keys = (*keys, f"outside.{rest}")
    hint = nearest(key, keys) or _same_last_name(key, keys)
    raise UsageError(f"unknown key '{key}' in {source}{hint or f'; groups: {_groups()}'}")


def _same_last_name(key: str, keys: tuple[str, ...]) -> str:
    """The hint for a key whose group is wrong or missing: ``mean_kmh`` for ``wind.mean_kmh``."""
    name = key.split(".")[-1]
    matches = difflib.get_close_matches(name, [k.split(".")[-1] for k in keys], n=1, cutoff=0.5)
    full = [known for known in keys if matches and known.split(".")[-1] == matches[0]]
    return f" (did you mean '{full[0]}'?)" if full else ""


def _groups() -> str:
    return ", ".join(Config.model_fields)


def _check_finite(key: str, value: Any, source: str) -> None:
    numbers = value if isinstance(value, list) else [value]
    for number in numbers:
        if isinstance(number, float) and not math.isfinite(number):
            raise UsageError(f"{key} = {number} in {source} must be a finite number")


def _validate(values: Mapping[str, Any], sources: Mapping[str, str]) -> Config:
    tree: dict[str, Any] = {}
    for key, value in values.items():
        if key == "faults.events" and isinstance(value, str):
            value = [value]
        *groups, name = key.split(".")
        node = tree
        for group in groups:
            node = node.setdefault(group, {})
        node[name] = value
    try:
        # JSON, because strict validation of JSON takes arrays for tuples and whole numbers for
        # floats but neither text for numbers nor numbers for booleans.
        return Config.model_validate_json(json.dumps(tree, default=str), strict=True)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        location = [str(part) for part in first["loc"] if not str(part).isdigit()]
        key = next(
            (
                ".".join(location[:n])
                for n in range(len(location), 0, -1)
                if ".".join(location[:n]) in values
            ),
            ".".join(location),
        )
        message = first["msg"][:1].lower() + first["msg"][1:]
        given = json.dumps(values.get(key), default=str)
        where = sources.get(key, "the configuration")
        raise UsageError(f"{key} = {given} in {where} is wrong: {message}") from None


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
        if isinstance(value, bool) or not isinstance(value, int | float) or is_outside_key(key):
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
    from experiments.build_tools import check_survey

    try:
        check_survey(params)
    except ValueError as error:
        return str(error)
    return ""
