"""The command group `touchdown vehicles`."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click
import numpy as np

from touchdown.experiments.cli.common import (
    JSON,
    PATH,
    VEHICLE_NAMES,
    CommandGroup,
    answer,
    completed,
)
from touchdown.experiments.cli.console import print_margins
from touchdown.experiments.errors import usage_errors
from touchdown.experiments.terminal import say

_NAME = click.argument(
    "vehicle", metavar="NAME|FILE.xml", shell_complete=completed(lambda: VEHICLE_NAMES)
)


@click.group(cls=CommandGroup)
def vehicles() -> None:
    """Vehicles: the shipped ones, checks of own MJCF files, pictures.

    Example: touchdown vehicles check hexarotor
    """


@vehicles.command("list")
@JSON
def vehicles_list(as_json: bool) -> int:
    """Print the shipped vehicles.

    Example: touchdown vehicles list
    """
    from touchdown.scenes.api import VEHICLES

    def show(found: Mapping[str, str]) -> None:
        say("\n".join(f"{name:16} {what}" for name, what in found.items()))

    return answer(dict(VEHICLES), as_json, show)


@vehicles.command("check")
@_NAME
@JSON
def vehicles_check(vehicle: str, as_json: bool) -> int:
    """Check that a vehicle can fly and land, and print its gains, their margins and its limits.

    What is wrong with a file is one line, with exit code 2.

    Example: touchdown vehicles check my_vehicle.xml
    """
    from touchdown.controller.design import angular_authority
    from touchdown.experiments.config.vehicles import examined, values_of

    found = examined(vehicle)
    model, count = found.vehicle, len(found.vehicle.rotor_spin)
    thrust = count * model.thrust_coefficient * model.rotor_speed_max**2
    figures = {
        "vehicle": vehicle,
        "mass_kg": model.mass_kg,
        "inertia_kgm2": model.inertia_kgm2.tolist(),
        "rotors": count,
        "thrust_over_weight": thrust / (model.mass_kg * 9.81),
        "angular_acceleration_radps2": angular_authority(model).tolist(),
        "limits": {
            "tilt_deg": found.max_tilt_deg,
            "jerk_mps3": round(found.max_jerk_mps3, 2),
            "descent_mps": found.max_descent_mps,
            "slope_deg": found.max_slope_deg,
        },
        "keys": values_of(found, {}),
        "loops": [dataclasses.asdict(margin) for margin in found.margins],
    }

    def show(_figures: Mapping[str, Any]) -> None:
        moments = ", ".join(f"{moment:.3g}" for moment in model.inertia_kgm2)
        rolls = ", ".join(f"{one:.3g}" for one in figures["angular_acceleration_radps2"])
        say(f"{vehicle}: {model.mass_kg:.3g} kg, inertia {moments} kg m^2, {count} rotors")
        say(f"thrust / weight {figures['thrust_over_weight']:.2f}; angular acceleration in hover "
            f"{rolls} rad/s^2 (roll, pitch, yaw)")  # fmt: skip
        say("limits: " + ", ".join(f"{k} {v:g}" for k, v in figures["limits"].items()))
        say("keys: " + (", ".join(f"{k}={_short(v)}" for k, v in figures["keys"].items())
                        or "the defaults"))  # fmt: skip
        print_margins(figures)

    return answer(figures, as_json, show)


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


@vehicles.command("render")
@_NAME
@click.option("--out", type=PATH, help="PNG file.  [NAME.png]")
@JSON
def vehicles_render(vehicle: str, out: Path | None, as_json: bool) -> int:
    """Write a picture of a vehicle on the ground.

    Example: touchdown vehicles render coaxial_x8 --out x8.png
    """
    from touchdown.experiments.config.vehicles import examined
    from touchdown.experiments.io.images import write_png
    from touchdown.scenes.api import Guests
    from touchdown.scenes.compose import load_scene
    from touchdown.scenes.render import render_vehicle

    examined(vehicle)
    scene = load_scene("flat", 0, guests=Guests(vehicle=vehicle))
    target = out or Path(f"{Path(vehicle).stem}.png")
    usage_errors(lambda: write_png(target, np.asarray(render_vehicle(scene))))
    return answer({"picture": str(target)}, as_json, lambda done: say(done["picture"]))
