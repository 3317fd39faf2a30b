"""``touchdown bench all`` and ``touchdown bench compare``."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from touchdown.experiments.cli.common import EXIT_DONE
from touchdown.experiments.errors import usage_errors
from touchdown.experiments.terminal import say

ROUNDS = click.IntRange(1, 100)


@click.command("all")
@click.option("--rounds", type=ROUNDS, default=1, show_default=True, help="Medians are printed.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
def bench_all(rounds: int, as_json: bool) -> int:
    """Measure what a flight costs: two landings as a worker flies them, the real-time factor with
    recording, the LIDAR beside other ray casters, the choice of a site.

    Example: touchdown bench all --json
    """
    import touchdown

    return _measure([Path(touchdown.__file__).parents[2]], rounds, as_json)


@click.command("compare")
@click.argument("a", type=click.Path(path_type=Path))
@click.argument("b", type=click.Path(path_type=Path))
@click.option("--rounds", type=ROUNDS, default=1, show_default=True, help="Medians are printed.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
def bench_compare(a: Path, b: Path, rounds: int, as_json: bool) -> int:
    """Run the measures of `bench all` on the checkouts A and B in turns, in this environment.

    Example: touchdown bench compare ../touchdown-before .
    """
    return _measure([a, b], rounds, as_json)


def _measure(trees: Sequence[Path], rounds: int, as_json: bool) -> int:
    from touchdown.experiments.benchmarks.all_measures import Figures, measure_all

    found: list[Figures] = []

    def run() -> None:
        for name, figures in measure_all(trees, rounds):
            found.extend(figures)
            if as_json:
                say(f"bench {name}: done", err=True)
                continue
            for one in figures:
                click.echo(_line(one))

    usage_errors(run)
    if as_json:
        click.echo(json.dumps(as_plain(found), indent=2))
    return EXIT_DONE


def as_plain(found: Sequence[Any]) -> dict[str, Any]:
    """Figures by title: unit, values of the checkouts, and the last over the first of two."""
    return {
        one.measure.title: {"unit": one.measure.unit, "values": list(one.values)}
        | ({"ratio": one.ratio} if len(one.values) > 1 else {})
        for one in found
    }


def _line(one: Any) -> str:
    values = "".join("         -" if v is None else f"{v:10.3g}" for v in one.values)
    ratio = f"  x {one.ratio:.2f}" if len(one.values) > 1 and one.ratio is not None else ""
    return f"{one.measure.title:38}{values} {one.measure.unit}{ratio}"
