"""``touchdown results``: the flights and the tables of README and the results pages."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from touchdown.experiments.cli.common import (
    EXIT_DONE,
    EXIT_FAILED,
    JSON,
    PATH,
    QUIET,
    interrupt_code,
)
from touchdown.experiments.terminal import say

if TYPE_CHECKING:
    from touchdown.experiments.campaign.forecast import Forecast


@click.command()
@click.option("--out", type=PATH, metavar="DIR", required=True,
              help="Directory of the flights; an earlier one is continued.")  # fmt: skip
@click.option("--profile", type=click.Choice(["field", "ideal"]), default="field",
              show_default=True, help="The sets of which world.")  # fmt: skip
@click.option("--only", multiple=True, metavar="NAME",
              help="One set: landings, positioning, blind or short. May be repeated.")  # fmt: skip
@click.option("--write", is_flag=True,
              help="Write docs/results/results.json and the tables of the pages.")  # fmt: skip
@click.option("--dry-run", is_flag=True, help="Print what it would cost, and fly nothing.")
@click.option("--jobs", type=click.IntRange(1, 1024), help="Flights at a time.  [cores]")
@JSON
@QUIET
def results(
    out: Path,
    profile: str,
    only: tuple[str, ...],
    write: bool,
    dry_run: bool,
    jobs: int | None,
    as_json: bool,
    quiet: bool,
) -> int:
    """Fly what README and the results pages print, and write their tables.

    Of a git checkout of Touchdown, without changes that are not committed. It may be interrupted at
    any time; the same command resumes it. --write takes rows of one revision only, which the pages
    state. Exit code 1 means that a flight has no outcome, 2 invalid input.

    Example: touchdown results --out runs/results --write
    """
    from touchdown.experiments.campaign.progress import Display
    from touchdown.experiments.campaign.session import Watcher
    from touchdown.experiments.results_tables.pages import write_pages
    from touchdown.experiments.results_tables.sets import chosen, fly, forecasts

    sets = chosen(profile, only)
    todo = forecasts(sets, out, jobs)
    if dry_run:
        _print_costs(todo, as_json)
        return EXIT_DONE
    if not quiet:
        _print_costs(todo, as_json=False, err=True)
    try:
        summaries = fly(sets, out, jobs, Watcher if quiet else Display)
    except KeyboardInterrupt as error:
        print(
            "touchdown: stopped; finished flights are kept, and the same command resumes the rest",
            file=sys.stderr,
        )
        return interrupt_code(error)
    incomplete = any(found["missing"] for found in summaries)
    if write and incomplete:
        say(
            "touchdown: flights are missing, so nothing is written; the same command flies them",
            err=True,
        )
    files = [str(file) for file in write_pages(sets, out)] if write and not incomplete else []
    if as_json:
        click.echo(json.dumps({"sets": summaries, "written": files}, indent=2))
    else:
        for found in summaries:
            counts = ", ".join(f"{name} {n}" for name, n in found["outcomes"].items())
            say(f"{found['directory']}: {found['finished']} of {found['runs']} flights; {counts}")
        for file in files:
            say(f"written: {file}")
    return EXIT_FAILED if any(f["crashed"] or f["missing"] for f in summaries) else EXIT_DONE


def _print_costs(found: Sequence[Forecast], as_json: bool, *, err: bool = False) -> None:
    """Flights and expected CPU time of each set by condition, then of all."""
    from touchdown.experiments.campaign.forecast import lines

    left = sum(one.flights - one.finished for one in found)
    hours, wall_min = sum(one.core_hours for one in found), sum(one.wall_s for one in found) / 60.0
    if as_json:
        tree = {"sets": [one.as_json() for one in found], "left": left, "core_hours": hours}
        click.echo(json.dumps(tree, indent=2))
        return
    for one in found:
        say("\n".join(lines(one)), err=err)
    say(f"together: {left} flights, {hours:.2f} core-hours, about {wall_min:.0f} min here", err=err)
