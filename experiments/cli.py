"""The command line. Heavy modules are imported inside the commands, so that help is instant."""

from __future__ import annotations

import json
import math
import os
import signal
import sys
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import click

from experiments.cli_base import (
    EXIT_DONE,
    EXIT_FAILED,
    EXIT_INTERRUPTED,
    EXIT_USAGE,
    CommandGroup,
    guarded_fly,
    has_display,
    is_good,
    rendering_backend,
    system_message,
    usage_errors,
)
from experiments.cli_bench import bench
from experiments.cli_bench_estimator import bench_estimator
from experiments.cli_calibrate import calibrate
from experiments.cli_campaign import campaign, query
from experiments.cli_edges import edges
from experiments.cli_export import export
from experiments.cli_recognition import classify, dataset, evaluate, quantize, train
from experiments.cli_replay import check_estimator, run_replay
from experiments.cli_report import regress, report
from experiments.cli_reproduce import reproduce
from experiments.cli_scenes import scenes
from experiments.console import (
    end_progress,
    error_line,
    make_progress,
    print_margins,
    print_result,
)


class SiteType(click.ParamType):
    """``X,Y`` in metres, world frame."""

    name = "X,Y"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, float]:
        if isinstance(value, tuple):
            return value
        try:
            x, y = (float(part) for part in str(value).split(","))
        except ValueError:
            self.fail(f"'{value}' is not of the form X,Y in metres, such as 12.5,-3", param, ctx)
        if not (math.isfinite(x) and math.isfinite(y)):
            self.fail(f"'{value}' must be two finite numbers", param, ctx)
        return x, y


_Command = Callable[..., int]

_FLIGHT_OPTIONS = (
    click.option(
        "--estimator",
        metavar="NAME",
        help="livo, paper, gps, optical_flow, hybrid_flow, stereo, oracle, or MODULE:FUNCTION.",
    ),
    click.option("--seed", type=int, help="Varies the place, the wind and all noise.  [0]"),
    click.option("--wind-kmh", type=float, help="Mean wind speed at 6 m.  [12]"),
    click.option(
        "--calibration",
        metavar="FILE",
        help="Of `touchdown calibrate`: what the estimator is told of camera and LIDAR.",
    ),
    click.option(
        "--config",
        "config_file",
        type=click.Path(path_type=Path),
        help="A TOML file, or the config.json of an earlier run.",
    ),
    click.option(
        "--set",
        "overrides",
        multiple=True,
        metavar="KEY=VALUE",
        help="Any key of the configuration, such as survey.height_m=20. May be repeated.",
    ),
    click.option(
        "--fault",
        multiple=True,
        metavar="KIND@START[+DURATION]",
        help="A fault at START seconds, such as lidar_dropout@20+1 or fog@0. May be repeated.",
    ),
    click.option(
        "--out",
        type=click.Path(path_type=Path),
        help="Run directory.  [runs/SCENE-ESTIMATOR-SEED]",
    ),
    click.option("--force", is_flag=True, help="Replace a run whose sensors.mcap would be lost."),
    click.option("--record/--no-record", default=None, help="Write flight.rrd.  [record]"),
    click.option(
        "--log-sensors",
        is_flag=True,
        default=None,
        help="Write sensors.mcap, all that sensors said, for --replay and other tools.",
    ),
    click.option("--json", "as_json", is_flag=True, help="Print the result as one JSON object."),
    click.option("--quiet", is_flag=True, help="No progress on stderr."),
)

_CONFIG_OPTIONS = ("scene", "estimator", "seed", "wind_kmh", "record", "calibration", "log_sensors")
"""Those of them that `experiments.config.load_config` takes."""


def _flight_options(command: _Command) -> _Command:
    for option in reversed(_FLIGHT_OPTIONS):
        command = option(command)
    return command


@click.group(cls=CommandGroup, invoke_without_command=True)
@click.version_option(package_name="touchdown", prog_name="touchdown")
@click.pass_context
def cli(context: click.Context) -> int:
    """Fly, map, choose a site and land a simulated quadrotor without GPS.

    Example: touchdown land crossroad
    """
    if context.invoked_subcommand is None:
        click.echo(context.get_help())
    return EXIT_DONE


@cli.command()
@click.argument("scene")
@_flight_options
@click.option("--site", type=SiteType(), help="Land here (metres, world frame), do not choose.")
@click.option(
    "--emergency",
    type=click.Choice(["battery"]),
    help="Down within landing.emergency_s of the survey's end, on the least bad site in reach.",
)
def land(site: tuple[float, float] | None, emergency: str | None, **options: Any) -> int:
    """Take off, survey, map, choose a landing site and land on it.

    SCENE is a name (see `touchdown scenes list`) or the path of an MJCF file. Exit code 0 means
    landed on safe ground, 1 any other outcome, 2 bad input.

    Example: touchdown land crossroad --seed 3 --wind-kmh 20 --set landing.second_look=false
    """
    return _run_flight(options, site=site, emergency=emergency)


@cli.command()
@click.argument("scene", required=False)
@_flight_options
@click.option(
    "--replay",
    "replayed",
    metavar="RUN",
    type=click.Path(path_type=Path),
    help="A run directory with sensors.mcap: those sensors instead of a flight.",
)
@click.pass_context
def fly(context: click.Context, replayed: Path | None, **options: Any) -> int:
    """Fly the survey alone and report the positioning error.

    With --replay, logged sensors go through an estimator without the simulator; RUN tells the
    scene, and the result lands in runs/SCENE-ESTIMATOR-SEED-replay unless --out says otherwise.

    Example: touchdown fly crossroad --estimator oracle --set survey.height_m=20
    """
    if replayed is not None:
        return run_replay(replayed, options)
    if options["scene"] is None:
        raise click.MissingParameter(ctx=context, param_hint="'SCENE'", param_type="argument")
    return _run_flight(options, survey_only=True)


def _run_flight(options: dict[str, Any], **more: Any) -> int:
    from experiments.config import load_config
    from experiments.run_directory import check_log_kept

    quiet, out = options["quiet"], options["out"]
    config = load_config(
        options["config_file"],
        options["overrides"],
        **{key: options[key] for key in _CONFIG_OPTIONS},
        fault=options["fault"] or None,
        **more,
    )
    if out is None:
        stem = Path(config.scene).stem
        out = Path("runs") / f"{stem}-{config.estimator.replace(':', '.')}-{config.seed}"
    check_log_kept(out, logs=config.log.sensors, force=options["force"])
    result = guarded_fly(config, out, make_progress(quiet))
    end_progress(quiet)
    good = is_good(result)
    if options["as_json"]:
        click.echo(json.dumps({**result, "run_dir": str(out)}, indent=2))
    else:
        print_result(result, out, good)
    return EXIT_DONE if good else EXIT_FAILED


# ----------------------------------------------------------------------------- looking, measuring


@cli.command()
@click.argument("run", type=click.Path(path_type=Path))
@click.option("--web", is_flag=True, help="Serve the viewer to a browser instead of a window.")
def view(run: Path, web: bool) -> int:
    """Open the recording of RUN, a run directory, in the Rerun viewer.

    Example: touchdown view runs/crossroad-livo-0
    """
    import subprocess

    from experiments.config import UsageError

    recording = run if run.suffix == ".rrd" else run / "flight.rrd"
    if not recording.is_file():
        raise UsageError(
            f"'{recording}' does not exist; name a run directory that was flown without --no-record"
        )
    if not web and sys.platform == "linux" and not has_display():
        raise UsageError(
            f"there is no display to open a window on; give touchdown view {run} --web, or open "
            f"'{recording}' on a machine that has one"
        )
    command = [sys.executable, "-m", "rerun", str(recording), *(["--web-viewer"] if web else [])]
    return EXIT_DONE if subprocess.run(command, check=False).returncode == 0 else EXIT_FAILED


cli.add_command(report)
cli.add_command(regress)
cli.add_command(reproduce)
cli.add_command(scenes)
cli.add_command(bench)
bench.add_command(bench_estimator)
cli.add_command(check_estimator)
cli.add_command(calibrate)
cli.add_command(campaign)
cli.add_command(query)
cli.add_command(edges)
cli.add_command(export)
for _command in (dataset, train, evaluate, quantize, classify):
    cli.add_command(_command)


@cli.group(cls=CommandGroup)
def control() -> int:
    """The flight controller.

    Example: touchdown control margins
    """
    return EXIT_DONE


@control.command("margins")
@click.option("--config", "config_file", type=click.Path(path_type=Path), help="A TOML file.")
@click.option("--set", "overrides", multiple=True, metavar="KEY=VALUE", help="May be repeated.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
def control_margins(config_file: Path | None, overrides: tuple[str, ...], as_json: bool) -> int:
    """Print gain and phase margin of every control loop, from the linear model.

    Example: touchdown control margins
    """
    import dataclasses

    from experiments.build import build_scene
    from experiments.build_tools import control_margins as margins_of
    from experiments.config import load_config

    config = load_config(config_file, overrides)
    scene = usage_errors(lambda: build_scene(config))
    rows = [dataclasses.asdict(margin) for margin in margins_of(config, scene)]
    if as_json:
        click.echo(json.dumps({"loops": rows}, indent=2))
    else:
        print_margins(rows)
    return EXIT_DONE


# ------------------------------------------------------------------------------------------ entry


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command and returns its exit code; bad input is one line on stderr."""
    os.environ.setdefault("MUJOCO_GL", rendering_backend())
    # What it could not write of a recording is told by `experiments.rerun_log`, in one line.
    os.environ.setdefault("RUST_LOG", "warn,re_log_encoding=off")
    warnings.formatwarning = _one_line_warning
    # Of numba, about a library that it does without; nothing here has several threads.
    warnings.filterwarnings("ignore", message=".*TBB threading layer")
    signal.signal(signal.SIGTERM, _interrupt)
    for word in sys.argv[1:] if arguments is None else arguments:
        if not word.isascii() and any("\ud800" <= letter <= "\udfff" for letter in word):
            return _fail(f"'{word}' is no text in UTF-8; rename the file, or mend the word")
    try:
        code = cli.main(
            args=None if arguments is None else list(arguments),
            prog_name="touchdown",
            standalone_mode=False,
        )
        if sys.stdout is not None:
            sys.stdout.flush()  # what fails here is told below, and not at the interpreter's end
    except click.exceptions.NoArgsIsHelpError as error:
        return _fail(_missing_command(error))
    except click.ClickException as error:
        return _fail(_click_message(error))
    except (click.Abort, KeyboardInterrupt):
        end_progress(quiet=False)
        print("touchdown: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    except SystemExit:
        # So click ends where the reader of a pipe has left, which is no failure of ours.
        if not type(sys.stdout).__name__.endswith("PacifyFlushWrapper"):
            raise
        return EXIT_DONE
    except BrokenPipeError:
        _let_go_of_stdout()
        return EXIT_DONE
    except ValueError as error:
        from experiments.config import UsageError

        if not isinstance(error, UsageError):
            raise
        return _fail(str(error))
    except OSError as error:
        message = system_message(error)
        if message is None:
            raise
        _let_go_of_stdout()
        return _fail(message)
    return int(code or 0)


def _one_line_warning(message: Warning | str, *_where: Any, **_more: Any) -> str:
    return f"touchdown: warning: {message}\n"


def _interrupt(_signal: int, _frame: Any) -> None:
    raise KeyboardInterrupt


def _let_go_of_stdout() -> None:
    """What could not be written is dropped, lest the interpreter try it again at its end."""
    try:
        sys.stdout.flush()
    except OSError:
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115  nothing is left to close it
        sys.__stdout__ = sys.stdout  # type: ignore[misc]


def _fail(message: str) -> int:
    end_progress(quiet=False)
    print(error_line(message), file=sys.stderr)
    return EXIT_USAGE


def _missing_command(error: click.exceptions.NoArgsIsHelpError) -> str:
    context = error.ctx
    if context is None or not isinstance(context.command, click.Group):
        return _click_message(error)
    known = ", ".join(context.command.list_commands(context))
    return f"'{context.command_path}' needs a command: {known}"


def _click_message(error: click.ClickException) -> str:
    """Click's message in the style of ours, with the way to the help of the command."""
    message = error.format_message().rstrip(".")
    message = message[:1].lower() + message[1:]
    context = getattr(error, "ctx", None)
    return f"{message}; see '{context.command_path} --help'" if context else message
