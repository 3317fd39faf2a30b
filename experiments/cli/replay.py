"""``touchdown fly --replay``, ``touchdown check-plugin`` and ``touchdown check-estimator``."""

from __future__ import annotations

import json
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from touchdown.experiments.cli.common import EXIT_DONE, EXIT_FAILED, JSON, OVERRIDES, PATH, Number
from touchdown.experiments.config.slots import SLOTS
from touchdown.experiments.errors import UsageError, usage_errors
from touchdown.experiments.terminal import say

if TYPE_CHECKING:
    from touchdown.experiments.external.examination import Findings

_FLOWN = {
    "seed": "--seed",
    "profile": "--profile",
    "preset": "--preset",
    "light": "--light",
    "wind_kmh": "--wind-kmh",
    "calibration": "--calibration",
    "config_file": "--config",
    "record": "--record",
    "log_sensors": "--log-sensors",
    "live": "--live",
    "selector": "--selector",
    "lander": "--lander",
    "controller": "--controller",
    "mapper": "--mapper",
    "classifier": "--classifier",
}
"""Options of the flight itself, without meaning in a replay."""


def run_replay(run: Path, options: dict[str, Any]) -> int:
    """Replays the sensors of ``run``; ``options`` are those of ``fly``. Returns the exit code."""
    from touchdown.experiments.cli.console import print_result
    from touchdown.experiments.external.processes import none_left
    from touchdown.experiments.flight.replay import replay, replay_config
    from touchdown.experiments.io.run_directory import check_log_kept, default_out_dir
    from touchdown.experiments.terminal import end_progress, make_progress

    for name, option in _FLOWN.items():
        if options.get(name) not in (None, (), False):
            raise UsageError(f"{option} does not go with --replay: the flight is over")
    config = replay_config(
        run, options["estimator"], options["overrides"], allow_code=options["allow_code"]
    )
    scene, quiet = options["scene"], options["quiet"]
    if scene is not None and scene != config.scene:
        raise UsageError(f"'{run}' was flown over {config.scene}, not {scene}")
    out = options["out"]
    if out is None:
        out = default_out_dir(config.scene, config.estimator, config.seed, "-replay")
    if out.resolve() != run.resolve():  # `replay` reports that with its own message
        check_log_kept(out, logs=False, force=options["force"])
    with none_left():
        result = replay(run, config, out, make_progress(quiet), options["fault"])
    end_progress(quiet)
    if options["as_json"]:
        click.echo(json.dumps({**result.plain(), "run_dir": str(out)}, indent=2))
    else:
        print_result(result, out)
        say(f"replayed open loop, judged at {result.judged_hz:g} Hz")
    return EXIT_DONE if result.is_success else EXIT_FAILED


_REPLAY = click.option(
    "--replay",
    "run",
    metavar="RUN",
    type=PATH,
    help="Of an estimator: observations of a run with sensors.mcap instead of synthetic ones.",
)
_SECONDS = click.option(
    "--seconds",
    type=Number(min=0.0, max=600.0, min_open=True),
    default=3.0,
    show_default=True,
    help="Of messages to an estimator.",
)


@click.command("check-plugin")
@click.argument("kind", type=click.Choice(list(SLOTS)))
@click.argument("name", metavar="MODULE:FUNCTION")
@_REPLAY
@_SECONDS
@OVERRIDES
@JSON
def check_plugin_command(
    kind: str,
    name: str,
    run: Path | None,
    seconds: float,
    overrides: tuple[str, ...],
    as_json: bool,
) -> int:
    """Check that a part of your own conforms to the interface of a flight, without flying.

    An estimator may be a shipped one. Exit code 0: it conforms; 1: rules are broken, each printed
    with its reason.

    Example: touchdown check-plugin selector my_lab.flat_disc:build
    """
    return _report(kind, name, run, seconds, overrides, as_json)


@click.command("check-estimator")
@click.argument("name")
@_REPLAY
@_SECONDS
@OVERRIDES
@JSON
def check_estimator_command(
    name: str, run: Path | None, seconds: float, overrides: tuple[str, ...], as_json: bool
) -> int:
    """As `touchdown check-plugin estimator`.

    NAME is MODULE:FUNCTION or a built-in estimator. Exit code 0: it conforms; 1: rules are broken,
    each printed with its reason.

    Example: touchdown check-estimator my_lab.vio:build
    """
    return _report("estimator", name, run, seconds, overrides, as_json)


def _report(
    kind: str,
    name: str,
    run: Path | None,
    seconds: float,
    overrides: tuple[str, ...],
    as_json: bool,
) -> int:
    from touchdown.experiments.external.examine import RULES
    from touchdown.experiments.external.processes import none_left

    with none_left():
        if kind == "estimator":
            found = _estimator(name, run, seconds, overrides)
        elif run is not None:
            raise UsageError(f"--replay is for an estimator; a {kind} is checked without a log")
        else:
            found = _part(kind, name, overrides)
    violations, figures = found.violations, found.figures
    if as_json:
        rows = [{"rule": v.rule, "reason": v.reason, "trace": v.trace} for v in violations]
        click.echo(json.dumps({kind: name, "violations": rows, "figures": figures}, indent=2))
        return EXIT_FAILED if violations else EXIT_DONE
    for violation in violations:
        say(str(violation))
        if violation.trace:
            say(textwrap.indent(violation.trace.rstrip(), "    "))
    for figure, text in figures.items():
        say(f"{figure}: {text}")
    broken = ", ".join(violation.rule for violation in violations)
    count = f"{len(violations)} of {len(RULES[kind])} rules broken: {broken}"
    say(f"{kind} {name}: {count if violations else 'conforms'}")
    return EXIT_FAILED if violations else EXIT_DONE


def _part(kind: str, name: str, overrides: tuple[str, ...]) -> Findings:
    from touchdown.experiments.config.loading import load_config
    from touchdown.experiments.config.slots import names_code, params_of
    from touchdown.experiments.external.examine import examine
    from touchdown.experiments.external.loading import external_builder
    from touchdown.experiments.external.synthetic_stream import synthetic_rig
    from touchdown.experiments.flight.platform import limit_threads
    from touchdown.experiments.flight.slots import RIGS

    if not names_code(SLOTS[kind], name):
        raise UsageError(
            f"'{name}' is no {kind} of the form MODULE:FUNCTION: shipped ones are tested"
        )
    limit_threads()
    chosen: dict[str, Any] = {kind: name}
    if kind == "lander":
        chosen["preset"] = "short"  # its mission is flown to the end
    config = load_config(None, overrides, **chosen)
    build = external_builder(name, kind)
    return examine(kind, build, RIGS[kind](config, synthetic_rig()), params_of(config, kind))


def _estimator(name: str, run: Path | None, seconds: float, overrides: tuple[str, ...]) -> Findings:
    from touchdown.experiments.config.loading import load_config
    from touchdown.experiments.config.slots import params_of
    from touchdown.experiments.errors import ExternalPartError
    from touchdown.experiments.external.conformance import examine_estimator
    from touchdown.experiments.flight.platform import limit_threads
    from touchdown.experiments.flight.replay import check_needs, open_run, replay_config, seen_by
    from touchdown.experiments.flight.wiring import build_estimator

    limit_threads()
    if run is None:
        config = load_config(None, overrides, estimator=name)
        build = usage_errors(lambda: _build_function(config))
        return examine_estimator(build, params=params_of(config, "estimator"), seconds=seconds)
    logged = open_run(run)
    config = replay_config(run, name, overrides)
    build = usage_errors(lambda: _build_function(config))
    rig, observations = logged.sensors.rig, []
    try:
        estimator = build_estimator(config, rig)
    except ExternalPartError:
        # It fails before the first observation; the conformance check states the reason.
        return examine_estimator(
            build, rig=rig, params=params_of(config, "estimator"), seconds=seconds
        )
    check_needs(name, estimator, logged.sensors)
    truth = {tick: pose.translation for tick, pose in logged.truth.items()}
    for obs in seen_by(estimator.needs, logged.sensors):
        observations.append(obs)
        if obs.time_s >= seconds:
            break
    return examine_estimator(
        build,
        rig=rig,
        params=params_of(config, "estimator"),
        observations=observations,
        true_position=truth.get,
    )


def _build_function(config: Any) -> Any:
    """``build(params, rig)`` of the configured estimator. Raises UsageError where there is none."""
    from touchdown.experiments.external.loading import external_builder, is_external
    from touchdown.experiments.flight.wiring import build_estimator, check_estimator_name

    check_estimator_name(config.estimator)
    if is_external(config.estimator):
        return external_builder(config.estimator)
    return lambda _params, rig: build_estimator(config, rig)
