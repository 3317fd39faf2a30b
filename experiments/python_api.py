"""The functions of ``import touchdown``: fly, land, replay and read results from Python.

Every mistake of the caller raises ``UsageError`` with one line. Heavy modules are imported inside
the functions.
"""

from __future__ import annotations

import functools
import json
import os
import re
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec, TypedDict, TypeVar, Unpack

from touchdown.experiments.config import loading
from touchdown.experiments.config.keys import flatten
from touchdown.experiments.config.schema import Config
from touchdown.experiments.config.slots import SLOTS, params_of
from touchdown.experiments.errors import UsageError, nearest
from touchdown.experiments.external.loading import Build, name_of

if TYPE_CHECKING:
    from touchdown.experiments.external.conformance import Violation
    from touchdown.experiments.io.results import RunResult

Overrides = Mapping[str, Any]
"""Values by dotted configuration key, such as ``{"survey.height_m": 20.0}``."""
_P = ParamSpec("_P")
_R = TypeVar("_R")
_KEYWORDS = (
    ("--allow-code", "allow_code=True"),
    ("--log-sensors", "log.sensors=True among the overrides"),
    ("--out, or give --force", "out, or remove it"), ("--out", "out"), ("--set", "overrides"),
    ("--scene-from", "the argument scene"),
    *((f"--{name}", f"the argument {name}") for name in ("scene", "seed", *SLOTS)),
)  # fmt: skip


class Parts(TypedDict, total=False):
    """The slots of a flight beside the estimator, as arguments; see ``docs/bring-your-own.md``."""

    selector: str | Build | None
    lander: str | Build | None
    controller: str | Build | None
    mapper: str | Build | None
    classifier: str | Build | None
    watch: str | Build | None


Progress = bool | Callable[[float, str, str], None]
"""True prints progress to stderr; a function is called with simulated seconds, phase and note."""


def _by_keyword(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Names keywords instead of options of the command line in the errors of ``function``."""

    @functools.wraps(function)
    def wrapped(*arguments: _P.args, **keywords: _P.kwargs) -> _R:
        try:
            return function(*arguments, **keywords)
        except UsageError as error:
            text = str(error)
            for option, keyword in _KEYWORDS:
                text = re.sub(rf"(?<!\w){option}(?![\w-])", keyword, text)
            raise UsageError(text) from error

    return wrapped


@_by_keyword
def load_config(
    file: str | Path | None = None,
    *,
    scene: str | Path | None = None,
    estimator: str | Build | None = None,
    seed: int | None = None,
    overrides: Overrides | None = None,
    allow_code: bool = False,
    **parts: Unpack[Parts],
) -> Config:
    """The configuration of a flight.

    ``file`` is a TOML file or the ``config.json`` of a run; without it the defaults apply.
    ``overrides`` win over the file, the other arguments over both. A file that came with results
    names external parts, whose modules a flight imports, only with ``allow_code``. Raises
    UsageError.
    """
    return loading.load_config(
        _path(file), _plain(overrides or {}), allow_code=allow_code,
        scene=_plain(scene), seed=_plain(seed), **_names(estimator=estimator, **parts),
    )  # fmt: skip


@_by_keyword
def fly(
    scene: str | Path | Config = "crossroad",
    *,
    estimator: str | Build | None = None,
    seed: int | None = None,
    overrides: Overrides | None = None,
    out: str | Path | None = None,
    progress: Progress = False,
    live: str | None = None,
    **parts: Unpack[Parts],
) -> RunResult:
    """Flies the survey alone and returns its result.

    ``scene`` is the name of a scene, the path of an MJCF file, or a configuration; the other
    arguments change it. ``estimator``, ``selector``, ``lander``, ``controller``, ``mapper``,
    ``classifier`` and ``watch`` are names, or functions ``build(params, rig)`` that make the part.
    With ``out`` the run directory appears there, and replaces an earlier one of the same
    configuration; without it nothing is written. ``{"record": False}`` in ``overrides`` leaves out
    the recording. ``live`` is the address of a Rerun viewer that shows the flight while it goes on,
    such as ``rerun+http://127.0.0.1:9876/proxy``. Raises UsageError for bad input before the
    flight.
    """
    slots = _names(estimator=estimator, **parts)
    config = _flight_config(scene, seed, overrides, survey_only=True, **slots)
    return _flown(config, out, progress, live)


@_by_keyword
def land(
    scene: str | Path | Config = "crossroad",
    *,
    estimator: str | Build | None = None,
    seed: int | None = None,
    overrides: Overrides | None = None,
    out: str | Path | None = None,
    progress: Progress = False,
    live: str | None = None,
    **parts: Unpack[Parts],
) -> RunResult:
    """Takes off, surveys, maps, chooses a site, lands on it, and returns the result.

    Arguments and errors are those of `fly`. An outcome other than a landing is a result, not an
    exception.
    """
    slots = _names(estimator=estimator, **parts)
    config = _flight_config(scene, seed, overrides, survey_only=False, **slots)
    return _flown(config, out, progress, live)


@_by_keyword
def replay(
    run: str | Path,
    *,
    estimator: str | Build | None = None,
    overrides: Overrides | None = None,
    out: str | Path | None = None,
    progress: Progress = False,
    allow_code: bool = False,
) -> RunResult:
    """Replays the logged sensors of a run directory into an estimator; returns the result.

    The run must hold ``sensors.mcap`` (``overrides={"log.sensors": True}`` of its flight). Without
    ``estimator``, that of the run is used; where it is an external one, with ``allow_code`` only.
    Raises UsageError.
    """
    from touchdown.experiments.flight import replay as replays
    from touchdown.experiments.flight.replacing import check_kept
    from touchdown.experiments.terminal import end_progress

    _prepare()
    texts = tuple(f"{key}={json.dumps(value)}" for key, value in (overrides or {}).items())
    config = replays.replay_config(
        Path(run), _names(estimator=estimator)["estimator"], texts, allow_code=allow_code
    )
    if (folder := _path(out)) is not None and folder.resolve() != Path(run).resolve():
        check_kept(folder, config, force=False, replayed=Path(run))
    result = replays.replay(Path(run), config, folder, _progress(progress))
    end_progress(quiet=progress is not True)
    return result.found_at(folder)


@_by_keyword
def load_runs(directory: str | Path) -> list[RunResult]:
    """The results of all runs at or below ``directory``, sorted by scene, estimator and seed, each
    with the ``path`` of its run and, in ``settings``, the configuration keys in which they differ.
    Raises UsageError where there is none or one cannot be read."""
    from touchdown.experiments.config.keys import settings_apart
    from touchdown.experiments.io import results

    found = list(results.load_runs(Path(directory)).values())
    paths = [run.path or Path(directory) for run in found]
    apart = zip(found, paths, settings_apart(paths), strict=True)
    return [run.found_at(path, settings) for run, path, settings in apart]


@_by_keyword
def check_estimator(
    estimator: str | Build, *, overrides: Overrides | None = None, seconds: float = 3.0
) -> list[Violation]:
    """Checks an estimator against the contract of a flight, on synthetic sensor messages.

    ``estimator`` is a name, ``module:function``, or the function ``build(params, rig)`` itself.
    Returns the first violation of each rule that is broken; an empty list is a pass.
    """
    from touchdown.experiments.external import conformance
    from touchdown.experiments.flight.platform import limit_threads
    from touchdown.experiments.flight.wiring import estimator_builder

    if not seconds > 0.0:
        raise UsageError(f"seconds = {seconds:g} must be positive")
    limit_threads()
    name = estimator if isinstance(estimator, str) else "given:function"
    config = load_config(estimator=name, overrides=overrides)
    build = estimator_builder(config) if isinstance(estimator, str) else estimator
    return conformance.check_estimator(
        build, params=params_of(config, "estimator"), seconds=seconds
    )


def _plain(value: Any) -> Any:
    """Paths as text, tuples as lists, NumPy scalars and arrays as Python numbers and lists."""
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "tolist"):
        value = value.tolist()
    return [_plain(item) for item in value] if isinstance(value, tuple | list) else value


def _names(**parts: Any) -> dict[str, Any]:
    """The names of what fills slots. Raises UsageError for what is neither a name nor callable."""
    names: dict[str, Any] = {}
    for kind, part in parts.items():
        if kind not in SLOTS:
            raise UsageError(f"there is no argument {kind}{nearest(kind, SLOTS)}")
        if not (part is None or isinstance(part, str) or callable(part)):
            raise UsageError(
                f"--{kind} is a {type(part).__name__}; give a name, or the function "
                "build(params, rig) that makes the part"
            )
        names[kind] = name_of(part) if callable(part) else part
    return names


def _flight_config(
    scene: str | Path | Config,
    seed: int | None,
    overrides: Overrides | None,
    **options: Any,
) -> Config:
    values: dict[str, Any] = {}
    if isinstance(scene, Config):
        values = dict(flatten(json.loads(loading.dump_config(scene))))
    return loading.load_config(
        None, {**values, **_plain(overrides or {})},
        scene=None if values else _plain(scene), seed=_plain(seed), **options,
    )  # fmt: skip


def _flown(
    config: Config, out: str | Path | None, progress: Progress, live: str | None
) -> RunResult:
    _prepare()
    from touchdown.experiments.flight.replacing import check_kept
    from touchdown.experiments.flight.run import fly_with_usage_errors
    from touchdown.experiments.terminal import end_progress

    if (folder := _path(out)) is not None:
        check_kept(folder, config, force=False)
    result = fly_with_usage_errors(config, folder, _progress(progress), live)
    end_progress(quiet=progress is not True)
    return result.found_at(folder)


def _prepare() -> None:
    """Chooses the rendering backend, which MuJoCo reads when it is loaded, and keeps away what
    Open3D would print in a notebook."""
    from touchdown.sim.opengl import rendering_backend

    os.environ.setdefault("OPEN3D_DISABLE_WEB_VISUALIZER", "true")
    if "mujoco" not in sys.modules:
        os.environ.setdefault("MUJOCO_GL", rendering_backend())


def _path(out: str | Path | None) -> Path | None:
    return None if out is None else Path(out)


def _progress(progress: Progress) -> Callable[[float, str, str], None]:
    from touchdown.experiments.terminal import make_progress

    return progress if callable(progress) else make_progress(quiet=not progress)
