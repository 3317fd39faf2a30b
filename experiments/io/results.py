"""The result of a run: the typed content of ``result.json``, its columns, and reading it back."""

import json
import os
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, Field, PrivateAttr

from touchdown.experiments.api import Outcome
from touchdown.experiments.errors import UsageError, input_message, reason_of
from touchdown.experiments.io.provenance import plain_json
from touchdown.experiments.io.result_parts import (
    Choice,
    Event,
    Figure,
    Intrusion,
    Landing,
    MapFigures,
    Measured,
    Nees,
    Part,
    PartNames,
    PhaseStart,
    PointXYZ,
    PositionError,
    Timing,
)
from touchdown.experiments.io.untrusted import read_object

_FILE = "result.json"
_LARGEST_SEED = 2**63 - 1


class RunResult(Part):
    """The result of one flight or replay. ``plain`` is the content of ``result.json``: the fields
    that were given, in the order below."""

    outcome: str
    reason: str = ""
    scene: str
    scene_sha: str | None = None
    """hash of the code of a scene MODULE:FUNCTION"""
    seed: int = Field(ge=-_LARGEST_SEED, le=_LARGEST_SEED)
    unit: str | None = None
    """flights of one unit share random draws; None in results of before flights of one seed over
    two scenes were independent"""
    estimator: str
    estimator_sha: str | None = None
    """hash of the code of an external estimator"""
    parts: PartNames | None = None
    """names of the parts that are not those by default"""
    parts_sha: PartNames | None = None
    """hashes of the code of the external ones"""
    profile: str | None = None
    """how kind the world was"""
    preset: str | None = None
    """how much was flown; None in results of before there were presets, which are of whole
    flights"""
    wind_kmh: Figure = None
    settings_set: dict[str, Any] | None = None
    """keys of the configuration that were set beside profile and preset, and their values; None in
    results of before they were told"""
    origin_m: PointXYZ = None
    """of the world's origin in the coordinates of the scene's file, where it was moved"""
    ground: dict[str, float] | None = None
    """of a scene with dials: what they asked for and what was reached"""
    replay_of: str | None = None
    flown_by: str | None = None
    """estimator of the flight that a replay reads"""
    judged_hz: Figure = None
    position_error_m: PositionError | None = None
    span_s: Annotated[tuple[Figure, Figure] | None, Field(strict=False)] = None
    """lift-off and end of the survey, between which positions are judged"""
    trajectory_error_m: Figure = None
    trajectory_error_max_m: Figure = None
    trajectory_variance_m2: Figure = None
    slowed_s: Figure = None
    """time by which wind has made the flight's trajectories longer than they were set"""
    nees: Nees | None = None
    landing: Landing | None = None
    """None where nothing was touched"""
    intrusion: Intrusion | None = None
    """None where nobody was sent"""
    choice: Choice | None = None
    """None where no site was to be chosen"""
    classifier: dict[str, Any] | str | None = None
    """the network of the ground classifier, or ``off``"""
    map: MapFigures | None = None
    timing: Timing | None = None
    versions: dict[str, str] = Field(default_factory=dict)
    renderer: str | None = None
    """what drew the camera's images, in the words of OpenGL; None without an image"""
    git_revision: str | None = None
    events: list[Event] = Field(default_factory=list)
    event_count: int = 0
    phases: list[PhaseStart] = Field(default_factory=list)
    faults: list[dict[str, Any]] = Field(default_factory=list)
    measured: Measured | None = None
    conditions: list[dict[str, Any]] = Field(default_factory=list)
    """verdicts of `experiments.flight.conditions`"""
    _path: Path | None = PrivateAttr(None)
    _settings: dict[str, Any] = PrivateAttr(default_factory=dict)

    @property
    def path(self) -> Path | None:
        """The run directory; None for a result that was not written."""
        return self._path

    @property
    def settings(self) -> Mapping[str, Any]:
        """The configuration keys in which the runs that `touchdown.load_runs` read together differ,
        with their values in this one."""
        return self._settings

    def found_at(
        self, path: Path | None, settings: Mapping[str, Any] = types.MappingProxyType({})
    ) -> "RunResult":
        """This result, of the run directory ``path``."""
        self._path, self._settings = path, dict(settings)
        return self

    @property
    def is_success(self) -> bool:
        """See `is_success`."""
        return is_success(self.outcome, None if self.landing is None else self.landing.ground_safe)

    def value(self, path: str) -> Any:
        """The value at a dotted path such as ``landing.slope_deg``; None where there is none."""
        return lookup(self.plain(), path)

    def plain(self) -> dict[str, Any]:
        """The content of ``result.json``: JSON types only."""
        return plain_json(self.model_dump(exclude_unset=True))

    def to_json(self) -> str:
        """The text of ``result.json``."""
        return json.dumps(self.plain(), indent=2) + "\n"


def is_success(outcome: str, touched_safe_ground: bool | None) -> bool:
    """The one rule of a successful flight: landed on safe ground, or, for a survey alone, flown to
    its end."""
    if outcome == Outcome.COMPLETED:
        return True
    return outcome == Outcome.LANDED and touched_safe_ground is True


def columns() -> dict[str, str]:
    """Dotted keys of all single values of a result and their kinds: ``text``, ``int``, ``float``,
    ``bool`` or ``floats``. Whole numbers are floats, except the seed."""
    return dict(_columns(RunResult, ""))


def _columns(model: type[BaseModel], prefix: str) -> typing.Iterator[tuple[str, str]]:
    hints = typing.get_type_hints(model)
    for name in model.model_fields:
        kind = _kind(hints[name])
        if isinstance(kind, str):
            yield prefix + name, "int" if prefix + name == "seed" else kind
        elif kind is not None:
            yield from _columns(kind, f"{prefix}{name}.")


_KINDS: Mapping[Any, str] = {str: "text", int: "float", float: "float", bool: "bool"}


def _kind(hint: Any) -> str | type[BaseModel] | None:
    """Kind of a field's column, the model of a nested part, or None for lists and mappings."""
    parts = [hint]
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        parts = [part for part in typing.get_args(hint) if part is not types.NoneType]
    if len(parts) != 1:
        return None
    (part,) = parts
    if typing.get_origin(part) is tuple:
        return "floats"
    if isinstance(part, type) and issubclass(part, BaseModel):
        return part
    return _KINDS.get(part)


def lookup(row: Mapping[str, Any], path: str) -> Any:
    """The value at a dotted path, None where any key is missing."""
    value: Any = row
    for key in path.split("."):
        if not isinstance(value, Mapping):
            return None
        value = value.get(key)
    return value


def load_result(path: Path) -> RunResult:
    """Reads one ``result.json``. Raises UsageError, one line, where it is none."""
    try:
        return RunResult.model_validate(read_object(path))
    except OSError as error:
        raise UsageError(input_message(error)) from error
    except ValueError as error:
        raise UsageError(f"'{path}' is no run's result: {reason_of(error)}") from error


def result_files(directory: Path) -> list[Path]:
    """Every ``result.json`` at or below ``directory``, sorted. Folders that cannot be read, or
    vanish meanwhile, hold none."""
    walked = os.walk(directory)
    return sorted(Path(folder, _FILE) for folder, _, files in walked if _FILE in files)


def load_runs(directory: Path) -> dict[str, RunResult]:
    """Every ``result.json`` at or below ``directory``, sorted by scene, estimator and seed, each
    with its ``path``. Keys are the run directories, relative to ``directory``.

    Raises UsageError where there is none or one cannot be read.
    """
    if not directory.is_dir():
        raise UsageError(f"'{directory}' is no directory of runs")
    found: dict[str, RunResult] = {}
    for file in result_files(directory):
        name = _run_name(file.parent, directory)
        found[name] = load_result(file).found_at(file.parent)
    if not found:
        raise UsageError(f"'{directory}' holds no finished run (no result.json)")
    ordered = sorted(found.items(), key=lambda i: (i[1].scene, i[1].estimator, i[1].seed))
    return dict(ordered)


def _run_name(run: Path, directory: Path) -> str:
    return directory.resolve().name if run == directory else run.relative_to(directory).as_posix()
