"""Commands for many flights: ``touchdown campaign ...``."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

import click

from touchdown.experiments.cli.common import (
    EXIT_DONE,
    EXIT_FAILED,
    JSON,
    OVERRIDES,
    PATH,
    QUIET,
    CommandGroup,
    answer,
    interrupt_code,
)
from touchdown.experiments.errors import visible


class ShardType(click.ParamType):
    """``I/N``: the I-th of N parts, from 1."""

    name = "I/N"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[int, int]:
        if isinstance(value, tuple):
            return value
        found = re.fullmatch(r"(\d+)/(\d+)", str(value))
        if not found or not 1 <= int(found[1]) <= int(found[2]):
            self.fail(f"'{value}' is not of the form I/N, such as 1/4 to 4/4", param, ctx)
        return int(found[1]), int(found[2])


class CampaignGroup(CommandGroup):
    """Runs ``campaign FILE.toml`` where the first argument is no subcommand."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        if not args:
            raise click.UsageError("missing argument 'FILE.toml', or 'status DIR'", ctx)
        if args[0].startswith("-") and args[0] not in ctx.help_option_names:
            args = ["--", *args]  # options of the flight, before the file
        return super().parse_args(ctx, args)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        if args and args[0] not in self.commands and _is_flight(args):
            return "", fly_file, args
        return super().resolve_command(ctx, args)

    def format_help(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        fly_file.format_help(ctx, formatter)
        formatter.write_paragraph()
        formatter.write_text("See also `touchdown campaign status DIR`.")


def _is_flight(args: list[str]) -> bool:
    return args[0].startswith("-") or bool(re.search(r"[./]", args[0])) or "--out" in args


@click.group(cls=CampaignGroup)
def campaign() -> int:
    """Fly scenes x estimators x seeds x winds.

    Example: touchdown campaign configs/positioning.toml --out runs/positioning
    """
    return EXIT_DONE


@click.command("campaign")
@click.argument("file", type=PATH, metavar="FILE.toml")
@click.option("--out", type=PATH, metavar="DIR",
              help="The campaign's directory; an existing one is resumed.")  # fmt: skip
@click.option("--jobs", type=click.IntRange(1, 1024), help="Flights at a time.  [cores]")
@click.option("--engine", type=click.Choice(["local", "ray"]), default="local", show_default=True)
@click.option("--ray-address", metavar="ADDRESS", help="Of a Ray cluster.  [a local one]")
@click.option("--shard", type=ShardType(), help="Fly the I-th of N parts, on one of N machines.")
@click.option("--allow-code", is_flag=True,
              help="Import external estimators that a campaign.toml of results names.")  # fmt: skip
@click.option("--preset", type=click.Choice(["whole", "short"]),
              help="How much each run flies: short is one leg of 12 m.  [whole]")  # fmt: skip
@OVERRIDES
@click.option("--dry-run", is_flag=True,
              help="Print the number of flights and their expected cost; fly nothing.")  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print the summary as one JSON object.")
@QUIET
@click.pass_context
def fly_file(
    context: click.Context,
    file: Path,
    out: Path | None,
    shard: tuple[int, int] | None,
    allow_code: bool,
    **more: Any,
) -> int:
    """Fly all runs of FILE.toml: scenes x estimators x seeds x winds, in parallel.

    Every run becomes a directory below DIR/runs, and a row of DIR/results.parquet. It may be
    interrupted at any time; the same command resumes it. Exit code 0 means that every run has an
    outcome, as the file expects it, 1 that some have not, 2 invalid input. --dry-run flies and
    writes nothing.

    Example: touchdown campaign configs/positioning.toml --out runs/positioning --jobs 2
    """
    from touchdown.experiments.campaign.forecast import forecast, lines
    from touchdown.experiments.campaign.plan import load_plan, runs_of_shard
    from touchdown.experiments.campaign.progress import Display, print_summary
    from touchdown.experiments.campaign.session import (
        Watcher,
        default_jobs,
        fly_campaign,
        make_engine,
    )

    plan = load_plan(file, allow_code=allow_code, preset=more["preset"],
                     overrides=more["overrides"])  # fmt: skip
    expected = forecast(plan, runs_of_shard(plan, shard), out, more["jobs"] or default_jobs())
    if more["dry_run"]:
        click.echo(json.dumps(expected.as_json(), indent=2) if more["as_json"] else
                   "\n".join(map(visible, lines(expected))))  # fmt: skip
        return EXIT_DONE
    if out is None:
        raise click.MissingParameter(ctx=context, param_hint="'--out'", param_type="option")
    flown_by = make_engine(more["engine"], more["jobs"], more["ray_address"])
    watcher = Watcher() if more["quiet"] else Display(lines(expected))
    try:
        figures = fly_campaign(plan, out, flown_by, shard=shard, watcher=watcher)
    except KeyboardInterrupt as error:
        print(
            "touchdown: stopped; finished runs are kept, and the same command resumes the "
            f"campaign (see 'touchdown campaign status {out}')",
            file=sys.stderr,
        )
        return interrupt_code(error)
    answer(figures, more["as_json"], print_summary)
    if missing := figures["missing"]:
        print(
            f"touchdown: {len(missing)} runs have no row, such as {missing[0]}; give the same "
            "command again to fly them",
            file=sys.stderr,
        )
    failed = figures["crashed"] or missing or not figures["as_expected"]
    return EXIT_FAILED if failed else EXIT_DONE


@campaign.command("status")
@click.argument("directory", type=PATH, metavar="DIR")
@JSON
def status(directory: Path, as_json: bool) -> int:
    """Print the progress of the campaign in DIR and its time by stage, also while it runs. Exit
    code 1 means that some results are not as its file expects.

    Example: touchdown campaign status runs/positioning
    """
    from touchdown.experiments.campaign.progress import print_summary
    from touchdown.experiments.campaign.session import summary

    figures = summary(directory)
    answer(figures, as_json, print_summary)
    return EXIT_DONE if figures["as_expected"] else EXIT_FAILED
