"""Commands on one part of a flight: ``check-plugin``, ``check-estimator``, ``control margins``,
``px4 params``, ``calibrate`` and ``edges``."""

from __future__ import annotations

import dataclasses
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from touchdown.experiments.cli.common import (
    CONFIG,
    JSON,
    OVERRIDES,
    PATH,
    QUIET,
    SEED,
    SEEDS,
    VEHICLE,
    CommandGroup,
    Number,
    answer,
    answered,
    many,
)
from touchdown.experiments.cli.console import print_calibration, print_margins, print_scores
from touchdown.experiments.config.slots import SLOTS
from touchdown.experiments.errors import UsageError, usage_errors
from touchdown.experiments.terminal import make_notes, say

if TYPE_CHECKING:
    from touchdown.experiments.external.examination import Findings

_check_options = many(
    click.option(
        "--replay", "run", metavar="RUN", type=PATH,
        help="Of an estimator: observations of a run with sensors.mcap, not synthetic ones.",
    ),
    click.option(
        "--seconds", type=Number(min=0.0, max=600.0, min_open=True), default=3.0,
        show_default=True, help="Of messages to an estimator.",
    ),
    OVERRIDES,
    JSON,
)  # fmt: skip


@click.command("check-plugin")
@click.argument("kind", type=click.Choice(list(SLOTS)))
@click.argument("name", metavar="MODULE:FUNCTION")
@_check_options
def check_plugin(**options: Any) -> int:
    """Check that a part of your own conforms to the interface of a flight, without flying.

    An estimator may be a shipped one. Exit code 0: it conforms; 1: rules are broken, each printed
    with its reason.

    Example: touchdown check-plugin selector my_lab.flat_disc:build
    """
    return _check(**options)


@click.command("check-estimator")
@click.argument("name")
@_check_options
def check_estimator(**options: Any) -> int:
    """As `touchdown check-plugin estimator`.

    NAME is MODULE:FUNCTION or a built-in estimator. Exit code 0: it conforms; 1: rules are broken,
    each printed with its reason.

    Example: touchdown check-estimator my_lab.vio:build
    """
    return _check("estimator", **options)


def _check(
    kind: str,
    name: str,
    run: Path | None,
    seconds: float,
    overrides: tuple[str, ...],
    as_json: bool,
) -> int:
    from touchdown.experiments.external.examination import RULES
    from touchdown.experiments.external.processes import none_left
    from touchdown.experiments.flight.platform import limit_threads

    limit_threads()
    with none_left():
        if kind == "estimator":
            found = _estimator(name, run, seconds, overrides)
        elif run is not None:
            raise UsageError(f"--replay is for an estimator; a {kind} is checked without a log")
        else:
            found = _part(kind, name, overrides)

    def show(_figures: Mapping[str, Any]) -> None:
        for violation in found.violations:
            say(str(violation))
            if violation.trace:
                say(textwrap.indent(violation.trace.rstrip(), "    "))
        for figure, text in found.figures.items():
            say(f"{figure}: {text}")
        broken = [violation.rule for violation in found.violations]
        count = f"{len(broken)} of {len(RULES[kind])} rules broken: {', '.join(broken)}"
        say(f"{kind} {name}: {count if broken else 'conforms'}")

    rows = [{"rule": v.rule, "reason": v.reason, "trace": v.trace} for v in found.violations]
    figures = {kind: name, "violations": rows, "figures": found.figures}
    return answer(figures, as_json, show, good=not found.violations)


def _part(kind: str, name: str, overrides: tuple[str, ...]) -> Findings:
    from touchdown.experiments.config.loading import load_config
    from touchdown.experiments.config.slots import names_code, params_of
    from touchdown.experiments.external.examine import examine
    from touchdown.experiments.external.loading import external_builder
    from touchdown.experiments.external.synthetic_stream import synthetic_rig
    from touchdown.experiments.flight.slots import RIGS

    if not names_code(SLOTS[kind], name):
        raise UsageError(
            f"'{name}' is no {kind} of the form MODULE:FUNCTION: shipped ones are tested"
        )
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
    from touchdown.experiments.flight.replay import check_needs, open_run, replay_config, seen_by
    from touchdown.experiments.flight.wiring import build_estimator, estimator_builder

    if run is None:
        config = load_config(None, overrides, estimator=name)
        build = estimator_builder(config)
        return examine_estimator(build, params=params_of(config, "estimator"), seconds=seconds)
    logged = open_run(run)
    config = replay_config(run, name, overrides)
    build = estimator_builder(config)
    rig, observations = logged.sensors.rig, []
    params = params_of(config, "estimator")
    try:
        estimator = build_estimator(config, rig)
    except ExternalPartError:
        # It fails before the first observation; the conformance check states the reason.
        return examine_estimator(build, rig=rig, params=params, seconds=seconds)
    check_needs(name, estimator, logged.sensors)
    truth = {tick: pose.translation for tick, pose in logged.truth.items()}
    for obs in seen_by(estimator.needs, logged.sensors):
        observations.append(obs)
        if obs.time_s >= seconds:
            break
    return examine_estimator(
        build, rig=rig, params=params, observations=observations, true_position=truth.get
    )


@click.group(cls=CommandGroup)
def control() -> None:
    """The flight controller.

    Example: touchdown control margins
    """


@control.command("margins")
@CONFIG
@OVERRIDES
@answered(print_margins)
def control_margins(config_file: Path | None, overrides: tuple[str, ...]) -> dict[str, Any]:
    """Print gain and phase margin of every control loop, from the linear model.

    Example: touchdown control margins
    """
    from touchdown.controller.design import loop_margins
    from touchdown.experiments.config.files import check_named_code
    from touchdown.experiments.config.loading import load_config
    from touchdown.experiments.flight.wiring import build_scene
    from touchdown.sim.airframe.vehicle import vehicle_model

    # No estimator is built.
    config = load_config(config_file, overrides, allow_code=True)
    if config_file is not None:
        check_named_code(config_file, [("scene", config.scene)])
    margins = loop_margins(vehicle_model(build_scene(config).model), config.control)
    return {"loops": [dataclasses.asdict(margin) for margin in margins]}


@click.group(cls=CommandGroup)
def px4() -> None:
    """PX4 as the flight controller.

    Example: touchdown px4 params
    """


@px4.command("params")
@VEHICLE
@CONFIG
@OVERRIDES
@JSON
def px4_params(
    vehicle: str | None, config_file: Path | None, overrides: tuple[str, ...], as_json: bool
) -> int:
    """Print all parameters of PX4 for the vehicle and its sensors, as lines of its start script.

    A PX4 that is started by hand for --px4-connect needs them: as the file px4-rc.params in the
    first folder of its PATH.

    Example: touchdown px4 params > px4-rc.params
    """
    from touchdown.experiments.config.loading import load_config
    from touchdown.experiments.flight.wiring import build_scene, make_world, nominal_rig
    from touchdown.experiments.px4.airframe import parameter_lines, parameters

    config = load_config(config_file, overrides, vehicle=vehicle)
    world = make_world(config, build_scene(config))
    try:
        rig = nominal_rig(world.rig, config)
    finally:
        world.close()
    found = parameters(rig, config.px4, config.control.max_tilt_deg)
    return answer(found, as_json, lambda _found: say("\n".join(parameter_lines(found))))


@click.command()
@click.option("--poses", type=click.IntRange(min=3), default=12, show_default=True)
@click.option("--seed", type=SEEDS, help="Varies the poses, the room and all noise.  [0]")
@click.option("--out", type=PATH, default=Path("calibration.json"), show_default=True,
              help="The file that flights load with --calibration.")  # fmt: skip
@click.option("--pictures", type=PATH, help="Folder for figures.")
@CONFIG
@OVERRIDES
@answered(print_calibration)
@QUIET
def calibrate(
    config_file: Path | None,
    overrides: tuple[str, ...],
    seed: int | None,
    poses: int,
    out: Path,
    pictures: Path | None,
    quiet: bool,
) -> dict[str, Any]:
    """Calibrate camera and LIDAR from a chessboard held in front of them in several poses.

    Renders and scans the board with all noise on, estimates the camera matrix, the distortion and
    the pose of the LIDAR, and reports the errors beside the stated covariance.

    Example: touchdown calibrate --poses 12 --out calibration.json --pictures pictures
    """
    from touchdown.experiments.calibration.calibrate import run_calibration
    from touchdown.experiments.config.loading import load_config

    # No estimator is built. Calibration is done in a workshop, on a rig at rest in even light.
    config = load_config(
        config_file, overrides, allow_code=True, profile_default="ideal", seed=seed
    )
    return run_calibration(config, poses, out, pictures, make_notes(quiet))


@click.group(cls=CommandGroup)
def edges() -> None:
    """Score the edge detector of the estimator `zou2024`, and draw its output.

    Example: touchdown edges evaluate
    """


_MODEL = click.option("--model", default="shipped", show_default=True,
                      help="`shipped`, `gradient`, or a file in OpenCV's form.")  # fmt: skip


@edges.command("evaluate")
@_MODEL
@click.option("--seeds", type=click.IntRange(1), default=5, show_default=True)
@click.option("--plot", type=PATH, help="Precision over recall, JPG or PNG.")
@answered(print_scores)
@QUIET
def edges_evaluate(model: str, seeds: int, plot: Path | None, quiet: bool) -> dict[str, Any]:
    """Score the detector beside Canny on scenes and seeds that it was not trained on.

    Canny gets the blur and the threshold that suit these very pictures best.

    Example: touchdown edges evaluate --seeds 3 --plot edges.png
    """
    from touchdown.experiments.edges.scores import evaluate, plot_curves

    report = evaluate(model, seeds, make_notes(quiet))
    if plot is not None:
        plot_curves(plot, report)
    return report


@edges.command("picture")
@click.option("--out", type=PATH, default=Path("edge-pictures"), show_default=True,
              help="Folder for smoothness.jpg.")  # fmt: skip
@SEED
@_MODEL
@QUIET
def edges_picture(out: Path, seed: int, model: str, quiet: bool) -> None:
    """Draw the edge energy of an image and the smoothness of the returns by it.

    Example: touchdown edges picture --out edge-pictures
    """
    from touchdown.experiments.edges.scores import draw_figure

    say(str(usage_errors(lambda: draw_figure(out, seed, model, make_notes(quiet)))))
