"""Tuning of an estimator: settings of its keys tried on replays of logs, as many for each method.

The settings are proposed by the tree-structured Parzen estimator of Optuna (Bergstra et al.,
"Algorithms for hyper-parameter optimization", NeurIPS 2011) from the trials so far alone, so that a
tuning that goes on from its file ends as one that was not stopped. The first trial is what is
shipped.
"""

import functools
import json
import math
import tomllib
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any

from touchdown.experiments.config.keys import flatten
from touchdown.experiments.config.loading import dump_config
from touchdown.experiments.errors import ExternalPartError, UsageError
from touchdown.experiments.flight.replay import (
    LoggedRun,
    RememberedLog,
    check_needs,
    open_run,
    replay,
    replay_config,
)
from touchdown.experiments.flight.wiring import build_estimator
from touchdown.experiments.io.provenance import git_revision

LOST_M = 50.0
"""error of a replay that diverged, whenever it did; assumed"""
_STARTING = 10
"""trials before the estimator of good settings has enough of them: drawn evenly; Optuna's own"""
Settings = dict[str, Any]
Space = Mapping[str, Mapping[str, Any]]
"""by key ``low`` and ``high``, with ``log`` if even in the logarithm, or ``choices``; ``default``
of a key that the configuration does not have"""
Report = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Trial:
    """``errors_m``: of each log, mean position errors; ``error_m``: their geometric mean."""

    settings: Settings
    errors_m: list[float]

    @property
    def error_m(self) -> float:
        return math.exp(sum(map(math.log, self.errors_m)) / len(self.errors_m))

    def plain(self) -> list[Any]:
        """As it stands in the file: the settings in the order of the keys, and the errors."""
        return [[*self.settings.values()], self.errors_m]


def require_optuna() -> None:
    """Raises UsageError unless Optuna is installed."""
    try:
        import optuna  # noqa: F401
    except ImportError as error:
        raise UsageError(
            f"{error.name} is not installed; pip install -c constraints.txt -e '.[tune]' "
            "installs what tuning needs"
        ) from error


def read_space(estimator: str, file: Path | None = None) -> Space:
    """The keys of an estimator, from ``file`` or the shipped table. Raises UsageError."""
    shipped = resources.files(__package__).joinpath("tuning_spaces.toml")
    try:
        text = (file or shipped).read_text(encoding="utf-8")
        spaces = tomllib.loads(text)
    except (OSError, ValueError) as error:
        raise UsageError(f"--space '{file}' cannot be read: {error}") from error
    space = spaces.get(estimator)
    if not isinstance(space, dict) or not space:
        hint = "" if file else "; --space FILE names the keys of another estimator"
        raise UsageError(f"no keys of '{estimator}' to vary; known: {', '.join(spaces)}{hint}")
    for key, values in space.items():
        named = set(values) - {"default"} if isinstance(values, dict) else set()
        if named != {"choices"} and named - {"log"} != {"low", "high"}:
            raise UsageError(f"the space of {key} needs low and high, or choices")
    return space


def proposed(space: Space, trials: Sequence[Trial], seed: int) -> Settings:
    """The settings to try next: a function of its arguments alone. Numbers have four digits."""
    import optuna
    from optuna.distributions import (
        BaseDistribution,
        CategoricalDistribution,
        FloatDistribution,
        IntDistribution,
    )

    def distribution(values: Mapping[str, Any]) -> BaseDistribution:
        if "choices" in values:
            return CategoricalDistribution(values["choices"])
        low, high, log = values["low"], values["high"], values.get("log", False)
        kind = IntDistribution if isinstance(low, int) and isinstance(high, int) else None
        return (kind or FloatDistribution)(low, high, log=log)

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    drawn = {key: distribution(values) for key, values in space.items()}
    sampler = optuna.samplers.TPESampler(seed=seed + len(trials), n_startup_trials=_STARTING)
    study = optuna.create_study(sampler=sampler)
    for trial in trials:
        study.add_trial(
            optuna.trial.create_trial(
                params=trial.settings, distributions=drawn, value=math.log(trial.error_m)
            )
        )
    found = study.ask(drawn).params
    rounded = {k: float(f"{v:.4g}") if isinstance(v, float) else v for k, v in found.items()}
    return {key: rounded[key] for key in space}


class Tuning:
    """Replays of ``runs`` with one estimator, up to ``until_s``; from the first trial on the logs
    are in memory."""

    def __init__(self, estimator: str, runs: Sequence[Path], until_s: float) -> None:
        self.estimator, self.until_s = estimator, until_s
        self.runs = [open_run(run) for run in runs]

    @functools.cached_property
    def logs(self) -> list[LoggedRun]:
        """The runs with what the estimator sees of their logs. Raises UsageError where it lacks a
        sensor."""
        return [self._remembered(run) for run in self.runs]

    def _remembered(self, run: LoggedRun) -> LoggedRun:
        config = replay_config(run.path, self.estimator, fresh=True)
        built = build_estimator(config, run.sensors.rig)
        check_needs(self.estimator, built, run.sensors)
        return replace(run, sensors=RememberedLog(run.sensors, built.needs, self.until_s))

    def names(self) -> list[dict[str, Any]]:
        """Scene and seed of each log."""
        return [{"scene": run.result.scene, "seed": run.result.seed} for run in self.runs]

    def defaults(self, space: Space) -> Settings:
        """What is shipped for the profile of the logs. Raises UsageError for an unknown key."""
        config = replay_config(self.runs[0].path, self.estimator, fresh=True)
        shipped = dict(flatten(json.loads(dump_config(config))))
        try:
            return {k: shipped[k] if k in shipped else v["default"] for k, v in space.items()}
        except KeyError:
            names = ", ".join(
                k for k, v in space.items() if {k, "default"}.isdisjoint({*shipped, *v})
            )
            raise UsageError(f"{names}: no key of the configuration, and no default") from None

    def tried(self, settings: Settings) -> Trial:
        """The trial of these settings. An external part that breaks a rule is lost."""
        given = tuple(f"{key}={json.dumps(value)}" for key, value in settings.items())
        return Trial(settings, [self._error_m(log, given) for log in self.logs])

    def _error_m(self, log: LoggedRun, given: tuple[str, ...]) -> float:
        config = replay_config(log.path, self.estimator, given, fresh=True)
        try:
            result = replay(log, config, until_s=self.until_s)
        except ExternalPartError as error:
            warnings.warn(f"counted as lost: {error}", stacklevel=2)
            return LOST_M
        found = result.position_error_m
        if result.outcome != "COMPLETED" or found is None or found.mean is None:
            return LOST_M
        return round(max(found.mean, 1e-4), 5)


def tune(
    estimator: str,
    logs: Sequence[Path],
    *,
    trials: int,
    space: Space,
    until_s: float,
    seed: int,
    out: Path | None,
    report: Report,
) -> dict[str, Any]:
    """Tries ``trials`` settings of ``estimator`` on ``logs``, those in the file ``out`` among them.
    Returns what is written to ``out`` after each trial. Raises UsageError."""
    require_optuna()
    tuning = Tuning(estimator, logs, until_s)
    facts = {
        "estimator": estimator, "logs": tuning.names(), "seed": seed, "keys": space,
        "until_s": until_s if math.isfinite(until_s) else None,
    }  # fmt: skip
    figures, done = _resumed(out, facts)
    defaults = tuning.defaults(space)
    while len(done) < trials:
        settings = proposed(space, done, seed) if done else defaults
        done.append(tuning.tried(settings))
        figures = summary(facts, done)
        write(out, figures)
        report(f"trial {len(done)}: {done[-1].error_m:.4f} m, best {figures['best_error_m']:.4f} m")
    return figures


def checked(figures: Mapping[str, Any], logs: Sequence[Path]) -> dict[str, Any]:
    """``figures`` of a tuning with the errors, as shipped and with the best settings, over whole
    ``logs`` that have not taken part in it."""
    tuning = Tuning(figures["estimator"], logs, math.inf)
    before, after = (tuning.tried(figures[f"{which}_settings"]) for which in ("default", "best"))
    errors = zip(tuning.names(), before.errors_m, after.errors_m, strict=True)
    check = [name | {"default_error_m": a, "best_error_m": b} for name, a, b in errors]
    return {**figures, "check": check}


def summary(facts: Mapping[str, Any], done: Sequence[Trial]) -> dict[str, Any]:
    """What the file holds: the facts of the tuning, its result and all trials; the first one is
    what is shipped."""
    best = min(done, key=lambda trial: trial.error_m)
    return {
        **facts,
        "revision": git_revision(),
        "trials": len(done),
        "default_error_m": round(done[0].error_m, 5),
        "best_error_m": round(best.error_m, 5),
        "default_settings": done[0].settings,
        "best_settings": best.settings,
        "tried": [trial.plain() for trial in done],
    }


def write(out: Path | None, figures: Mapping[str, Any]) -> None:
    """Writes the file of a tuning, if there is to be one: a line for each trial."""
    if out is None:
        return
    lines = [json.dumps(trial) for trial in figures["tried"]]
    head = json.dumps({**figures, "tried": []}, indent=1)
    tried = "[\n  " + ",\n  ".join(lines) + "\n ]"
    partial = out.with_name(out.name + ".partial")
    partial.write_text(head.replace('"tried": []', f'"tried": {tried}') + "\n", encoding="utf-8")
    partial.replace(out)


def _resumed(out: Path | None, facts: Mapping[str, Any]) -> tuple[dict[str, Any], list[Trial]]:
    """An earlier file and its trials, if there is one. Raises UsageError for one of another
    tuning."""
    if out is None or not out.exists():
        return {}, []
    try:
        earlier = json.loads(out.read_text(encoding="utf-8"))
        other = [name for name, value in facts.items() if earlier[name] != value]
        keys, tried = list(facts["keys"]), earlier["tried"]
        done = [] if other else [Trial(dict(zip(keys, one, strict=True)), m) for one, m in tried]
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise UsageError(f"--out '{out}' is no file of a tuning; name another") from error
    if other:
        raise UsageError(f"--out '{out}' is of a tuning with other {', '.join(other)}")
    return earlier, done
