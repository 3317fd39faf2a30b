"""The commands `touchdown land` and `touchdown fly`."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from touchdown.experiments.cli.common import (
    CONFIG,
    JSON,
    LIGHT,
    OVERRIDES,
    PATH,
    PRESET,
    PROFILE,
    QUIET,
    RIG,
    SCENES,
    VEHICLE,
    Parsed,
    answer,
    completed,
    finite_numbers,
    many,
)
from touchdown.experiments.config.slots import SLOTS
from touchdown.experiments.errors import UsageError
from touchdown.experiments.terminal import end_progress, make_progress, say

if TYPE_CHECKING:
    from touchdown.experiments.config.schema import Config
    from touchdown.experiments.io.results import RunResult
    from touchdown.experiments.viewing.processes import LiveView


def _viewer_address(text: str) -> str:
    if not re.fullmatch(r"auto|window|web|rerun(\+https?)?://[^/\s]+/proxy", text):
        raise ValueError
    return text


_SITE = Parsed(
    "X,Y", "two finite numbers in metres, such as 12.5,-3", lambda text: finite_numbers(text, 2)
)
_LIVE = Parsed(
    "window|web|URL",
    "a URL such as rerun+http://127.0.0.1:9876/proxy (give the scene before --live)",
    _viewer_address,
)


ESTIMATORS = ("livo", "zou2024", "gps", "optical_flow", "hybrid_flow", "stereo", "oracle")
"""Those of `experiments.flight.wiring`, repeated so that help and completion are instant."""


def _part(kind: str, text: str) -> Callable[[Any], Any]:
    """The option that names what fills a slot."""
    names = ESTIMATORS if kind == "estimator" else SLOTS[kind].shipped
    found = completed(lambda: names)
    return click.option(f"--{kind}", metavar="NAME", help=text, shell_complete=found)


_flight_options = many(
    _part("estimator", f"{', '.join(ESTIMATORS)}, or MODULE:FUNCTION."),
    _part("selector", "What chooses the site: risk, zou2024, or MODULE:FUNCTION.  [risk]"),
    _part("lander", "What flies the mission: site, or MODULE:FUNCTION.  [site]"),
    _part("controller", "Setpoints to rotor speeds: cascade, px4, or MODULE:FUNCTION.  [cascade]"),
    _part("mapper", "What makes the map: grid, or MODULE:FUNCTION.  [grid]"),
    _part("classifier", "Class of ground: auto, off, a file, or MODULE:FUNCTION.  [auto]"),
    _part("watch", "Watches the landing place: standard, off, or MODULE:FUNCTION.  [standard]"),
    click.option("--px4", metavar="PATH", help="PX4's SITL build.  [TOUCHDOWN_PX4]"),
    click.option("--px4-port", type=int, help="Port on which PX4 finds its simulator.  [4560]"),
    click.option("--px4-connect", is_flag=True, default=None, help="Wait for a PX4 that runs."),
    click.option("--px4-aid", type=click.Choice(["none", "gps"]),
                 help="What PX4 is given beside the estimate.  [none]"),
    click.option("--seed", type=int, help="Varies the scene, the wind and all noise.  [0]"),
    click.option("--profile", type=PROFILE, help="How kind the world is.  [field]"),
    PRESET,
    click.option("--light", type=LIGHT, help="Light of the scene; see lamp.below_m.  [day]"),
    VEHICLE,
    RIG,
    click.option("--wind-kmh", type=float, help="Mean wind speed at 6 m.  [12]"),
    click.option("--calibration", metavar="FILE",
                 help="Of `touchdown calibrate`: the calibration given to the estimator."),
    CONFIG,
    click.option("--allow-code", is_flag=True,
                 help="Import the external parts that a run's config.json names."),
    OVERRIDES,
    click.option("--fault", multiple=True, metavar="KIND@START[+SECONDS|*N]",
                 help="Such as lidar_dropout@20+1 or fog@0, in seconds. May be repeated."),
    click.option("--scene-from", metavar="MODULE:FUNCTION",
                 help="What makes the scene: a PyMJCF root, a Composer entity or an MjSpec."),
    click.option("--as-is", is_flag=True, default=None,
                 help="Take the scene of a file as it is: nothing is dressed or guessed."),
    click.option("--classes", metavar="FILE",
                 help="Classes of a file's geoms: TOML by name, or a PNG from above."),
    click.option("--out", type=PATH, help="Run directory.  [runs/SCENE-ESTIMATOR-SEED-MODE...]"),
    click.option("--force", is_flag=True,
                 help="Replace a run of another configuration, or one with sensors.mcap."),
    click.option("--record/--no-record", default=None, help="Write flight.rrd.  [record]"),
    click.option("--log-sensors", is_flag=True, default=None,
                 help="Write sensors.mcap, all messages of the sensors, as for --replay."),
    click.option("--live", type=_LIVE, is_flag=False, flag_value="auto",
                 metavar="[window|web|URL]",
                 help="Show the flight while it goes on: in a window, on a page of this machine, "
                 "or in the Rerun viewer at URL."),
    JSON,
    QUIET,
)  # fmt: skip

_CONFIG_OPTIONS = (
    "seed", "profile", "preset", "vehicle", "rig", "light", "wind_kmh", "record", "calibration",
    "log_sensors", "as_is", "classes", "selector", "lander", "controller", "mapper",
    "classifier", "watch", "px4", "px4_port", "px4_connect", "px4_aid",
)  # fmt: skip
"""The options of `experiments.config.loading.load_config` that say how the sensors' data come
about; a replay has them already."""


@click.command()
@click.argument("scene", required=False, shell_complete=SCENES)
@_flight_options
@click.option("--site", type=_SITE, help="Land here (metres, world frame).")
@click.option("--emergency", type=click.Choice(["battery"]),
              help="Land within landing.emergency_s of the survey's end, on the safest site in "
              "reach.")  # fmt: skip
def land(site: tuple[float, float] | None, emergency: str | None, **options: Any) -> int:
    """Take off, survey, map, choose a landing site and land on it.

    SCENE is a name (see `touchdown scenes list`), the path of an MJCF file, or MODULE:FUNCTION as
    for --scene-from. Exit code 0 means landed on safe ground, 1 any other outcome, 2 bad input.

    Example: touchdown land crossroad --seed 3 --wind-kmh 20 --set landing.site_recheck=false
    """
    return _run_flight(options, site=site, emergency=emergency)


@click.command()
@click.argument("scene", required=False, shell_complete=SCENES)
@_flight_options
@click.option("--trajectory", metavar="FILE.tum",
              help="Carry the sensors along these poses: t x y z qx qy qz qw, z up.")  # fmt: skip
@click.option("--replay", "replayed", metavar="RUN", type=PATH,
              help="Run directory with sensors.mcap, which replaces the simulation.")  # fmt: skip
def fly(replayed: Path | None, **options: Any) -> int:
    """Fly the survey alone and report the positioning error.

    With --trajectory, the vehicle is carried along poses that somebody flew. With --replay, logged
    sensors go through an estimator without the simulator. The scene is that of RUN; the result is
    written to runs/SCENE-ESTIMATOR-SEED-replay..., or to --out.

    Example: touchdown fly crossroad --estimator oracle --set survey.height_m=20
    """
    trajectory = options.pop("trajectory")
    if replayed is None:
        return _run_flight(options, survey_only=True, trajectory=trajectory)
    if trajectory is not None:
        raise UsageError("--trajectory does not go with --replay: the flight is over")
    return _run_replay(replayed, options)


def _take_scene(options: dict[str, Any]) -> None:
    """Takes ``--scene-from`` as the scene."""
    from touchdown.scenes.api import names_function

    made = options.pop("scene_from")
    if made is None:
        return
    if options["scene"] is not None:
        raise UsageError(f"--scene-from makes the scene; leave out '{options['scene']}'")
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
    from touchdown.experiments.external.processes import none_left
    from touchdown.experiments.flight.replacing import check_kept
    from touchdown.experiments.flight.run import fly_with_usage_errors

    _take_scene(options)
    if options["scene"] is None:
        context = click.get_current_context()
        raise click.MissingParameter(ctx=context, param_hint="'SCENE'", param_type="argument")
    config = load_config(
        options["config_file"],
        options["overrides"],
        allow_code=options["allow_code"],
        **{key: options[key] for key in ("scene", "estimator", *_CONFIG_OPTIONS)},
        fault=options["fault"] or None,
        **more,
    )
    out = options["out"] or _default_out(config, "fly" if config.landing.survey_only else "land")
    check_kept(out, config, force=options["force"])
    with _viewer(options["live"]) as view:
        with none_left():
            address = None if view is None else view.address
            result = fly_with_usage_errors(config, out, make_progress(options["quiet"]), address)
        code = print_run(result, out, as_json=options["as_json"], quiet=options["quiet"])
        if view is not None:
            view.stay()
    return code


def _default_out(config: Config, mode: str) -> Path:
    from touchdown.experiments.config.settings import name_ending
    from touchdown.experiments.io.run_directory import default_out_dir

    ending = name_ending(config, mode)
    return default_out_dir(config.scene, config.estimator, config.seed, ending)


def _run_replay(run: Path, options: dict[str, Any]) -> int:
    from touchdown.experiments.external.processes import none_left
    from touchdown.experiments.flight.replacing import check_kept
    from touchdown.experiments.flight.replay import replay, replay_config, with_faults

    _take_scene(options)
    for name in (*_CONFIG_OPTIONS, "config_file", "live"):
        if options[name] not in (None, False):
            option = name.removesuffix("_file").replace("_", "-")
            raise UsageError(f"--{option} does not go with --replay: the flight is over")
    config = replay_config(
        run, options["estimator"], options["overrides"], allow_code=options["allow_code"]
    )
    if options["scene"] not in (None, config.scene):
        raise UsageError(f"'{run}' was flown over {config.scene}, not {options['scene']}")
    flown = with_faults(config, options["fault"])
    out = options["out"] or _default_out(flown, "replay")
    if out.resolve() != run.resolve():  # `replay` reports that with its own message
        check_kept(out, flown, force=options["force"], replayed=run)
    with none_left():
        result = replay(run, config, out, make_progress(options["quiet"]), options["fault"])
    code = print_run(result, out, as_json=options["as_json"], quiet=options["quiet"])
    if not options["as_json"]:
        say(f"replayed open loop, judged at {result.judged_hz:g} Hz")
    return code


def print_run(result: RunResult, out: Path, *, as_json: bool, quiet: bool) -> int:
    """Prints the result of a flight or a replay in the run directory ``out``; returns the exit
    code."""

    def show(_figures: dict[str, Any]) -> None:
        from touchdown.experiments.cli.console import print_result

        print_result(result, out)

    end_progress(quiet)
    figures = {**result.plain(), "run_dir": str(out)}
    return answer(figures, as_json, show, good=result.is_success)
