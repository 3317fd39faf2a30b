"""The command group `touchdown control`."""

from __future__ import annotations

import json
from pathlib import Path

import click

from touchdown.experiments.cli.common import EXIT_DONE, CommandGroup
from touchdown.experiments.cli.console import print_margins
from touchdown.experiments.errors import usage_errors


@click.group(cls=CommandGroup)
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

    from touchdown.controller.design import loop_margins
    from touchdown.experiments.config.loading import load_config
    from touchdown.experiments.flight.wiring import build_scene
    from touchdown.sim.airframe.vehicle import vehicle_model

    # No estimator is built.
    config = load_config(config_file, overrides, allow_code=True)
    scene = usage_errors(lambda: build_scene(config))
    margins = loop_margins(vehicle_model(scene.model), config.control)
    rows = [dataclasses.asdict(margin) for margin in margins]
    if as_json:
        click.echo(json.dumps({"loops": rows}, indent=2))
    else:
        print_margins(rows)
    return EXIT_DONE
