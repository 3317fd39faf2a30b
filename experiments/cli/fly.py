"""The commands `touchdown land` and `touchdown fly`."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from touchdown.experiments.cli.common import EXIT_DONE, EXIT_FAILED, PATH
from touchdown.experiments.cli.console import print_result
from touchdown.experiments.errors import UsageError
from touchdown.experiments.terminal import end_progress, make_progress

if TYPE_CHECKING:
    from touchdown.experiments.viewing.processes import LiveView


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


class LiveType(click.ParamType):
    """``window``, ``web``, or the address of a viewer."""

    name = "live"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        text = str(value)
        if text not in ("auto", "window", "web") and not re.fullmatch(
            r"rerun(\+https?)?://[^/\s]+/proxy", text
        ):
            self.fail(
                f"'{text}' is none of window, web and an address such as "
                "rerun+http://127.0.0.1:9876/proxy (give the scene before --live)",
                param,
                ctx,
            )
        return text


_Command = Callable[..., int]
_FLIGHT_OPTIONS = (
    click.option(
        "--estimator",
        metavar="NAME",
        help="livo, zou2024, gps, optical_flow, hybrid_flow, stereo, oracle, or MODULE:FUNCTION.",
    ),
    *(
        click.option(f"--{kind}", metavar="NAME", help=f"{text}, or MODULE:FUNCTION.  [{default}]")
        for kind, text, default in (
            ("selector", "What chooses the site: risk, zou2024 (Zou, Sun and Kong 2024)", "risk"),
            ("lander", "What flies the mission: site", "site"),
            ("controller", "What turns setpoints into rotor speeds: cascade, px4", "cascade"),
            ("mapper", "What makes the map: grid", "grid"),
            ("classifier", "What tells the class of ground: auto, off, a file", "auto"),
        )
    ),
    click.option(
        "--px4",
        metavar="PATH",
        help="PX4's SITL build for --controller px4.  [TOUCHDOWN_PX4]",
    ),
    click.option("--px4-port", type=int, help="Port on which PX4 finds its simulator.  [4560]"),
    click.option(
        "--px4-connect", is_flag=True, default=None, help="Wait for a PX4 that you start."
    ),
    click.option(
        "--px4-aid",
        type=click.Choice(["none", "gps"]),
        help="What PX4 is given beside the estimate.  [none]",
    ),
    click.option("--seed", type=int, help="Varies the scene, the wind and all noise.  [0]"),
    click.option(
        "--profile",
        type=click.Choice(["ideal", "field", "harsh"]),
        help="How kind the world is.  [field]",
    ),
    click.option(
        "--preset",
        type=click.Choice(["whole", "short"]),
        help="How much is flown: short is one leg of 12 m at 15 m.  [whole]",
    ),
    click.option(
        "--light",
        type=click.Choice(["day", "overcast", "dusk", "night"]),
        help="Light of the scene; a lamp lights the ground where lamp.below_m says so.  [day]",
    ),
    click.option("--wind-kmh", type=float, help="Mean wind speed at 6 m.  [12]"),
    click.option(
        "--calibration",
        metavar="FILE",
        help="File of `touchdown calibrate`: the calibration given to the estimator.",
    ),
    click.option(
        "--config",
        "config_file",
        type=PATH,
        help="A TOML file, or the config.json of an earlier run.",
    ),
    click.option(
        "--allow-code",
        is_flag=True,
        help="Import the external parts that a run's config.json names.",
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
        metavar="KIND@START[+SECONDS|*N]",
        help="A fault at START seconds, such as lidar_dropout@20+1 or fog@0. May be repeated.",
    ),
    click.option(
        "--scene-from",
        metavar="MODULE:FUNCTION",
        help="A function makes the scene: a PyMJCF root, a Composer entity or an MjSpec.",
    ),
    click.option(
        "--as-is",
        is_flag=True,
        default=None,
        help="Take the scene of a file as it is: nothing is dressed or guessed.",
    ),
    click.option(
        "--classes",
        metavar="FILE",
        help="Classes of a file's geoms: TOML by name, or a PNG from above.",
    ),
    click.option("--out", type=PATH, help="Run directory.  [runs/SCENE-ESTIMATOR-SEED]"),
    click.option("--force", is_flag=True, help="Replace a run whose sensors.mcap would be lost."),
    click.option("--record/--no-record", default=None, help="Write flight.rrd.  [record]"),
    click.option(
        "--log-sensors",
        is_flag=True,
        default=None,
        help="Write sensors.mcap, every message of the sensors, for --replay and other tools.",
    ),
    click.option(
        "--live",
        type=LiveType(),
        is_flag=False,
        flag_value="auto",
        metavar="[window|web|URL]",
        help="Show the flight in the Rerun viewer while it goes on: in a window, on a page of this "
        "machine, or in the viewer at URL.",
    ),
    click.option("--json", "as_json", is_flag=True, help="Print the result as one JSON object."),
    click.option("--quiet", is_flag=True, help="No progress on stderr."),
)


_CONFIG_OPTIONS = (
    "scene", "estimator", "seed", "profile", "preset", "light", "wind_kmh", "record",
    "calibration", "log_sensors", "as_is", "classes",
    "selector", "lander", "controller", "mapper", "classifier",
    "px4", "px4_port", "px4_connect", "px4_aid",
)  # fmt: skip
"""The options that `experiments.config.loading.load_config` takes."""


def _flight_options(command: _Command) -> _Command:
    for option in reversed(_FLIGHT_OPTIONS):
        command = option(command)
    return command


@click.command()
@click.argument("scene", required=False)
@_flight_options
@click.option("--site", type=SiteType(), help="Land here (metres, world frame).")
@click.option(
    "--emergency",
    type=click.Choice(["battery"]),
    help="Land within landing.emergency_s of the survey's end, on the safest site in reach.",
)
def land(site: tuple[float, float] | None, emergency: str | None, **options: Any) -> int:
    """Take off, survey, map, choose a landing site and land on it.

    SCENE is a name (see `touchdown scenes list`), the path of an MJCF file, or MODULE:FUNCTION as
    for --scene-from. Exit code 0 means landed on safe ground, 1 any other outcome, 2 bad input.

    Example: touchdown land crossroad --seed 3 --wind-kmh 20 --set landing.second_look=false
    """
    return _run_flight(options, site=site, emergency=emergency)


@click.command()
@click.argument("scene", required=False)
@_flight_options
@click.option(
    "--replay",
    "replayed",
    metavar="RUN",
    type=PATH,
    help="Run directory with sensors.mcap: its sensors replace the simulation.",
)
def fly(replayed: Path | None, **options: Any) -> int:
    """Fly the survey alone and report the positioning error.

    With --replay, logged sensors go through an estimator without the simulator. The scene is that
    of RUN; the result is written to runs/SCENE-ESTIMATOR-SEED-replay, or to --out.

    Example: touchdown fly crossroad --estimator oracle --set survey.height_m=20
    """
    if replayed is not None:
        _take_scene(options)
        from touchdown.experiments.cli.replay import run_replay

        return run_replay(replayed, options)
    return _run_flight(options, survey_only=True)


def _take_scene(options: dict[str, Any]) -> None:
    """Takes ``--scene-from`` as the scene."""
    made = options.pop("scene_from")
    if made is None:
        return
    if options["scene"] is not None:
        raise UsageError(f"--scene-from makes the scene; leave out '{options['scene']}'")
    from touchdown.scenes.api import names_function

    if not names_function(made):
        raise UsageError(f"--scene-from '{made}' is not of the form MODULE:FUNCTION")
    options["scene"] = made


def _viewer(target: str | None) -> AbstractContextManager[LiveView | None]:
    if target is None:
        return nullcontext()
    from touchdown.experiments.viewing.processes import live_viewer

    return live_viewer(target)


def _run_flight(options: dict[str, Any], **more: Any) -> int:
    from touchdown.experiments.config.loading import load_config
    from touchdown.experiments.config.slots import external_parts
    from touchdown.experiments.external.processes import none_left
    from touchdown.experiments.flight.run import fly_with_usage_errors
    from touchdown.experiments.io.run_directory import check_log_kept, default_out_dir

    _take_scene(options)
    if options["scene"] is None:
        context = click.get_current_context()
        raise click.MissingParameter(ctx=context, param_hint="'SCENE'", param_type="argument")
    quiet, out = options["quiet"], options["out"]
    config = load_config(
        options["config_file"],
        options["overrides"],
        allow_code=options["allow_code"],
        **{key: options[key] for key in _CONFIG_OPTIONS},
        fault=options["fault"] or None,
        **more,
    )
    if out is None:
        suffix = "" if config.preset == "whole" else f"-{config.preset}"
        suffix += "".join(
            f"-{n.replace(':', '.')}" for k, n in external_parts(config) if k != "estimator"
        )
        out = default_out_dir(config.scene, config.estimator, config.seed, suffix)
    check_log_kept(out, logs=config.log.sensors, force=options["force"])
    with _viewer(options["live"]) as view:
        with none_left():
            address = None if view is None else view.address
            result = fly_with_usage_errors(config, out, make_progress(quiet), address)
        end_progress(quiet)
        if options["as_json"]:
            click.echo(json.dumps({**result.plain(), "run_dir": str(out)}, indent=2))
        else:
            print_result(result, out)
        if view is not None:
            view.stay()
    return EXIT_DONE if result.is_success else EXIT_FAILED
