"""``touchdown bench profile``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from touchdown.experiments.cli.common import EXIT_DONE, SEED
from touchdown.experiments.errors import UsageError, usage_errors
from touchdown.experiments.terminal import say


@click.command("profile")
@click.argument("scene", default="crossroad")
@click.option("--estimator", default="livo", show_default=True)
@click.option("--profile", default="field", show_default=True)
@click.option("--seed", type=SEED, default=0, show_default=True)
@click.option("--full", is_flag=True, help="The whole survey instead of a short one.")
@click.option("--stage", "more", multiple=True, metavar="MODULE:NAME",
              help="Another function as a stage of its own; repeatable.")  # fmt: skip
@click.option("--out", type=click.Path(path_type=Path), default=None, metavar="DIR",
              help="Write stages.json and, with py-spy, flame.svg there.")  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
def bench_profile(
    scene: str,
    estimator: str,
    profile: str,
    seed: int,
    full: bool,
    more: tuple[str, ...],
    out: Path | None,
    as_json: bool,
) -> int:
    """Fly once on one core, without recording: the processor time of each stage, and a flame graph.

    The time of a stage is without that of the stages that it calls. The flame graph needs py-spy
    (pip install py-spy).

    Example: touchdown bench profile forest --out profile
    """
    from touchdown.experiments.benchmarks import flight_profile

    chosen: dict[str, Any] = {
        "scene": scene, "estimator": estimator, "profile": profile, "seed": seed, "full": full,
    }  # fmt: skip

    def measure() -> dict[str, Any]:
        config = flight_profile.profile_config(**chosen)
        for place in more:
            flight_profile.found(place)
        figures = None
        if out is not None:
            if out.exists() and not out.is_dir():
                raise UsageError(f"--out '{out}' is a file: name a directory")
            out.mkdir(parents=True, exist_ok=True)
            again = [scene, "--estimator", estimator, "--profile", profile, "--seed", str(seed)]
            again += [*(["--full"] if full else []), *(f"--stage={place}" for place in more)]
            figures = flight_profile.profile_with_flames(again, out / "flame.svg")
            if figures is None:
                say("no flame graph: py-spy is not installed (pip install py-spy)", err=True)
        figures = figures or flight_profile.profile_flight(config, more)
        if out is not None:
            (out / "stages.json").write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
        return figures

    figures = usage_errors(measure)
    click.echo(json.dumps(figures, indent=2) if as_json else flight_profile.table(figures))
    return EXIT_DONE
