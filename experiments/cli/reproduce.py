"""``touchdown reproduce``: the paper's tables and figures, from one command."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import click

from touchdown.experiments.cli.common import (
    EXIT_DONE,
    EXIT_FAILED,
    JSON,
    PATH,
    QUIET,
    answer,
    interrupt_code,
)


@click.command()
@click.option("--out", type=PATH, metavar="DIR",
              help="Directory; required without --list. An earlier one is continued.")  # fmt: skip
@click.option("--quick", is_flag=True, help="Few flights and one small network.")
@click.option("--jobs", type=click.IntRange(1, 1024), help="Flights at a time.  [cores]")
@click.option("--skip", multiple=True, metavar="PART",
              help="Leave a part out, such as recognition. May be repeated.")  # fmt: skip
@click.option("--photographs", multiple=True, metavar="[KIND=]DIR",
              help="Train the networks on these labelled photographs too, as --data of "
              "touchdown train. May be repeated.")  # fmt: skip
@click.option("--list", "only_list", is_flag=True,
              help="Print the parts, their tables and figures, and approximate times.")  # fmt: skip
@JSON
@QUIET
def reproduce(
    out: Path | None,
    quick: bool,
    jobs: int | None,
    skip: tuple[str, ...],
    photographs: tuple[str, ...],
    only_list: bool,
    as_json: bool,
    quiet: bool,
) -> int:
    """Reproduce all tables and figures of the paper and compare them with the published ones.

    Calibrates, flies the campaigns of positioning and landing, trains networks, and writes
    DIR/report: report.html (one file, no network needed), report.md and report.json. It may be
    interrupted at any time; the same command resumes it, and without --quick extends a quick
    edition to a whole one. Exit code 1 means that a part failed its purpose, 2 invalid input.

    Example: touchdown reproduce --out runs/reproduction --quick
    """
    from touchdown.experiments.campaign.progress import Display
    from touchdown.experiments.campaign.session import Watcher, default_jobs
    from touchdown.experiments.reproduce.report import figures_of
    from touchdown.experiments.reproduce.run import overview
    from touchdown.experiments.reproduce.run import reproduce as run
    from touchdown.experiments.reproduce.state import REPORT
    from touchdown.experiments.terminal import make_notes

    jobs = jobs or default_jobs()
    if only_list:
        _print_list(overview(quick=quick, jobs=jobs, skip=skip, photographs=photographs), as_json)
        return EXIT_DONE
    if out is None:
        raise click.UsageError("missing option '--out'", click.get_current_context())
    try:
        done = run(
            out,
            quick=quick,
            jobs=jobs,
            skip=skip,
            photographs=photographs,
            notes=make_notes(quiet),
            watcher=Watcher if quiet else Display,
        )
    except KeyboardInterrupt as error:
        print(
            "touchdown: stopped; finished parts are kept, and the same command resumes the rest",
            file=sys.stderr,
        )
        return interrupt_code(error)
    figures = figures_of(done, out / REPORT)
    answer(figures, as_json, _print_parts)
    return EXIT_DONE if done.successful else EXIT_FAILED


def _print_list(parts: Sequence[Mapping[str, Any]], as_json: bool) -> None:
    if as_json:
        click.echo(json.dumps({"parts": parts}, indent=2))
        return
    for part in parts:
        minutes = part["core_minutes"]
        click.echo(f"{part['part']:15} {minutes:8.1f} min of one core   {', '.join(part['shows'])}")
    click.echo(f"{'together':15} {sum(p['core_minutes'] for p in parts):8.1f} min of one core")


def _print_parts(figures: Mapping[str, Any]) -> None:
    for part in figures["parts"]:
        verdict = "done" if part["good"] else f"FAILED: {part['why']}"
        click.echo(f"{part['part']:15} {part['edition']:6} {part['wall_s']:8.0f} s  {verdict}")
    for name in figures["skipped"]:
        click.echo(f"{name:15} left out")
    for path in figures["files"].values():
        click.echo(f"written: {path}")
