"""Command ``touchdown bench tune``."""

import math
from pathlib import Path
from typing import Any

import click

from touchdown.experiments.cli.common import PATH, QUIET, SEED, Number, answered
from touchdown.experiments.terminal import say


def _print(figures: dict[str, Any]) -> None:
    logs = ", ".join(f"{log['scene']} {log['seed']}" for log in figures["logs"])
    say(
        f"{figures['estimator']}: {figures['trials']} trials of {len(figures['keys'])} keys, {logs}"
    )
    say(f"as shipped  {figures['default_error_m']:.4f} m")
    say(f"best        {figures['best_error_m']:.4f} m")
    for key, value in figures["best_settings"].items():
        say(f"  {key} = {value}  (as shipped {figures['default_settings'][key]})")
    for log in figures.get("check", ()):
        errors = f"{log['default_error_m']:.4f} m as shipped, {log['best_error_m']:.4f} m"
        say(f"check {log['scene']} {log['seed']}: {errors}")


@click.command("tune")
@click.argument("estimator")
@click.argument("logs", nargs=-1, required=True, type=PATH)
@click.option("--trials", type=click.IntRange(1, 10000), default=40, show_default=True,
              help="Settings that are tried; the first is what is shipped.")  # fmt: skip
@click.option("--space", "space_file", type=PATH, metavar="FILE",
              help="TOML of the keys to vary, a table an estimator.  [that shipped]")  # fmt: skip
@click.option("--until", "until_s", type=Number(min=1.0), metavar="SECONDS",
              help="Time at which each replay ends.  [its log's end]")  # fmt: skip
@click.option("--check", multiple=True, type=PATH, metavar="LOG",
              help="Try the first and the best on a further log. May be repeated.")  # fmt: skip
@click.option("--out", type=PATH, metavar="FILE",
              help="JSON of the result and all trials; one that is there goes on.")  # fmt: skip
@SEED
@answered(_print)
@QUIET
def bench_tune(
    estimator: str,
    logs: tuple[Path, ...],
    space_file: Path | None,
    until_s: float | None,
    check: tuple[Path, ...],
    quiet: bool,
    **options: Any,
) -> dict[str, Any]:
    """Find settings of an estimator by replays of LOGS, run directories flown with --log-sensors:
    those of the smallest geometric mean of the position errors. A replay that diverges counts as
    50 m. The logs are held in memory. Needs the extra `tune`.

    Example: touchdown bench tune optical_flow runs/log --check runs/other --out tune.json
    """
    from touchdown.experiments.benchmarks import tuning

    figures = tuning.tune(
        estimator, logs, space=tuning.read_space(estimator, space_file),
        until_s=math.inf if until_s is None else until_s,
        report=lambda text: None if quiet else say(text, err=True), **options,
    )  # fmt: skip
    if check:
        figures = tuning.checked(figures, check)
        tuning.write(options["out"], figures)
    return figures
