"""The command group `touchdown control`."""

from __future__ import annotations

from pathlib import Path

import click

from touchdown.experiments.cli.common import EXIT_DONE, JSON, OVERRIDES, PATH, CommandGroup, answer
from touchdown.experiments.cli.console import print_margins
from touchdown.experiments.errors import usage_errors


@click.group(cls=CommandGroup)
def control() -> int:
    """The flight controller.

    Example: touchdown control margins
    """
    return EXIT_DONE


@control.command("margins")
@click.option("--config", "config_file", type=PATH, help="A TOML file.")
@OVERRIDES
@JSON
def control_margins(config_file: Path | None, overrides: tuple[str, ...], as_json: bool) -> int:
    """Print gain and phase margin of every control loop, from the linear model.

    Example: touchdown control margins
    """
    import dataclasses

    from touchdown.controller.design import loop_margins
    from touchdown.experiments.config.files import check_named_code
    from touchdown.experiments.config.loading import load_config
    from touchdown.experiments.flight.wiring import build_scene
    from touchdown.sim.airframe.vehicle import vehicle_model

    # No estimator is built.
    config = load_config(config_file, overrides, allow_code=True)
    if config_file is not None:
        check_named_code(config_file, [("scene", config.scene)])
    scene = usage_errors(lambda: build_scene(config))
    margins = loop_margins(vehicle_model(scene.model), config.control)
    rows = [dataclasses.asdict(margin) for margin in margins]
    return answer({"loops": rows}, as_json, lambda found: print_margins(found["loops"]))
