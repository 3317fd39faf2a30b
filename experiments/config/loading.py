"""Loading of configurations from files and options.

Order of precedence, lowest first: the defaults of the ``*Params`` dataclasses in the ``api.py``
files, the profile, the preset, the vehicle, the rig, a TOML file (or the ``config.json`` of an
earlier run), ``--set a.b=c``, explicit options.
Every mistake is a ``UsageError`` with one line: what is wrong, where, what would be right.
"""

import dataclasses
import difflib
import functools
import json
import math
import re
import tomllib
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from touchdown.experiments.config.files import (
    LARGEST,
    came_with_results,
    check_named_code,
    read_tree,
    wrong_value,
)
from touchdown.experiments.config.keys import (
    BASES,
    REMOVED_GROUPS,
    base_in,
    flatten,
    renewed,
)
from touchdown.experiments.config.profiles import (
    BEFORE_PROFILES,
    DEFAULT,
    KEY,
    base_sources,
    base_values,
    chosen_by_hand,
)
from touchdown.experiments.config.ranges import (
    choices_of,
    constants,
    out_of_range,
    rule_of,
    types_of_keys,
)
from touchdown.experiments.config.schema import Config
from touchdown.experiments.config.slots import PREFIX, SLOTS, check_part_names, wrong_external_key
from touchdown.experiments.errors import UsageError, nearest, plain_fault
from touchdown.landing.api import SurveyParams

OPTION_KEYS: Mapping[str, str] = {
    "scene": "scene",
    "seed": "seed",
    "estimator": "estimator",
    "profile": "profile",
    "preset": "preset",
    "light": "light",
    "vehicle": "vehicle",
    "rig": "rig",
    "as_is": "scene_as_is",
    "classes": "scene_classes",
    "calibration": "calibration",
    "record": "record",
    "log_sensors": "log.sensors",
    "wind_kmh": "wind.mean_kmh",
    "site": "landing.site_xy_m",
    "emergency": "landing.emergency",
    **{kind: slot.key for kind, slot in SLOTS.items() if kind != "estimator"},
    "survey_only": "landing.survey_only",
    "trajectory": "survey.trajectory",
    "fault": "faults.events",
    "px4": "px4.path",
    "px4_port": "px4.port",
    "px4_connect": "px4.connect",
    "px4_aid": "px4.aid",
}
"""Explicit options of ``load_config`` and the keys that they set."""
BY_DEFAULT = "the defaults"
"""Source of the profile that nothing names."""


def load_config(
    file: Path | None = None,
    overrides: Sequence[str] | Mapping[str, Any] = (),
    take: Callable[[str], bool] = lambda _key: True,
    *,
    allow_code: bool = False,
    profile_default: str = DEFAULT,
    **options: Any,
) -> Config:
    """Builds the configuration of a flight.

    ``file`` is a TOML file or a ``config.json``; ``overrides`` are ``a.b=c`` strings whose values
    are TOML (bare words count as text), or values by key; ``options`` are the names in
    ``OPTION_KEYS``, where None means not given. Keys of the file for which ``take`` is false are
    left out. Without ``allow_code`` a file that came with results must not name external code for a
    slot, unless an override or an option names what fills it. ``profile_default`` is the profile
    where no source names one. Raises ``UsageError``.
    """
    values: dict[str, Any] = {}
    sources: dict[str, str] = {}
    if file is not None:
        for key, value in read_values(file).items():
            if take(key):
                values[key], sources[key] = value, str(file)
    given: dict[str, Any] = {}
    if isinstance(overrides, Mapping):
        by_source = {"overrides": overrides}
    else:
        by_source = {f"--set {text}": dict([parse_override(text)]) for text in overrides}
    for source, pairs in by_source.items():
        for key, value in renewed(pairs, source).items():
            given[key], sources[key] = value, source
    for name, value in options.items():
        if value is not None:
            key, source = OPTION_KEYS[name], f"--{name.replace('_', '-')}"
            given |= renewed({key: list(value) if isinstance(value, tuple) else value}, source)
            sources[key] = source
    if file is not None:
        values = under_base(file, values, given)
    values |= given
    if KEY not in values:
        values[KEY], sources[KEY] = profile_default, BY_DEFAULT
    if file is not None and not allow_code:
        keys = ("scene", "px4.path", *(slot.key for slot in SLOTS.values()))
        check_named_code(
            file, ((key, values.get(key)) for key in keys if sources.get(key) == str(file))
        )
    return config_of(values, sources)


def read_values(file: Path) -> dict[str, Any]:
    """The values by dotted key of a configuration file. A JSON file is the ``config.json`` of a
    run: without a profile it is of a version that had none. Raises ``UsageError``."""
    now = renewed(dict(flatten(read_tree(file))), f"'{file}'")
    if file.suffix != ".json":
        return now
    if constants := [key for key in now if is_constant(key)]:
        warnings.warn(f"'{file}': constants now, left out: {', '.join(constants)}", stacklevel=2)
    return {KEY: BEFORE_PROFILES} | {key: now[key] for key in now if key not in constants}


def under_base(file: Path, values: dict[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """The ``values`` that ``file`` contributes beside those ``given`` by hand: of a whole
    configuration under another profile or preset, only what its author had chosen."""
    whole = {**values, **given}
    if came_with_results(file) and any(base_in(whole, k) != base_in(values, k) for k in BASES):
        return chosen_by_hand(values, dict(default_values()))
    return values


def config_of(values: Mapping[str, Any], sources: Mapping[str, str]) -> Config:
    """The configuration with ``values`` by dotted key over those of their profile and preset.
    ``sources`` holds the source of each value, for error messages. Raises ``UsageError``."""
    for key, value in values.items():
        if reason := wrong_value([key, value]):
            raise UsageError(f"{key[:80]} in {sources[key]} {reason}")
        _check_key(key, sources[key])
        _check_range(key, value, sources[key])
    if found := wrong_external_key(values):
        key, reason = found
        raise UsageError(f"{key} in {sources.get(key, 'the configuration')} {reason}")
    base = base_values(values)
    sources = {**base_sources(values), **sources}
    config = _validate({KEY: base_in(values, KEY), **base, **values}, sources)
    check_part_names(config, sources)
    _check_rates(config)
    _check_map(config)
    _check_faults(config, sources)
    check_survey(config, sources)
    _check_dials(config, sources)
    return config


def dump_config(config: Config) -> str:
    """JSON text that ``load_config`` reads back to an equal configuration."""
    return config.model_dump_json(indent=2) + "\n"


@functools.cache
def default_values() -> tuple[tuple[str, Any], ...]:
    """Every dotted key of the schema, in its order, and its default as JSON has it."""
    return tuple(flatten(json.loads(Config().model_dump_json())))


@functools.cache
def known_keys() -> tuple[str, ...]:
    """Every dotted key of the schema, in its order."""
    return tuple(key for key, _ in default_values())


def is_constant(key: str) -> bool:
    """True for a key of an earlier version that cannot be set any more."""
    return key in constants() or key.partition(".")[0] in REMOVED_GROUPS


def is_key(key: str) -> bool:
    """True if a dotted key can be set."""
    return key in known_keys() or key.startswith(PREFIX)


def parse_override(text: str) -> tuple[str, Any]:
    """The dotted key and the value of ``key=value``, as after ``--set``. Raises UsageError."""
    key, equals, raw = text.partition("=")
    key = key.strip()
    if not equals or not re.fullmatch(r"[A-Za-z0-9_]+(\.[A-Za-z0-9_]+)*", key):
        raise UsageError(f"--set '{text}' is not of the form key=value, such as wind.mean_kmh=20")
    try:
        return key, tomllib.loads(f"value = {raw.strip()}")["value"]
    except (tomllib.TOMLDecodeError, KeyError, RecursionError):
        return key, raw.strip()
    except ValueError:  # of Python, about a number of thousands of digits
        return key, LARGEST + 1


MAX_SEEDS = 100_000
_MAX_DIGITS = 40


def parse_seeds(text: Any, where: str, maximum: int = MAX_SEEDS) -> list[int]:
    """``"0-2, 7"`` gives [0, 1, 2, 7]. ``where`` names the option or key in error messages.

    Raises UsageError for other forms and for more than ``maximum`` seeds.
    """
    seeds: list[int] = []
    for part in str(text).split(","):
        found = re.fullmatch(r"\s*(\d+)\s*(?:-\s*(\d+)\s*)?", part)
        if not found or not isinstance(text, str):
            raise UsageError(f"{where} {text!r} is not of the form '0-9' or '0-4,7'")
        digits = max(map(len, found.groups("")))
        first, last = (0, 0) if digits > _MAX_DIGITS else (int(found[1]), int(found[2] or found[1]))
        if digits > _MAX_DIGITS or last > LARGEST:
            raise UsageError(
                f"{where} {text[: 2 * _MAX_DIGITS]!r} holds a seed above {LARGEST}, the largest; "
                "give smaller ones"
            )
        if last < first:
            raise UsageError(f"{where} {text!r} counts down in '{part.strip()}'")
        if len(seeds) + last + 1 - first > maximum:
            raise UsageError(f"{where} {text!r} are more than {maximum}; give fewer")
        seeds += range(first, last + 1)
    return seeds


def _check_key(key: str, source: str) -> None:
    keys = known_keys()
    if is_key(key):
        return
    if key == "external":
        keys = ("external.gain",)
    if is_constant(key):
        raise UsageError(f"'{key}' in {source} is a constant and no key; leave it out")
    inside = [known for known in keys if known.startswith(f"{key}.")]
    if inside:
        raise UsageError(
            f"'{key}' in {source} is a group, set one of its keys, such as '{inside[0]}'"
        )
    group, _, rest = key.partition(".")
    if rest and difflib.get_close_matches(group, ["external"], cutoff=0.7):
        keys = (*keys, f"external.{rest}")
    from touchdown.experiments.config.suggestions import suggestion  # reads what the keys mean

    hint = suggestion(key, keys) or f"; groups: {', '.join(Config.model_fields)}"
    raise UsageError(f"unknown key '{key}' in {source}{hint}")


def _check_range(key: str, value: Any, source: str) -> None:
    numbers = value if isinstance(value, list) else [value]
    for number in numbers:
        if isinstance(number, float) and not math.isfinite(number):
            raise UsageError(f"{key} = {number} in {source} must be a finite number")
    if out_of_range(key, value):
        raise UsageError(f"{key} = {_given(value)} in {source} {rule_of(key)}")


def _given(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else json.dumps(value, default=str)


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
        raise UsageError(_message(error, values, sources)) from None


def _message(error: ValidationError, values: Mapping[str, Any], sources: Mapping[str, str]) -> str:
    """One line about the first mistake that pydantic found."""
    first = error.errors(include_url=False)[0]
    message = plain_fault(first["msg"])
    location = [str(part) for part in first["loc"] if not str(part).isdigit()]

    prefixes = [".".join(location[:n]) for n in range(len(location), 0, -1)]
    key = next((prefix for prefix in prefixes if prefix in values), prefixes[0])
    value = values.get(key)
    where = sources.get(key, "the configuration")
    if (names := choices_of(types_of_keys().get(key))) and isinstance(value, list):
        value = next((name for name in value if name not in names), value)
    given = _given(value)
    if names:
        hint = nearest(str(value), names)
        known = ", ".join(name or "''" for name in names)
        return f"{key} = {given[:60]} in {where} is unknown{hint}; known: {known}"
    return f"{key} = {given} in {where} is wrong: {message}"


def _check_rates(config: Config) -> None:
    """Raises UsageError unless every rate divides the clock: events fall on whole ticks."""
    sim = config.sim
    for name in ("control_ticks", "imu_ticks", "camera_ticks", "lidar_scan_ticks"):
        ticks = getattr(sim, name)
        if sim.tick_hz % ticks:
            raise UsageError(f"sim.{name} = {ticks} must divide sim.tick_hz = {sim.tick_hz}")
        if name in ("imu_ticks", "lidar_scan_ticks") and ticks % sim.control_ticks:
            raise UsageError(
                f"sim.{name} = {ticks} must be a multiple of "
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


def _check_map(config: Config) -> None:
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


def _check_dials(config: Config, sources: Mapping[str, str]) -> None:
    """Raises UsageError for dials of ``rugged`` or ``deck`` over another scene."""
    for scene, dials in (("rugged", config.rugged), ("deck", config.deck)):
        usual = type(dials)()
        if config.scene == scene or dials == usual:
            continue
        given = dataclasses.asdict(dials)
        key = next(f"{scene}.{k}" for k, v in given.items() if v != getattr(usual, k))
        raise UsageError(
            f"{key} in {sources.get(key, 'the configuration')} is a dial of the scene '{scene}' "
            f"and not of '{config.scene}': fly over '{scene}', or leave it out"
        )


def _check_faults(config: Config, sources: Mapping[str, str]) -> None:
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
    if not config.survey.is_serpentine:
        return
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
